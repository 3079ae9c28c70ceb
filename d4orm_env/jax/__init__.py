"""The physics and the environments in JAX."""
