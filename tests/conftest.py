"""Settings that hold for every test. They must stand before the first import of JAX or matplotlib."""

from __future__ import annotations

import os

from hypothesis import settings

# A rank mismatch that JAX would broadcast silently is a bug here, so it is an error in the suite.
os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
os.environ["MPLBACKEND"] = "Agg"

# No deadline: the first example pays for compilation. In CI the examples are the same in every run.
settings.register_profile("local", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")
