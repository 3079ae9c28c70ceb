"""Teams of Crazyflies in crazyflow, a physics that was written elsewhere; extra ``drones``.

crazyflow 0.4.0, https://pypi.org/project/crazyflow: first-principles dynamics of rotors and body, and the Mellinger
controller of the Crazyflie (D. Mellinger and V. Kumar, "Minimum snap trajectory generation and control for quadrotors",
ICRA, 2011), both at 500 Hz.
"""

import contextlib
import io
import os
import sys
from importlib.util import find_spec

if find_spec("crazyflow") is None:
    raise ImportError("drones in flight need crazyflow; install it with: pip install 'd4orm-env[drones]'")
# SciPy looks once, in one of these. numba has imported SciPy by now, but neither of them.
if os.environ.get("SCIPY_ARRAY_API") != "1":
    if {"scipy._lib._array_api", "scipy._lib._array_api_override"} & sys.modules.keys():
        raise ImportError(
            "crazyflow needs SciPy's array API, and SciPy is in use without it already; set the environment variable "
            "SCIPY_ARRAY_API=1, or import d4orm_env.crazyflow first"
        )
    os.environ["SCIPY_ARRAY_API"] = "1"

with contextlib.redirect_stdout(io.StringIO()):  # MJX's own words on libraries that it goes without
    import crazyflow.sim  # noqa: F401

from d4orm_env.crazyflow.environment import DroneBodies, DronePhysics, check_problem, parallel_env
from d4orm_env.crazyflow.flight import FlightRecord

__all__ = ["DroneBodies", "DronePhysics", "FlightRecord", "check_problem", "parallel_env"]
