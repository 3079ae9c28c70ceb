"""Benchmark of the engines, the environments and the planners on this machine."""
