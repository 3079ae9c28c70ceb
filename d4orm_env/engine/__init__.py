"""Engines: the same physics compiled for CPUs (numba) and for whatever JAX runs on."""
