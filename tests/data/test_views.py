from pathlib import Path

import numpy as np
import torch

from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.views import read_views


def test_views_come_in_the_order_asked_for(packed_set: Path) -> None:
    scenes = PackedScenes(packed_set)
    found = read_views(scenes, 2, np.array([4, 0]))
    assert found.images.shape == (2, 3, 32, 32)
    assert found.images[0, 2, 5, 7] == scenes.images[2, 4, 5, 7, 2] / np.float32(255)
    assert torch.equal(found.T_world_camera, scenes.camera(2).T_world_camera[[4, 0]])
    assert torch.equal(found.intrinsics, scenes.camera(2).intrinsics[[4, 0]])


def test_camera_is_the_set_s(packed_set: Path) -> None:
    scenes = PackedScenes(packed_set)
    camera = read_views(scenes, 1, np.array([3])).camera()
    truth = scenes.camera(1)[torch.tensor([3])]
    assert torch.equal(camera.T_world_camera, truth.T_world_camera)
    assert (camera.width, camera.height) == (truth.width, truth.height) == (32, 32)
