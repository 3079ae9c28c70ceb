"""Problems as data: teams, worlds, observations and trajectories, checks of them, files and names."""
