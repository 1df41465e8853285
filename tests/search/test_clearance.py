"""The gripper stays off the table: poses are lifted, no more than it takes, and the climb keeps to it."""

import math

import pytest
import roma
import torch

from nerfgrasp import registry
from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.gripper import ROBOTIQ_2F85
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import random_candidates
from nerfgrasp.search.ascent import ascend
from nerfgrasp.search.clearance import TableClearance

WORKSPACE = Workspace()
CLEARANCE = TableClearance()


def tilted(angle: float, height: float) -> torch.Tensor:
    """Returns a grasp that approaches `angle` from straight down, turned about its closing axis."""
    rotation = roma.rotvec_to_rotmat(torch.tensor([math.pi - angle, 0.0, 0.0]))
    return make_pose(rotation, torch.tensor([0.0, 0.0, height]))


def test_lowest_point_of_a_top_down_grasp_is_the_fingertip():
    assert ROBOTIQ_2F85.lowest(tilted(0.0, 0.1)).item() == pytest.approx(0.1 - 0.0375 / 2, abs=1e-6)


def test_lowest_point_of_a_tilted_grasp():
    tip, half_pad, angle = 0.0375 / 2, 0.011, math.radians(30)
    expected = 0.1 - tip * math.cos(angle) - half_pad * math.sin(angle)
    assert ROBOTIQ_2F85.lowest(tilted(angle, 0.1)).item() == pytest.approx(expected, abs=1e-6)


def test_lying_body_is_lower_than_the_fingers():
    assert ROBOTIQ_2F85.lowest(tilted(math.pi / 2, 0.1)).item() == pytest.approx(0.1 - 0.075 / 2, abs=1e-6)


def test_low_poses_are_lifted_straight_up_to_the_clearance_and_others_stay():
    low, high = tilted(0.2, 0.005), tilted(0.2, 0.1)
    lifted = CLEARANCE.lifted(torch.stack([low, high]), WORKSPACE)
    assert ROBOTIQ_2F85.lowest(lifted[0]).item() == pytest.approx(CLEARANCE.metres, abs=1e-6)
    assert torch.equal(lifted[0, :2], low[:2])
    assert torch.equal(lifted[1], high)


def test_table_lies_at_the_workspace_s_lower_face():
    raised = Workspace(torch.tensor([-0.2, -0.2, 0.3]), torch.tensor([0.2, 0.2, 0.5]))
    lifted = CLEARANCE.lifted(tilted(0.0, 0.3), raised)
    assert ROBOTIQ_2F85.lowest(lifted).item() == pytest.approx(0.3 + CLEARANCE.metres, abs=1e-6)


@pytest.mark.parametrize("name", registry.names(registry.POSES))
def test_climb_towards_the_table_ends_at_the_clearance(name: str):
    start = random_candidates(32, WORKSPACE, torch.Generator().manual_seed(0))
    pose = registry.load(registry.POSES, name)()
    _, trace = ascend(lambda T: -T[:, 2, 3], start, pose, WORKSPACE, clearance=CLEARANCE)
    assert ROBOTIQ_2F85.lowest(trace.T_world_grasp).min() >= CLEARANCE.metres - 1e-4
    last = ROBOTIQ_2F85.lowest(trace.T_world_grasp[-1])
    assert (last < CLEARANCE.metres + 1e-3).float().mean() > 0.9
