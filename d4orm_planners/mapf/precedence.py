"""Precedence: routes along moves on a roadmap, and which robots each one lets pass before it goes on.

As in action dependency graphs (W. Hoenig, S. Kiesel, A. Tinka, J. W. Durham and N. Ayanian, 2019) only the order
matters, not the time: wherever two routes come too near to each other, the robot that moved there first goes first.
Since the moves can be made one after another, in their order, robots never wait in a ring.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_planners.mapf.near_neighbours import Cells, cells_about, items_in, sort_into_cells
from d4orm_planners.mapf.roadmap import Roadmap
from d4orm_planners.tracking.path_drives import Corners, Route, Routes

SPACING = 4 / 15  #: Distance between the points of a route, at most, in radii of the largest robot, as all below
CUTS = (1.0, 0.5, 0.25)  #: Shares of the allowed cut that corners are rounded by; the first that leaves room at walls
ARC_POINTS, ARC_CHECKS, ARC_SLACK = 9, 17, 1 / 15
"""Points along an arc, those that are looked at for walls, and how far from those they keep beyond the margin."""
TINY = float(np.finfo(np.float64).tiny)
STRAIGHT, TURNING_BACK = 1e-4, 0.31  #: Sine of half the angle of no corner, cosine of one too sharp to round
WAIT_SLACK = 0.6  #: Distance beyond radii and margin that robots under way keep
SHARPEST = 2 / 3  #: Radius below which corners are not rounded


def stops_of(roadmap: Roadmap, moves: IntArray, num_robots: int) -> Corners:
    """The corners that moves ``(M, 2)`` made one after another lead along."""
    order = np.argsort(moves[:, 0], kind="stable")
    begin = np.append(0, np.cumsum(np.bincount(moves[:, 0], minlength=num_robots) + 1)).astype(np.int64)
    moving = np.ones(begin[-1], bool)
    moving[begin[:-1]] = False
    positions, times = np.empty((begin[-1], 3)), np.full(begin[-1], -1.0)
    positions[~moving] = roadmap.nodes[roadmap.starts]
    positions[moving] = roadmap.nodes[roadmap.heads[moves[order, 1]]]
    times[moving] = order
    return Corners(positions, begin, times, times)


def make_routes(problem: Problem, stops: Corners, robots: Sequence[int], cut: float) -> list[Route]:
    """The routes of robots along corners, which are rounded by ``cut`` at most [m], less where walls are near."""
    owner = np.repeat(np.asarray(robots), np.diff(stops.begin))
    spacing = SPACING * problem.team.largest_radius
    points, first, times, bends = _rounded(stops, _corner_radii(problem, stops.positions, owner, cut), spacing)
    ends = [slice(low, high) for low, high in pairwise(first)]
    return [Route(points[own], times[own], bends[own]) for own in ends]


def join_routes(problem: Problem, routes: Sequence[Route]) -> Routes:
    """All robots' routes, and their precedence."""
    points, times, bends = (np.concatenate(parts) for parts in zip(*routes))
    first = np.append(0, np.cumsum([len(route.times) for route in routes])).astype(np.int64)
    arcs = np.append(0.0, np.cumsum(_lengths(np.diff(points, axis=0))))
    arcs -= np.repeat(arcs[first[:-1]], np.diff(first))
    radius = np.asarray(problem.team.girth, np.float64)
    separation = problem.margin + WAIT_SLACK * problem.team.largest_radius
    cells = sort_into_cells(problem.team.flattened(points, problem.margin), 2 * float(radius.max()) + separation)
    return Routes(points, times, bends, first, arcs, *_find_waits(cells, first, times, radius, separation))


class RouteBends(NamedTuple):
    """Corners of paths, without the angles themselves, whose functions differ from one processor to the next."""

    corners: Floats  #: ``(C, 3)`` where they are [m]
    before: Floats  #: ``(C, 3)`` unit vectors that lead to each
    after: Floats  #: ``(C, 3)`` unit vectors that lead on from each
    straight: Floats  #: ``(C,)`` half of the shorter of the paths to the corners next to each [m]
    cosine: Floats  #: ``(C,)`` of half the angle by which the path turns
    sine: Floats  #: ``(C,)``


def _bends_at(corners: Floats, inner: IntArray) -> RouteBends:
    """The corners with these numbers, each with the one before it and the one after it."""
    before, after = corners[inner] - corners[inner - 1], corners[inner + 1] - corners[inner]
    one, other = _lengths(before), _lengths(after)
    before, after = before / np.maximum(one, TINY)[:, None], after / np.maximum(other, TINY)[:, None]
    cosine = np.clip(before[:, 0] * after[:, 0] + before[:, 1] * after[:, 1] + before[:, 2] * after[:, 2], -1.0, 1.0)
    halves = np.sqrt((1 + cosine) / 2), np.sqrt((1 - cosine) / 2)
    return RouteBends(corners[inner], before, after, np.minimum(one, other) / 2, *halves)


def _arcs(bends: RouteBends, radius: Floats, num_points: int) -> Floats:
    """``(C, P, 3)`` points along the arcs that round corners."""
    tangent = radius * bends.sine / bends.cosine
    begin, end = bends.corners - bends.before * tangent[:, None], bends.corners + bends.after * tangent[:, None]
    inward = bends.after - bends.before
    inward /= np.maximum(_lengths(inward), TINY)[:, None]
    centre = bends.corners + inward * (radius / bends.cosine)[:, None]
    share = np.linspace(0, 1, num_points)[None, :, None]
    spokes = (begin - centre)[:, None] * (1 - share) + (end - centre)[:, None] * share
    arcs: Floats = centre[:, None] + spokes * (radius[:, None] / np.maximum(_lengths(spokes), TINY))[..., None]
    return arcs


def _corner_radii(problem: Problem, corners: Floats, owner: IntArray, cut: float) -> Floats:
    """``(C,)`` radius of the arc that rounds each corner [m]; infinite where there is none, zero for a sharp one."""
    radii = np.full(len(corners), np.inf)
    inner = np.flatnonzero((owner[:-2] == owner[1:-1]) & (owner[1:-1] == owner[2:])) + 1
    bends = _bends_at(corners, inner)
    radii[inner[bends.sine > STRAIGHT]] = 0.0
    # Who turns back does so on the spot.
    turns = np.flatnonzero((bends.sine > STRAIGHT) & (bends.cosine > TURNING_BACK))
    inner, bends = inner[turns], RouteBends(*(values[turns] for values in bends))
    if not len(inner):
        return radii
    turning = problem.team.turning_radius.astype(np.float64)[owner[inner]]
    most = np.maximum(cut * bends.cosine / (1 - bends.cosine), turning)
    radius = np.minimum(np.multiply.outer(CUTS, most), bends.straight * bends.cosine / bends.sine)
    fits = _fits(problem, bends, radius, owner[inner])
    number, corner = fits.argmax(axis=0), np.arange(len(inner))
    chosen = radius[number, corner]
    rounded = fits[number, corner] & (chosen > SHARPEST * problem.team.largest_radius)
    radii[inner[rounded]] = chosen[rounded]
    return radii


def _fits(problem: Problem, bends: RouteBends, radius: Floats, owner: IntArray) -> BoolArray:
    """``(S, C)`` whether arcs of each ``radius`` ``(S, C)`` leave room at walls."""
    fits = np.ones(radius.shape, bool)
    if problem.world.num_obstacles:
        slack = ARC_SLACK * problem.team.largest_radius
        safety_distance = np.asarray(problem.team.wall_radius, np.float64)[owner] + problem.margin + slack
        repeated = RouteBends(*(np.concatenate([values] * len(radius)) for values in bends))
        arcs = _arcs(repeated, radius.ravel(), ARC_CHECKS)[..., : problem.dimension]
        arcs = arcs.reshape(*radius.shape, *arcs.shape[1:])
        for distance in set(safety_distance.tolist()):
            alike = safety_distance == distance
            fits[:, alike] = problem.world.is_clear(arcs[:, alike], distance).all(axis=-1)
    return fits


def _lengths(steps: Floats) -> Floats:
    length: Floats = np.sqrt(steps[..., 0] ** 2 + steps[..., 1] ** 2 + steps[..., 2] ** 2)
    return length


def _rounded(stops: Corners, radii: Floats, spacing: float) -> tuple[Floats, IntArray, Floats, Floats]:
    """``(points, first, times, bends)``, so far apart at most, along paths with corners rounded by these radii."""
    corners, rounded = stops.positions, np.flatnonzero((radii > 0) & np.isfinite(radii))
    arcs = _arcs(_bends_at(corners, rounded), radii[rounded], ARC_POINTS)
    # Corners that are rounded become as many points, others stay one.
    repeats = np.ones(len(corners), np.int64)
    repeats[rounded] = ARC_POINTS
    positions, bends, arrive = (np.repeat(array, repeats, axis=0) for array in (corners, radii, stops.arrives))
    depart = np.repeat(stops.departs, repeats)
    at = np.append(0, np.cumsum(repeats))
    index = at[rounded][:, None] + np.arange(ARC_POINTS)
    positions[index.ravel()] = arcs.reshape(-1, 3)
    # The first half of an arc belongs to the stretch before the corner, the second to the one after it.
    depart[index[:, 1:].ravel()] = np.repeat(stops.arrives[rounded], ARC_POINTS - 1)
    late = index[:, ARC_POINTS // 2 + 1 :]
    depart[late.ravel()] = arrive[late.ravel()] = np.repeat(stops.departs[rounded + 1], late.shape[1])
    # Long stretches become several points each.
    start = np.zeros(len(positions), bool)
    start[at[stops.begin[:-1]]] = True
    steps = np.diff(positions, axis=0, prepend=positions[:1])
    steps[start] = 0.0
    parts = np.maximum(np.ceil(_lengths(steps) / spacing).astype(np.int64), 1)
    last = np.cumsum(parts)
    part = np.arange(last[-1]) - np.repeat(last - parts, parts) + 1
    share = part / np.repeat(parts, parts)
    points = np.repeat(positions - steps, parts, axis=0) + np.repeat(steps, parts, axis=0) * share[:, None]
    times = np.repeat(depart, parts) + np.repeat(arrive - depart, parts) * share
    inside = np.repeat(bends, parts)
    inside[part < np.repeat(parts, parts)] = np.inf
    first = np.append((last - parts)[at[stops.begin[:-1]]], last[-1]).astype(np.int64)
    return points, first, times, inside


def _find_waits(cells: Cells, first: IntArray, times: Floats, radius: Floats, least: float) -> tuple[IntArray, ...]:
    room, num_robots = 8 * len(times), len(first) - 1
    owner = np.repeat(np.arange(num_robots), np.diff(first))
    wait_first = np.empty(num_robots + 1, np.int64)
    while True:
        waits = np.empty((room, 3), np.int64)
        count = find_waits(cells, first, owner, times, radius, least, wait_first, waits)
        if count <= room:
            return wait_first, *np.ascontiguousarray(waits[:count].T)
        room = count


@compiled
def _find_touched(
    cells: Cells, a: int, k: int, first: IntArray, owner: IntArray, times: Floats, radius: Floats, margin: float,
    farthest: float, passed: IntArray, wanted: IntArray, touched: IntArray,
) -> int:  # fmt: skip
    """Find the robots with earlier points too near to point ``a`` of robot ``k``; returns how many they are.

    ``touched`` lists these robots, ``wanted`` says how far each of them has to have come; those that have ``passed``
    as far already are left out. ``farthest`` is the greatest distance that may be too near [m].
    """
    points, count = cells.points, 0
    (low_i, high_i), (low_j, high_j), (low_k, high_k) = cells_about(cells, points[a], points[a], farthest)
    for ci in range(low_i, high_i):
        for cj in range(low_j, high_j):
            begin, end = items_in(cells, ci, cj, low_k, high_k)
            for number in range(begin, end):
                b = cells.items[number]
                j = owner[b]
                until = b - first[j] + 1
                if j == k or times[b] >= times[a] or until <= passed[j] or until <= wanted[j]:
                    continue
                near = radius[k] + radius[j] + margin
                dx, dy, dz = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
                if dx * dx + dy * dy + dz * dz < near * near:
                    if wanted[j] == 0:
                        touched[count] = j
                        count += 1
                    wanted[j] = until
    return count


@cached_kernel(variant="waits", **OPTIONS)
def find_waits(
    cells: Cells, first: IntArray, owner: IntArray, times: Floats, radius: Floats, margin: float, wait_first: IntArray,
    waits: IntArray,
) -> int:  # fmt: skip
    """Find the robots that each one has to let pass; see :class:`Routes`.

    ``owner`` ``(T,)`` is the robot of each point, and ``waits`` ``(room, 3)`` is at which point, for whom and until it
    has come where. Returns how many waits there are; as many as there is room for are written.
    """
    count, num_robots, farthest = 0, first.shape[0] - 1, 2.0 * radius.max() + margin
    passed = np.zeros(num_robots, np.int64)
    wanted = np.zeros(num_robots, np.int64)
    touched = np.zeros(num_robots, np.int64)
    for k in range(num_robots):
        wait_first[k] = count
        passed[:] = 0
        for a in range(first[k], first[k + 1]):
            num_touched = _find_touched(
                cells, a, k, first, owner, times, radius, margin, farthest, passed, wanted, touched
            )
            for number in range(num_touched):
                j = touched[number]
                # Where it is at that time it is out of the way, however near that is.
                last = max(np.searchsorted(times[first[j] : first[j + 1]], times[a]) - 1, 0)
                until = min(wanted[j], last)
                wanted[j] = 0
                if until > passed[j]:
                    passed[j] = until
                    if count < waits.shape[0]:
                        waits[count, 0], waits[count, 1], waits[count, 2] = a - first[k], j, until
                    count += 1
    wait_first[num_robots] = count
    return count
