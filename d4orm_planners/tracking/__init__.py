"""Tracking: robots driven along references under their own dynamics."""
