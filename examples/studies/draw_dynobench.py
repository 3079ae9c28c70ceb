"""Draw instances of the kinds of db-CBS's examples, as it writes them: other sizes and poses with every seed.

    python -m examples.studies draw_dynobench --out drawn
    python -m examples.studies dynobench --checkouts drawn

In corridors sizes are those of its examples times 0.85 to 1.05, in which robots can pass each other at the alcove, or
before the corridor, and nowhere else; rooms have boxes over a tenth of them. Instances that `load_dynobench` refuses
with obstacles 0.1 m larger, or `check_reachable` as they are, are drawn again.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from examples.common import argument_parser, count

from d4orm_env import load_dynobench

Pose = tuple[float, float, float]
"""Position and heading."""
Random = np.random.Generator
Scene = tuple[tuple[float, float], list[list[float]], Callable[[int], tuple[Pose, Pose]]]
"""The room's size, boxes as ``[x, y, width, height]`` of their centres, and what draws a robot's start and goal."""
TYPES = {
    "unicycle": "unicycle_first_order_0", "unicycle_sphere": "unicycle_first_order_0_sphere",
    "unicycle2": "unicycle_second_order_0", "trailer": "car_first_order_with_1_trailers_0",
    "double_integrator": "double_integrator_0", "single_integrator": "single_integrator",
}  # fmt: skip
MIXED = ("unicycle", "trailer", "double_integrator")
"""Models of mixed teams, each robot's drawn."""
TRIES = 200
"""Draws of poses before the whole is drawn again."""


def room(random: Random, wide: bool) -> Scene:
    """Boxes anywhere, and robots from anywhere to anywhere two metres away, with any headings."""
    side = 10.0 if wide else 5.0
    boxes: list[list[float]] = []
    while sum(width * height for _, _, width, height in boxes) < 0.1 * side**2:
        size = random.normal(0.75, 0.5, 2)
        x, y = random.uniform(size / 2, side - size / 2) if (size >= 0.1).all() else (0, 0)
        apart = (abs(x - a) > (w + size[0]) / 2 or abs(y - b) > (h + size[1]) / 2 for a, b, w, h in boxes)
        if (size >= 0.1).all() and all(apart):
            boxes.append([x, y, *size])

    def poses(_: int) -> tuple[Pose, Pose]:
        while True:
            start, goal = random.uniform([0.5, 0.5, -np.pi], [side - 0.5, side - 0.5, np.pi], (2, 3))
            if np.hypot(*(goal - start)[:2]) >= 2:
                return tuple(start), tuple(goal)

    return (side, side), boxes, poses


def swap(random: Random, wide: bool) -> Scene:
    """Pairs that change places, each on its line across an empty room."""
    del wide
    centre, first = random.uniform(2.2, 2.8, 2), random.uniform(-np.pi, np.pi)
    angles, reach = first + np.array([0, random.uniform(np.pi / 3, 2 * np.pi / 3)]), random.uniform(1.2, 1.8, 2)

    def poses(robot: int) -> tuple[Pose, Pose]:
        line, heading = robot // 2, angles[robot // 2] + np.pi * (robot % 2)
        ends = [centre + side * reach[line] * np.array([np.cos(heading), np.sin(heading)]) for side in (-1, 1)]
        start, goal = ((*end, heading) for end in ends)
        return start, goal

    return (5.0, 5.0), [], poses


def alcove(random: Random, wide: bool) -> Scene:
    """A corridor in which one overtakes another, which has one place to let it pass."""
    corridor, alcove, depth, left, right = random.uniform(0.85, 1.05, 5) * (
        (1.5, 1.5, 1.0, 2.5, 2.5) if wide else (0.5, 1.0, 0.5, 1.5, 1.5)
    )
    length, height = left + alcove + right, depth + corridor + 0.5
    boxes = [
        [left / 2, depth / 2, left, depth], [length - right / 2, depth / 2, right, depth],
        [length / 2, height - 0.25, length, 0.5],
    ]  # fmt: skip

    def poses(robot: int) -> tuple[Pose, Pose]:
        # Fractions of the corridor from its ends: the second robot is between the first one and the alcove.
        begin, end = random.uniform(0.8, 1.0, 2) if robot else random.uniform(0.2, 0.35, 2)
        y, (turned, ends_turned) = depth + corridor / 2, random.uniform(-0.1, 0.1, 2)
        return (begin * left, y, turned), (length - end * right, y, ends_turned)

    return (length, height), boxes, poses


def at_goal(random: Random, wide: bool) -> Scene:
    """A corridor that one stands in, at its goal, which another has to leave by."""
    corridor, left, hall, wall = random.uniform(0.85, 1.05, 4) * (
        (1.5, 2.5, 2.0, 1.0) if wide else (0.5, 1.5, 1.5, 0.5)
    )
    height = corridor + 2 * wall
    boxes = [[left / 2, wall / 2, left, wall], [left / 2, height - wall / 2, left, wall]]

    def poses(robot: int) -> tuple[Pose, Pose]:
        turned, ends_turned = random.uniform(-0.1, 0.1, 2)
        if robot:
            stands = (random.uniform(0.8, 1.0) * left, height / 2, turned)
            return stands, stands
        goal = (left + random.uniform(0.6, 0.75) * hall, height / 2, ends_turned)
        return (random.uniform(0.2, 0.35) * left, height / 2, turned), goal

    return (left + hall, height), boxes, poses


def parallelpark(random: Random, wide: bool) -> Scene:
    """One parks between two that are parked, while another backs along the road."""
    del wide
    road, x, y = random.uniform(0.8, 1.2), random.uniform(3, 4), random.uniform(1.7, 2.3)
    boxes = [[x + side * random.uniform(0.75, 1.0), y, 0.5, 0.25] for side in (-1, 1)]

    def poses(robot: int) -> tuple[Pose, Pose]:
        if robot:
            return (x + random.uniform(-0.3, 0.3), road, 0.0), (random.uniform(1.6, 2.4), road, 0.0)
        return (random.uniform(0.8, 1.2), road, 0.0), (x, y, 0.0)

    return (6.0, 6.0), boxes, poses


def _divided(random: Random, side: float, gaps: list[tuple[float, float]]) -> Scene:
    """A wall across a room with gaps, given by where they begin and end, and robots that change sides."""
    x = side / 2 + random.uniform(-0.3, 0.3)
    ends = [0.0, *(end for gap in gaps for end in gap), side]
    boxes = [[x, (ends[i] + ends[i + 1]) / 2, 0.2, ends[i + 1] - ends[i]] for i in range(0, len(ends), 2)]

    def poses(robot: int) -> tuple[Pose, Pose]:
        left = (random.uniform(0.6, x - 0.7), random.uniform(0.6, side - 0.6))
        right = (random.uniform(x + 0.7, side - 0.6), random.uniform(0.6, side - 0.6))
        turned, ends_turned = random.uniform(-0.3, 0.3, 2) + np.pi * (robot % 2)
        start, goal = (right, left) if robot % 2 else (left, right)
        return (*start, turned), (*goal, ends_turned)

    return (side, side), boxes, poses


def window(random: Random, wide: bool) -> Scene:
    """A wall with one gap."""
    del wide
    middle, half = random.uniform(1.5, 3.5), random.uniform(0.3, 0.4)
    return _divided(random, 5.0, [(middle - half, middle + half)])


def wall(random: Random, wide: bool) -> Scene:
    """A wall with two gaps."""
    del wide
    middles, half = (random.uniform(1.2, 2.4), random.uniform(3.6, 4.8)), random.uniform(0.15, 0.25)
    return _divided(random, 6.0, [(middle - half, middle + half) for middle in middles])


KINDS: tuple[tuple[Callable[[Random, bool], Scene], tuple[int, ...], tuple[str, ...]], ...] = (
    (room, (2, 4, 8), ("unicycle", "unicycle_sphere", "unicycle2", "hetero")),
    (swap, (2, 4), ("unicycle", "unicycle2", "trailer", "double_integrator")),
    (swap, (2,), ("hetero",)),
    (alcove, (2,), ("unicycle", "unicycle_sphere")),
    (at_goal, (2,), ("unicycle", "unicycle_sphere")),
    (parallelpark, (2,), ("unicycle",)),
    (window, (4,), ("unicycle", "unicycle2", "trailer", "double_integrator")),
    (wall, (2,), ("single_integrator",)),
)
"""Scenes, numbers of robots, and models."""
NAMES = {
    f"{kind.__name__}_n{robots}_{{}}_{model}": (kind, robots, model)
    for kind, numbers, models in KINDS for robots in numbers for model in models
}  # fmt: skip
"""Names of files, but for the seed; by their ends db-CBS chooses its settings."""


def state(model: str, pose: Pose, bend: float) -> list[float]:
    """A state at rest as theirs: trailers have headings of their own."""
    x, y, *headings = pose[0], pose[1], *(math.remainder(angle, math.tau) for angle in (pose[2], pose[2] + bend))
    others = {
        "trailer": headings, "double_integrator": [0.0, 0.0], "single_integrator": [],
        "unicycle2": [headings[0], 0.0, 0.0],
    }  # fmt: skip
    return _rounded([x, y, *others.get(model, headings[:1])])


def fits(content: dict[str, Any], spare: float) -> bool:
    """Check that `load_dynobench` takes a problem whose boxes are larger by so much, and at 0 that there are paths."""
    environment = content["environment"]
    boxes = [box | {"size": [side + spare for side in box["size"]]} for box in environment["obstacles"]]
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # starts within the margin, which is zero there
        path = Path(folder) / "drawn.yaml"
        path.write_text(yaml.safe_dump(content | {"environment": environment | {"obstacles": boxes}}))
        try:
            problem = load_dynobench(path)
            if not spare:
                problem.check_reachable()
        except ValueError:
            return False
    return True


def drawn(name: str, seed: int) -> dict[str, Any]:
    """The content of a file."""
    kind, robots, model = NAMES[name]
    random = np.random.default_rng([seed, *name.encode()])
    while True:
        size, boxes, poses = kind(random, model == "unicycle_sphere")
        obstacles = [{"type": "box", "center": _rounded(box[:2]), "size": _rounded(box[2:])} for box in boxes]
        environment = {"min": [0, 0], "max": _rounded(size), "obstacles": obstacles}
        content: dict[str, Any] = {"environment": environment, "robots": []}
        models = random.choice(MIXED, robots) if model == "hetero" else [model] * robots
        for _ in range(TRIES):
            own = str(models[len(content["robots"])])
            bends = random.uniform(-0.4, 0.4, 2) if kind is room else (0.0, 0.0)
            start, goal = map(state, (own, own), poses(len(content["robots"])), bends)
            team = [*content["robots"], {"type": TYPES[own], "start": start, "goal": goal}]
            if fits(content | {"robots": team}, 0.1):
                content["robots"] = team
            if len(content["robots"]) == robots:
                break
        if len(content["robots"]) == robots and fits(content, 0.0):
            return content


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 4) for value in values]


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=count, default=5, help="of every kind")
    arguments = parser.parse_args()
    folder: Path = arguments.out / "example"
    folder.mkdir(parents=True, exist_ok=True)
    files = [(name, seed) for seed in range(1 if arguments.quick else arguments.seeds) for name in NAMES]
    for name, seed in files:
        (folder / f"{name.format(seed)}.yaml").write_text(yaml.safe_dump(drawn(name, seed)))
    print(f"wrote {len(files)} files to {folder}")


if __name__ == "__main__":
    main()
