"""Setpoints for robots: smooth motions through plans, sampled or as polynomials, in files."""
