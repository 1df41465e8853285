"""Packed sets: the images of many scenes in arrays that are mapped, not read.

A set's folder holds `set.json`, the arrays of `array_layout` with scenes and views leading, and `scenes/NNNNNN.json`,
the truth of each scene. A scene's truth is written last, so that its being there says the scene is complete.
"""

import errno
import os
from pathlib import Path

import numpy as np
import torch
from numpy.lib.format import open_memmap

from nerfgrasp.data.settings import SET_FILE, SetSettings, claim_folder, read_settings
from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder, read_json, remove, remove_temporaries, replacing, write_json
from nerfgrasp.geometry import Camera
from nerfgrasp.scenes.scene import Observations, Scene, Truth, Workspace
from nerfgrasp.scenes.truth import truth_from_json, truth_to_json

DEPTH_UNIT = 1e-4
"""Metres that a stored depth of 1 stands for; 0 stands for no depth: nothing there, or farther than 6.55 m."""


def array_layout(settings: SetSettings) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Returns shape and type of each of a set's arrays."""
    lead, size = (settings.scenes, settings.views), settings.size
    depth = {"depth": ((*lead, size, size), np.dtype(np.uint16))} if settings.depth else {}
    return {
        "images": ((*lead, size, size, 3), np.dtype(np.uint8)),
        "masks": ((*lead, size, size), np.dtype(np.uint8)),
        "intrinsics": ((*lead, 3, 3), np.dtype(np.float32)),
        "T_world_camera": ((*lead, 4, 4), np.dtype(np.float32)),
        **depth,
    }


class PackedWriter:
    """Writes the scenes of a set, in any order and from any number of processes.

    One process calls `prepare` first. Writing a scene again with the same content changes nothing.

    Args:
        folder: the set's folder.
        settings: what the set is.
    """

    def __init__(self, folder: Path, settings: SetSettings) -> None:
        self.folder = folder
        self.settings = settings

    def prepare(self, workspace: Workspace) -> None:
        """Claims the folder and allocates what is not there yet; what a killed run left half-written goes.

        Raises:
            UserError: the folder holds something else or is damaged, the disk is full, or it is read-only.
        """
        new = claim_folder(self.folder, self.settings, workspace)
        try:
            self._allocate()
        except UserError:
            if new:
                self._withdraw()
            raise

    def missing(self) -> list[int]:
        """Returns the numbers of the scenes that are not complete."""
        complete = _complete(self.folder)
        return [index for index in range(self.settings.scenes) if index not in complete]

    def write(
        self,
        index: int,
        images: np.ndarray,
        masks: np.ndarray,
        camera: Camera,
        truth: Truth,
        depth: np.ndarray | None = None,
    ) -> None:
        """Writes scene `index` and marks it complete.

        Args:
            index: its number in the set.
            images: `[V, H, W, 3]`, RGB, uint8.
            masks: `[V, H, W]` uint8, 0 where there is no object and i + 1 on object i.
            camera: batch shape `[V]`.
            truth: what the scene is made of.
            depth: `[V, H, W]` along the optical axis in metres, infinite where there is none; for sets that keep it.

        Raises:
            UserError: it cannot be written.
        """
        values = [images, masks, camera.intrinsics.numpy(), camera.T_world_camera.numpy()]
        values += [] if depth is None else [_depth_to_units(depth)]
        for name, value in zip(array_layout(self.settings), values, strict=True):
            array = _open_array(self.folder, name, self.settings, "r+")
            array[index] = value
            array.flush()
        write_json(_scene_path(self.folder, index), truth_to_json(truth))

    def clear(self) -> None:
        """Removes what killed processes left half-written; nobody else may be writing."""
        for folder in (self.folder, self.folder / "scenes"):
            remove_temporaries(folder)

    def truth(self, index: int) -> Truth:
        """Returns what scene `index`, a complete one, is made of."""
        return _read_truth(self.folder, index)

    def _allocate(self) -> None:
        make_folder(self.folder / "scenes")
        self.clear()
        begun = bool(_complete(self.folder))
        for name, (shape, dtype) in array_layout(self.settings).items():
            if begun or _array_path(self.folder, name).exists():
                _open_array(self.folder, name, self.settings, "r")
            else:
                _allocate(_array_path(self.folder, name), shape, dtype)

    def _withdraw(self) -> None:
        """Leaves the folder as empty as it was: a set that has no room is not begun."""
        arrays = [_array_path(self.folder, name) for name in array_layout(self.settings)]
        for path in (*arrays, self.folder / "scenes"):
            remove(path)
        remove(self.folder / SET_FILE)


class PackedScenes:
    """A complete packed set, opened for reading; a `SceneSource`. Pickles as its folder's name: workers map it anew.

    Args:
        folder: the set's folder.

    Raises:
        UserError: there is no set, it is not complete, or it is damaged.
    """

    images: np.memmap
    """`[N, V, H, W, 3]` uint8, RGB."""
    masks: np.memmap
    """`[N, V, H, W]` uint8: 0 where there is no object, i + 1 on object i."""
    intrinsics: np.memmap
    """`[N, V, 3, 3]` float32, pixels."""
    T_world_camera: np.memmap
    """`[N, V, 4, 4]` float32, OpenCV axes, metres."""
    depth: np.memmap | None = None
    """`[N, V, H, W]` uint16 in units of `DEPTH_UNIT`, 0 for none; None in a set that keeps no depth."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self.settings, self.workspace = read_settings(self.folder)
        if self.settings.format != "packed":
            raise UserError(f"{self.folder} is a set of {self.settings.format}, not a packed one")
        absent = self.settings.scenes - len(_complete(self.folder))
        if absent > 0:
            raise UserError(f"{self.folder} is not complete: {absent} of {self.settings.scenes} scenes are missing")
        for name in array_layout(self.settings):
            setattr(self, name, _open_array(self.folder, name, self.settings, "r"))

    def __len__(self) -> int:
        return self.settings.scenes

    def __reduce__(self) -> tuple[type["PackedScenes"], tuple[Path]]:
        return PackedScenes, (self.folder,)

    def truth(self, index: int) -> Truth:
        """Returns what scene `index` is made of; a damaged file is a UserError."""
        return _read_truth(self.folder, range(len(self))[index])

    def camera(self, index: int) -> Camera:
        """Returns the cameras of scene `index`, batch shape `[V]`."""
        intrinsics, pose = (torch.from_numpy(np.array(a[index])) for a in (self.intrinsics, self.T_world_camera))
        return Camera(intrinsics, pose, self.settings.size, self.settings.size)

    def workspace_of(self, index: int) -> Workspace:
        """Returns the workspace of scene `index`, which is that of all."""
        return self.workspace

    def read_images(self, index: int, views: np.ndarray) -> np.ndarray:
        """Returns views `[n]` of scene `index`: `[n, H, W, 3]` uint8, RGB."""
        return self.images[index][views]

    def read_colours(self, index: int, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Returns the pixels of scene `index` at (view, y, x), each `[n]`: `[n, 3]` uint8, RGB."""
        return self.images[index][view, y, x]

    def read_masks(self, index: int, views: np.ndarray) -> np.ndarray:
        """Returns `[n, H, W]` uint8: 0 where there is no object, i + 1 on object i."""
        return self.masks[index][views]

    def read_depth(self, index: int, views: np.ndarray) -> np.ndarray:
        """Returns `[n, H, W]` float32: metres along the optical axis, infinite where there is none.

        Raises:
            UserError: the set keeps no depth.
        """
        if self.depth is None:
            raise UserError(f"{self.folder} keeps no depth: generate it with --depth true")
        units = self.depth[index][views]
        return np.where(units > 0, units * np.float32(DEPTH_UNIT), np.float32(np.inf))

    def scene(self, index: int) -> Scene:
        """Returns scene `index` with all its views, named by its number."""
        images = torch.from_numpy(np.array(self.images[index])).movedim(-1, -3) / 255
        observations = Observations(images.contiguous(), self.camera(index))
        return Scene(_scene_path(self.folder, index).stem, observations, self.workspace, self.truth(index))


def _array_path(folder: Path, name: str) -> Path:
    return folder / f"{name}.npy"


def _scene_path(folder: Path, index: int) -> Path:
    return folder / "scenes" / f"{index:06d}.json"


def _depth_to_units(depth: np.ndarray) -> np.ndarray:
    units = np.round(depth / DEPTH_UNIT)
    return np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)


def _read_truth(folder: Path, index: int) -> Truth:
    path = _scene_path(folder, index)
    return truth_from_json(read_json(path), str(path))


def _complete(folder: Path) -> set[int]:
    return {int(path.stem) for path in (folder / "scenes").glob("[0-9]*.json")}


def _allocate(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> None:
    with replacing(path) as temporary:
        open_memmap(temporary, mode="w+", dtype=dtype, shape=shape)
        # A mapped file with holes kills the process that writes it once the disk is full: take the space now.
        if hasattr(os, "posix_fallocate"):
            with temporary.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, temporary.stat().st_size)


def _open_array(folder: Path, name: str, settings: SetSettings, mode: str) -> np.memmap:
    path = _array_path(folder, name)
    shape, dtype = array_layout(settings)[name]
    try:
        array = open_memmap(path, mode=mode)
    except (OSError, ValueError, EOFError) as error:
        if isinstance(error, OSError) and error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            raise UserError(f"cannot {'read' if mode == 'r' else 'write'} {path}: {error.strerror}") from error
        raise UserError(f"{folder} is damaged: cannot read {path.name} ({error})") from error
    if array.shape != shape or array.dtype != dtype:
        raise UserError(f"{folder} is damaged: {path.name} is {array.dtype} {array.shape}, not {dtype} {shape}")
    return array
