"""Observations and workspaces made from plain arrays, and checked."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera, is_rigid
from nerfgrasp.scenes.scene import Observations, Workspace

Array = Any
"""A NumPy array, a tensor on any device, or (nested) sequences of numbers or of such."""


def observations_from_arrays(images: Array, intrinsics: Array, T_world_camera: Array) -> Observations:
    """Returns observations of V undistorted pinhole images of one size, on the CPU.

    Args:
        images: `[V, H, W, 3]` or `[V, 3, H, W]`, RGB: uint8, or floats in [0, 1].
        intrinsics: `[3, 3]` or `[V, 3, 3]` in pixels; pixel centres lie at +0.5 (add 0.5 to the cx and cy of OpenCV
            and ROS, whose centres are integers).
        T_world_camera: `[V, 4, 4]`, camera to world, OpenCV axes (x right, y down, z forward), metres.

    Raises:
        UserError: shapes or counts do not fit, a number is not finite, a focal length not positive, or a matrix no
            rigid transform.
    """
    pictures = _pictures(images)
    views, height, width = len(pictures), *pictures.shape[-2:]
    matrices = _numbers("intrinsics", intrinsics)
    matrices = matrices.expand(views, 3, 3) if matrices.shape == (3, 3) else matrices
    poses = _numbers("camera poses", T_world_camera)
    for what, given, shape in (("intrinsics", matrices, (3, 3)), ("camera poses", poses, (4, 4))):
        if given.ndim != 3 or given.shape[1:] != shape:
            raise UserError(f"{what} are of shape {list(given.shape)}: they must be {[views, *shape]}")
        if len(given) != views:
            raise UserError(f"{views} images, but {len(given)} {what}: give one of each a view")
    last = torch.tensor([0.0, 0.0, 1.0])
    for view, matrix in enumerate(matrices):
        if not (matrix.diagonal()[:2] > 0).all() or not torch.allclose(matrix[2], last):
            raise UserError(f"intrinsics of view {view} are no camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    for view in torch.nonzero(~is_rigid(poses))[:, 0].tolist():
        raise UserError(f"camera pose of view {view} is not a rigid transform: a 4x4 rotation and translation")
    return Observations(pictures, Camera(matrices.contiguous(), poses, width, height))


def workspace_from_corners(minimum: Array, maximum: Array, where: str = "workspace") -> Workspace:
    """Returns a box in metres, on the CPU.

    Args:
        minimum: its lower corner, three numbers.
        maximum: its upper corner.
        where: what the message of an error begins with.

    Raises:
        UserError: these are not two corners of a box.
    """
    low, high = (_numbers(f"{where}: a corner", corner) for corner in (minimum, maximum))
    if low.shape != (3,) or high.shape != (3,):
        raise UserError(f"{where} needs two corners, minimum and maximum, of three numbers in metres each")
    if not (low < high).all():
        raise UserError(f"{where} is empty: its minimum is not below its maximum on every axis")
    return Workspace(low, high)


def _pictures(images: Array) -> Tensor:
    """Returns `[V, 3, H, W]` in [0, 1]."""
    given = _tensor("images", images)
    channels_last = given.ndim == 4 and given.shape[-1] == 3
    if given.ndim != 4 or not (channels_last or given.shape[1] == 3) or 0 in given.shape:
        raise UserError(f"images are of shape {list(given.shape)}: they must be RGB, [V, H, W, 3] or [V, 3, H, W]")
    first = given.movedim(-1, 1) if channels_last else given
    if given.dtype == torch.uint8:
        return first.contiguous() / 255
    if not given.is_floating_point():
        raise UserError(
            f"images are of type {str(given.dtype).removeprefix('torch.')}: give uint8, or floats in [0, 1]"
        )
    if not ((given >= 0) & (given <= 1)).all():
        raise UserError("images hold floats that are not in [0, 1], or no numbers: give uint8, or divide by 255")
    return first.float().contiguous()


def _numbers(what: str, given: Array) -> Tensor:
    numbers = _tensor(what, given).float()
    if not numbers.isfinite().all():
        raise UserError(f"{what} holds a number that is not finite")
    return numbers


def _tensor(what: str, given: Array) -> Tensor:
    if isinstance(given, Sequence) and given and isinstance(given[0], Tensor):
        given = [one.detach().cpu() for one in given]
    try:
        array = given.detach().cpu() if isinstance(given, Tensor) else torch.from_numpy(np.array(given))
    except (TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"{what}: no array of numbers: {' '.join(str(error).split())}") from error
    return array
