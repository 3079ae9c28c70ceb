"""What MPPI, CEM, MBD, i-MBD and D4orm share: noise schedules, weights and the loop over iterations."""
