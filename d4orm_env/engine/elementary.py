"""Elementary functions of float32 for compiled code: they vectorise, and are the same on every processor."""

from __future__ import annotations

import math

import numpy as np

from d4orm_env.dynamics.robot_model import Ops
from d4orm_env.engine.compiling import ONE, ZERO, compiled


@compiled
def sqrt(x: float) -> float:
    return math.sqrt(x)


@compiled
def minimum(a: np.float32, b: np.float32) -> np.float32:
    return a if a < b else b


@compiled
def maximum(a: np.float32, b: np.float32) -> np.float32:
    return a if a > b else b


# Reduction by multiples of pi/2 in two parts (Cody and Waite) and minimax polynomials on [-pi/4, pi/4]. Unlike calls of
# libm these vectorise. Headings stay within a few turns, where the error is below 2e-7.
_TWO_OVER_PI = np.float32(2 / np.pi)
_HALF_PI_HIGH = np.float32(1.5703125)
_HALF_PI_LOW = np.float32(np.pi / 2 - 1.5703125)
_HALF = np.float32(0.5)
_S1, _S2, _S3 = np.float32(-1.6666654611e-1), np.float32(8.3321608736e-3), np.float32(-1.9515295891e-4)
_C1, _C2, _C3 = np.float32(4.166664568298827e-2), np.float32(-1.388731625493765e-3), np.float32(2.443315711809948e-5)


@compiled
def _shifted_sine(x: np.float32, quarters: np.int32) -> np.float32:
    """``sin(x + quarters * pi / 2)``."""
    nearest = np.floor(x * _TWO_OVER_PI + _HALF)
    r = (x - nearest * _HALF_PI_HIGH) - nearest * _HALF_PI_LOW
    r2 = r * r
    sine = r + r * r2 * (_S1 + r2 * (_S2 + r2 * _S3))
    cosine = ONE - _HALF * r2 + r2 * r2 * (_C1 + r2 * (_C2 + r2 * _C3))
    quadrant = np.int32(nearest) + quarters
    value = cosine if (quadrant & np.int32(1)) != np.int32(0) else sine
    return -value if (quadrant & np.int32(2)) != np.int32(0) else value


@compiled
def sine(x: np.float32) -> np.float32:
    return _shifted_sine(x, np.int32(0))


@compiled
def cosine(x: np.float32) -> np.float32:
    return _shifted_sine(x, np.int32(1))


_TAN_PI_8, _QUARTER_PI = np.float32(np.sqrt(2) - 1), np.float32(np.pi / 4)
_HALF_PI, _PI = np.float32(np.pi / 2), np.float32(np.pi)
_A1, _A2, _A3, _A4 = (np.float32(a) for a in (-3.33329491539e-1, 1.99777106478e-1, -1.38776856032e-1, 8.05374449538e-2))


@compiled
def arctan2(y: np.float32, x: np.float32) -> np.float32:
    """Angle of the point ``(x, y)`` to 3e-7 (Cephes, atanf); zero for the origin."""
    wide, tall = abs(x), abs(y)
    larger, smaller = max(wide, tall), min(wide, tall)
    tangent = smaller / (larger if larger > ZERO else ONE)
    beyond = tangent > _TAN_PI_8
    t = (tangent - ONE) / (tangent + ONE) if beyond else tangent
    t2 = t * t
    angle = t + t * t2 * (_A1 + t2 * (_A2 + t2 * (_A3 + t2 * _A4)))
    angle = _QUARTER_PI + angle if beyond else angle
    angle = _HALF_PI - angle if tall > wide else angle
    angle = _PI - angle if x < ZERO else angle
    return -angle if y < ZERO else angle


@compiled
def _where(condition: bool, a: np.float32, b: np.float32) -> np.float32:
    return a if condition else b


OPS = Ops(cosine, sine, sqrt, minimum, maximum, arctan2, _where)
