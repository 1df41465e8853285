"""Mesh objects: what a scene says of an object whose shape lies in files of a catalogue."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

Vector = tuple[float, float, float]
"""Along the object's axes."""


@dataclass(frozen=True)
class MeshObject:
    """One object of a catalogue, named and not contained: a scene stays small and holds no path."""

    kind: ClassVar[str] = "mesh"
    """What tells it from a prism in JSON."""
    name: str
    """Its name in the catalogue, e.g. `banana`."""
    catalogue: str
    """The catalogue's name: its folder's, or `pybullet`."""
    sha256: str
    """16 hex digits over the model's visual and collision files."""
    mass: float
    """kg."""
    centre: Vector
    """Centre of mass in the object's frame, metres."""
    inertia: tuple[Vector, Vector, Vector]
    """About the centre of mass, along the object's axes, kg m²."""
    T_world_object: Tensor
    """`[4, 4]`."""

    def to_json(self) -> dict[str, Any]:
        """Returns plain JSON data that `from_json` reads back exactly."""
        return {
            "kind": self.kind,
            "name": self.name,
            "library": self.catalogue,  # the key that recorded scene hashes were made with
            "sha256": self.sha256,
            "mass": self.mass,
            "centre": list(self.centre),
            "inertia": [list(row) for row in self.inertia],
            "T_world_object": self.T_world_object.double().tolist(),
        }

    @staticmethod
    def from_json(data: dict[str, Any]) -> "MeshObject":
        """Reads what `to_json` wrote; a missing key is a KeyError, a wrong number of numbers a ValueError."""
        first, second, third = data["inertia"]
        return MeshObject(
            name=data["name"],
            catalogue=data["library"],
            sha256=data["sha256"],
            mass=data["mass"],
            centre=_vector(data["centre"]),
            inertia=(_vector(first), _vector(second), _vector(third)),
            T_world_object=torch.tensor(data["T_world_object"]),
        )


def _vector(numbers: Sequence[float]) -> Vector:
    x, y, z = numbers
    return x, y, z
