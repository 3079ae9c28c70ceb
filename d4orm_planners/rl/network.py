"""A learned policy as numbers: a small network in NumPy, its normalisation, and the files both are kept in.

A policy file is a safetensors file: arrays, and a JSON text in its header. Nothing in it is executed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.files import checked_path, replaced_when_done
from d4orm_env.core.observation_layout import ObservationSlices
from d4orm_env.dynamics.models import get_model
from d4orm_env.envs.features import Features

FORMAT = 1
EPSILON = 0.1
"""Added to variances. Features are of order one; what was never seen to vary, as a fourth neighbour in teams of four,
must not be blown up when it does."""
CLIP = 10.0  #: Bound of normalised features
MAX_BYTES = 64 * 2**20
SUFFIX = ".safetensors"
_ACTIVATIONS: Mapping[str, Callable[[FloatArray], FloatArray]] = {"tanh": np.tanh, "relu": lambda x: np.maximum(x, 0)}
KINDS = ("neighbor", "obstacle")  #: Kinds of sets, in the order in which features have them
SUM_SCALE = 0.25  #: Scale of sums, which keeps those of a few of order one


class Header(BaseModel):
    """Header of a policy file."""

    model_config = ConfigDict(extra="forbid", strict=True)

    format: int  #: Version of the file format
    algorithm: str  #: ``"ppo"`` or ``"sac"``
    model: str  #: Robot model that it was trained for
    dimension: int = Field(ge=2, le=3)  #: Position dimensions of the observations
    num_neighbors: int = Field(ge=0, le=1000)  #: Robots in an observation
    num_obstacles: int = Field(ge=0, le=1000)  #: Obstacles in an observation
    num_rays: int | None = Field(default=None, ge=1, le=1000)  #: Rays of its range sensor; ``None`` is none
    ray_range: float | None = Field(default=None, gt=0)  #: Range of that [m]; ``None`` without rays
    activation: str  #: Between the layers
    squashed: bool  #: Whether the output goes through tanh
    layers: int = Field(ge=1, le=16)  #: Number of layers; those of sets come before them and are not counted
    #: Whether it reads goal headings, or how many bodies' with trailers; ``None`` acts as if there were none
    goal_headings: Literal[True, 2, 3, 4] | None = None
    #: ``"sets"`` if neighbours and obstacles are pooled first, see :mod:`d4orm_planners.rl.network`. Such a policy
    #: acts for any number of observed robots
    encoder: Literal["sets"] | None = None
    frame: Literal["heading"] | None = None  #: Direction of the first axis of a robot's frame; ``None`` is to the goal
    #: Whether it heads along the shortest paths, see :meth:`Features.along`; ``None`` is straight
    shortest_paths: Literal[True] | None = None
    brakes: Literal[True] | None = None  #: Whether it has learned to brake; ``None`` has go-to-goal brake for it
    training: dict[str, object]  #: The command and its settings, for people, and the ``training_time`` [s]

    @property
    def range_sensors(self) -> str:
        """The range sensors that it reads, as :func:`range_sensors` says it."""
        return range_sensors(self.num_rays or 0, self.ray_range or 0.0)

    @property
    def observation_options(self) -> dict[str, object]:
        """Arguments of environments whose robots observe as in training."""
        rays = {"observed_rays": self.num_rays, "ray_range": self.ray_range} if self.num_rays else {}
        return {"observed_robots": self.num_neighbors, "observed_obstacles": self.num_obstacles, **rays}

    def text(self) -> str:
        """Return it as JSON, which earlier versions read where it says nothing that they do not know."""
        return self.model_dump_json(exclude_defaults=True)


def range_sensors(number: int, ray_range: float) -> str:
    """The arguments of an environment whose robots have so many rays of this range [m]."""
    return f"observed_rays={number}, ray_range={ray_range:g}" if number else "observed_rays=0"


@dataclass(frozen=True, eq=False)
class Network:
    """A policy that needs nothing but NumPy."""

    header: Header  #: Its header
    #: ``weight_i`` ``(out, in)`` and ``bias_i`` ``(out,)`` of each layer, and the normalisation: ``observation_mean``
    #: and ``observation_variance`` ``(F,)``, and ``reward_variance`` ``()``, which only further training needs. With
    #: sets, the arrays of those, and no normalisation of observations.
    arrays: Mapping[str, FloatArray]

    @property
    def features(self) -> Features:
        head = self.header
        sizes, turns = (head.dimension, head.num_neighbors, head.num_obstacles), int(head.goal_headings or 0)
        slices = ObservationSlices(*sizes, num_rays=head.num_rays or 0, goal_headings=turns)
        return replace(Features.of(slices, head.model), frame=head.frame or "goal")

    @property
    def training_time(self) -> float | None:
        """Seconds of training behind it, where the file tells."""
        seconds = self.header.training.get("training_time")
        return float(seconds) if isinstance(seconds, int | float) else None

    def __call__(self, features: FloatArray) -> FloatArray:
        """``(N, m)`` most likely actions in ``[-1, 1]`` for ``(N, F)`` features."""
        hidden = self._inputs(features)
        activation = _ACTIVATIONS[self.header.activation]
        for layer in range(self.header.layers):
            hidden = hidden @ self.arrays[f"weight_{layer}"].T + self.arrays[f"bias_{layer}"]
            if layer < self.header.layers - 1:
                hidden = activation(hidden)
        return np.tanh(hidden) if self.header.squashed else np.clip(hidden, -1, 1)

    def controls(self, observations: FloatArray, limits: FloatArray) -> FloatArray:
        """``(N, m)`` most likely controls for ``(N, D)`` observations of robots with limits ``(N, m)``.

        Observations of another size are a ValueError.
        """
        features = self.features_for(observations.shape[1])
        if features is None:
            raise ValueError(f"observations have {observations.shape[1]} numbers; the policy was trained for others")
        seen, frames = features.encode(observations)
        return features.decode(self(seen), frames, limits)

    def features_for(self, size: int) -> Features | None:
        """Return its features of observations of ``size`` numbers; ``None`` if it cannot act by those."""
        if self.header.encoder is None:
            return self.features if size == self.features.slices.size else None
        return self.features.of_observation_size(size)

    def _inputs(self, features: FloatArray) -> FloatArray:
        if self.header.encoder == "sets":
            return encode(self.features, self.arrays, np.clip(features, -CLIP, CLIP))
        mean, variance = self.arrays["observation_mean"], self.arrays["observation_variance"]
        return np.clip((features - mean) / np.sqrt(variance + EPSILON), -CLIP, CLIP)

    def save(self, path: str | Path) -> None:
        with replaced_when_done(checked_path(path, "a network"), (SUFFIX,)) as temporary:
            # As bytes, because the library's own files are for the owner's eyes only.
            temporary.write_bytes(save(dict(self.arrays), metadata={"d4orm": self.header.text()}))


def load_network(path: str | Path) -> Network:
    """Read a policy file; ValueError for another file, too large, of another version, or that does not fit together."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"policy file {path} does not exist; train one with 'd4orm train'")
    if (size := path.stat().st_size) > MAX_BYTES:
        raise ValueError(f"policy file {path} has {size} bytes; at most {MAX_BYTES} are read")
    try:
        with safe_open(path, "numpy") as file:
            text = (file.metadata() or {}).get("d4orm")
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dictionary
    except SafetensorError as error:
        raise ValueError(f"policy file {path} is no safetensors file ({error}); write one with 'd4orm train'") from None
    if text is None:
        raise ValueError(f"policy file {path} holds no policy of this program; write one with 'd4orm train'")
    header = _header(path, text)
    return Network(header, _checked(path, header, arrays))


def _header(path: Path, text: str) -> Header:
    try:
        header = Header.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "header"
        raise ValueError(f"policy file {path}: {where}: {first['msg']}; write one with 'd4orm train'") from None
    if header.format != FORMAT:
        raise ValueError(
            f"policy file {path} has format {header.format}, and this program reads format {FORMAT}; write one with "
            "'d4orm train'"
        )
    if header.activation not in _ACTIVATIONS:
        raise ValueError(
            f"policy file {path}: activation {header.activation!r} is unknown; known are {', '.join(_ACTIVATIONS)}"
        )
    try:
        get_model(header.model)
    except ValueError as error:
        raise ValueError(f"policy file {path}: {error}") from None
    return header


def _checked(path: Path, header: Header, arrays: dict[str, np.ndarray]) -> dict[str, FloatArray]:
    features = Network(header, {}).features
    width: int | None
    shapes: dict[str, tuple[int | None, ...]] = {"reward_variance": ()}
    if header.encoder == "sets":
        sets, width = _set_shapes(features, arrays)
        shapes |= sets
    else:
        width = features.size
        shapes |= {"observation_mean": (width,), "observation_variance": (width,)}
    for layer in range(header.layers):
        shapes[f"weight_{layer}"] = (None, width)
        width = _width(arrays.get(f"weight_{layer}"))
        if layer == header.layers - 1:
            width = get_model(header.model).control_size
            shapes[f"weight_{layer}"] = (width, *shapes[f"weight_{layer}"][1:])
        shapes[f"bias_{layer}"] = (width,)
    if set(arrays) != set(shapes):
        raise ValueError(f"policy file {path} holds {', '.join(sorted(arrays))}; expected {', '.join(sorted(shapes))}")
    for name, shape in shapes.items():
        array = arrays[name]
        fits = array.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, array.shape))
        if not fits or array.dtype != np.float32 or not np.isfinite(array).all():
            raise ValueError(
                f"policy file {path}: {name} is {array.dtype} {array.shape}; expected finite float32 of shape {shape}"
            )
    if (arrays.get("observation_variance", np.zeros(1)) < 0).any():
        raise ValueError(f"policy file {path}: observation_variance is negative in places; it must not be")
    return arrays


def _set_shapes(
    features: Features, arrays: Mapping[str, FloatArray]
) -> tuple[dict[str, tuple[int | None, ...]], int | None]:
    """Shapes of the arrays of sets, hidden widths being those of ``arrays``, and the width of :func:`encode`'s result.

    The width is ``None`` if the arrays do not say.
    """
    shapes: dict[str, tuple[int | None, ...]] = {}
    width: int | None = features.own_size
    for kind, row in zip(KINDS, (features.neighbor_size, features.obstacle_size), strict=True):
        first, second = (_width(arrays.get(f"{kind}_weight_{layer}")) for layer in (0, 1))
        shapes |= {
            f"{kind}_weight_0": (first, row),
            f"{kind}_own": (first, features.own_size),
            f"{kind}_bias_0": (first,),
            f"{kind}_weight_1": (second, first),
            f"{kind}_bias_1": (second,),
        }
        width = None if width is None or second is None else width + 2 * second
    return shapes, width


def encode(features: Features, arrays: Mapping[str, FloatArray], seen: FloatArray) -> FloatArray:
    """``(N, E)`` inputs of the layers that follow, for ``(N, F)`` features of any number of neighbours."""
    own, *sets = features.of_size(seen.shape[1]).parts(seen)
    parts = [own]
    for kind, rows in zip(KINDS, sets, strict=True):
        hidden = rows @ arrays[f"{kind}_weight_0"].T + (own @ arrays[f"{kind}_own"].T)[:, None]
        hidden = np.maximum(hidden + arrays[f"{kind}_bias_0"], 0)
        hidden = np.maximum(hidden @ arrays[f"{kind}_weight_1"].T + arrays[f"{kind}_bias_1"], 0) * rows[..., :1]
        # No value is below zero, which stands for an empty set.
        parts += [hidden.max(axis=1, initial=0), SUM_SCALE * hidden.sum(axis=1)]
    return np.concatenate(parts, axis=1)


def _width(weight: FloatArray | None) -> int | None:
    return len(weight) if weight is not None and weight.ndim == 2 else None
