"""The compiled step of one robot in one world, for every model, and the choice between models.

Its numbers are tuples of two to six: consecutive rows of a workspace from offset ``o``, in world ``s``. Reading and
writing them is written out, because the vectoriser gives up on loops over tuples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.winding import Unwinding, unwinding
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import COMMON, MODEL_CODES, MODELS, model_digest
from d4orm_env.dynamics.robot_model import (
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
from d4orm_env.dynamics.source_digest import bytecode
from d4orm_env.engine.compiling import ZERO, compiled, inlined
from d4orm_env.engine.elementary import OPS, cosine, sine
from d4orm_env.engine.simd import TILE

Row: TypeAlias = tuple[np.float32, ...]
"""A state, a control, limits, a position or a velocity of one robot in one world."""


@compiled
def read2(w: FloatArray, o: int, s: int) -> Row:
    return (w[o + s], w[o + TILE + s])


@compiled
def read3(w: FloatArray, o: int, s: int) -> Row:
    return (w[o + s], w[o + TILE + s], w[o + 2 * TILE + s])


@compiled
def _write2(w: FloatArray, o: int, s: int, x: Row) -> None:
    w[o + s] = x[0]
    w[o + TILE + s] = x[1]


@compiled
def _write3(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write2(w, o, s, x)
    w[o + 2 * TILE + s] = x[2]


@compiled
def _pick2(first: bool, x: Row, y: Row) -> Row:
    return (x[0] if first else y[0], x[1] if first else y[1])


@compiled
def _pick3(first: bool, x: Row, y: Row) -> Row:
    return (x[0] if first else y[0], x[1] if first else y[1], x[2] if first else y[2])


@compiled
def _squared_norm2(v: Row) -> np.float32:
    return v[0] * v[0] + v[1] * v[1]


@compiled
def _squared_norm3(v: Row) -> np.float32:
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@compiled
def squared_gap2(x: Row, y: Row) -> np.float32:
    return _squared_norm2((x[0] - y[0], x[1] - y[1]))


@compiled
def squared_gap3(x: Row, y: Row) -> np.float32:
    return _squared_norm3((x[0] - y[0], x[1] - y[1], x[2] - y[2]))


READ: dict[int, Any] = {2: read2, 3: read3}
WRITE: dict[int, Any] = {2: _write2, 3: _write3}
PICK: dict[int, Any] = {2: _pick2, 3: _pick3}
SQUARED_NORM = {2: _squared_norm2, 3: _squared_norm3}
SQUARED_GAP = {2: squared_gap2, 3: squared_gap3}


def _add_size(size: int, rest: int) -> None:
    """Put together the functions of tuples of ``size`` numbers and of the ``rest``."""
    (read, read_rest), (write, write_rest), (pick, pick_rest) = ((of[size], of[rest]) for of in (READ, WRITE, PICK))

    @compiled
    def read_both(w: FloatArray, o: int, s: int) -> Row:
        return read(w, o, s) + read_rest(w, o + size * TILE, s)

    @compiled
    def write_both(w: FloatArray, o: int, s: int, x: Row) -> None:
        write(w, o, s, x)
        write_rest(w, o + size * TILE, s, x[size:])

    @compiled
    def pick_both(first: bool, x: Row, y: Row) -> Row:
        return pick(first, x, y) + pick_rest(first, x[size:], y[size:])

    READ[size + rest], WRITE[size + rest], PICK[size + rest] = read_both, write_both, pick_both


for _sizes in ((2, 2), (2, 3), (3, 3)):
    _add_size(*_sizes)


Six: TypeAlias = tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]
GoalHeading: TypeAlias = tuple[np.bool_ | None, np.float32, np.float32, np.float32, Six | None]
"""``None`` in a team without goal headings, which leaves what they ask for out of a kernel; a robot's own as a unit
vector; the square of the chord by which it may be missed, infinite for none; and likewise its trailers' hitch angles,
zero for any, ``None`` as the first."""
Docking: TypeAlias = tuple[np.float32, np.float32, np.bool_, GoalHeading]
"""Squares of the goal radius and of the goal speed, whether a robot that has arrived stays there for good, and its goal
heading."""
Mover: TypeAlias = Callable[[bool, Row, Row, Row, TimeStep], Row]
Docker: TypeAlias = Callable[[bool, Row, Row, Row, Row, Docking], tuple[Row, np.float32, bool]]


@inlined
def docking_of(arrays: ProblemArrays, k: Whole) -> Docking:
    """Docking conditions of robot ``k``.

    Numbers only: a function without reference counts must not hand out arrays.
    """
    x, y, chord2, hitches = _goal_heading(arrays.goal_direction, arrays.squared_goal_chord, k)
    heading = arrays.turns_at_goals, x, y, chord2, hitches
    return arrays.squared_goal_radius, arrays.squared_goal_speed[k], arrays.docks, heading


@inlined
def _goal_heading(
    directions: FloatArray | None, chords2: Any, k: Whole
) -> tuple[np.float32, np.float32, np.float32, Six | None]:
    if directions is None:
        return ZERO, ZERO, ZERO, None
    own = directions[k]
    return own[0], own[1], chords2[k], (own[2], own[3], own[4], own[5], own[6], own[7])


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


def models_key(names: tuple[str, ...]) -> str:
    """Key in the cache of a kernel for these models: the codes are in the kernel too."""
    return repr([(name, MODEL_CODES[name], model_digest(MODELS[name], bytecode)) for name in names])


def _in_scalar_style(function: ModelFunction) -> ModelFunction:
    """The function itself, or what :class:`RungeKutta` or :class:`Unwinding` computes."""
    if isinstance(function, Unwinding):
        return unwinding(inlined(_in_scalar_style(function.limit_state)), function.index)
    if not isinstance(function, RungeKutta):
        return function
    derivative, moved = inlined(function.derivative), inlined(MOVED[function.state_size])

    def integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
        return runge_kutta(derivative, moved, x, u, limits, h, ops)

    return integrate


@cache
def make_stepper(model: Model) -> tuple[Mover, Docker]:
    """The two halves of the compiled step of one robot of this model in one world, for a control within its limits.

    ``move(at_rest, x, u, limits, h) -> x`` and ``dock(at_rest, x, u, limits, goal, docking) -> (x, squared distance
    to the goal, whether docked)``.
    """
    functions = ModelFunctions(*(inlined(_in_scalar_style(function)) for function in model.functions))
    pick_x = PICK[model.state_size]
    squared_norm, squared_gap = SQUARED_NORM[model.dimension], SQUARED_GAP[model.dimension]
    faces = _facing(model)

    @inlined
    def move(at_rest: bool, x: Row, u: Row, limits: Row, h: TimeStep) -> Row:
        return pick_x(at_rest, x, transition.advance(functions, x, u, limits, h, OPS))

    @inlined
    def dock(at_rest: bool, x: Row, u: Row, limits: Row, goal: Row, docking: Docking) -> tuple[Row, np.float32, bool]:
        gap2 = squared_gap(x, goal)
        speed2 = squared_norm(functions.velocity(x, u, limits, OPS))
        arrives = transition.arrives(gap2, speed2, docking[0], docking[1]) & faces(docking[3][0], x, docking[3])
        docks = transition.absorbed(arrives, docking[2])
        return pick_x(docks, functions.rest(x, ZERO), x), gap2, at_rest | arrives

    return move, dock


def _facing(model: Model) -> Callable[[np.bool_ | None, Row, GoalHeading], bool]:
    """``faces(turns, x, goal heading)``: whether the robot faces its goal heading, if it has one."""
    index = model.heading_index
    if index is None:

        @inlined
        def always(turns: np.bool_ | None, x: Row, heading: GoalHeading) -> bool:
            return True

        return always

    @inlined
    def faces(turns: np.bool_ | None, x: Row, heading: GoalHeading) -> bool:
        if turns is None:
            return True
        # Without a goal heading nothing is computed.
        if heading[3] == np.float32(np.inf):
            return True
        return bool(transition.faces(cosine(x[index]), sine(x[index]), heading[1], heading[2], heading[3]))

    if not model.trailers:
        return faces
    hitches, count = tuple(hitch for hitch, _ in model.trailers), len(model.trailers)

    @inlined
    def bends(turns: np.bool_ | None, x: Row, heading: GoalHeading) -> bool:
        good = faces(turns, x, heading)
        wanted = heading[4]
        if turns is None or wanted is None:
            return good
        for i in range(count):
            c, s, angle = wanted[2 * i], wanted[2 * i + 1], x[hitches[i]]
            if c != ZERO or s != ZERO:
                good = good and bool(transition.faces(cosine(angle), sine(angle), c, s, heading[3]))
        return good

    return bends


def dispatch(branches: Mapping[str, Callable[..., None]]) -> Callable[..., None]:
    """``call(code, *arguments)``: the compiled function of the model with that code, of a table by models' names.

    The codes are those of :data:`~d4orm_env.dynamics.models.MODEL_CODES`. Nothing is done for one not in the table, so
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
