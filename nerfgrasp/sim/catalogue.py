"""Catalogues of object models: folders of URDFs or meshes, prepared for physics and pictures once."""

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nerfgrasp.errors import UserError, unknown_name
from nerfgrasp.files import make_folder, read_json, replacing, write_json
from nerfgrasp.scenes.meshes import MeshObject
from nerfgrasp.sim.decomposition import read_objects
from nerfgrasp.sim.preparation import write_model
from nerfgrasp.sim.sources import Source, find_sources

VARIABLE = "NERFGRASP_OBJECTS"
"""The environment variable that names the folder where none is given."""
PYBULLET = "pybullet"
"""The name of the catalogue of the pybullet package's own objects."""


@dataclass(frozen=True)
class ObjectModel:
    """One object, ready for physics and pictures. All its files share one frame, metres."""

    name: str
    """Unique in its catalogue."""
    catalogue: str
    """The catalogue's name."""
    sha256: str
    """16 hex digits over the files that it was made of."""
    visual: Path
    """OBJ with a texture."""
    hulls: Path
    """OBJ with one `o` a convex hull."""
    collision: Path
    """The same hulls, each smaller by the margin by which Bullet inflates them."""
    mass: float
    """kg."""
    centre: tuple[float, float, float]
    """Centre of mass, metres."""
    inertia: tuple[tuple[float, float, float], ...]
    """`[3][3]` about the centre of mass, kg m²."""

    def corners(self) -> NDArray[np.float64]:
        """Returns the hulls' corners `[K, 3]`, metres."""
        return np.concatenate([hull.vertices for hull in read_objects(self.hulls)])

    def place(self, T_world_object: Tensor | None = None) -> MeshObject:
        """Returns the object of a scene that is this model, at `T_world_object` `[4, 4]`."""
        pose = torch.eye(4) if T_world_object is None else T_world_object
        first, second, third = self.inertia
        return MeshObject(self.name, self.catalogue, self.sha256, self.mass, self.centre, (first, second, third), pose)


@dataclass(frozen=True)
class Catalogue:
    """The objects of a folder, in the order of their names."""

    name: str
    """The folder's."""
    sources: tuple[Source, ...]
    """Its models as they were found."""

    @property
    def names(self) -> tuple[str, ...]:
        """The models' names."""
        return tuple(source.name for source in self.sources)

    @cached_property
    def sha256(self) -> str:
        """16 hex digits over all models."""
        text = "\n".join(f"{source.name} {source.sha256}" for source in self.sources)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def models(self) -> tuple[ObjectModel, ...]:
        """All models; those that never were are prepared now, a minute each at most.

        Raises:
            UserError: one of them cannot be read, or has no size of an object in metres.
        """
        return tuple(map(self.model, self.names))

    def model(self, name: str) -> ObjectModel:
        """Returns one model, which is prepared now if it never was.

        Raises:
            UserError: there is none of this name, it cannot be read, or it has no size of an object in metres.
        """
        for source in self.sources:
            if source.name == name:
                return _prepared(self.name, source)
        raise unknown_name(f"object of {self.name}", name, self.names)


def open_catalogue(folder: Path | None = None) -> Catalogue:
    """Returns the catalogue of a folder of URDFs or of meshes, textures beside them.

    Args:
        folder: where it is; without, the folder that NERFGRASP_OBJECTS names or else the objects that come with
            the pybullet package, as the catalogue `pybullet`.

    Raises:
        UserError: there are no models, or a file that one of them names is missing.
    """
    chosen = chosen_folder(folder)
    return _package_catalogue() if chosen is None else _open(chosen)


def chosen_folder(folder: Path | None = None) -> Path | None:
    """Returns the absolute folder that `open_catalogue` opens for `folder`; None where it is the package's own."""
    named = folder or os.environ.get(VARIABLE)
    return Path(named).resolve() if named else None


def model_of(thing: MeshObject) -> ObjectModel:
    """Returns the model that an object of a scene names.

    It is looked for in the catalogues that this process has opened, in the folder that NERFGRASP_OBJECTS names and
    among pybullet's.

    Raises:
        UserError: it is nowhere, or its files are no longer those of the scene.
    """
    changed = None
    for catalogue in _known():
        if catalogue.name == thing.catalogue and thing.name in catalogue.names:
            model = catalogue.model(thing.name)
            if model.sha256 == thing.sha256:
                return model
            changed = model.sha256
    what = f"object {thing.name!r} of the catalogue {thing.catalogue!r}"
    if changed:
        raise UserError(
            f"{what} is not the scene's: its files' hash is {changed}, the scene was made with {thing.sha256}"
        )
    raise UserError(f"{what} is not here: name its folder by --objects or by the variable {VARIABLE}")


def cache_folder() -> Path:
    """Returns where prepared models are kept: `nerfgrasp/objects` in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nerfgrasp" / "objects"


_opened: dict[Path, Catalogue] = {}


def _open(folder: Path) -> Catalogue:
    if folder not in _opened:
        _opened[folder] = Catalogue(folder.name, tuple(find_sources(folder)))
    return _opened[folder]


@cache
def _package_catalogue() -> Catalogue:
    import pybullet_data

    return Catalogue(PYBULLET, tuple(find_sources(Path(pybullet_data.getDataPath(), "random_urdfs"))))


def _known() -> Iterator[Catalogue]:
    yield from list(_opened.values())
    if os.environ.get(VARIABLE):
        yield open_catalogue()
    yield _package_catalogue()


def _prepared(catalogue: str, source: Source) -> ObjectModel:
    folder = cache_folder() / source.sha256
    if not folder.is_dir():
        _prepare(source, folder)
    data = read_json(folder / "model.json")
    centre, inertia = tuple(data["centre"]), tuple(map(tuple, data["inertia"]))
    files = (folder / "visual.obj", folder / "hulls.obj", folder / "collision.obj")
    return ObjectModel(source.name, catalogue, source.sha256, *files, data["mass"], centre, inertia)


def _prepare(source: Source, folder: Path) -> None:
    """Writes the model's folder whole or not at all."""
    make_folder(folder.parent)
    try:
        with replacing(folder) as temporary:
            make_folder(temporary)
            write_json(temporary / "model.json", write_model(source, temporary))
    except UserError:
        # Another process may have been faster, and what it wrote is the same.
        if not folder.is_dir():
            raise
