"""Multi-agent path finding on a roadmap, and large-neighbourhood search on what was found."""
