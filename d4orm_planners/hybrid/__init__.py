"""The planner to recommend: path finding where it helps, D4orm where paths conflict, anytime improvement."""
