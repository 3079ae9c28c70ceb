"""Shortest free paths to the goals."""
