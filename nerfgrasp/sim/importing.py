"""Importing object models into a folder of our own form: URDF, textured mesh and convex hulls for each."""

import re
import shutil
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder, read_json, replacing, write_json
from nerfgrasp.sim.archives import check_sha256, fetch, is_url, unpack
from nerfgrasp.sim.catalogue import Catalogue, ObjectModel, cache_folder
from nerfgrasp.sim.sources import Part, Source, attachments, find_sources

YCB_MASSES = {
    "002_master_chef_can": 0.414,
    "009_gelatin_box": 0.097,
    "011_banana": 0.066,
    "012_strawberry": 0.018,
    "016_pear": 0.049,
    "035_power_drill": 0.895,
    "048_hammer": 0.665,
    "056_tennis_ball": 0.058,
    "061_foam_brick": 0.028,
}
"""kg, of the paper's nine, as Calli et al. 2015 weighed them: YCB's archives say nothing of mass."""
FILES = ("visual.obj", "visual.mtl", "texture.png", "hulls.obj")
"""Of a prepared model, those that an object's folder has."""
ORIGIN = "source.json"
"""What an object's folder says of where it came from."""


def import_source(source: str, out: Path, sha256: str | None = None) -> Iterator[tuple[str, bool]]:
    """Imports the objects of one source; yields each one's name and whether it is new.

    Args:
        source: an archive, the URL of one, or a folder.
        out: the folder in which each object gets one of its own.
        sha256: checksum of the archive.

    Raises:
        UserError: the source cannot be had, is damaged or holds no objects, or `out` holds another object of the
            same name.
    """
    path = fetch(source, cache_folder().parent / "downloads", sha256) if is_url(source) else Path(source)
    if path.is_dir():
        if sha256 is not None:
            raise UserError(f"{path} is a folder: --sha256 is the checksum of an archive")
        yield from _import_folder(path, out, source)
        return
    if not path.is_file():
        raise UserError(f"{source}: no such file or folder")
    check_sha256(path, sha256)
    with tempfile.TemporaryDirectory() as folder:
        unpack(path, Path(folder))
        try:
            yield from _import_folder(Path(folder), out, source)
        except UserError as error:
            raise UserError(str(error).replace(folder, source)) from error


def find_scans(folder: Path) -> list[Source]:
    """Returns the objects that lie in `folder` as YCB publishes them: `ID/google_16k/textured.obj`.

    Of several resolutions the first by name is taken; `011_banana` is called `banana`.

    Raises:
        UserError: the texture of one is missing.
    """
    found: dict[str, Source] = {}
    for file in sorted(folder.rglob("textured.obj")):
        identity = file.parent.parent.name
        if file.parent.name.startswith("google_") and identity not in found:
            attachments(file)
            part = (Part(file, np.eye(4)),)
            name = re.sub(r"^\d+_", "", identity)
            found[identity] = Source(name, file, part, part, YCB_MASSES.get(identity))
    return list(found.values())


def write_object(model: ObjectModel, folder: Path, origin: str) -> None:
    """Writes one object's folder, whole or not at all.

    Args:
        model: the object.
        folder: its folder.
        origin: where it came from, in words.
    """
    with replacing(folder) as temporary:
        make_folder(temporary)
        for name in FILES:
            shutil.copyfile(model.visual.parent / name, temporary / name)
        _write_urdf(temporary / f"{model.name}.urdf", model)
        write_json(temporary / ORIGIN, {"source": origin, "sha256": model.sha256}, indent=1)


def _import_folder(folder: Path, out: Path, origin: str) -> Iterator[tuple[str, bool]]:
    # A catalogue's own URDFs say more than the meshes that they name.
    scans = [] if any(folder.rglob("*.urdf")) else find_scans(folder)
    for source in scans or find_sources(folder):
        target = out / source.name
        if target.exists():
            if not (target / ORIGIN).is_file() or read_json(target / ORIGIN).get("sha256") != source.sha256:
                raise UserError(f"{target} is there already, and it was not made of {source.file}: remove it first")
            yield source.name, False
        else:
            write_object(Catalogue(out.name, (source,)).model(source.name), target, origin)
            yield source.name, True


def _write_urdf(path: Path, model: ObjectModel) -> None:
    robot = ElementTree.Element("robot", name=model.name)
    link = ElementTree.SubElement(robot, "link", name=model.name)
    for tag, file in (("visual", "visual.obj"), ("collision", "hulls.obj")):
        geometry = ElementTree.SubElement(ElementTree.SubElement(link, tag), "geometry")
        ElementTree.SubElement(geometry, "mesh", filename=file)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=" ".join(f"{x:.9g}" for x in model.centre))
    ElementTree.SubElement(inertial, "mass", value=f"{model.mass:.9g}")
    moments = {f"i{'xyz'[i]}{'xyz'[j]}": f"{model.inertia[i][j]:.9g}" for i in range(3) for j in range(i, 3)}
    ElementTree.SubElement(inertial, "inertia", moments)
    ElementTree.indent(robot)
    ElementTree.ElementTree(robot).write(path, encoding="unicode")
