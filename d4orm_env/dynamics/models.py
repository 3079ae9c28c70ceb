"""Robot models by name: those that come with the package, one file each beside this one, and users'."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import fields
from functools import cache
from itertools import chain, product
from types import FunctionType
from typing import Any

import numpy as np

from d4orm_env.core.arrays import short_repr
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.registry import Registry
from d4orm_env.core.winding import Unwinding
from d4orm_env.dynamics.car import CAR
from d4orm_env.dynamics.differential_drive import DIFFERENTIAL_DRIVE
from d4orm_env.dynamics.first_order_cars import FIRST_ORDER_CARS
from d4orm_env.dynamics.holonomic2d import HOLONOMIC2D
from d4orm_env.dynamics.holonomic2d_jerk import HOLONOMIC2D_JERK
from d4orm_env.dynamics.holonomic3d import HOLONOMIC3D
from d4orm_env.dynamics.holonomic3d_drag import HOLONOMIC3D_DRAG
from d4orm_env.dynamics.robot_model import OWN_LIMITS, PYTHON_OPS, SPEED, Limit, Model, RungeKutta
from d4orm_env.dynamics.source_digest import bytecode, check_formulas, pieces, source_text, with_strict_integers
from d4orm_env.dynamics.transition import TimeStep
from d4orm_env.dynamics.unicycle import UNICYCLE
from d4orm_env.dynamics.unicycle1 import UNICYCLE1
from d4orm_env.dynamics.unicycle2 import UNICYCLE2
from d4orm_env.dynamics.velocity2d import VELOCITY2D

_BUILT_IN = (
    HOLONOMIC2D, HOLONOMIC3D, VELOCITY2D, DIFFERENTIAL_DRIVE, UNICYCLE, CAR, UNICYCLE1, UNICYCLE2, HOLONOMIC2D_JERK,
    HOLONOMIC3D_DRAG, *FIRST_ORDER_CARS,
)  # fmt: skip

MODEL_CODES: dict[str, int] = {model.name: code for code, model in enumerate(_BUILT_IN)}
"""The engines' number of each model, given when it is registered or loaded from another package."""

NUM_BUILT_IN = len(_BUILT_IN)
"""Codes from this one on go to models in the order in which this process registers them."""

COMMON = tuple(model.name for model in _BUILT_IN[:4])
"""Models that share compiled kernels, whatever mixture of them a team is. Teams with others have kernels of their own,
so that compiling never takes longer because of a model that is not used.
"""

FAR = 4.0
"""Times its limit that a component is at, to see whether a model brings it within."""
ROUNDING = 1 - 1e-6
"""Factor that takes back what scaling by a norm rounds up."""


def get_model(name: str) -> Model:
    """Look a model up by name: those registered, and those that installed packages offer.

    Raises:
        ValueError: If there is no such model, or it cannot be loaded; the message lists those there are.
    """
    return MODELS.look_up(name)


def names_of_codes(codes: Iterable[int]) -> tuple[str, ...]:
    """The names of the models with these codes."""
    names = tuple(MODEL_CODES)
    for code in codes:
        if not 0 <= code < len(names):
            raise ValueError(f"model code {code} is unknown; there are codes 0 to {len(names) - 1}: register the model")
    return tuple(names[code] for code in codes)


@cache
def model_digest(model: Model, content: Callable[[FunctionType], object] = source_text) -> str:
    """SHA-256 over all that a model is, its functions' sources and the constants that they name included."""
    sha = hashlib.sha256(repr([value for name, value in vars(model).items() if name != "functions"]).encode())
    for function in model.functions:
        sha.update(repr(list(_pieces(function, content))).encode())
    return sha.hexdigest()


def _pieces(function: object, content: Callable[[FunctionType], object]) -> Iterator[object]:
    """:func:`~d4orm_env.dynamics.source_digest.pieces` of a model's function, or of what it was made of."""
    if isinstance(function, RungeKutta):
        return iter(["Runge-Kutta"])
    if isinstance(function, Unwinding):
        return chain(["unwinding", function.index], _pieces(function.limit_state, content))
    return pieces(function, content)


def register_model(model: Model) -> None:
    """Add a robot model, which is then known by its name everywhere, to this process.

    Processes that are started to work on problems with it have to register it too: do it where the module that defines
    it is imported. A package that offers it as an entry point of the group ``d4orm.models`` need not.

    Args:
        model: The model.

    Raises:
        ValueError: If the name is taken or none, a size or an index does not fit, or a function fails on Python's
            numbers, returns a wrong number of them, names a constant that is a float, leaves controls or speeds beyond
            their limits, or moves a robot at rest.
    """
    if not isinstance(model, Model):
        raise ValueError(f"register_model takes a Model, not {short_repr(model)}; see docs/how_to/own_robot.md")
    MODELS.add(model.name, model)


def _admit(name: str, model: object) -> Model:
    """A model with its code, checked if it does not come with this package."""
    if model in _BUILT_IN:
        return model
    if not isinstance(model, Model):
        raise ValueError(f"model {name!r} is {short_repr(model)}; it must be a Model, see docs/how_to/own_robot.md")
    if model.name != name:
        raise ValueError(f"model {name!r} calls itself {model.name!r}; offer it under that name")
    _check_attributes(model)
    _check_functions(model)
    _check_limits(model)
    _check_rest(model)
    MODEL_CODES.setdefault(name, len(MODEL_CODES))
    return model


def _check_attributes(model: Model) -> None:
    _check_tuples(model)
    n, m, num_limits = model.state_size, model.control_size, len(model.limit_names)
    indices = (*model.speed_indices, *(index for index, _ in (*model.state_limits, *model.trailers)), *model.angles)
    columns = (
        *model.control_limits,
        *(column for _, column in (*model.state_limits, *model.trailers)),
        *chain(*model.lower_limits),
    )
    name = model.name
    checks = (
        (
            isinstance(name, str) and name.isidentifier(),
            f"name is {name!r}; it must be an identifier such as 'my_robot'",
        ),
        (model.dimension in (2, 3), f"dimension is {model.dimension}; it must be 2 or 3"),
        (model.dimension <= n <= 6, f"state_names has {n} names; it must have from {model.dimension} to 6"),
        (m in (2, 3), f"control_names has {m} names; it must have 2 or 3"),
        (len({*model.state_names}) == n, "two components of state_names have the same name; rename one"),
        (len({*model.control_names}) == m, "two components of control_names have the same name; rename one"),
        (len(model.control_limits) == m, f"control_limits has {len(model.control_limits)} columns; expected {m}"),
        (all(0 <= index < n for index in indices), f"an index of a state component is not from 0 to {n - 1}"),
        (all(0 <= column < num_limits for column in columns), f"a column of limits is not from 0 to {num_limits - 1}"),
        (len({*model.limit_names, "radius"}) == num_limits + 1, "two limits have the same name; rename yours"),
        ({*model.start_angles} <= {*model.own_angles}, "start_angles has an index that own_angles lacks"),
        (all(limit.default > 0 for limit in model.own_limits), "a default of own_limits is not positive"),
    )
    for holds, complaint in checks:
        if not holds:
            raise ValueError(f"model {name!r}: {complaint}")


def _check_tuples(model: Model) -> None:
    """Check that what is several is in tuples, by which models are told apart."""
    own = model.own_limits
    if not (isinstance(own, tuple) and all(isinstance(limit, Limit) for limit in own)):
        raise ValueError(
            f"model {model.name!r}: own_limits is {short_repr(own)}; give a tuple of Limit, as (Limit('drag', 0.3),)"
        )
    for attribute in fields(model):
        value = getattr(model, attribute.name)
        if str(attribute.type).startswith("tuple") and not (
            isinstance(value, tuple) and not any(isinstance(part, list) for part in value)
        ):
            raise ValueError(f"model {model.name!r}: {attribute.name} is {short_repr(value)}; give tuples, not lists")


def _check_functions(model: Model) -> None:
    n, m, d, functions = model.state_size, model.control_size, model.dimension, model.functions
    x, u = (0.5,) * n, (0.25,) * m
    limits = (1.0,) * OWN_LIMITS + tuple(limit.default for limit in model.own_limits)
    h = TimeStep(0.1, 0.1 / 2, 0.1 / 3, 0.1 / 6)
    calls: dict[str, tuple[int, tuple[Any, ...]]] = {
        "derivative": (n, (x, u, limits, PYTHON_OPS)),
        "limit_control": (m, (u, limits, PYTHON_OPS)),
        "limit_state": (n, (x, limits, PYTHON_OPS)),
        "velocity": (d, (x, u, limits, PYTHON_OPS)),
        "rest": (n, (x, 0.0)),
        "integrate": (n, (x, u, limits, h, PYTHON_OPS)),
        "approach": (d, (x, (1.0,) * d, limits, h, PYTHON_OPS)),
        "track": (m, (x, (0.5,) * d, limits, h, PYTHON_OPS)),
    }
    for name, (size, arguments) in calls.items():
        function = getattr(functions, name)
        _result(model, name, size, *arguments)
        floats = [value for value in _pieces(function, bytecode) if isinstance(value, float)]
        if floats:
            raise ValueError(
                f"model {model.name!r}: {name} uses the float {floats[0]:g}, which would change an engine's "
                f"precision; make it one of own_limits"
            )
        own = function
        while isinstance(own, Unwinding):
            own = own.limit_state
        if isinstance(own, FunctionType) and not own.__module__.startswith("d4orm_env."):
            _check_compilable(f"model {model.name!r}: {name}", own, arguments)


def _result(model: Model, name: str, size: int, *arguments: Any) -> tuple[float, ...]:
    """Call a function of the model, which must return as many finite numbers."""
    try:
        result = getattr(model.functions, name)(*arguments)
        numbers = tuple(float(value) for value in result)
    except Exception as error:
        raise ValueError(f"model {model.name!r}: {name} fails on Python's numbers: {error!r}") from error
    if not isinstance(result, tuple) or len(result) != size or not np.isfinite(numbers).all():
        raise ValueError(f"model {model.name!r}: {name} returns {result!r}; expected a tuple of {size} finite numbers")
    return numbers


def _check_limits(model: Model) -> None:
    """Check that controls and states far beyond the limits are brought within them: the judge takes the model's word.

    Controls component by component, for those that share a limit may as well keep to a square of it as to a disc.
    """
    bounds = dict(model.state_limits) | dict.fromkeys(model.speed_indices, SPEED)
    states = [bounds.get(index) for index in range(model.state_size)]
    speeds = list(model.limited_components.items())
    controls = [(column, [part]) for part, column in enumerate(model.control_limits)]
    # Ascending and descending, so that a function that takes another column than it declares goes too far in one.
    for standard in ((1.0, 2.0, 3.0), (3.0, 2.0, 1.0)):
        limits = (*standard, *(limit.default for limit in model.own_limits))
        _check_bounds(model, "limit_control", model.control_limits, controls, limits)
        _check_bounds(model, "limit_state", states, speeds, limits)


def _check_bounds(
    model: Model,
    name: str,
    columns: Sequence[int | None],
    bounded: Iterable[tuple[int, list[int]]],
    limits: tuple[float, ...],
) -> None:
    lowest = model.lower_bounds([*limits])
    ends = [(0.5,) if column is None else (-FAR * lowest[column], FAR * limits[column]) for column in columns]
    for beyond, (column, parts) in product(product(*ends), bounded):
        result = _result(model, name, len(columns), beyond, limits, PYTHON_OPS)
        reached = result[parts[0]] if len(parts) == 1 else math.hypot(*(result[part] for part in parts))
        if not -lowest[column] <= reached * ROUNDING <= limits[column]:
            raise ValueError(
                f"model {model.name!r}: {name} makes {result} of {beyond}, where {model.limit_names[column]}, "
                f"{limits[column]:g}, bounds component {' and '.join(map(str, parts))}; bring them within, with clip "
                "or norm_scale"
            )


def _check_rest(model: Model) -> None:
    """Check that a robot that docks stays where it is, and stands."""
    x = tuple(0.25 + 0.125 * index for index in range(model.state_size))
    result = _result(model, "rest", len(x), x, 0.0)
    kept = [*range(model.dimension), *model.angles[: model.heading_index is not None]]
    if any(result[part] != x[part] for part in kept) or any(result[part] for part in model.speed_indices):
        raise ValueError(
            f"model {model.name!r}: rest makes {result} of {x}; it must keep the position and the heading, and make "
            "speeds zero"
        )


def _check_compilable(owner: str, function: FunctionType, arguments: tuple[Any, ...]) -> None:
    """Check that engines can compile a function, and that its numbers stay in their precision."""
    check_formulas(owner, function)
    try:
        results = with_strict_integers(function)(*map(_in_float32, arguments))
    except Exception as error:
        raise ValueError(f"{owner} fails on float32 numbers: {error!r}") from error
    if any(getattr(value, "dtype", np.float32) != np.float32 for value in results):
        raise ValueError(
            f"{owner} computes with a whole number that it names, which would change an engine's precision; write the "
            "number out, or make it one of own_limits"
        )


def _in_float32(argument: Any) -> Any:
    if isinstance(argument, TimeStep):
        return TimeStep(*map(np.float32, tuple[Any, ...](argument)))
    if argument is PYTHON_OPS:
        return NUMPY_OPS
    return tuple(map(np.float32, argument)) if isinstance(argument, tuple) else np.float32(argument)


MODELS = Registry("model", "d4orm.models", _admit, model_digest)
"""All robot models by name; :func:`register_model` adds to them."""

for _model in _BUILT_IN:
    register_model(_model)
