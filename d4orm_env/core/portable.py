"""Sine, cosine, arc tangent, exponential and logarithm with the same bits on every processor.

NumPy and the C library choose among versions of these functions by the processor's instruction set, and their last
bits differ. These are made of NumPy's elementwise ``+ - * /``, rounding and comparison only, which IEEE 754 defines to
the bit; each operation is a call of its own, so that no compiler can fuse two. All compute in float64, and round to
float32 where every argument is. They are accurate to about 1 ulp over the whole range, and keep IEEE's signs and
special values; what is not finite or outside a function's domain gives infinity or NaN without a warning.

The polynomials and the reduction of arguments are those of fdlibm (Sun Microsystems, 1993).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import Floats
from d4orm_env.dynamics.robot_model import Ops

Real: TypeAlias = Any
"""An array or a number, float32 or float64, whichever the arguments are."""
Part = TypeVar("Part", Floats, float)
Function = Callable[..., Real]

_TWO_OVER_PI = 6.36619772367581382433e-01
_HALF_PI = (
    1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624871116645580e-21, 8.47842766036889956997e-32,
)  # fmt: skip
"""pi/2 in parts; the first three have 33 bits, so that their products with a quadrant below 2**20 are exact."""
_REDUCED_EXACTLY = 2.0**20  # magnitude from which on arguments are reduced in whole numbers, one by one
_PI_BITS = 1200  # the largest float64 has 1024 bits before the point, and 176 are left behind it

_SINE = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04, 2.75573137070700676789e-06,
    -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
_COSINE = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05, -2.75573143513906633035e-07,
    2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip
_EXPONENTIAL = (
    1.66666666666666019037e-01, -2.77777777770155933842e-03, 6.61375632143793436117e-05, -1.65339022054652515390e-06,
    4.13813679705723846039e-08,
)  # fmt: skip
_LOGARITHM = (
    6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01, 2.222219843214978396e-01,
    1.818357216161805012e-01, 1.531383769920937332e-01, 1.479819860511658591e-01,
)  # fmt: skip
_ARC_TANGENT = (
    3.33333333333329318027e-01, -1.99999999998764832476e-01, 1.42857142725034663711e-01, -1.11111104054623557880e-01,
    9.09088713343650656196e-02, -7.69187620504482999495e-02, 6.66107313738753120669e-02, -5.83357013379057348645e-02,
    4.97687799461593236017e-02, -3.65315727442169155270e-02, 1.62858201153657823623e-02,
)  # fmt: skip
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_ONE_OVER_LN2 = 1.44269504088896338700e00
_SQRT_HALF = 7.07106781186547524401e-01
_PI, _PI_LOW = 3.14159265358979311600e00, 1.22464679914735317722e-16

_ARC_LIMITS = (7 / 16, 11 / 16, 19 / 16, 39 / 16)
_ARCS = np.array(
    [
        (0.0, 0.0, 1, 0, 0, 1),
        (4.63647609000806093515e-01, 2.26987774529616870924e-17, 2, -1, 1, 2),
        (7.85398163397448278999e-01, 3.06161699786838301793e-17, 1, -1, 1, 1),
        (9.82793723247329054082e-01, 1.39033110312309984516e-17, 1, -1.5, 1.5, 1),
        (1.57079632679489655800e00, 6.12323399573676603587e-17, 0, -1, 1, 0),
    ]
).T
"""Arc tangents of 0, 1/2, 1, 3/2 and infinity, high and low part, and a to d; the rest is of (a q + b) / (c q + d)."""


def _in_float64(function: Function) -> Function:
    """Compute in float64, in silence, and round to float32 what came in float32."""

    @wraps(function)
    def wrapper(*arguments: ArrayLike) -> Real:
        arrays = [np.asarray(argument) for argument in arguments]
        single = all(array.dtype == np.float32 for array in arrays)
        with np.errstate(all="ignore"):
            result = function(*(array.astype(np.float64, copy=False) for array in arrays))
            if not single:
                return result
            return tuple(map(np.float32, result)) if isinstance(result, tuple) else np.float32(result)

    return wrapper


def sin(x: ArrayLike) -> Real:
    """Sine of ``x`` [rad]."""
    return sin_cos(x)[0]


def cos(x: ArrayLike) -> Real:
    """Cosine of ``x`` [rad]."""
    return sin_cos(x)[1]


@_in_float64
def sin_cos(x: Floats) -> tuple[Floats, Floats]:
    """Sine and cosine of ``x`` [rad], for little more than the price of one."""
    quadrant, high, low = _reduced(x)
    sine, cosine = _sine(high, low), _cosine(high, low)
    swapped = (quadrant & 1).astype(bool)
    first, second = np.where(swapped, cosine, sine), np.where(swapped, sine, cosine)
    first, second = np.where(quadrant & 2, -first, first), np.where((quadrant + 1) & 2, -second, second)
    return np.where(x == 0, x, first)[()], second[()]  # minus zero keeps its sign


def sin_cos_of(x: float) -> tuple[float, float]:
    """:func:`sin_cos` of one number, in a fifteenth of the time."""
    if not abs(x) < _REDUCED_EXACTLY:
        sine, cosine = sin_cos(np.float64(x))
        return float(sine), float(cosine)
    multiple = float(round(x * _TWO_OVER_PI))
    high, low = _remainder(x, multiple)
    quadrant, sine, cosine = int(multiple) & 3, _sine(high, low), _cosine(high, low)
    first, second = (cosine, sine) if quadrant & 1 else (sine, cosine)
    return (-first if quadrant & 2 else first) if x else x, -second if (quadrant + 1) & 2 else second


@_in_float64
def arctan2(y: Floats, x: Floats) -> Floats:
    """Angle of the point ``(x, y)`` [rad], from minus pi to pi."""
    tall, wide = np.abs(y), np.abs(x)
    alike = ((tall == 0) & (wide == 0)) | (np.isinf(tall) & np.isinf(wide))  # where the quotient has no value
    quotient = np.where(alike, np.where(tall == 0, 0.0, 1.0), tall / wide)
    angle = _arc_tangent(quotient)
    angle = np.where(np.signbit(x), _PI - (angle - _PI_LOW), angle)
    return np.copysign(angle, y)[()]


@_in_float64
def exp(x: Floats) -> Floats:
    """The exponential of ``x``."""
    x = np.minimum(np.maximum(x, -800.0), 800.0)  # beyond, the result is zero or infinite anyway; NaN stays
    exponent = np.rint(x * _ONE_OVER_LN2)
    high, low = x - exponent * _LN2_HIGH, exponent * _LN2_LOW
    rest = high - low
    remainder = rest - rest * rest * _polynomial(rest * rest, _EXPONENTIAL)
    mantissa = 1.0 - ((low - (rest * remainder) / (2.0 - remainder)) - high)
    return np.ldexp(mantissa, np.where(np.isnan(x), 0, exponent).astype(np.int32))


@_in_float64
def log(x: Floats) -> Floats:
    """The natural logarithm of ``x``; minus infinity at zero, NaN below."""
    mantissa, power = np.frexp(x)
    small = mantissa < _SQRT_HALF
    exponent = np.where(small, power - 1, power).astype(np.float64)
    f = np.where(small, mantissa + mantissa, mantissa) - 1.0
    s = f / (2.0 + f)
    half_square = 0.5 * f * f
    series = s * s * _polynomial(s * s, _LOGARITHM)
    result = exponent * _LN2_HIGH - ((half_square - (s * (half_square + series) + exponent * _LN2_LOW)) - f)
    result = np.where(x == 0, -np.inf, np.where(x < 0, np.nan, result))
    return np.where(np.isposinf(x), x, result)[()]


def root(value: float, degree: int) -> float:
    """The square root, or one of another degree, of a positive number."""
    return float(np.sqrt(value) if degree == 2 else exp(log(value) / degree))


def standard_normal(generator: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Standard normal numbers of this shape, by the transform of Box and Muller from the generator's uniform ones."""
    uniform = generator.random((2, *shape))
    normal = np.sqrt(-2 * log(1 - uniform[0])) * cos(2 * _PI * uniform[1])
    return np.asarray(normal, np.float32)


NUMPY_OPS = Ops(cos, sin, np.sqrt, np.minimum, np.maximum, arctan2, np.where)
"""Functions that the robot models need, over NumPy arrays."""


def _polynomial(x: Part, coefficients: tuple[float, ...]) -> Part:
    """``coefficients[0] + coefficients[1] * x + ...``, by Horner's rule."""
    total = coefficients[-2] + x * coefficients[-1]
    for coefficient in coefficients[-3::-1]:
        total = coefficient + x * total
    return total


def _sine(high: Part, low: Part) -> Part:
    """Sine of ``high + low`` within a quarter of pi of zero."""
    square = high * high
    cube = square * high
    rest = _polynomial(square, _SINE[1:])
    return high - ((square * (0.5 * low - cube * rest) - low) - cube * _SINE[0])


def _cosine(high: Part, low: Part) -> Part:
    """Cosine of ``high + low`` within a quarter of pi of zero."""
    square = high * high
    half = 0.5 * square
    head = 1.0 - half
    return head + (((1.0 - head) - half) + (square * (square * _polynomial(square, _COSINE)) - high * low))


def _arc_tangent(q: Floats) -> Floats:
    """Arc tangent of ``q >= 0``."""
    q = np.minimum(q, 1e300)  # keeps zero times infinity out of the shift
    index = sum((q >= limit).astype(np.intp) for limit in _ARC_LIMITS)
    high, low, a, b, c, d = (column[index] for column in _ARCS)
    x = (a * q + b) / (c * q + d)
    square = x * x
    return high - ((x * (square * _polynomial(square, _ARC_TANGENT)) - low) - x)


def _reduced(x: Floats) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Nearest multiple of pi/2 as a number of quadrants from 0 to 3, and what is left over, high and low part."""
    huge = ~(np.abs(x) < _REDUCED_EXACTLY)  # NaN too
    some_huge = huge.any()
    small = np.where(huge, 0.0, x) if some_huge else x
    multiple = np.rint(small * _TWO_OVER_PI)
    high, low = _remainder(small, multiple)
    quadrant = multiple.astype(np.int64) & 3
    if some_huge:
        quadrant, high, low = (np.array(part) for part in (quadrant, high, low))
        for position in zip(*np.nonzero(np.atleast_1d(huge)), strict=True):
            where = position if np.ndim(x) else ()
            quadrant[where], high[where], low[where] = _reduced_exactly(float(x[where]))
    return quadrant, high, low


def _remainder(x: Part, multiple: Part) -> tuple[Part, Part]:
    """Rest of ``x`` over a multiple of pi/2, high and low part."""
    rest, first = _difference(x - multiple * _HALF_PI[0], multiple * _HALF_PI[1])
    rest, second = _difference(rest, multiple * _HALF_PI[2])
    error = (first + second) - multiple * _HALF_PI[3]
    high = rest + error
    return high, (rest - high) + error


def _difference(a: Part, b: Part) -> tuple[Part, Part]:
    """``a - b`` rounded, and what rounding lost (Knuth)."""
    result = a - b
    part = result - a
    return result, (a - (result - part)) - (b + part)


def _reduced_exactly(x: float) -> tuple[int, float, float]:
    """Reduce as :func:`_reduced`, for one number of any magnitude, in whole numbers."""
    if not np.isfinite(x):
        return 0, np.nan, 0.0
    numerator, denominator = x.as_integer_ratio()
    half_pi = _scaled_pi() // 2
    scaled = (numerator << _PI_BITS) // denominator
    multiple = (2 * scaled + half_pi) // (2 * half_pi)
    rest = scaled - multiple * half_pi
    high = rest / (1 << _PI_BITS)
    above, below = high.as_integer_ratio()
    return multiple & 3, high, (rest - (above << _PI_BITS) // below) / (1 << _PI_BITS)


@cache
def _scaled_pi() -> int:
    """``floor(pi * 2**_PI_BITS)``, but for the last bits of it, by Machin's formula."""
    guard = 32
    one = 1 << (_PI_BITS + guard)
    return (16 * _scaled_arc_cotangent(5, one) - 4 * _scaled_arc_cotangent(239, one)) >> guard


def _scaled_arc_cotangent(n: int, one: int) -> int:
    power, total, k = one // n, 0, 1
    while power:
        total += power // k if k % 4 == 1 else -(power // k)
        power //= n * n
        k += 2
    return total
