"""Scenes on disk: a folder of images and `transforms.json`, as nerfstudio and instant-ngp write it.

On disk, cameras are OpenGL camera-to-world (x right, y up, z backward); in memory they are OpenCV's (x right, y
down, z forward). They are converted here and nowhere else. Pixel centres lie at +0.5 in both. What is ours, the
workspace and the truth, stands under the key `nerfgrasp`; a scene without it has the default workspace.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder, read_json, replacing
from nerfgrasp.geometry import Camera, is_rigid
from nerfgrasp.scenes.images import image_size, read_image
from nerfgrasp.scenes.scene import Observations, Scene, Truth, Workspace
from nerfgrasp.scenes.truth import (
    tensor_to_json,
    truth_from_json,
    truth_to_json,
    workspace_from_json,
    workspace_to_json,
)

FORMAT_VERSION = 1
SCENE_FILE = "transforms.json"

_OPENGL_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
_PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE")
_DISTORTIONS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


@dataclass(frozen=True)
class SceneFiles:
    """A scene folder whose images are read one at a time."""

    path: Path
    """Its `transforms.json`."""
    images: tuple[Path, ...]
    """The files of its V views."""
    camera: Camera
    """Batch shape `[V]`."""
    workspace: Workspace
    """Where grasps are searched."""
    truth: Truth | None
    """Known in simulation."""

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.parent.resolve().name

    def image(self, view: int) -> Tensor:
        """Returns a view's image `[3, H, W]`, RGB in [0, 1], transparent pixels laid on white.

        Raises:
            UserError: it is damaged or has more than 8 bits a channel.
        """
        return read_image(self.images[view], f"{self.path}, frame {view}")


def open_scene(folder: Path) -> SceneFiles:
    """Reads a scene folder but for its images, all its frames in the order of the file.

    Intrinsics may stand at the top or in each frame: `fl_x` or `camera_angle_x`; `fl_y`, else `camera_angle_y`,
    else as x; `cx`, `cy`, else the image's centre; `w`, `h`, else the image's own.

    Args:
        folder: holds `transforms.json`; frames name their images relative to it, with or without a suffix.

    Raises:
        UserError: anything is missing, damaged, not finite or of another size, a matrix is no rigid transform,
            or the images are distorted. The line names the file and the frame.
    """
    folder, path, data = _read_transforms(folder)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path}: no frames")
    views = [_read_frame(folder, data, frame, f"{path}, frame {i}") for i, frame in enumerate(frames)]
    width, height = _same_size([view.size for view in views], path)
    intrinsics, poses = torch.stack([v.intrinsics for v in views]), torch.stack([v.T_world_camera for v in views])
    camera = Camera(intrinsics, poses, width, height)
    return SceneFiles(path, tuple(view.image for view in views), camera, *_read_ours(data, path))


def read_scene(folder: Path) -> Scene:
    """Reads a scene folder with its images; arguments and errors as `open_scene`'s and `SceneFiles.image`'s."""
    files = open_scene(folder)
    images = torch.stack([files.image(view) for view in range(len(files.images))])
    return Scene(files.name, Observations(images, files.camera), files.workspace, files.truth)


def read_truth(folder: Path) -> Truth | None:
    """Returns what a scene is made of, if its folder says so, without reading its images."""
    _, path, data = _read_transforms(folder)
    return _read_ours(data, path)[1]


def write_scene(folder: Path, scene: Scene) -> None:
    """Writes a scene folder, whole or not at all: 8-bit PNG images and `transforms.json`. Depth is not kept.

    Args:
        folder: must not be there, or be empty.
        scene: is read back exactly where its images are multiples of 1/255 and its numbers float32.

    Raises:
        UserError: the folder is there and not empty, or it cannot be written.
    """
    folder = Path(folder).resolve()
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise UserError(f"{folder} is already there: give a new folder")
    make_folder(folder.parent)
    with replacing(folder) as temporary:
        (temporary / "images").mkdir(parents=True)
        names = [f"images/{view:03d}.png" for view in range(len(scene.observations))]
        for name, image in zip(names, scene.observations.images, strict=True):
            pixels = (image.detach().cpu() * 255).round().clamp(0, 255).byte().movedim(0, -1)
            Image.fromarray(pixels.numpy()).save(temporary / name)
        text = json.dumps(_transforms(scene, names), indent=2, allow_nan=False)
        (temporary / SCENE_FILE).write_text(text + "\n")


def _transforms(scene: Scene, names: list[str]) -> dict[str, Any]:
    camera = scene.observations.camera
    ours: dict[str, Any] = {"version": FORMAT_VERSION, "workspace": workspace_to_json(scene.workspace)}
    if scene.truth is not None:
        ours["truth"] = truth_to_json(scene.truth)
    intrinsics = [_intrinsics_to_json(matrix) for matrix in camera.intrinsics]
    shared = intrinsics[0] if all(each == intrinsics[0] for each in intrinsics) else {}
    frames = [
        ({} if shared else each) | {"file_path": name, "transform_matrix": tensor_to_json(pose)}
        for each, name, pose in zip(intrinsics, names, _swap_axes(camera.T_world_camera.cpu()), strict=True)
    ]
    size = {"w": camera.width, "h": camera.height}
    return {"camera_model": "PINHOLE", **size, **shared, "frames": frames, "nerfgrasp": ours}


def _intrinsics_to_json(matrix: Tensor) -> dict[str, float]:
    fl_x, cx, fl_y, cy = (tensor_to_json(matrix[at]) for at in ((0, 0), (0, 2), (1, 1), (1, 2)))
    return {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}


def _swap_axes(T_world_camera: Tensor) -> Tensor:
    """OpenGL's camera axes to OpenCV's, or back: y and z turn over."""
    return T_world_camera @ _OPENGL_OPENCV.to(T_world_camera.dtype)


def _read_transforms(folder: Path) -> tuple[Path, Path, dict[str, Any]]:
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder")
    return folder, folder / SCENE_FILE, read_json(folder / SCENE_FILE)


def _read_ours(data: dict[str, Any], path: Path) -> tuple[Workspace, Truth | None]:
    if "nerfgrasp" not in data:
        return Workspace(), None
    ours, where = data["nerfgrasp"], f"{path}, key 'nerfgrasp'"
    if not isinstance(ours, dict) or ours.get("version") != FORMAT_VERSION:
        raise UserError(f"{where}: not of version {FORMAT_VERSION}")
    workspace = workspace_from_json(ours["workspace"], where) if "workspace" in ours else Workspace()
    return workspace, truth_from_json(ours["truth"], where) if ours.get("truth") is not None else None


class _Frame(NamedTuple):
    image: Path
    size: tuple[int, int]
    """Width and height in pixels."""
    intrinsics: Tensor
    """`[3, 3]`"""
    T_world_camera: Tensor
    """`[4, 4]`"""


def _read_frame(folder: Path, data: dict[str, Any], frame: Any, where: str) -> _Frame:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise UserError(f"{where}: 'file_path' is missing")
    values = {**{key: value for key, value in data.items() if key != "frames"}, **frame}
    _check_undistorted(values, where)
    pose = _pose(values, where)
    image = _find_image(folder, frame["file_path"], where)
    width, height = image_size(image, where)
    for key, actual in (("w", width), ("h", height)):
        if key in values and _number(values, key, where) != actual:
            raise UserError(f"{where}: the image {frame['file_path']} is {width}x{height}, but {key} is {values[key]}")
    return _Frame(image, (width, height), _intrinsics(values, width, height, where), pose)


def _same_size(sizes: list[tuple[int, int]], path: Path) -> tuple[int, int]:
    for index, (width, height) in enumerate(sizes):
        if (width, height) != sizes[0]:
            first = "x".join(map(str, sizes[0]))
            raise UserError(f"{path}, frame {index}: the image is {width}x{height}, but frame 0's is {first}")
    return sizes[0]


def _find_image(folder: Path, name: str, where: str) -> Path:
    for suffix in _SUFFIXES:
        path = folder / (name + suffix)
        if path.is_file():
            return path
    raise UserError(f"{where}: the image {name} is missing")


def _check_undistorted(values: dict[str, Any], where: str) -> None:
    model = values.get("camera_model", "PINHOLE")
    if model not in _PINHOLE_MODELS or values.get("is_fisheye"):
        raise UserError(f"{where}: camera model {model!r} is no pinhole camera: undistort the images first")
    for key in _DISTORTIONS:
        if key in values and _number(values, key, where) != 0:
            raise UserError(f"{where}: the images are distorted ({key} is {values[key]}): undistort them first")


def _intrinsics(values: dict[str, Any], width: int, height: int, where: str) -> Tensor:
    fl_x = _focal_length(values, "x", width, where)
    if fl_x is None:
        raise UserError(f"{where}: 'fl_x' is missing")
    fl_y = _focal_length(values, "y", height, where)
    cx = _number(values, "cx", where) if "cx" in values else width / 2
    cy = _number(values, "cy", where) if "cy" in values else height / 2
    return torch.tensor([[fl_x, 0.0, cx], [0.0, fl_x if fl_y is None else fl_y, cy], [0.0, 0.0, 1.0]])


def _focal_length(values: dict[str, Any], axis: str, extent: int, where: str) -> float | None:
    """Pixels, from `fl_` or from the field of view `camera_angle_` (radians, edge to edge)."""
    key, angle = f"fl_{axis}", f"camera_angle_{axis}"
    if key in values:
        length = _number(values, key, where)
    elif angle in values:
        key, field_of_view = angle, _number(values, angle, where)
        length = extent / 2 / math.tan(field_of_view / 2) if 0 < field_of_view < math.pi else 0.0
    else:
        return None
    if length <= 0:
        raise UserError(f"{where}: {key} is {values[key]}, which is no focal length")
    return length


def _pose(values: dict[str, Any], where: str) -> Tensor:
    if "transform_matrix" not in values:
        raise UserError(f"{where}: 'transform_matrix' is missing")
    try:
        matrix = torch.from_numpy(np.array(values["transform_matrix"], dtype=np.float64))
    except (TypeError, ValueError, OverflowError):
        matrix = torch.empty(0)
    if matrix.shape != (4, 4):
        raise UserError(f"{where}: 'transform_matrix' is not 4x4 numbers")
    if not matrix.isfinite().all():
        raise UserError(f"{where}: 'transform_matrix' holds a number that is not finite")
    if not is_rigid(matrix):
        raise UserError(f"{where}: 'transform_matrix' is not a rigid transform")
    return _swap_axes(matrix).float()


def _number(values: dict[str, Any], key: str, where: str) -> float:
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
        raise UserError(f"{where}: {key!r} is {value!r}, which is no finite number")
    return float(value)
