"""Convex pieces of a mesh: physics knows no other shapes."""

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import HalfspaceIntersection

from nerfgrasp.sim.bullet import p, silence

MAX_HULLS = 32
"""A decomposition into more is made anew: it is slow, and as a rule made of slivers."""
MAX_VERTICES = 128
"""Of one hull, likewise."""
CONVEX = 0.98
"""A piece whose volume is at least this part of its hull's is taken for convex."""
MIN_VOLUME = 1e-9
"""m³. Smaller pieces are rubble of a decomposition."""
VHACD = {"resolution": 1_000_000, "concavity": 0.0006, "maxNumVerticesPerCH": 64}
"""Settings of the decomposition: voxels in all, the hollow that may remain, corners of a hull."""


def convex_pieces(meshes: Iterable[trimesh.Trimesh]) -> list[trimesh.Trimesh] | None:
    """Returns the convex hulls that meshes are made of already; None where they are not.

    Args:
        meshes: each is taken apart into what hangs together.
    """
    # Bare of their texture: along its seams a closed surface counts as open.
    bare = [trimesh.Trimesh(mesh.vertices, mesh.faces) for mesh in meshes]
    pieces = [piece for mesh in bare for piece in mesh.split(only_watertight=False)]
    if not 0 < len(pieces) <= MAX_HULLS or not all(map(_is_convex, pieces)):
        return None
    return [piece.convex_hull for piece in pieces]


def decompose(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Returns convex hulls that cover a mesh closely, by V-HACD; it takes up to a minute and gives the same again.

    The mesh may be open, and its normals may point anywhere: what is decomposed are the voxels within.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "mesh.obj"), Path(folder, "hulls.obj")
        write_hulls(source, [mesh])
        with silence():
            p.vhacd(str(source), str(target), str(Path(folder, "log.txt")), **VHACD)
        pieces = read_objects(target)
    return [hull for hull in (piece.convex_hull for piece in pieces) if hull.volume >= MIN_VOLUME]


def inset(hull: trimesh.Trimesh, margin: float) -> trimesh.Trimesh:
    """Returns a hull whose every face lies `margin` metres further in; less far where the hull is too thin for it."""
    centre = hull.center_mass
    normals = hull.face_normals
    level = (normals * (hull.triangles[:, 0] - centre)).sum(axis=1)
    planes = np.column_stack([normals, min(margin, level.min() / 2) - level])
    # Triangles of one face say the same thing many times over.
    planes = planes[np.unique(planes.round(7), axis=0, return_index=True)[1]]
    corners = HalfspaceIntersection(planes, np.zeros(3)).intersections + centre
    return trimesh.convex.convex_hull(corners)


def write_hulls(path: Path, hulls: Sequence[trimesh.Trimesh]) -> None:
    """Writes meshes as one OBJ file, each an object `o` of its own."""
    lines, first = [], 1
    for number, hull in enumerate(hulls):
        lines.append(f"o hull_{number}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in hull.vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (hull.faces + first).tolist()]
        first += len(hull.vertices)
    path.write_text("\n".join(lines) + "\n")


def read_objects(path: Path) -> list[trimesh.Trimesh]:
    """Reads a mesh file, its objects each for itself where the format knows of objects."""
    # Some published scans have normals that are not numbers.
    with np.errstate(invalid="ignore"):
        scene = trimesh.load_scene(path, split_objects=True, group_material=False)
    meshes = []
    # By name: nothing promises an order of the scene's own, and physics depends on the order.
    for node in sorted(scene.graph.nodes_geometry, key=lambda name: (len(name), name)):
        T_scene_mesh, name = scene.graph[node]
        mesh = scene.geometry[name].copy()
        if isinstance(mesh, trimesh.Trimesh):
            meshes.append(mesh.apply_transform(T_scene_mesh))
    return meshes


def solid_properties(hulls: Sequence[trimesh.Trimesh], mass: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns centre of mass `[3]` and inertia `[3, 3]` about it of hulls of even density that weigh `mass` kg."""
    volumes = np.array([hull.volume for hull in hulls])
    centres = np.array([hull.center_mass for hull in hulls])
    density = mass / volumes.sum()
    centre = (volumes @ centres) / volumes.sum()
    inertia = np.zeros((3, 3))
    for hull, volume, offset in zip(hulls, volumes, centres - centre, strict=True):
        around = offset @ offset * np.eye(3) - np.outer(offset, offset)
        inertia += density * (hull.moment_inertia / hull.density + volume * around)
    return centre, inertia


def _is_convex(piece: trimesh.Trimesh) -> bool:
    if not 4 <= len(piece.vertices) <= MAX_VERTICES or not piece.is_watertight:
        return False
    return bool(abs(piece.volume) >= max(MIN_VOLUME, CONVEX * piece.convex_hull.volume))
