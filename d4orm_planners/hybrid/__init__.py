"""The planner to recommend: path finding where it helps, D4orm where ways conflict, anytime improvement."""
