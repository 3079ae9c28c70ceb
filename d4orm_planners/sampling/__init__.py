"""Common parts of MPPI, CEM, MBD, i-MBD and D4orm: noise schedules, weights and the loop over iterations."""
