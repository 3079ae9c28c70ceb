"""Checks of a problem: its numbers, and its states by the physics.

Each refusal is a ``ValueError`` that names the robot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from d4orm_env.core.arrays import (
    LARGEST,
    SMALLEST,
    FloatArray,
    Floats,
    check_choice,
    positive_number,
    short_repr,
    whole_number,
)
from d4orm_env.core.bodies import body_poses
from d4orm_env.core.gaps import gaps_at, near_pairs, world_gap
from d4orm_env.core.goal_poses import states_at_goals
from d4orm_env.core.team import Team
from d4orm_env.core.winding import MAX_ANGLE, MOST_TURNS
from d4orm_env.core.world import World
from d4orm_env.dynamics.robot_model import OWN_LIMITS, SPEED, STANDARD_LIMITS, TURN_RATE, Model
from d4orm_env.footprints import Disc

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem

Arrival = Literal["dock", "stay"]
"""Effect of arriving: the robot stays at its goal for good, or drives on."""

MAX_HORIZON, MAX_ROBOT_STEPS = 1_000_000, 50_000_000
"""Most steps of a problem, and most robots times steps: a slip of the finger must not fill the memory."""
MIN_TIME_STEP, MAX_TIME_STEP = 1e-6, 1e3
"""Bounds of ``dt`` [s]."""
MAX_HEADING = 1000.0
"""Largest heading that is measured [rad]; float32 resolves it to 6e-5 rad. What is taken is unwound."""
RESOLUTION = 100
"""The goal radius is at least so many times what float32 resolves at the farthest start or goal."""
STEP_RESOLUTION = 10
"""A robot at its speed limit moves at least so many times that in one step."""
INTEGRATION_ERROR = 2 / 15
"""Most that one step of RK4 may be off where a robot turns at its limits, as a share of the goal radius."""
SWINGS = 32
"""Number of hitch angles to either side that are tried for a trailer that may arrive at any."""


def check_arrival(value: object) -> None:
    """Refuse what is no :data:`Arrival`."""
    check_choice(value, "arrival", get_args(Arrival))


def check_is_team(value: object) -> None:
    """Refuse what is no team."""
    if not isinstance(value, Team):
        raise ValueError(f"team is {short_repr(value)}; give a Team, as make_team() returns")


def check_is_problem(value: object) -> None:
    """Refuse what is no problem."""
    if not hasattr(value, "goal_radius"):
        raise ValueError(f"problem is {short_repr(value)}; give a Problem, as make_problem() returns")


def checked_numbers(
    dt: float, horizon: int, margin: float, goal_radius: float, collision_penalty: float, num_robots: int
) -> dict[str, Any]:
    """The numbers of a problem, each within its bounds, by name."""
    numbers = {
        "dt": positive_number(dt, "dt", least=MIN_TIME_STEP, most=MAX_TIME_STEP),
        "horizon": whole_number(horizon, "horizon", 1, MAX_HORIZON),
        "margin": positive_number(margin, "margin", zero_allowed=True, most=LARGEST),
        "goal_radius": positive_number(goal_radius, "goal_radius", least=SMALLEST, most=LARGEST),
        "collision_penalty": positive_number(collision_penalty, "collision_penalty", most=LARGEST),
    }
    if horizon * num_robots > MAX_ROBOT_STEPS:
        most = MAX_ROBOT_STEPS // num_robots
        raise ValueError(f"horizon is {horizon} steps for {num_robots} robots; it must be at most {most} for so many")
    return numbers


def check_physics(problem: Problem) -> list[str]:
    """Refuse what float32 or RK4 does not hold, and contact at starts or goals; return what is within the margin."""
    team, starts = problem.team, problem.start[:, : problem.dimension]
    check_resolution(team, np.concatenate([starts, problem.goal], axis=1), problem.dt, problem.goal_radius)
    check_turning(team, problem.dt, problem.goal_radius)
    found = []
    for what, positions, states in (("start", starts, problem.start), ("goal", problem.goal, states_at_goals(problem))):
        poses = team.body_poses(states) if team.shapes else None
        found.append(check_positions(team, problem.world, what, positions, problem.margin, poses))
    _check_hitched(problem)
    return [text for text in found if text]


def _check_hitched(problem: Problem) -> None:
    """Refuse goals with a heading where the first trailer without a hitch angle is in something at any."""
    team, world, states = problem.team, problem.world, states_at_goals(problem)
    clear = world.clearance(problem.goal) > team.radius
    for robot, model in enumerate(team.robot_models):
        hitches = [hitch for hitch, _ in model.trailers if np.isnan(states[robot, hitch])]
        if not hitches or clear[robot] or np.isnan(states[robot, model.heading_index]):
            continue
        own = [body for body in team.bodies if body.robot == robot]
        number = next(i for i, body in enumerate(own) if i and body.heading == hitches[0])
        limit = dict(model.state_limits).get(hitches[0])
        swing = np.pi if limit is None else float(team.limits[robot, limit])
        # From one angle to the next no point moves farther.
        doubt = swing / SWINGS * (own[number].hitch + own[number].footprint.outer_radius)
        best = -np.inf
        for angle in sorted(np.linspace(-swing, swing, 2 * SWINGS + 1), key=abs):
            states[robot, hitches[0]] = angle
            best = max(best, world_gap(world, own[number].footprint, body_poses(own, states, 2)[number]))
            if best > -doubt:
                break
        else:
            where = f"goal of robot_{robot} at {_point(problem.goal[robot])} has trailer {number}"
            raise ValueError(
                f"{where} {-best - doubt:.3g} m or more inside an obstacle or outside the bounds at every hitch angle "
                f"(footprint {own[number].footprint}); move it, or change the world or goal_heading"
            )


def check_states(team: Team, states: FloatArray, what: str = "start", max_angle: float = float(MAX_ANGLE)) -> None:
    """Refuse states (``what``) ``(K, n)`` whose padding is not zero, or whose speed or heading is too large."""
    limits = team.limits
    for robot, model in enumerate(team.robot_models):
        state = states[robot]
        if state[model.state_size :].any():
            raise ValueError(
                f"{what} of robot_{robot} is {state.tolist()}; a {model.name} has {model.state_size} components, "
                f"so set the padding after them to zero"
            )
        _check_state_limits(model, limits[robot], state, f"{what} {{}} of robot_{robot} is ")
        for index in model.angles:
            if abs(float(state[index])) > max_angle:
                raise ValueError(
                    f"{what} {model.state_names[index]} of robot_{robot} is {state[index]:g} rad; it must be at most "
                    f"{max_angle:g} in magnitude, so take whole turns off, or convert degrees by numpy.deg2rad"
                )


def _check_state_limits(model: Model, limits: FloatArray, state: FloatArray, where: str) -> None:
    """Refuse a state ``(n,)`` beyond a limit; ``where`` says whose it is, with a gap for the component."""
    lower, backwards = dict(model.lower_limits), model.lower_bounds(limits)
    for column, components in model.limited_components.items():
        values, limit, bound = state[components], float(limits[column]), column
        if len(values) == 1 and values[0] < 0:
            limit, bound = float(backwards[column]), lower[column] if backwards[column] < limits[column] else column
        size = float(np.linalg.norm(values))
        if size > limit * (1 + 1e-5):
            name, unit = ("speed", " m/s") if column == SPEED else (model.state_names[components[0]], "")
            known = "limit" if bound == SPEED else model.limit_names[bound]
            raise ValueError(f"{where.format(name)}{size:g}{unit}, above its {known} of {limit:g}{unit}")


def check_resolution(team: Team, positions: FloatArray, dt: float, goal_radius: float) -> None:
    """Refuse ``positions`` ``(K, .)`` that float32 does not resolve as the goal radius, and a step of a robot, ask."""
    farthest = np.abs(positions).max(axis=1)
    grain = np.spacing(farthest).astype(np.float64)
    stride = team.max_speed.astype(np.float64) * dt
    for robot in range(team.num_robots):
        where = f"robot_{robot} starts or ends at a coordinate of {farthest[robot]:g} m, where float32 resolves "
        if RESOLUTION * grain[robot] > goal_radius:
            raise ValueError(
                f"{where}{grain[robot]:.2g} m, more than 1/{RESOLUTION} of the goal radius of {goal_radius:g} "
                f"m; move the problem nearer to the origin, or use a larger goal_radius"
            )
        if STEP_RESOLUTION * grain[robot] > stride[robot]:
            raise ValueError(
                f"{where}{grain[robot]:.2g} m, and moves at most {stride[robot]:.2g} m in a step of {dt:g} s; "
                f"move the problem nearer to the origin, or use a larger dt or max_speed"
            )


def check_turning(team: Team, dt: float, goal_radius: float) -> None:
    """Refuse a time step in which one step of RK4 does not follow a robot that turns as fast as it may."""
    team_limits, most = team.limits, INTEGRATION_ERROR * goal_radius
    for robot, model in enumerate(team.robot_models):
        speed = float(team_limits[robot, SPEED])
        angle = model.turn_rate(team_limits[robot]) * dt
        where = f"robot_{robot} may turn by {angle:.3g} rad in a step of {dt:g} s"
        if angle > MAX_ANGLE:
            raise ValueError(f"{where}, more than {MOST_TURNS} turns; use a smaller dt or {_turning_limits(model)}")
        error = speed * dt * angle**4 / 2880
        if error > most:
            raise ValueError(
                f"{where}, and at {speed:g} m/s one step of RK4 may then be {error:.2g} m off (most: {most:.2g} m, by "
                f"goal_radius); use a smaller dt, {_turning_limits(model)} or max_speed"
            )


def check_positions(
    team: Team, world: World, what: str, positions: FloatArray, margin: float, poses: Floats | None = None
) -> str:
    """Refuse starts or goals (``what``) at ``positions`` ``(K, d)`` outside the world, or that touch something.

    Where the heading of a body's pose is NaN [rad], as all are by default, the disc within its footprint counts for it,
    and trailers that are nowhere do not count; ``poses`` are ``(F, d + 1)``, or without the trailers ``(K, d + 1)``.
    Returned is what is nearest within the margin, for an error or a warning: the empty string if nothing is.
    """
    radius, shaped = team.radius.astype(np.float64), bool(team.shapes)
    gaps = world.clearance(positions) - team.wall_radius.astype(np.float64)
    if poses is None:
        poses = np.column_stack([positions.astype(np.float64), np.full(len(positions), np.nan)])
    gap_of = gaps_at(team, poses, world)
    for robot in np.flatnonzero(gaps <= margin) if shaped else ():
        gaps[robot] = gap_of(int(robot), int(robot))
    for robot in np.flatnonzero(gaps <= 0):
        where = f"{what} of robot_{robot} at {_point(positions[robot])} is {0 - gaps[robot]:.3g} m inside an obstacle"
        raise ValueError(f"{where} or outside the bounds ({_size(team, int(robot))}); move it, or change the world")
    first, second, between = near_pairs(positions.astype(np.float64), radius, margin)
    if shaped:
        between = np.array([gap_of(one, other) for one, other in zip(first.tolist(), second.tolist(), strict=True)])
    if len(overlapping := np.flatnonzero(between <= 0)):
        of_first = overlapping[second[overlapping] == second[overlapping].min()]
        pair = int(of_first[np.argmin(between[of_first])])
        one, other = int(first[pair]), int(second[pair])
        distance = "" if shaped else f"more than {radius[one] + radius[other]:g} m "
        raise ValueError(
            f"{what}s of robot_{one} at {_point(positions[one])} and robot_{other} at {_point(positions[other])} "
            f"overlap by {0 - between[pair]:.3g} m; move them {distance}apart"
        )
    least = int(np.argmin(gaps))
    gap, nearest = gaps[least], "an obstacle or the bounds"
    if len(between) and between.min() < gap:
        pair = int(np.argmin(between))
        least, gap, nearest = int(second[pair]), between[pair], f"robot_{first[pair]}"
    if gap > margin:
        return ""
    return f"the {what} of robot_{least} is {gap:.3g} m from {nearest}, and the margin is {margin:g} m"


def _size(team: Team, robot: int) -> str:
    footprint = team.footprint[robot]
    return f"robot radius {footprint.radius:g} m" if isinstance(footprint, Disc) else f"footprint {footprint}"


def _turning_limits(model: Model) -> str:
    """The limits to lower where a robot turns too fast."""
    if TURN_RATE in model.control_limits:
        return STANDARD_LIMITS[TURN_RATE]
    columns = [column for column in model.control_limits if column >= OWN_LIMITS] if model.first_order else []
    columns = columns or [column for _, column in model.state_limits]
    return ", ".join(model.limit_names[column] for column in columns) or "limits"


def _point(position: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in position) + ")"
