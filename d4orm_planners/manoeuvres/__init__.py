"""Manoeuvres of robots that are no discs or must face somewhere: searched in positions, headings and time."""
