"""Robots in processes of their own that plan together while they drive: what ``onboard_lifelong.py`` starts."""
