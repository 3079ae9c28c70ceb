"""Programs to run from the root of the clone, as `python -m examples.step_loop`."""
