"""Comparing policies: studies of trials, their store, and what they come to."""
