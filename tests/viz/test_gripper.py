import numpy as np
import pytest
import torch
from PIL import Image

from nerfgrasp.geometry import Camera, project
from nerfgrasp.grippers import FRANKA, ROBOTIQ_2F85
from nerfgrasp.scenes.scene import Grasps
from nerfgrasp.viz.gripper import draw_gripper, gripper_lines, gripper_strip


def test_fingers_close_along_x_and_the_stem_leaves_backwards() -> None:
    strip = gripper_strip(torch.eye(4), ROBOTIQ_2F85)
    assert strip[0].tolist() == pytest.approx([-0.085 / 2, 0.0, 0.0375 / 2])
    assert strip[-1].tolist() == pytest.approx([0.085 / 2, 0.0, 0.0375 / 2])
    assert strip[3, :2].tolist() == [0.0, 0.0]
    assert strip[3, 2] < strip[2, 2] < 0.0 < strip[0, 2]  # the tool centre point lies between the fingers


def test_every_gripper_has_its_own_dimensions() -> None:
    strip = gripper_strip(torch.eye(4), FRANKA)
    assert strip[-1, 0] - strip[0, 0] == pytest.approx(FRANKA.fingers.stroke)
    assert strip[1, 2].item() == pytest.approx(FRANKA.palm)


def test_lines_are_the_strips_segments(grasps: Grasps) -> None:
    lines, strip = gripper_lines(grasps.T_world_grasp, ROBOTIQ_2F85), gripper_strip(grasps.T_world_grasp, ROBOTIQ_2F85)
    assert lines.shape == (2, 6, 2, 3)
    assert torch.equal(lines[:, :, 1], strip[:, 1:])


def test_a_grasp_from_above_has_its_stem_on_top(grasps: Grasps) -> None:
    strip = gripper_strip(grasps.T_world_grasp[0], ROBOTIQ_2F85)
    assert float(strip[3, 2]) == pytest.approx(0.05 - float(ROBOTIQ_2F85.outline()[3, 2]))


def test_drawing_marks_the_gripper_and_nothing_else(camera: Camera, grasps: Grasps) -> None:
    grey = Image.new("RGB", (256, 192), (128, 128, 128))
    drawn = np.asarray(draw_gripper(grey, camera[0], grasps.T_world_grasp[0], ROBOTIQ_2F85)).astype(int)
    changed = np.abs(drawn - 128).max(axis=-1) > 20
    pixels, _ = project(camera[0], gripper_strip(grasps.T_world_grasp[0], ROBOTIQ_2F85))
    x, y = (pixels * 4).unbind(-1)
    assert all(changed[int(v), int(u)] for u, v in zip(x, y, strict=True))
    rows, columns = np.nonzero(changed)
    assert x.min() - 6 < columns.min()
    assert columns.max() < x.max() + 6
    assert y.min() - 6 < rows.min()
    assert rows.max() < y.max() + 6


def test_a_gripper_behind_the_camera_is_not_drawn(camera: Camera) -> None:
    behind = torch.eye(4)
    behind[:3, 3] = torch.tensor([1.5, 0.0, 1.2])
    grey = Image.new("RGB", (128, 96), (128, 128, 128))
    assert np.abs(np.asarray(draw_gripper(grey, camera[0], behind, ROBOTIQ_2F85)).astype(int) - 128).max() <= 1


def test_the_fingers_alone_leave_the_middle_free(camera: Camera, grasps: Grasps) -> None:
    plain = Image.new("RGB", (256, 192), (0, 0, 255))
    whole, fingers = (
        np.asarray(draw_gripper(plain, camera[0], grasps.T_world_grasp[0], ROBOTIQ_2F85, fingers_only=only)).astype(int)
        for only in (False, True)
    )
    painted = [(drawn != (0, 0, 255)).any(axis=-1).sum() for drawn in (whole, fingers)]
    assert 0 < painted[1] < 0.8 * painted[0]
