"""Contact tests in scalar style, on squared lengths: no square root is needed to compare two distances.

Two bodies touch when the distance between their surfaces is zero or less, so every test is "less or equal"
(paper, Eq. 1 and the safety reward, with the margin added to the radii).
"""

from __future__ import annotations

from d4orm_env.dynamics.robot_model import Flag, Number, Ops, Truth, Vector


def axis_gap(x: Number, lower: Number, upper: Number, zero: Number, ops: Ops) -> Number:
    """Return the distance of ``x`` from the interval from ``lower`` to ``upper``; zero inside it."""
    return ops.maximum(ops.maximum(lower - x, x - upper), zero)


def leaves(x: Number, radius: Number, lower: Number, upper: Number) -> Flag:
    """Check whether a body of radius ``radius`` at ``x`` touches or leaves the interval from ``lower`` to ``upper``."""
    return (x - radius <= lower) | (x + radius >= upper)


def meets_edge(x: Number, y: Number, along_x: Number, along_y: Number, radius: Number, zero: Number, ops: Ops) -> Truth:
    """Check whether a disc of radius ``radius`` at ``(x, y)`` touches the edge from the origin to the end ``along``."""
    square = along_x * along_x + along_y * along_y
    share = ops.minimum(ops.maximum(x * along_x + y * along_y, zero), square) / square
    gap_x, gap_y = x - share * along_x, y - share * along_y
    return gap_x * gap_x + gap_y * gap_y <= radius * radius


def lies_left(x: Number, y: Number, along_x: Number, along_y: Number, zero: Number) -> Truth:
    """Check whether ``(x, y)`` lies on or left of the line from the origin to ``(along_x, along_y)``."""
    return along_x * y - along_y * x >= zero


def meets_triangle(corners: Vector, x: Number, y: Number, radius: Number, zero: Number, ops: Ops) -> Flag:
    """Check whether a disc of radius ``radius`` at ``(x, y)`` touches a triangle, given by its corners' ``x, y``."""
    ax, ay, bx, by, cx, cy = corners
    edges = (
        meets_edge(x - ax, y - ay, bx - ax, by - ay, radius, zero, ops)
        | meets_edge(x - bx, y - by, cx - bx, cy - by, radius, zero, ops)
        | meets_edge(x - cx, y - cy, ax - cx, ay - cy, radius, zero, ops)
    )
    inside = (
        lies_left(x - ax, y - ay, bx - ax, by - ay, zero)
        & lies_left(x - bx, y - by, cx - bx, cy - by, zero)
        & lies_left(x - cx, y - cy, ax - cx, ay - cy, zero)
    )
    return edges | inside
