"""What a team does, changed for some robots around all others: faster ways, found by search in space and time."""
