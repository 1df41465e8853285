"""Scenes of many views, wherever they come from: what training draws its rays from."""

from pathlib import Path
from typing import Protocol

import numpy as np

from nerfgrasp.data.captures import CapturedScenes, scene_folders
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.settings import SET_FILE, read_settings
from nerfgrasp.data.streams import SceneSet, check_enough
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera
from nerfgrasp.scenes.scene import Workspace


class SceneSource(Protocol):
    """N scenes, each with V views of one size; V and the size may differ between scenes."""

    def __len__(self) -> int: ...

    def camera(self, index: int) -> Camera:
        """Returns the cameras of a scene's views, batch shape `[V]`."""

    def workspace_of(self, index: int) -> Workspace:
        """Returns a scene's workspace."""

    def read_images(self, index: int, views: np.ndarray) -> np.ndarray:
        """Returns views `[n]` of a scene: `[n, H, W, 3]` uint8, RGB."""

    def read_colours(self, index: int, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Returns a scene's pixels at (view, y, x), each `[n]`: `[n, 3]` uint8, RGB."""

    def read_masks(self, index: int, views: np.ndarray) -> np.ndarray:
        """Returns `[n, H, W]` uint8: 0 where no object is known to be."""


def open_source(source: SceneSet | Path) -> SceneSource:
    """Opens a set, or whatever a folder holds: a packed set, one scene, or folders of one scene each.

    Raises:
        UserError: it is missing, incomplete or damaged.
    """
    if isinstance(source, SceneSet):
        return source.open()
    return PackedScenes(source) if _is_packed(source) else CapturedScenes(source)


def _is_packed(folder: Path) -> bool:
    return (folder / SET_FILE).exists() and read_settings(folder)[0].format == "packed"


def one_folder(source: SceneSet | Path, other: SceneSet | Path) -> bool:
    """Returns whether two sources are the same folder, however it is spelled."""
    return _folder(source) == _folder(other)


def check_apart(source: SceneSet | Path, other: SceneSet | Path) -> None:
    """Compares what is learned from with what is kept out of it, where at least one is a folder.

    Raises:
        UserError: one lies in the other, or they share a scene, but they are not one folder.
    """
    one, two = _folder(source), _folder(other)
    if one == two or (isinstance(source, SceneSet) and isinstance(other, SceneSet)):
        return
    where = f"data.init_args: train ({one}) and validation ({two})"
    if one in two.parents or two in one.parents:
        raise UserError(f"{where} lie one in the other: give two folders apart, or one twice")
    shared = _scenes_of(source) & _scenes_of(other)
    if shared:
        raise UserError(f"{where} share the scene {min(shared)}: give two folders apart, or one twice")


def _folder(source: SceneSet | Path) -> Path:
    """Returns a source's folder, absolute and with links followed."""
    return Path(source.folder if isinstance(source, SceneSet) else source).resolve()


def _scenes_of(source: SceneSet | Path) -> set[Path]:
    """Returns the folders of captured scenes, of any other set its own."""
    folder = _folder(source)
    if isinstance(source, SceneSet) or _is_packed(folder):
        return {folder}
    return {path.resolve() for path in scene_folders(folder)}


def check_source(where: str, source: SceneSet | Path, scenes: int, views: int, alike: bool) -> None:
    """Compares what is drawn at once with what a source holds, without making a set that is not there yet.

    Args:
        where: the beginning of the message.
        source: what is drawn from.
        scenes: scenes drawn at once.
        views: views drawn of each.
        alike: whether images of different scenes must be of one size.

    Raises:
        UserError: the source holds too little, or a folder cannot be read.
    """
    if isinstance(source, SceneSet):
        check_enough(where, "scenes", scenes, source.scenes)
        check_enough(where, "views", views, source.views)
        return
    opened = open_source(source)
    cameras = [opened.camera(index) for index in range(len(opened))]
    check_enough(where, "scenes", scenes, len(cameras))
    check_enough(where, "views", views, min(len(camera) for camera in cameras))
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if alike and len(sizes) > 1:
        two = " and ".join(f"{width}x{height}" for width, height in sizes[:2])
        raise UserError(f"{where}: images of {two} do not stack: give data.init_args.image_size, the network's")
