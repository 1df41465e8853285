import math

import pytest
import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Grasps
from nerfgrasp.search import best_first, distinct
from nerfgrasp.search.ranking import grasp_angle


def pose(x: float = 0.0, yaw: float = 0.0) -> Tensor:
    rotation = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, math.radians(yaw)]))
    return make_pose(rotation, torch.tensor([x, 0.0, 0.0]))


def test_best_first_sorts_and_leaves_out_what_is_not_finite() -> None:
    T = torch.stack([pose(0.0), pose(0.1), pose(0.2), pose(0.3), pose(math.nan)])
    ranked = best_first(T, torch.tensor([1.0, math.nan, 3.0, math.inf, 9.0]))
    assert ranked.value.tolist() == [3.0, 1.0]
    assert ranked.T_world_grasp[:, 0, 3].tolist() == pytest.approx([0.2, 0.0])


@pytest.mark.parametrize(("yaw", "expected"), [(0, 0), (30, 30), (90, 90), (150, 30), (180, 0), (270, 90)])
def test_grasp_angle_counts_the_half_turn(yaw: float, expected: float) -> None:
    angle = grasp_angle(pose(yaw=yaw)[:3, :3], pose()[:3, :3])
    assert math.degrees(float(angle)) == pytest.approx(expected, abs=0.1)


def test_grasp_angle_tells_up_from_down() -> None:
    upside_down = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    assert float(grasp_angle(upside_down, torch.eye(3))) == pytest.approx(math.pi, abs=1e-3)


def test_distinct_keeps_the_better_of_two_that_are_alike() -> None:
    poses = [
        pose(0.0),
        pose(0.01, yaw=10),  # near the first
        pose(0.01, yaw=175),  # near the first, the gripper turned round
        pose(0.01, yaw=60),  # there too, but closing another way
        pose(0.025),  # too far off
        pose(0.03),  # near the last one
    ]
    grasps = Grasps(torch.stack(poses), torch.arange(6.0).flip(0))
    assert distinct(grasps).value.tolist() == [5.0, 2.0, 1.0]
    assert distinct(grasps, count=2).value.tolist() == [5.0, 2.0]
    assert distinct(grasps, distance=0.0).value.tolist() == grasps.value.tolist()
