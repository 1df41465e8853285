"""Prismatic objects: unions of upright, extruded convex polygons of one height."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Polygon = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Prism:
    """One object. In its own frame it stands on z = 0 and reaches up to `height`."""

    kind: str
    """`box`, `cylinder`, `l`, `t`, `u`, `cross` or `triangle`."""
    parts: tuple[Polygon, ...]
    """Disjoint convex footprints, counter-clockwise corners (x, y) in metres in the object's frame; their union
    is the footprint. A cylinder is one regular polygon of many corners."""
    height: float
    """Metres."""
    colour: tuple[float, float, float]
    """RGB in [0, 1]."""
    density: float
    """kg/m³."""
    T_world_object: Tensor
    """`[4, 4]`."""

    def to_json(self) -> dict[str, Any]:
        """Returns plain JSON data that `from_json` reads back exactly."""
        return {
            "kind": self.kind,
            "parts": [[list(corner) for corner in part] for part in self.parts],
            "height": self.height,
            "colour": list(self.colour),
            "density": self.density,
            "T_world_object": self.T_world_object.double().tolist(),
        }

    @staticmethod
    def from_json(data: dict[str, Any]) -> "Prism":
        """Reads what `to_json` wrote; a missing key is a KeyError."""
        return Prism(
            kind=data["kind"],
            parts=tuple(tuple((x, y) for x, y in part) for part in data["parts"]),
            height=data["height"],
            colour=tuple(data["colour"]),
            density=data["density"],
            T_world_object=torch.tensor(data["T_world_object"]),
        )


@dataclass(frozen=True)
class MassProperties:
    """A solid's mass and how it is spread."""

    mass: float
    """kg."""
    centre: NDArray[np.float64]
    """Centre of mass `[3]` in the object's frame, metres."""
    inertia: NDArray[np.float64]
    """`[3, 3]` about the centre of mass, along the object's axes, kg m²."""


def mass_properties(prism: Prism) -> MassProperties:
    """Returns the mass, centre of mass and inertia of a prism of even density."""
    area, first, second = _moments(prism.parts)
    mass = prism.density * prism.height * area
    x, y = first / area
    about_centroid = mass * (second / area - np.array([[x * x, x * y], [x * y, y * y]]))
    inertia = np.zeros((3, 3))
    inertia[:2, :2] = np.trace(about_centroid) * np.eye(2) - about_centroid
    inertia[:2, :2] += mass * prism.height**2 / 12 * np.eye(2)
    inertia[2, 2] = np.trace(about_centroid)
    return MassProperties(mass, np.array([x, y, prism.height / 2]), inertia)


def centroid(parts: Sequence[Polygon]) -> tuple[float, float]:
    """Returns the centroid (x, y) of a union of disjoint polygons."""
    area, first, _ = _moments(parts)
    return float(first[0] / area), float(first[1] / area)


def footprint_in_world(prism: Prism) -> list[NDArray[np.float64]]:
    """Returns each part's corners `[K, 2]` in the world frame, for a prism that stands upright."""
    T = prism.T_world_object.double().numpy()
    return [np.asarray(part) @ T[:2, :2].T + T[:2, 3] for part in prism.parts]


def corners_in_world(prism: Prism) -> NDArray[np.float64]:
    """Returns the corners `[2K, 3]` of all parts, lower and upper, in the world frame, in any pose."""
    T = prism.T_world_object.double().numpy()
    flat = np.concatenate([np.asarray(part) for part in prism.parts])
    solid = np.concatenate([np.column_stack([flat, np.full(len(flat), z)]) for z in (0.0, prism.height)])
    return solid @ T[:3, :3].T + T[:3, 3]


def clear_gap(a: Sequence[NDArray[np.float64]], b: Sequence[NDArray[np.float64]]) -> float:
    """Returns a gap in metres that separates two footprints for sure; negative where they may overlap.

    The gap between two convex polygons is taken across their own edges' directions (separating axes), which
    never exceeds the true distance.
    """
    return min(_separation(p, q) for p in a for q in b)


def _separation(p: NDArray[np.float64], q: NDArray[np.float64]) -> float:
    """Returns the widest gap between two convex polygons over the outward normals of their edges."""
    return max(_gap_beyond_edges(p, q), _gap_beyond_edges(q, p))


def _gap_beyond_edges(p: NDArray[np.float64], q: NDArray[np.float64]) -> float:
    edges = np.roll(p, -1, axis=0) - p
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    beyond = (q @ normals.T).min(axis=0) - (p * normals).sum(axis=1)
    return float(beyond.max())


def _moments(parts: Sequence[Polygon]) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Returns the area, the first moments `[2]` and the second moments `[2, 2]` about the origin (Green's theorem)."""
    area, first, second = 0.0, np.zeros(2), np.zeros((2, 2))
    for part in parts:
        a = np.asarray(part)
        b = np.roll(a, -1, axis=0)
        doubled = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
        total = a + b
        area += float(doubled.sum()) / 2
        first += (doubled[:, None] * total).sum(axis=0) / 6
        outer = np.einsum("n,ni,nj->ij", doubled, a, a) + np.einsum("n,ni,nj->ij", doubled, b, b)
        second += (outer + np.einsum("n,ni,nj->ij", doubled, total, total)) / 24
    return area, first, second
