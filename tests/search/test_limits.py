"""Limits: poses are turned and lifted, no more than it takes, and the climb keeps to them."""

import math

import pytest
import roma
import torch

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import random_candidates
from nerfgrasp.search.ascent import ascend
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.schedule import SHORT_CLIMB

WORKSPACE = Workspace()
LIMITS = Limits(max_tilt=math.radians(60))
ANY_TILT = Limits(max_tilt=math.pi)


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
    lifted = LIMITS.enforce(torch.stack([low, high]), WORKSPACE)
    assert ROBOTIQ_2F85.lowest(lifted[0]).item() == pytest.approx(LIMITS.clearance, abs=1e-6)
    assert torch.equal(lifted[0, :2], low[:2])
    assert torch.equal(lifted[1], high)


def test_table_lies_at_the_workspace_s_lower_face():
    raised = Workspace(torch.tensor([-0.2, -0.2, 0.3]), torch.tensor([0.2, 0.2, 0.5]))
    lifted = LIMITS.enforce(tilted(0.0, 0.3), raised)
    assert ROBOTIQ_2F85.lowest(lifted).item() == pytest.approx(0.3 + LIMITS.clearance, abs=1e-6)


def test_tilted_poses_are_turned_to_the_limit_about_the_horizontal():
    steep, before = tilted(0.9 * math.pi, 0.15), tilted(math.radians(50), 0.15)
    turned = LIMITS.enforce(torch.stack([steep, before]), WORKSPACE)
    torch.testing.assert_close(turned[0], tilted(math.radians(60), 0.15), atol=1e-5, rtol=0)
    assert torch.equal(turned[1], before)
    assert torch.equal(ANY_TILT.enforce(steep, WORKSPACE), steep)


def test_approach_from_straight_below_is_turned_too():
    turned = LIMITS.enforce(torch.eye(4), WORKSPACE)
    assert turned[2, 2].item() == pytest.approx(-0.5, abs=1e-5)


@pytest.mark.parametrize("limit", [0.3, math.radians(60), math.pi])
def test_random_candidates_are_uniform_up_to_the_tilt(limit: float):
    drawn = random_candidates(20000, WORKSPACE, torch.Generator().manual_seed(1), limit)
    cosine = -drawn[:, 2, 2]
    assert cosine.min() >= math.cos(limit) - 1e-5
    assert cosine.mean().item() == pytest.approx((1 + math.cos(limit)) / 2, abs=0.015)
    # Free about the vertical and about the approach.
    assert drawn[:, :2, :3].mean(0).abs().max() < 0.02


@pytest.mark.parametrize("name", registry.names(registry.POSES))
def test_climb_towards_the_table_ends_at_the_clearance(name: str):
    start = random_candidates(32, WORKSPACE, torch.Generator().manual_seed(0))
    pose = registry.load(registry.POSES, name)()
    _, trace = ascend(lambda T: -T[:, 2, 3], start, pose, WORKSPACE, limits=LIMITS)
    assert (-trace.T_world_grasp[..., 2, 2]).min() >= 0.5 - 1e-4
    assert ROBOTIQ_2F85.lowest(trace.T_world_grasp).min() >= LIMITS.clearance - 1e-4
    last = ROBOTIQ_2F85.lowest(trace.T_world_grasp[-1])
    assert (last < LIMITS.clearance + 1e-3).float().mean() > 0.9


def test_no_clearance_lets_the_hand_go_anywhere():
    low = tilted(0.2, 0.005)
    assert torch.equal(Limits(clearance=None).enforce(low, WORKSPACE), low)


def test_a_clearance_without_room_is_told():
    Limits(clearance=0.18).check_room(WORKSPACE)  # the fingertips reach 18.75 mm below the tool centre point
    with pytest.raises(
        UserError, match=r"clearance is 0.19 m: the workspace's height leaves room for 0.181. m at most"
    ):
        Limits(clearance=0.19).check_room(WORKSPACE)


SHALLOW = Workspace(torch.tensor([-0.2, -0.2, 0.1]), torch.tensor([0.2, 0.2, 0.13]))
"""30 mm high: a hand that is tilted far has no room above the table in it."""


def within(T: torch.Tensor, limits: Limits, box: Workspace) -> bool:
    """Says whether all grasps keep the limits and the box."""
    inside = (T[..., :3, 3] >= box.minimum - 1e-5) & (T[..., :3, 3] <= box.maximum + 1e-5)
    clear = ROBOTIQ_2F85.lowest(T) >= box.minimum[2] + limits.clearance - 1e-5
    return bool(inside.all() & clear.all() & (-T[..., 2, 2] >= math.cos(limits.max_tilt) - 1e-5).all())


def test_in_a_shallow_workspace_hands_are_turned_until_they_have_room():
    drawn = random_candidates(512, SHALLOW, torch.Generator().manual_seed(0), LIMITS.max_tilt)
    kept = LIMITS.enforce(drawn, SHALLOW)
    assert within(kept, LIMITS, SHALLOW)
    assert within(ANY_TILT.enforce(drawn, SHALLOW), ANY_TILT, SHALLOW)
    turned = (kept != drawn)[:, :3, :3].any(dim=2).any(dim=1)
    assert 0.2 < turned.float().mean() < 0.95
    assert (kept[turned, 2, 3] > SHALLOW.maximum[2] - 1e-4).all()  # no more than it takes: they touch the top
    assert torch.equal(kept[:, :2, 3], drawn[:, :2, 3])
    one = drawn[turned][0]
    # Some processors round a batch in another way than a single pose.
    torch.testing.assert_close(LIMITS.enforce(one, SHALLOW), kept[turned][0], atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", ["quaternion", "screw"])  # decoupled, and a whole transform
def test_a_climb_in_a_shallow_workspace_keeps_to_it_and_to_the_limits(name: str):
    start = random_candidates(12, SHALLOW, torch.Generator().manual_seed(0))
    pose = registry.load(registry.POSES, name)()
    # Towards lying hands.
    _, trace = ascend(lambda T: T[:, 2, 2] + T[:, 0, 3], start, pose, SHALLOW, SHORT_CLIMB, limits=LIMITS)
    assert within(trace.T_world_grasp, LIMITS, SHALLOW)


@pytest.mark.parametrize("changes", [{"max_tilt": -0.1}, {"max_tilt": math.nan}, {"clearance": -0.01}])
def test_limits_that_cannot_be_meant_are_told(changes: dict[str, float]):
    with pytest.raises(UserError, match=" is .*: it must be "):
        Limits(**changes)
