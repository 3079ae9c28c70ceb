"""AMSwarm: receding-horizon planning by alternating minimisation, every robot for itself."""
