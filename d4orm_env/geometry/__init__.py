"""Obstacles: shapes, polygons and the index that finds the nearest."""
