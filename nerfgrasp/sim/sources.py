"""Object models as their makers publish them: URDF files or bare meshes, checked and read."""

import hashlib
import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from nerfgrasp.errors import UserError
from nerfgrasp.sim.decomposition import CONVEX, MAX_HULLS, MAX_VERTICES, VHACD, read_objects

MESHES = (".obj", ".stl", ".ply", ".glb")
"""Suffixes of meshes that are read."""
PREPARATION = 2
"""Grows with every change of how models are prepared that changes the result."""
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """A piece of a model: a mesh file in its place."""

    file: Path
    """The mesh."""
    T_object_part: NDArray[np.float64]
    """`[4, 4]`, scale included."""

    def load(self) -> list[trimesh.Trimesh]:
        """Returns its meshes in the model's frame.

        Raises:
            UserError: the file holds no mesh that can be read.
        """
        try:
            meshes = read_objects(self.file)
        # Readers of damaged files raise many kinds of exception.
        except Exception as error:
            raise UserError(f"{self.file}: the mesh cannot be read ({type(error).__name__}: {error})") from error
        if not any(len(mesh.faces) for mesh in meshes):
            raise UserError(f"{self.file}: there are no triangles in it")
        for mesh in meshes:
            mesh.apply_transform(self.T_object_part)
        return meshes


@dataclass(frozen=True)
class Source:
    """One model, found but not yet prepared."""

    name: str
    """Unique in its catalogue."""
    file: Path
    """The URDF, or the mesh."""
    visual: tuple[Part, ...]
    """What is seen."""
    collision: tuple[Part, ...]
    """What touches."""
    mass: float | None = None
    """kg, as the URDF has it."""
    colour: Colour | None = None
    """RGB in [0, 1], as the URDF has it; for meshes without texture."""

    @cached_property
    def sha256(self) -> str:
        """16 hex digits over the files, their placement and how they are prepared."""
        parts = [*self.visual, *self.collision]
        settings = [PREPARATION, VHACD, MAX_HULLS, MAX_VERTICES, CONVEX, self.mass, self.colour]
        digest = hashlib.sha256(json.dumps([*settings, len(self.visual)], sort_keys=True).encode())
        for part in parts:
            digest.update(part.T_object_part.tobytes())
            for file in (part.file, *attachments(part.file)):
                digest.update(hashlib.sha256(file.read_bytes()).digest())
        return digest.hexdigest()[:16]


def find_sources(folder: Path) -> list[Source]:
    """Returns the models of a folder by name: its URDFs at any depth or, where there are none, its meshes.

    Raises:
        UserError: there are neither, or a file that one of them names is missing; it names the file.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder of objects")
    # What is hidden is being written, or is nobody's object.
    shown = [file for file in folder.rglob("*") if not any(part[0] == "." for part in file.relative_to(folder).parts)]
    files = sorted(file for file in shown if file.suffix.lower() == ".urdf")
    read = _read_urdf
    if not files:
        files, read = sorted(file for file in shown if file.suffix.lower() in MESHES), _read_mesh
    if not files:
        raise UserError(f"{folder}: neither a URDF nor a mesh ({', '.join(MESHES)}) in this folder")
    return [read(file, name) for name, file in zip(_names(folder, files), files, strict=True)]


def attachments(mesh: Path) -> list[Path]:
    """Returns the material and texture files that an OBJ names.

    Raises:
        UserError: one of them is missing.
    """
    if mesh.suffix.lower() != ".obj":
        return []
    found = []
    for materials in _named(mesh, "mtllib"):
        found.append(materials)
        found += _named(materials, "map_Kd")
    return found


def _named(file: Path, key: str) -> list[Path]:
    """Returns the files that a line of an OBJ or MTL file names."""
    found = re.findall(rf"^\s*{key}[ \t]+(.*\S)", file.read_text(errors="replace"), re.MULTILINE)
    # Options stand before a texture's name; names may hold blanks.
    names = [name.split()[-1] if name.startswith("-") else name for name in found]
    files = [file.parent / name.replace("\\", "/") for name in names]
    for needed in files:
        if not needed.is_file():
            raise UserError(f"{file}: it names {needed.name}, and there is no such file")
    return files


def _names(folder: Path, files: Sequence[Path]) -> list[str]:
    """Returns the files' stems, or their paths where stems repeat."""
    stems = [file.stem for file in files]
    if len(set(stems)) == len(stems):
        return stems
    return ["-".join(file.relative_to(folder).with_suffix("").parts) for file in files]


def _read_mesh(file: Path, name: str) -> Source:
    attachments(file)
    part = (Part(file, np.eye(4)),)
    return Source(name, file, part, part)


def _read_urdf(file: Path, name: str) -> Source:
    try:
        robot = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, OSError) as error:
        raise UserError(f"{file}: not a URDF ({error})") from error
    links = robot.findall("link")
    if len(links) != 1:
        raise UserError(f"{file}: {len(links)} links: an object has one")
    try:
        visual, collision = (tuple(_parts(file, links[0], tag)) for tag in ("visual", "collision"))
        mass = links[0].find("inertial/mass")
        colour = _colour(robot, links[0])
        kilograms = None if mass is None else float(mass.attrib["value"])
    except (KeyError, ValueError) as error:
        raise UserError(f"{file}: damaged URDF ({type(error).__name__}: {error})") from error
    if not visual and not collision:
        raise UserError(f"{file}: it names no mesh")
    return Source(name, file, visual or collision, collision or visual, kilograms, colour)


def _parts(urdf: Path, link: ElementTree.Element, tag: str) -> Iterator[Part]:
    for element in link.findall(tag):
        mesh = element.find("geometry/mesh")
        if mesh is None:
            raise UserError(f"{urdf}: a {tag} without a mesh: boxes, cylinders and spheres are not read")
        file = _mesh_file(urdf, mesh.attrib["filename"])
        attachments(file)
        scale = np.diag([*_numbers(mesh.get("scale"), (1.0, 1.0, 1.0)), 1.0])
        yield Part(file, _origin(element.find("origin")) @ scale)


def _mesh_file(urdf: Path, name: str) -> Path:
    """Finds a mesh beside its URDF; of `package://NAME/PATH`, `PATH` beside it or above."""
    relative = name.split("://", 1)[-1]
    if name.startswith("package://"):
        relative = relative.split("/", 1)[-1]
        folders: Sequence[Path] = urdf.parents
    else:
        folders = [urdf.parent]
    for folder in folders:
        if (folder / relative).is_file():
            return folder / relative
    raise UserError(f"{urdf}: it names the mesh {name}, and there is no such file")


def _origin(element: ElementTree.Element | None) -> NDArray[np.float64]:
    T = np.eye(4)
    if element is not None:
        # Roll, pitch and yaw are about the parent's own axes, one after the other.
        T = trimesh.transformations.euler_matrix(*_numbers(element.get("rpy"), (0.0, 0.0, 0.0)), axes="sxyz")
        T[:3, 3] = _numbers(element.get("xyz"), (0.0, 0.0, 0.0))
    return T


def _colour(robot: ElementTree.Element, link: ElementTree.Element) -> Colour | None:
    """Returns the first visual's colour, which may stand under a material's name elsewhere in the file."""
    material = link.find("visual/material")
    if material is None:
        return None
    named = [other for other in robot.findall("material") if other.get("name") == material.get("name")]
    for element in (material, *named):
        if (colour := element.find("color")) is not None:
            red, green, blue, *_ = (float(word) for word in colour.attrib["rgba"].split())
            return red, green, blue
    return None


def _numbers(text: str | None, default: Colour) -> Colour:
    if text is None:
        return default
    x, y, z = (float(word) for word in text.split())
    return x, y, z
