"""Footprints as problem files hold them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from d4orm_env.core.arrays import shown
from d4orm_env.core.errors import unknown
from d4orm_env.footprints import Box, Capsule, Disc, Ellipsoid, Footprint, Polygon, Train

KINDS: dict[str, type[Footprint]] = {
    kind.__name__.lower(): kind for kind in (Disc, Box, Capsule, Polygon, Ellipsoid, Train)
}
"""Footprints by their names in files."""


def described(footprint: Footprint) -> dict[str, Any]:
    """The content of a file that means a footprint; the inverse of :func:`parsed`."""
    if isinstance(footprint, Train):
        return {
            "shape": "train",
            "front": described(footprint.front),
            "trailers": [*map(described, footprint.trailers)],
        }
    fields = asdict(footprint)  # type: ignore[call-overload] # all are dataclasses
    if "corners" in fields:
        fields["corners"] = [list(corner) for corner in fields["corners"]]
    return {"shape": type(footprint).__name__.lower()} | fields


def parsed(content: object) -> Footprint:
    """The footprint that a file means, such as ``{"shape": "box", "length": 0.5, "width": 0.25}``.

    Raises:
        ValueError: If the shape is unknown, or a size is missing, unknown or out of range.
    """
    if not isinstance(content, dict) or not isinstance(content.get("shape"), str):
        example = "{shape: box, length: 0.5, width: 0.25}"
        raise ValueError(f"footprint must be a mapping such as {example}, not {shown(content)}")
    kind = KINDS.get(content["shape"])
    if kind is None:
        raise unknown("footprint", content["shape"], KINDS)
    sizes = {name: value for name, value in content.items() if name != "shape"}
    try:
        if kind is Train:
            bodies: list[Any] = [parsed(sizes.pop("front")), *map(parsed, sizes.pop("trailers"))]
            return Train(bodies[0], bodies[1:], **sizes)
        return kind(**sizes)
    except (TypeError, KeyError) as error:
        raise ValueError(f"footprint {content['shape']}: {error}") from None
