import math

import pytest
import torch

from nerfgrasp.geometry import Camera, is_rigid, project
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.viz.imagination import OUTSIDE, _shrink, colour_depth, opposite_camera


def test_the_other_side_is_the_widest_gap(camera: Camera) -> None:
    other = opposite_camera(camera, Workspace())
    assert is_rigid(other.T_world_camera)
    # The cameras stand at 0°, 90° and 180°, all 0.6 m out and 0.5 m up: amid the gap lies 270°.
    assert other.T_world_camera[:3, 3].tolist() == pytest.approx([0.0, -0.6, 0.5], abs=1e-5)
    pixel, depth = project(other, torch.zeros(1, 3))
    assert pixel[0].tolist() == pytest.approx([32.0, 24.0], abs=1e-3)
    assert float(depth) == pytest.approx(math.hypot(0.6, 0.5), abs=1e-5)


def test_the_other_side_of_one_camera_is_opposite(camera: Camera) -> None:
    other = opposite_camera(camera[:1], Workspace())
    assert other.T_world_camera[:3, 3].tolist() == pytest.approx([-0.6, 0.0, 0.5], abs=1e-5)


def test_a_shrunk_camera_sees_the_same(camera: Camera) -> None:
    point = torch.tensor([[0.05, 0.1, 0.02]])
    small = _shrink(camera[0], 32)
    assert (small.width, small.height) == (32, 24)
    assert torch.allclose(project(small, point)[0] * 2, project(camera[0], point)[0], atol=1e-4)
    assert _shrink(small, 64) is small


def test_near_is_bright_and_outside_is_grey() -> None:
    depth = torch.linspace(0.5, 1.5, 64).view(8, 8)
    inside = torch.ones(8, 8, dtype=torch.bool)
    inside[3] = False
    colour = colour_depth(depth, inside)
    assert colour.shape == (8, 8, 3)
    assert float(colour[0, 0].mean()) > 0.8
    assert float(colour[-1, -1].mean()) < 0.1
    assert torch.equal(colour[3], torch.full((8, 3), OUTSIDE))
    assert torch.equal(colour_depth(depth, torch.zeros_like(inside)), torch.full((8, 8, 3), OUTSIDE))
