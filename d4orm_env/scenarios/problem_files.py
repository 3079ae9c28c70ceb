"""Scenario files: problems as YAML that people can write.

``examples/scenarios/mixed_team.yaml`` documents the format.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable

import numpy as np
import yaml

from d4orm_env.core.files import checked_path, naming, read_yaml, replaced_when_done
from d4orm_env.core.goal_poses import DEFAULT_TOLERANCE
from d4orm_env.core.infeasibility import prove_infeasible
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import check_is_problem
from d4orm_env.dynamics.robot_model import UNLIMITED
from d4orm_env.footprints import Disc
from d4orm_env.scenarios.cl_mapf import load_cl_mapf
from d4orm_env.scenarios.dynobench import load_dynobench
from d4orm_env.scenarios.schema import VERSION, parse, start_fields
from d4orm_env.scenarios.settings import described


def load_problem(path: str | os.PathLike[str]) -> Problem:
    """Read a scenario file.

    Args:
        path: A YAML file of at most 10 MB, 10,000 robots and 5 * 10^7 robots times steps, in the explicit form (every
            robot listed) or the short form (a scenario and its arguments); or an instance of dynobench or db-CBS, see
            :func:`~d4orm_env.scenarios.dynobench.load_dynobench`, or of CSDO, see
            :func:`~d4orm_env.scenarios.cl_mapf.load_cl_mapf`.

    Warns:
        UserWarning: If it is proved that nothing solves the problem, with the robots and why.

    Raises:
        ValueError: If the file cannot be read, is not YAML, breaks the schema, or makes no valid problem. One line that
            names the file, the field, and what was expected.
    """
    path = checked_path(path, "a scenario file")
    with naming(path):
        content = read_yaml(path)
    keys = set(content) if isinstance(content, dict) else set()
    if "environment" in keys:
        problem = load_dynobench(path)
    elif "agents" in keys:
        problem = load_cl_mapf(path)
    else:
        with naming(path):
            problem = parse(content)
    proofs = [f"robot_{robot} {proof}" for robot, proof in prove_infeasible(problem).items()]
    if proofs:
        more = f", and {len(proofs) - 1} more" if len(proofs) > 1 else ""
        warnings.warn(f"{path}: nothing solves this problem: {proofs[0]}{more}", stacklevel=2)
    return problem


def save_problem(problem: Problem, path: str | os.PathLike[str]) -> None:
    """Write a problem in the explicit form; :func:`load_problem` returns an equal one, to the bit.

    The file is written under another name in the same folder and renamed, so that it is never half there.

    Raises:
        ValueError: If the file cannot be written; nothing is left behind.
    """
    check_is_problem(problem)
    target = checked_path(path, "a scenario file")
    with replaced_when_done(target) as temporary:
        temporary.write_text(scenario_text(problem), encoding="utf-8")


def scenario_text(problem: Problem) -> str:
    """Return the text that :func:`save_problem` writes: one line for each robot and obstacle."""
    lines = []
    for key, value in describe(problem).items():
        if isinstance(value, list):
            lines += [f"{key}:", *(f"  - {_flow(entry)}" for entry in value)]
        elif isinstance(value, dict):
            lines += [f"{key}:" if value else f"{key}: {{}}"]
            for part, entries in value.items():
                if part in ("bounds", "origin"):
                    lines += [f"  {part}: {_flow(entries)}"]
                else:
                    lines += [f"  {part}:", *(f"    - {_flow(entry)}" for entry in entries)]
        else:
            lines += [f"{key}: {_flow(value)}"]
    return "\n".join(lines) + "\n"


def _flow(value: object) -> str:
    """Write a value on one line; text in quotes."""
    style = '"' if isinstance(value, str) else None
    text: str = yaml.safe_dump(
        value, width=2**31 - 1, sort_keys=False, explicit_end=False, default_style=style, default_flow_style=True
    )
    return text.removesuffix("...\n").strip()


def describe(problem: Problem) -> dict[str, object]:
    """The content of a file that means that problem, to the bit: the inverse of :func:`parse`."""
    settings = {name: getattr(problem, name) for name in ("dt", "horizon", "margin", "goal_radius")}
    speeds = _decimals(problem.goal_speed)
    settings["goal_speed"] = speeds[0] if len(set(speeds)) == 1 else speeds
    if not problem.docks:
        settings["arrival"] = problem.arrival
    if problem.collision_penalty != 1:
        settings["collision_penalty"] = problem.collision_penalty
    robots = [_describe_robot(problem, robot) for robot in range(problem.num_robots)]
    return {
        "version": VERSION,
        "name": str(problem.name).encode("utf-8", "replace").decode(),  # YAML has no lone surrogates
        **settings,
        "robots": robots,
        "world": _describe_world(problem),
    }


def _describe_robot(problem: Problem, robot: int) -> dict[str, object]:
    team, dimension = problem.team, problem.dimension
    model = team.robot_models[robot]
    state = _decimals(problem.start[robot, : model.state_size])
    entry: dict[str, object] = {"model": model.name, "start": state[:dimension], "goal": _decimals(problem.goal[robot])}
    if "velocity" in start_fields(model):
        entry["velocity"] = state[dimension:]
    elif "state" in start_fields(model):
        entry["state"] = state[dimension:]
    else:
        entry |= dict(zip(start_fields(model), state[dimension:], strict=True))
    footprint = team.footprint[robot]
    if not isinstance(footprint, Disc):
        entry["footprint"] = described(footprint)
    else:
        entry["radius"] = footprint.radius if team.shapes else _decimals(team.radius[[robot]])[0]
    for name in ("max_speed", "max_acceleration", "max_turn_rate"):
        (entry[name],) = _decimals(np.asarray(getattr(team, name))[[robot]])
    if team.lag[robot]:
        (entry["lag"],) = _decimals(team.lag[[robot]])
    if not np.isnan(problem.goal_heading[robot]):
        (entry["goal_heading"],) = _decimals(problem.goal_heading[[robot]])
    if "goal_heading" in entry or problem.goal_heading_tolerance[robot] != np.float32(DEFAULT_TOLERANCE):
        (entry["goal_heading_tolerance"],) = _decimals(problem.goal_heading_tolerance[[robot]])
    hitches = problem.goal_hitches[robot, : len(model.trailers)]
    if not np.isnan(hitches).all():
        entry["goal_hitches"] = [None if np.isnan(hitch) else _decimals([hitch])[0] for hitch in hitches]
    own = {limit.name: team.own_limits[limit.name][robot] for limit in model.own_limits}
    bounding = [limit.name for limit in model.own_limits if not own[limit.name] == limit.default == UNLIMITED]
    if bounding:
        values = _decimals([own[name] for name in bounding])
        entry["own_limits"] = dict(zip(bounding, values, strict=True))
    return entry


def _describe_world(problem: Problem) -> dict[str, object]:
    world, dimension = problem.world, problem.dimension
    content: dict[str, object] = {}
    if world.lower is not None:
        lower, upper = map(_decimals, world.bounds)
        content["bounds"] = {"lower": lower, "upper": upper}
    if world.origin.any():
        content["origin"] = world.origin.tolist()
    for kind in ("circles", "spheres", "cylinders"):
        rows = [_decimals(row) for row in getattr(world, kind)]
        content[kind] = [{"center": row[:-1], "radius": row[-1]} for row in rows]
    boxes = [_decimals(row) for row in world.boxes]
    content["boxes"] = [{"lower": row[:dimension], "upper": row[dimension:]} for row in boxes]
    content["polygons"] = [{"corners": [_decimals(corner) for corner in corners]} for corners in world.polygons]
    return {kind: entries for kind, entries in content.items() if entries}


def _decimals(values: Iterable[np.float32]) -> list[float]:
    """float32 values as the shortest decimals that read back as the same float32."""
    shortest = [float(str(value)) for value in values]
    # Reading a decimal by way of float64 may round twice; the exact value never does.
    return [number if np.float32(number) == value else float(value) for number, value in zip(shortest, values)]
