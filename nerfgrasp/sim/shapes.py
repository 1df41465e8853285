"""Random footprints of prismatic objects, each with a bar that a Robotiq 2F-85 can grasp.

Every footprint is a tuple of disjoint convex parts, shifted so that its centroid is the origin. The lengths are
chosen so that the open fingers (85 mm apart, pads 22 mm wide, 8 mm thick) fit around at least one bar.
"""

import math
from collections.abc import Callable

from numpy.random import Generator

from nerfgrasp.scenes.prisms import Polygon, centroid

CYLINDER_CORNERS = 32


def rectangle(x0: float, y0: float, x1: float, y1: float) -> Polygon:
    """Returns the axis-aligned rectangle between two corners in metres, counter-clockwise."""
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def box(width: float, length: float) -> tuple[Polygon, ...]:
    """Returns a box's footprint, `width` along x and `length` along y."""
    return _centred((rectangle(0.0, 0.0, width, length),))


def cylinder(diameter: float) -> tuple[Polygon, ...]:
    """Returns a regular polygon of 32 corners on the circle."""
    angles = [2 * math.pi * i / CYLINDER_CORNERS for i in range(CYLINDER_CORNERS)]
    return (tuple((0.5 * diameter * math.cos(a), 0.5 * diameter * math.sin(a)) for a in angles),)


def angle(length_x: float, length_y: float, bar_x: float, bar_y: float) -> tuple[Polygon, ...]:
    """Returns an L: an arm along x, `bar_x` thick, and one along y, `bar_y` thick; outer lengths."""
    return _centred((rectangle(0.0, 0.0, length_x, bar_x), rectangle(0.0, bar_x, bar_y, length_y)))


def tee(length: float, bar: float, stem_length: float, stem: float) -> tuple[Polygon, ...]:
    """Returns a T: a bar along x and a stem that leaves its middle along -y."""
    return _centred((rectangle(-length / 2, 0.0, length / 2, bar), rectangle(-stem / 2, -stem_length, stem / 2, 0.0)))


def channel(gap: float, arm: float, arm_length: float, base: float) -> tuple[Polygon, ...]:
    """Returns a U: a base along x, `base` thick, and two arms `arm` thick, `gap` apart, along y."""
    outer = gap / 2 + arm
    return _centred(
        (
            rectangle(-outer, 0.0, outer, base),
            rectangle(-outer, base, -gap / 2, base + arm_length),
            rectangle(gap / 2, base, outer, base + arm_length),
        )
    )


def cross(length_x: float, length_y: float, bar_x: float, bar_y: float) -> tuple[Polygon, ...]:
    """Returns a cross: a bar along x, `bar_x` thick, and one along y, `bar_y` thick, through each other's middle."""
    return _centred(
        (
            rectangle(-length_x / 2, -bar_x / 2, length_x / 2, bar_x / 2),
            rectangle(-bar_y / 2, bar_x / 2, bar_y / 2, length_y / 2),
            rectangle(-bar_y / 2, -length_y / 2, bar_y / 2, -bar_x / 2),
        )
    )


def triangle(base: float, altitude: float) -> tuple[Polygon, ...]:
    """Returns an isosceles triangle with its base along x."""
    return _centred((((-base / 2, 0.0), (base / 2, 0.0), (0.0, altitude)),))


def _centred(parts: tuple[Polygon, ...]) -> tuple[Polygon, ...]:
    x0, y0 = centroid(parts)
    return tuple(tuple((x - x0, y - y0) for x, y in part) for part in parts)


def _random_box(rng: Generator) -> tuple[Polygon, ...]:
    width = rng.uniform(0.025, 0.07)
    return box(width, rng.uniform(width, 0.1))


def _random_cylinder(rng: Generator) -> tuple[Polygon, ...]:
    return cylinder(rng.uniform(0.03, 0.07))


def _random_angle(rng: Generator) -> tuple[Polygon, ...]:
    return angle(*rng.uniform(0.07, 0.095, 2).tolist(), *rng.uniform(0.025, 0.035, 2).tolist())


def _random_tee(rng: Generator) -> tuple[Polygon, ...]:
    length, stem_length = rng.uniform(0.075, 0.095), rng.uniform(0.035, 0.055)
    return tee(length, rng.uniform(0.025, 0.035), stem_length, rng.uniform(0.025, 0.035))


def _random_channel(rng: Generator) -> tuple[Polygon, ...]:
    gap, arm = rng.uniform(0.036, 0.045), rng.uniform(0.02, 0.025)
    return channel(gap, arm, rng.uniform(0.03, 0.045), rng.uniform(0.025, 0.035))


def _random_cross(rng: Generator) -> tuple[Polygon, ...]:
    return cross(*rng.uniform(0.085, 0.1, 2).tolist(), *rng.uniform(0.025, 0.03, 2).tolist())


def _random_triangle(rng: Generator) -> tuple[Polygon, ...]:
    return triangle(rng.uniform(0.04, 0.07), rng.uniform(0.035, 0.07))


RANDOM_FOOTPRINTS: dict[str, Callable[[Generator], tuple[Polygon, ...]]] = {
    "box": _random_box,
    "cylinder": _random_cylinder,
    "l": _random_angle,
    "t": _random_tee,
    "u": _random_channel,
    "cross": _random_cross,
    "triangle": _random_triangle,
}
"""By kind: draws a footprint."""
