"""Rivals of the paper: IPOPT, AMSwarm, MMD and ORCA."""
