"""Checkpoints of a training, whole or not there, readable without unpickling; and its learning curve."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, recursive_setattr
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_env.core.errors import first_line
from d4orm_env.core.files import ArrayArchive, claim_folder, make_folder, replaced_when_done
from d4orm_env.core.lazy import LazyModule
from d4orm_env.render import own_style
from d4orm_planners.evaluation.tables import write_csv
from d4orm_planners.rl.network import SUFFIX, Network, load_network
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.task_mixture import MixedVecEnv

figures: Any = LazyModule("matplotlib.figure")


@dataclass(frozen=True)
class Evaluation:
    """A point of the curve."""

    steps: int  #: Robot-steps trained, or in an imitation, learned from
    num_robots: int  #: Size of the team trained last
    scenario: str  #: Scenario trained last
    success_rate: float  #: Share of the validation episodes in which all arrived and none ever touched anything
    travel_time: float  #: Their mean arrival time [s], with the whole episode for robots that did not arrive
    seconds: float  #: Time that the stage took
    env_share: float  #: Share of it in the environments, drawing instances included; in an imitation, in recording
    #: Root mean square of the actions less those of the expert, in units of the limits, in episodes that were not
    #: learned from; ``None`` without an expert
    imitation_error: float | None = None
    parts: Sequence[float] | None = None  #: Success rates of a mixture's parts; ``success_rate`` is their mean

    @property
    def rank(self) -> tuple[float, float]:
        """Larger is better."""
        return self.success_rate, -self.travel_time


def evaluate_network(
    network: Network, worlds: RobotVecEnv | MixedVecEnv, seed: int
) -> tuple[float, float, list[float]]:
    """Success rate, mean travel time [s], and success rates of a mixture's parts, whose means the others are.

    There is one episode in each world, without exploring.
    """
    means = [np.mean(run_worlds(network, part, seed), axis=0) for part in worlds.parts]
    success, travel_time = (float(np.mean(values)) for values in zip(*means))
    return success, travel_time, [float(mean[0]) for mean in means]


def run_worlds(network: Network, worlds: RobotVecEnv, seed: int) -> list[tuple[bool, float]]:
    """``(success, travel time)`` of the first episode of every world, in the order in which they end."""
    worlds.seed(seed)
    features = worlds.reset()
    pending = np.ones(worlds.num_worlds, np.bool_)
    outcomes = []
    while pending.any():
        worlds.step_async(network(features))
        features, *_ = worlds.step_wait()
        outcomes += [(success, travel) for world, success, travel in worlds.finished if pending[world]]
        pending[[world for world, *_ in worlds.finished]] = False
    return outcomes


def write_curve(folder: Path, evaluations: Sequence[Evaluation]) -> None:
    write_csv(folder / "curve.csv", [vars(evaluation) for evaluation in evaluations])
    with replaced_when_done(folder / "curve.png") as temporary:
        _draw(temporary, evaluations)


@own_style()
def _draw(path: Path, evaluations: Sequence[Evaluation]) -> None:
    figure = figures.Figure(figsize=(7, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = [evaluation.steps / 1e6 for evaluation in evaluations]
    left.plot(steps, [100 * evaluation.success_rate for evaluation in evaluations], marker=".")
    left.set(xlabel="robot-steps [million]", ylabel="success [%]", ylim=(0, 100))
    right.plot(steps, [evaluation.travel_time for evaluation in evaluations], marker=".", color="tab:orange")
    right.set(xlabel="robot-steps [million]", ylabel="travel time [s]")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


_KEEP = 2
_COUNTERS = ("num_timesteps", "_n_updates")
_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "acted")


class Checkpoints:
    """The checkpoints in a training's folder; ValueError if that has other settings, OSError if it cannot be used."""

    def __init__(self, out: Path, settings: Mapping[str, object]) -> None:
        self.policy_path = out / f"policy{SUFFIX}"
        self._folder = out / "checkpoints"
        make_folder(self._folder)
        remedy = f"learn on from its policy in another folder, with --start-from {self.policy_path}"
        claim_folder(out / "settings.json", settings, "a training", remedy)

    def policy(self) -> Network:
        return load_network(self.policy_path)

    def conclude(
        self, index: int, model: BaseAlgorithm, env: VecNormalize, network: Network, evaluations: Sequence[Evaluation]
    ) -> Checkpoint:
        """Write the policy, if the last of the evaluations is as good as any, the curve, and a stage's checkpoint.

        Older checkpoints are removed but for the last :data:`_KEEP`.
        """
        if evaluations[-1].rank == max(evaluation.rank for evaluation in evaluations):
            network.save(self.policy_path)
        write_curve(self.policy_path.parent, evaluations)
        # Last, so that what a stage that was broken off has written is written again.
        final = self._folder / f"{index + 1:06d}"
        temporary = final.with_suffix(".partial")
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        model.save(temporary / "model.zip", exclude=["lr_schedule"])
        np.savez(temporary / "state.npz", **_numbers(model, env))
        state = {"evaluations": [asdict(evaluation) for evaluation in evaluations]}
        (temporary / "state.json").write_text(json.dumps(state, indent=1) + "\n")
        shutil.rmtree(final, ignore_errors=True)
        temporary.rename(final)
        for old in self._complete()[:-_KEEP]:
            shutil.rmtree(old)
        return Checkpoint.read(final)

    def latest(self) -> Checkpoint | None:
        complete = self._complete()
        return Checkpoint.read(complete[-1]) if complete else None

    def _complete(self) -> list[Path]:
        return sorted(path for path in self._folder.iterdir() if path.name.isdigit())


@dataclass(frozen=True)
class Checkpoint:
    """A training after some stages."""

    folder: Path
    evaluations: list[Evaluation]

    @classmethod
    def read(cls, folder: Path) -> Checkpoint:
        """Read what is small. Raises ValueError if it cannot be read."""
        with _readable(folder):
            state = json.loads((folder / "state.json").read_text())
            evaluations = TypeAdapter(list[Evaluation]).validate_python(state["evaluations"])
            if len(evaluations) != int(folder.name):
                raise ValueError(f"it has {len(evaluations)} evaluations")
            return cls(folder, evaluations)

    def restore(self, env: VecNormalize, model: BaseAlgorithm, fresh: bool) -> None:
        """Put a new environment, and a fresh model, into the checkpoint's state; ValueError if that cannot be."""
        with _readable(self.folder):
            numbers = self._numbers(model, env, fresh)
        for name, running in _running(env).items():
            running.mean, running.var = numbers[f"{name}_mean"], numbers[f"{name}_var"]
            running.count = float(numbers[f"{name}_count"])
        if not fresh:
            return
        for name in _COUNTERS:
            setattr(model, name, int(numbers[name]))
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None:
            for name in _REPLAY:
                filled = numbers[f"replay_{name}"]
                getattr(buffer, name)[: len(filled)] = filled
            buffer.pos, buffer.full = int(numbers["replay_pos"]), bool(numbers["replay_full"])
        with _readable(self.folder):
            _, parameters, variables = load_from_zip_file(self.folder / "model.zip", device="cpu", load_data=False)
            model.set_parameters(parameters, device="cpu")
            for name, value in (variables or {}).items():
                recursive_setattr(model, f"{name}.data", value.data)

    def _numbers(self, model: BaseAlgorithm, env: VecNormalize, fresh: bool) -> dict[str, np.ndarray]:
        """The arrays of ``state.npz`` that are wanted, none larger than the model and the environment have room for."""
        room = _numbers(model, env, whole=True)
        numbers = {}
        with (self.folder / "state.npz").open("rb") as stream, ArrayArchive(stream, room) as archive:
            for name, largest in room.items():
                if not (fresh or name.startswith(tuple(f"{running}_" for running in _running(env)))):
                    continue
                numbers[name] = array = archive.array(name, largest.nbytes)
                # A replay buffer may be filled in part.
                skipped = 1 if name.startswith("replay_") else 0
                same = (array.ndim, array.shape[skipped:]) == (largest.ndim, largest.shape[skipped:])
                if not same or array.dtype != largest.dtype:
                    raise ValueError(f"{name} is {array.dtype} {array.shape}, not {largest.dtype} {largest.shape}")
        return numbers


def _running(env: VecNormalize) -> dict[str, Any]:
    return {"observation": env.obs_rms, "reward": env.ret_rms}


@contextmanager
def _readable(folder: Path) -> Iterator[None]:
    """Say of whatever goes wrong with a checkpoint what it is and what to do."""
    try:
        yield
    except Exception as error:  # a damaged archive makes zipfile, NumPy and torch raise errors of a dozen kinds
        raise ValueError(
            f"checkpoint {folder} cannot be read ({first_line(error)}); remove it to go on from the one before"
        ) from error


def _numbers(model: BaseAlgorithm, env: VecNormalize, whole: bool = False) -> dict[str, Any]:
    """Numbers that Stable-Baselines3 does not keep in its zip, or keeps pickled; with ``whole``, of a full buffer."""
    numbers = {name: np.array(getattr(model, name)) for name in _COUNTERS}
    for name, running in _running(env).items():
        numbers |= {f"{name}_{part}": np.array(getattr(running, part)) for part in ("mean", "var", "count")}
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        count = buffer.buffer_size if whole or buffer.full else buffer.pos
        numbers |= {f"replay_{name}": getattr(buffer, name)[:count] for name in _REPLAY}
        numbers |= {"replay_pos": np.array(buffer.pos), "replay_full": np.array(buffer.full)}
    return numbers
