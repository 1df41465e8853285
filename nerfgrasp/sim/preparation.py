"""Making a model ready: a visual mesh with one texture, convex hulls, and mass properties computed from them."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from nerfgrasp.errors import UserError
from nerfgrasp.sim.bullet import HULL_MARGIN
from nerfgrasp.sim.decomposition import convex_pieces, decompose, inset, solid_properties, write_hulls
from nerfgrasp.sim.sources import Colour, Source

DENSITY = 400.0
"""kg/m³, where the model says nothing plausible of its mass."""
PLAUSIBLE_DENSITY = (30.0, 8000.0)
"""kg/m³, from foam to steel."""
SIZES = (0.005, 1.0)
"""Metres. An object's greatest extent lies between them, or it is not in metres."""
MAX_TEXTURE = 1024
"""Pixels. Scans come with four times as many, which no picture here shows and every picture waits for."""
GREY: Colour = (0.7, 0.7, 0.7)
"""Of objects without any colour."""
CREASE = 0.75
"""The least cosine between a triangle's normal and a corner's; at sharper corners the surface has an edge."""


def write_model(source: Source, folder: Path) -> dict[str, Any]:
    """Writes `visual.obj` with its texture, `hulls.obj` and `collision.obj`; returns mass, centre and inertia.

    Raises:
        UserError: a mesh cannot be read, or the object has no size of an object in metres.
    """
    visual = [mesh for part in source.visual for mesh in part.load()]
    check_size(source, visual)
    collision = [mesh for part in source.collision for mesh in part.load()]
    hulls = convex_pieces(collision) or _decompose(source, visual)
    if not hulls:
        raise UserError(f"{source.file}: it has no volume")
    volume = sum(hull.volume for hull in hulls)
    mass = source.mass
    if mass is None or not PLAUSIBLE_DENSITY[0] <= mass / volume <= PLAUSIBLE_DENSITY[1]:
        mass = DENSITY * volume
    centre, inertia = solid_properties(hulls, mass)
    write_visual(folder, visual, source.colour)
    write_hulls(folder / "hulls.obj", hulls)
    write_hulls(folder / "collision.obj", [inset(hull, HULL_MARGIN) for hull in hulls])
    return {"mass": float(mass), "centre": centre.tolist(), "inertia": inertia.tolist()}


def check_size(source: Source, meshes: list[trimesh.Trimesh]) -> None:
    """Raises a UserError where the meshes' greatest extent is none of an object in metres."""
    corners = np.concatenate([mesh.vertices for mesh in meshes])
    extent = float((corners.max(axis=0) - corners.min(axis=0)).max())
    if not np.isfinite(extent):
        raise UserError(f"{source.file}: the mesh has corners that are not finite")
    if extent > SIZES[1]:
        raise UserError(f"{source.file}: the object is {extent:.4g} m long: is the mesh in millimetres?")
    if extent < SIZES[0]:
        raise UserError(f"{source.file}: the object is {extent * 1000:.2g} mm long: is the mesh in metres?")


def write_visual(folder: Path, meshes: list[trimesh.Trimesh], colour: Colour | None = None) -> None:
    """Writes `visual.obj`, `visual.mtl` and `texture.png`: one mesh, one texture, whatever there was.

    Args:
        folder: where.
        meshes: in the object's frame, with texture, colours or neither.
        colour: of meshes without texture.
    """
    mesh: Any = trimesh.util.concatenate([_textured(mesh, colour) for mesh in meshes])
    image = mesh.visual.material.image.convert("RGB")
    image.thumbnail((MAX_TEXTURE, MAX_TEXTURE), Image.Resampling.LANCZOS)
    image.save(folder / "texture.png")
    (folder / "visual.mtl").write_text("newmtl texture\nKd 1 1 1\nmap_Kd texture.png\n")
    lines = ["mtllib visual.mtl", "o visual", "usemtl texture"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.7g} {v:.7g}" for u, v in mesh.visual.uv.tolist()]
    normals, which = np.unique(corner_normals(mesh).reshape(-1, 3).round(5), axis=0, return_inverse=True)
    lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in normals.tolist()]
    for (a, b, c), (i, j, k) in zip((mesh.faces + 1).tolist(), (which.reshape(-1, 3) + 1).tolist(), strict=True):
        lines.append(f"f {a}/{a}/{i} {b}/{b}/{j} {c}/{c}/{k}")
    (folder / "visual.obj").write_text("\n".join(lines) + "\n")


def corner_normals(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Returns a normal for every corner of every triangle `[F, 3, 3]`.

    It is the corner's own where that is finite and near the triangle's, else the triangle's: so edges stay sharp.
    """
    flat = mesh.face_normals[:, None]
    with np.errstate(invalid="ignore"):
        smooth = np.asarray(mesh.vertex_normals)[mesh.faces]
        return np.where((smooth * flat).sum(axis=-1, keepdims=True) >= CREASE, smooth, flat)


def _textured(mesh: trimesh.Trimesh, colour: Colour | None) -> trimesh.Trimesh:
    """Returns the mesh with a texture: its own, or its colours as one."""
    visual: Any = mesh.visual
    if isinstance(visual, trimesh.visual.ColorVisuals):
        of_its_own = visual.defined and colour is None
        mesh.visual = visual.to_texture() if of_its_own else _plain(mesh, colour or GREY)
        return mesh
    material = visual.material.to_simple() if hasattr(visual.material, "to_simple") else visual.material
    if material.image is None or visual.uv is None:
        red, green, blue, _ = (int(part) / 255 for part in material.main_color)
        mesh.visual = _plain(mesh, colour or (red, green, blue))
    else:
        mesh.visual = trimesh.visual.TextureVisuals(visual.uv, material=material)
    return mesh


def _plain(mesh: trimesh.Trimesh, colour: Colour) -> trimesh.visual.TextureVisuals:
    image = Image.new("RGB", (8, 8), tuple(round(255 * part) for part in colour))
    return trimesh.visual.TextureVisuals(np.full((len(mesh.vertices), 2), 0.5), image=image)


def _decompose(source: Source, meshes: list[trimesh.Trimesh]) -> list[trimesh.Trimesh]:
    print(f"nerfgrasp: {source.name}: decomposing into convex hulls, once", file=sys.stderr)
    whole: Any = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces) for mesh in meshes])
    return decompose(whole)
