"""The step of a tile of worlds, compiled with numba from the scalar functions of :mod:`d4orm_env.core`.

A tile is a block of :data:`TILE` worlds (samples of a plan, or environments) that differ in their numbers only. All a
tile needs lies in one flat float32 array, the workspace: for every robot :data:`ROWS` rows, every row one number per
world. So every inner loop runs over worlds with distances between its operands that the compiler knows, which is what
lets it vectorise without checking for overlap, and the tile stays in cache while all robots and pairs are visited.
Who is near what is kept apart, in ``near`` ``(K, 2)``: a bit for every world.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Protocol, TypeAlias, TypeVar

import numba
import numpy as np
from numba.extending import register_jitable
from numba.np.unsafe import ndarray
from numpy.typing import NDArray

from d4orm_env.core import collision, reward, robot_model, transition
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.dynamics import COMMON, MODEL_CODES, MODELS, model_digest
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.robot_model import (
    MOVED,
    Model,
    ModelFunction,
    ModelFunctions,
    Ops,
    RungeKutta,
    TimeStep,
    Vector,
    runge_kutta,
)
from d4orm_env.engine.lanes import TILE, at_most, use_wide_registers, within_2, within_3

ZERO = np.float32(0)
ONE = np.float32(1)

# First rows of a robot in the workspace. A power of two in all would map the same row of every robot to the same cache
# set.
STATE, CONTROL, GOAL, DOCKED, DISTANCE2, SPARE, ROWS = 0, 6, 10, 13, 14, 15, 17
STRIDE = ROWS * TILE

# Columns of ``near``.
ROBOT, OBSTACLE = 0, 1
NOWHERE = np.uint64(0)

Row: TypeAlias = tuple[np.float32, ...]
"""A state, a control, limits, a place or a velocity of one robot in one world."""
Docking: TypeAlias = tuple[np.float32, np.float32, np.bool_]
"""Squares of the goal radius and of the goal speed, and whether who has arrived stands there for ever."""
Mover: TypeAlias = Callable[[bool, Row, Row, Row, TimeStep], Row]
Docker: TypeAlias = Callable[[bool, Row, Row, Row, Row, Docking], tuple[Row, np.float32, bool]]
RobotMover: TypeAlias = Callable[[ProblemArrays, int, FloatArray], None]
MotionReader: TypeAlias = Callable[[ProblemArrays, int, int, FloatArray, FloatArray, FloatArray], None]

F = TypeVar("F", bound=Callable[..., object])


class Compiler(Protocol):
    """A decorator that compiles a function, which otherwise stays what it is."""

    def __call__(self, function: F, /) -> F: ...


OPTIONS: dict[str, Any] = {"error_model": "numpy"}
"""No fast mathematics: only what IEEE 754 defines to the bit, in the order in which it is written. Multiply-adds do not
fuse, sums are not regrouped, nothing is estimated; so a kernel gives the same bits on every processor, however wide its
registers. What it costs is measured in docs/performance.md."""

UNCOUNTED = OPTIONS | {"_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""For everything that kernels call: without numba's reference counts, which would cost more than the sums they
surround, and without what Python would call them by, which takes a fifth to a third of the time of compiling. Such
functions cannot make arrays, and a call from Python ends the process: tests call them from compiled functions."""

compiled: Compiler = numba.njit(nogil=True, **UNCOUNTED)

INLINED = UNCOUNTED | {"forceinline": True}
"""For functions that take functions (a model, ``Ops``): inlining leaves no function pointer behind, so that numba can
keep the kernels on disk. And for those that take a problem's arrays, which are a long argument to pass by value."""

inlined: Compiler = numba.njit(nogil=True, **INLINED)

for _function in (
    robot_model.norm_scale,
    robot_model.control_scale,
    robot_model.clip,
    robot_model.stopping_speed,
    robot_model.share,
    robot_model.planar_approach,
    robot_model.first_order_approach,
    robot_model.turn_towards,
    robot_model.runge_kutta,
    transition.advance,
    transition.arrives,
    transition.stands,
    collision.axis_gap,
    collision.leaves,
    collision.meets_edge,
    collision.lies_left,
    collision.meets_triangle,
    reward.step_reward,
):
    # Lets compiled code call the core's plain Python functions, which stay as they are for everyone else.
    register_jitable(**INLINED)(_function)


to_fixed_tuple: Callable[..., Row] = ndarray.to_fixed_tuple
"""Its calls in compiled code lack the first argument, which type checkers cannot know."""


@register_jitable(nogil=True, **OPTIONS)
def aligned_zeros(size: int) -> FloatArray:
    """A flat float32 array that begins with a cache line, so that no vector load touches two."""
    space = np.zeros(size + 16, np.float32)
    first = np.int64(-(space.ctypes.data // 4) % 16)
    return space[first : first + size]


@compiled
def _sqrt(x: float) -> float:
    return math.sqrt(x)


@compiled
def _minimum(a: np.float32, b: np.float32) -> np.float32:
    return a if a < b else b


@compiled
def _maximum(a: np.float32, b: np.float32) -> np.float32:
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


OPS = Ops(cosine, sine, _sqrt, _minimum, _maximum, arctan2, _where)


# Tuples of two to six numbers: consecutive rows of the workspace from offset ``o``, in world ``s``. Written out,
# because the vectoriser gives up on loops over tuples.


@compiled
def _read2(w: FloatArray, o: int, s: int) -> Row:
    return (w[o + s], w[o + TILE + s])


@compiled
def _read3(w: FloatArray, o: int, s: int) -> Row:
    return (w[o + s], w[o + TILE + s], w[o + 2 * TILE + s])


@compiled
def _read4(w: FloatArray, o: int, s: int) -> Row:
    return _read2(w, o, s) + _read2(w, o + 2 * TILE, s)


@compiled
def _read5(w: FloatArray, o: int, s: int) -> Row:
    return _read2(w, o, s) + _read3(w, o + 2 * TILE, s)


@compiled
def _read6(w: FloatArray, o: int, s: int) -> Row:
    return _read3(w, o, s) + _read3(w, o + 3 * TILE, s)


@compiled
def _write2(w: FloatArray, o: int, s: int, x: Row) -> None:
    w[o + s] = x[0]
    w[o + TILE + s] = x[1]


@compiled
def _write3(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write2(w, o, s, x)
    w[o + 2 * TILE + s] = x[2]


@compiled
def _write4(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write3(w, o, s, x)
    w[o + 3 * TILE + s] = x[3]


@compiled
def _write5(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write4(w, o, s, x)
    w[o + 4 * TILE + s] = x[4]


@compiled
def _write6(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write4(w, o, s, x)
    w[o + 4 * TILE + s] = x[4]
    w[o + 5 * TILE + s] = x[5]


@compiled
def _pick2(first: bool, x: Row, y: Row) -> Row:
    return (x[0] if first else y[0], x[1] if first else y[1])


@compiled
def _pick3(first: bool, x: Row, y: Row) -> Row:
    return (x[0] if first else y[0], x[1] if first else y[1], x[2] if first else y[2])


@compiled
def _pick4(first: bool, x: Row, y: Row) -> Row:
    return _pick2(first, x, y) + _pick2(first, (x[2], x[3]), (y[2], y[3]))


@compiled
def _pick5(first: bool, x: Row, y: Row) -> Row:
    return _pick2(first, x, y) + _pick3(first, (x[2], x[3], x[4]), (y[2], y[3], y[4]))


@compiled
def _pick6(first: bool, x: Row, y: Row) -> Row:
    return _pick3(first, x, y) + _pick3(first, (x[3], x[4], x[5]), (y[3], y[4], y[5]))


@compiled
def _squared_norm2(v: Row) -> np.float32:
    return v[0] * v[0] + v[1] * v[1]


@compiled
def _squared_norm3(v: Row) -> np.float32:
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@compiled
def _squared_gap2(x: Row, y: Row) -> np.float32:
    return _squared_norm2((x[0] - y[0], x[1] - y[1]))


@compiled
def _squared_gap3(x: Row, y: Row) -> np.float32:
    return _squared_norm3((x[0] - y[0], x[1] - y[1], x[2] - y[2]))


READ = {2: _read2, 3: _read3, 4: _read4, 5: _read5, 6: _read6}
WRITE = {2: _write2, 3: _write3, 4: _write4, 5: _write5, 6: _write6}
_PICK = {2: _pick2, 3: _pick3, 4: _pick4, 5: _pick5, 6: _pick6}
_SQUARED_NORM = {2: _squared_norm2, 3: _squared_norm3}
SQUARED_GAP = {2: _squared_gap2, 3: _squared_gap3}


def _integrator(function: ModelFunction) -> ModelFunction:
    """The function itself, or in scalar style what :class:`RungeKutta` computes."""
    if not isinstance(function, RungeKutta):
        return function
    derivative, moved = inlined(function.derivative), inlined(MOVED[function.state_size])

    def integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
        return runge_kutta(derivative, moved, x, u, limits, h, ops)

    return integrate


def models_of_kernel(models: tuple[str, ...]) -> tuple[str, ...]:
    """Models that a kernel for a team of these is compiled for, in the order of their codes.

    Every model has kernels of its own, because compiling takes seconds a model; mixed teams of common models share
    those for all of these that have their dimension.
    """
    different = set(models)
    if len(different) > 1 and different <= set(COMMON):
        dimension = MODELS[models[0]].dimension
        different = {name for name in COMMON if MODELS[name].dimension == dimension}
    return tuple(sorted(different, key=MODEL_CODES.__getitem__))


def models_key(sources: str, names: tuple[str, ...]) -> str:
    """Key in the cache of a kernel made of these sources and models: the codes are in the kernel too."""
    return f"{sources} {[(name, MODEL_CODES[name], model_digest(MODELS[name])) for name in names]}"


def make_stepper(model: Model) -> tuple[Mover, Docker]:
    """The two halves of the compiled step of one robot of this model in one world, for a control within its limits.

    ``move(standing, x, u, limits, h) -> x`` and ``dock(standing, x, u, limits, goal, docking) -> (x, squared distance
    to the goal, whether docked)``.
    """
    functions = ModelFunctions(*(inlined(_integrator(function)) for function in model.functions))
    pick_x = _PICK[model.state_size]
    squared_norm, squared_gap = _SQUARED_NORM[model.dimension], SQUARED_GAP[model.dimension]

    @inlined
    def move(standing: bool, x: Row, u: Row, limits: Row, h: TimeStep) -> Row:
        return pick_x(standing, x, transition.advance(functions, x, u, limits, h, OPS))

    @inlined
    def dock(standing: bool, x: Row, u: Row, limits: Row, goal: Row, docking: Docking) -> tuple[Row, np.float32, bool]:
        gap2 = squared_gap(x, goal)
        speed2 = squared_norm(functions.velocity(x, u, limits, OPS))
        arrives = transition.arrives(gap2, speed2, docking[0], docking[1])
        docks = transition.stands(arrives, docking[2])
        return pick_x(docks, functions.rest(x, ZERO), x), gap2, standing | arrives

    return move, dock


def _mover(model: Model) -> Callable[..., None]:
    """The compiled step of one robot of this model in every world of a tile.

    It is one long chain of dependent operations. Cut into loops, a core works on more worlds at the same time.
    """
    move, dock = make_stepper(model)
    limit_control = inlined(model.functions.limit_control)
    read_x, write_x = READ[model.state_size], WRITE[model.state_size]
    read_u, write_u, pick_u = READ[model.control_size], WRITE[model.control_size], _PICK[model.control_size]
    read_goal = READ[model.dimension]
    no_control, num_limits = (ZERO,) * model.control_size, len(model.limit_names)

    @compiled
    def run(all_limits: FloatArray, h: TimeStep, docking: Docking, w: FloatArray) -> None:
        use_wide_registers()
        limits = to_fixed_tuple(all_limits, num_limits)
        for s in range(TILE):
            standing = transition.stands(w[DOCKED * TILE + s] > ZERO, docking[2])
            u = limit_control(read_u(w, CONTROL * TILE, s), limits, OPS)
            write_u(w, CONTROL * TILE, s, pick_u(standing, no_control, u))
        for s in range(TILE):
            standing = transition.stands(w[DOCKED * TILE + s] > ZERO, docking[2])
            u = read_u(w, CONTROL * TILE, s)
            write_x(w, STATE * TILE, s, move(standing, read_x(w, STATE * TILE, s), u, limits, h))
        for s in range(TILE):
            standing = transition.stands(w[DOCKED * TILE + s] > ZERO, docking[2])
            x, u = read_x(w, STATE * TILE, s), read_u(w, CONTROL * TILE, s)
            x, gap2, docked = dock(standing, x, u, limits, read_goal(w, GOAL * TILE, s), docking)
            write_x(w, STATE * TILE, s, x)
            w[DOCKED * TILE + s] = ONE if docked else ZERO
            w[DISTANCE2 * TILE + s] = gap2

    return run


def dispatch(branches: Mapping[str, Callable[..., None]]) -> Callable[..., None]:
    """``call(code, *arguments)``: the compiled function of the model with that code, of a table by models' names.

    The codes are those of :data:`~d4orm_env.core.dynamics.MODEL_CODES`. Nothing is done for one not in the table, so
    a kernel is chosen by the codes that it is called with.
    """
    (name, branch), *others = branches.items()
    own_code = MODEL_CODES[name]
    if not others:

        @inlined
        def call_only(code: int, *arguments: object) -> None:
            if code == own_code:
                branch(*arguments)

        return call_only
    rest = dispatch(dict(others))

    @inlined
    def call(code: int, *arguments: object) -> None:
        if code == own_code:
            branch(*arguments)
        else:
            rest(code, *arguments)

    return call


@cache
def robot_mover(names: tuple[str, ...]) -> RobotMover:
    """``move_robot(arrays, k, w)`` for robots of these models.

    It moves robot ``k`` one step in every world of the tile; its control rows hold the executed control afterwards.
    """
    move = dispatch({name: _mover(MODELS[name]) for name in names})

    @inlined
    def move_robot(arrays: ProblemArrays, k: int, w: FloatArray) -> None:
        h = transition.TimeStep(arrays.time_step[0], arrays.time_step[1], arrays.time_step[2], arrays.time_step[3])
        docking = (arrays.squared_goal_radius, arrays.squared_goal_speed, arrays.docks)
        move(arrays.model_codes[k], arrays.limits[k], h, docking, w[k * STRIDE : (k + 1) * STRIDE])

    return move_robot


@inlined
def measure_goal_distance(num_robots: int, dimension: int, w: FloatArray) -> None:
    """Fill the squared distance to the goal from places."""
    for k in range(num_robots):
        robot = w[k * STRIDE : (k + 1) * STRIDE]
        for s in range(TILE):
            total = ZERO
            for axis in range(dimension):
                gap = robot[(STATE + axis) * TILE + s] - robot[(GOAL + axis) * TILE + s]
                total += gap * gap
            robot[DISTANCE2 * TILE + s] = total


@inlined
def near_pair(reach: np.float32, a: int, b: int, dimension: int, w: FloatArray) -> np.uint64:
    """Where two centres, in the rows of ``w`` from ``a`` and from ``b`` on, are within ``reach`` of each other."""
    if dimension == 2:
        return within_2(w, a, b, reach * reach)
    return within_3(w, a, b, reach * reach)


@inlined
def mark_pairs(arrays: ProblemArrays, extra: np.float32, w: FloatArray, near: NDArray[np.uint64]) -> None:
    """Flag every two robots closer than their radii plus ``extra``."""
    for k in range(1, arrays.radius.shape[0]):
        for other in range(k):
            reach = arrays.radius[k] + arrays.radius[other] + extra
            touch = near_pair(reach, k * STRIDE, other * STRIDE, arrays.goal.shape[1], w)
            near[k, ROBOT] |= touch
            near[other, ROBOT] |= touch


@inlined
def near_round(reach: np.float32, centre: FloatArray, axes: int, places: FloatArray, spare: FloatArray) -> np.uint64:
    """Where the first rows of ``places`` are within ``reach`` of a centre, over two or three axes.

    ``spare`` is a row to overwrite.
    """
    if axes == 2:
        point = (centre[0], centre[1])
        for s in range(TILE):
            spare[s] = _squared_gap2(_read2(places, 0, s), point)
    else:
        spot = (centre[0], centre[1], centre[2])
        for s in range(TILE):
            spare[s] = _squared_gap3(_read3(places, 0, s), spot)
    return at_most(spare, 0, reach * reach)


def _motion_reader(model: Model) -> Callable[..., None]:
    velocity_of = inlined(model.functions.velocity)
    read_x, read_u = READ[model.state_size], READ[model.control_size]
    dimension, num_limits = model.dimension, len(model.limit_names)

    @compiled
    def read(all_limits: FloatArray, o: int, s: int, w: FloatArray, velocity: FloatArray) -> None:
        limits = to_fixed_tuple(all_limits, num_limits)
        v = velocity_of(read_x(w, o + STATE * TILE, s), read_u(w, o + CONTROL * TILE, s), limits, OPS)
        for axis in range(dimension):
            velocity[axis] = v[axis]

    return read


@cache
def motion_reader(names: tuple[str, ...]) -> MotionReader:
    """``read_motion(arrays, k, s, w, velocity, heading)`` for robots of these models.

    It fills the velocity ``(d,)`` and the heading's cosine and sine ``(2,)`` of robot ``k`` in world ``s``.
    """
    read_velocity = dispatch({name: _motion_reader(MODELS[name]) for name in names})
    headings = np.full(1 + max(MODEL_CODES[name] for name in names), -1)
    for name in names:
        index = MODELS[name].heading_index
        headings[MODEL_CODES[name]] = -1 if index is None else index

    @inlined
    def read_motion(
        arrays: ProblemArrays, k: int, s: int, w: FloatArray, velocity: FloatArray, heading: FloatArray
    ) -> None:
        code = arrays.model_codes[k]
        read_velocity(code, arrays.limits[k], k * STRIDE, s, w, velocity)
        index = headings[code]
        heading[0] = cosine(w[k * STRIDE + index * TILE + s]) if index >= 0 else ZERO
        heading[1] = sine(w[k * STRIDE + index * TILE + s]) if index >= 0 else ZERO

    return read_motion
