"""Comparing policies, and how fast the engines, environments and planners are."""
