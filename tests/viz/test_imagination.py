import math

import pytest
import torch

from nerfgrasp.geometry import Camera, is_rigid, project
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.viz.imagination import full_orbit, opposite_camera


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


def test_a_full_orbit_starts_at_the_first_camera_and_turns_on(camera: Camera) -> None:
    around = full_orbit(camera[1:], Workspace(), 4)
    eyes = torch.tensor([[0.0, 0.6, 0.5], [-0.6, 0.0, 0.5], [0.0, -0.6, 0.5], [0.6, 0.0, 0.5]])
    assert torch.allclose(around.T_world_camera[:, :3, 3], eyes, atol=1e-5)
    pixels, _ = project(around, torch.zeros(4, 1, 3))
    assert torch.allclose(pixels, torch.tensor([32.0, 24.0]), atol=1e-3)
