from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nerfgrasp.errors import UserError
from nerfgrasp.scenes.arrays import observations_from_arrays, workspace_from_corners

BYTES = np.random.default_rng(0).integers(0, 256, (2, 4, 6, 3), dtype=np.uint8)
K = np.array([[5.0, 0.0, 3.0], [0.0, 5.0, 2.0], [0.0, 0.0, 1.0]])
POSES = np.eye(4)[None].repeat(2, axis=0)


@pytest.mark.parametrize(
    "images",
    [
        BYTES,
        torch.from_numpy(BYTES),
        list(BYTES),
        [torch.from_numpy(image) for image in BYTES],
        [Image.fromarray(image) for image in BYTES],
        BYTES.transpose(0, 3, 1, 2),
        BYTES / 255,
        (BYTES / 255).astype(np.float32).transpose(0, 3, 1, 2),
    ],
    ids=["array", "tensor", "arrays", "tensors", "pillow", "channels-first", "double", "float"],
)
def test_images_of_any_kind_are_the_same_observations(images: Any) -> None:
    observations = observations_from_arrays(images, K, POSES)
    expected = torch.from_numpy(BYTES).permute(0, 3, 1, 2).float() / 255
    assert torch.allclose(observations.images, expected, atol=1e-6)
    camera = observations.camera
    assert (camera.width, camera.height, len(camera)) == (6, 4, 2)
    assert torch.equal(camera.intrinsics, torch.from_numpy(K).float().expand(2, 3, 3))
    assert camera.T_world_camera.dtype == torch.float32


def changed(array: Any, at: tuple[int, ...], value: float) -> Any:
    copy = np.array(array, dtype=np.float64)
    copy[at] = value
    return copy


@pytest.mark.parametrize(
    ("images", "intrinsics", "poses", "message"),
    [
        (BYTES[0], K, POSES, r"images are of shape \[4, 6, 3\]: they must be RGB"),
        (BYTES[:0], K, POSES[:0], r"images are of shape \[0, 4, 6, 3\]"),
        (np.zeros((2, 4, 6, 4), np.uint8), K, POSES, r"images are of shape \[2, 4, 6, 4\]"),
        ([BYTES[0], BYTES[1][:2]], K, POSES, "images: no array of numbers"),
        (BYTES.astype(np.int64), K, POSES, "images are of type int64: give uint8"),
        (BYTES.astype(np.float32), K, POSES, r"not in \[0, 1\]"),
        (changed(BYTES / 255, (0, 0, 0, 0), np.nan), K, POSES, r"not in \[0, 1\], or no numbers"),
        (BYTES, K[:2], POSES, r"intrinsics are of shape \[2, 3\]: they must be \[2, 3, 3\]"),
        (BYTES, np.stack([K] * 3), POSES, "2 images, but 3 intrinsics"),
        (BYTES, K, POSES[:1], "2 images, but 1 camera poses"),
        (BYTES, K, POSES[:, :3], r"camera poses are of shape \[2, 3, 4\]"),
        (BYTES, changed(K, (0, 0), np.nan), POSES, "intrinsics holds a number that is not finite"),
        (BYTES, changed(K, (1, 1), -5.0), POSES, "intrinsics of view 0 are no camera matrix"),
        (BYTES, np.stack([K, K.T]), POSES, "intrinsics of view 1 are no camera matrix"),
        (BYTES, K, changed(POSES, (1, 0, 0), 2.0), "camera pose of view 1 is not a rigid transform"),
        (BYTES, K, changed(POSES, (1, 0, 3), np.inf), "camera poses holds a number that is not finite"),
        (BYTES, "K", POSES, "intrinsics: no array of numbers"),
    ],
)
def test_what_does_not_fit_is_told(images: Any, intrinsics: Any, poses: Any, message: str) -> None:
    with pytest.raises(UserError, match=message):
        observations_from_arrays(images, intrinsics, poses)


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ([0, 0], [1, 1, 1], "workspace needs two corners"),
        ([0, 0, 0], [1, 0, 1], "workspace is empty"),
        ([0, 0, 0], [1, -1, 1], "workspace is empty"),
        ([0, 0, np.nan], [1, 1, 1], "workspace: a corner holds a number that is not finite"),
        ([0, 0, "a"], [1, 1, 1], "workspace: a corner: no array of numbers"),
    ],
)
def test_what_is_no_box_is_told(low: Any, high: Any, message: str) -> None:
    with pytest.raises(UserError, match=message):
        workspace_from_corners(low, high)


def test_a_box_of_any_numbers() -> None:
    box = workspace_from_corners((0, 0, 0), np.array([0.5, 1.0, 2.0]))
    assert box.maximum.tolist() == [0.5, 1.0, 2.0]
    assert box.minimum.dtype == box.maximum.dtype == torch.float32
