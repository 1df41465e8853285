import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from elsewhere import another_device

from nerfgrasp.geometry import Camera, is_rigid, project, transform
from nerfgrasp.models import GraspValue, GraspValueConfig
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.viz.imagination import (
    GRASP_DISTANCE,
    full_orbit,
    grasp_camera,
    imagine,
    imagined_panels,
    opposite_camera,
)


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


def test_a_grasp_looks_along_its_approach_with_its_closing_axis_level(grasps: Grasps) -> None:
    T = grasps.T_world_grasp[1]
    camera = grasp_camera(T, 64)
    points = torch.tensor([[0.0, 0.0, 0.0], [0.04, 0.0, 0.0], [0.0, 0.0, 0.02], [0.0, 0.04, 0.0]])
    pixels, depth = project(camera, transform(T, points))
    assert depth.tolist() == pytest.approx([GRASP_DISTANCE, GRASP_DISTANCE, GRASP_DISTANCE + 0.02, GRASP_DISTANCE])
    step = 64 * 0.04 / GRASP_DISTANCE
    expected = torch.tensor([[32.0, 32.0], [32.0 + step, 32.0], [32.0, 32.0], [32.0, 32.0 + step]])
    assert torch.allclose(pixels, expected, atol=1e-3)
    assert camera.T_world_camera[2, 3] > T[2, 3]  # it looks down


def test_the_scene_is_imagined_from_the_side_and_from_the_grasp(
    observations: Observations, grasps: Grasps, tiny_network: Callable[..., Any]
) -> None:
    torch.manual_seed(0)
    model = GraspValue(GraspValueConfig(backbone=tiny_network())).eval()
    alone = imagine(model, observations, Workspace(), longer_side=16)
    both = imagine(model, observations, Workspace(), grasps.T_world_grasp[0], longer_side=16)
    assert (list(alone), list(both)) == (["imagined"], ["imagined", "from_grasp"])
    assert torch.equal(alone["imagined"].rgb, both["imagined"].rgb)
    view = both["from_grasp"]
    assert view.rgb.shape == (16, 16, 3)
    assert view.inside.all()  # the camera is above the workspace's middle
    assert 0.0 < float(view.depth[8, 8]) < GRASP_DISTANCE + 0.05 + 0.04  # no farther than the box below the table
    rows = imagined_panels(both)
    assert [[panel.fingers_only for panel in row] for row in rows] == [[False, False], [True, True]]
    assert "grasp" in rows[1][0].title
    assert not torch.equal(rows[0][0].image, rows[0][1].image)


def test_a_model_on_another_device_imagines_the_same(
    observations: Observations, grasps: Grasps, tiny_network: Callable[..., Any]
) -> None:
    model = GraspValue(GraspValueConfig(backbone=tiny_network())).eval()
    here = imagine(model, observations, Workspace(), grasps.T_world_grasp[0], longer_side=16)
    with another_device() as send:
        send(model)
        there = imagine(model, observations, Workspace(), grasps.T_world_grasp[0], longer_side=16)
    for name, view in here.items():
        torch.testing.assert_close(there[name].rgb, view.rgb)
        torch.testing.assert_close(there[name].depth, view.depth)
        assert there[name].camera.intrinsics.device.type == "cpu"
