"""Sampling engines: samples drawn, rolled out, scored and averaged, on the CPU and in JAX."""
