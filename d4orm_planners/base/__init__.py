"""Planners, policies, plans and episodes: what every method shares."""
