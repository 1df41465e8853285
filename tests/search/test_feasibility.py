"""Feasibility: an analytic density stands in for the field; what meets it is known."""

import math
from typing import Any, cast

import pytest
import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.models.mvnerf import SceneFeatures
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.feasibility import Feasibility, meeting, opacity

WORKSPACE = Workspace()
NOTHING = cast(SceneFeatures, None)
WORST = math.log(1e-3)


class Boxes:
    """A field that is dense in axis-aligned boxes (low, high) and below the table's top."""

    def __init__(self, *boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> None:
        self.boxes = [tuple(map(torch.tensor, box)) for box in boxes]

    def density(self, features: Any, points: Tensor, directions: Tensor) -> Tensor:
        assert points.shape[:-2] == directions.shape[:-1]
        inside = [((points > low) & (points < high)).all(dim=-1) for low, high in self.boxes]
        return 1000.0 * (torch.stack(inside).any(dim=0) | (points[..., 2] < 0.0)).float()


BAR = ((-0.02, -0.04, 0.0), (0.02, 0.04, 0.06))


def weigh(field: Boxes, T: Tensor, **changes: Any) -> float:
    weights = {"free": 1.0, "gap": 1.0, "slant": 0.0, **changes}
    return Feasibility(**weights)(cast(GraspValue, field), NOTHING, T[None], WORKSPACE).item()


def top_down(x: float = 0.0, y: float = 0.0, z: float = 0.045, yaw: float = 0.0) -> Tensor:
    turned = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, yaw])) @ torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    return make_pose(turned, torch.tensor([x, y, z]))


def test_a_bar_between_the_pads_costs_nothing():
    assert weigh(Boxes(BAR), top_down()) == pytest.approx(0.0, abs=0.01)


def test_nothing_between_the_pads_costs_the_most_that_one_chance_can():
    assert weigh(Boxes(BAR), top_down(y=0.1)) == pytest.approx(WORST, abs=0.01)


def test_half_of_the_pads_on_the_bar_is_half_a_chance():
    # Of three rows of lines, 12 mm apart, two lie above the bar's top.
    assert weigh(Boxes(BAR), top_down(z=0.063)) == pytest.approx(math.log(1 / 3), abs=0.02)


def test_fingers_on_the_bar():
    assert weigh(Boxes(BAR), top_down(x=0.03)) == pytest.approx(WORST, abs=0.1)
    long = ((-0.02, -0.05, 0.0), (0.02, 0.05, 0.06))
    assert weigh(Boxes(long), top_down()) == pytest.approx(0.0, abs=0.01)
    assert weigh(Boxes(long), top_down(yaw=math.pi / 2)) == pytest.approx(WORST, abs=0.1)


def test_palm_on_the_bar():
    tall = ((-0.02, -0.04, 0.0), (0.02, 0.04, 0.1))
    assert weigh(Boxes(tall), top_down(z=0.075)) == pytest.approx(0.0, abs=0.01)
    assert weigh(Boxes(tall), top_down(z=0.045)) == pytest.approx(WORST, abs=0.1)


def test_what_stands_in_the_fingers_way_counts_and_what_lies_beyond_does_not():
    above = ((0.04, -0.02, 0.07), (0.06, 0.02, 0.08))
    beyond = ((0.04, -0.02, 0.001), (0.06, 0.02, 0.02))
    assert weigh(Boxes(BAR, above), top_down()) < WORST + 0.1
    assert weigh(Boxes(BAR, beyond), top_down()) == pytest.approx(0.0, abs=0.01)


def test_neither_the_table_nor_what_is_outside_of_the_workspace_counts():
    low = ((-0.02, -0.04, 0.0), (0.02, 0.04, 0.03))
    assert weigh(Boxes(low), top_down(z=0.015)) == pytest.approx(0.0, abs=0.01)  # fingertips below the table
    outside = ((0.26, -0.1, 0.0), (0.4, 0.1, 0.2))
    shifted = ((0.18, -0.04, 0.0), (0.24, 0.04, 0.06))
    assert weigh(Boxes(shifted, outside), top_down(x=0.22)) == pytest.approx(0.0, abs=0.01)


def test_the_gap_is_left_out_where_the_way_alone_takes_too_much() -> None:
    asked: list[int] = []

    class Counting(Boxes):
        def density(self, features: Any, points: Tensor, directions: Tensor) -> Tensor:
            asked.append(len(points))
            return super().density(features, points, directions)

    poses = torch.stack([top_down(), top_down(x=0.03), top_down(y=0.1)])  # fine, a finger on the bar, nothing grasped
    field, feasibility = cast(GraspValue, Counting(BAR)), Feasibility()
    whole = feasibility(field, NOTHING, poses, WORKSPACE)
    of_ways, of_gaps = asked[:2], asked[2]
    asked.clear()
    least = torch.full((3,), -5.0)
    found = feasibility(field, NOTHING, poses, WORKSPACE, least)
    assert asked == [*of_ways, of_gaps * 2 // 3]
    assert torch.equal(found[[0, 2]], whole[[0, 2]])
    assert whole[1] <= found[1] <= least[1]


def test_of_no_grasps_nothing_is_asked() -> None:
    none = Feasibility()(cast(GraspValue, None), NOTHING, torch.zeros(0, 4, 4), WORKSPACE)
    assert none.shape == (0,)


def test_many_grasps_are_weighed_as_few_are() -> None:
    poses = torch.stack([top_down(x=0.002 * i) for i in range(40)])
    field, feasibility = cast(GraspValue, Boxes(BAR)), Feasibility()
    one_by_one = [feasibility(field, NOTHING, pose[None], WORKSPACE) for pose in poses]
    assert torch.allclose(feasibility(field, NOTHING, poses, WORKSPACE), torch.cat(one_by_one), atol=1e-5)


def test_faces_that_slant_across_the_pads_cost_their_slope() -> None:
    gap = torch.zeros(1, 3, 3, 40)
    for row, piece in enumerate((8, 11, 14)):  # across the pad, each row meets a wall three pieces farther
        gap[0, row, :, piece:] = 50.0
    feasibility = Feasibility()
    step, across = 0.085 / 40, 0.36 * feasibility.gripper.fingers.pad_width
    found = feasibility._slant(gap.flatten(1, 2), torch.ones(1, 9))
    # The fit gives way a little where few lines meet anything: of nine, all on the wall, by a factor 6 / 6.3.
    assert found.item() == pytest.approx(6 / 6.3 * 3 * step / across, rel=1e-3)


def test_a_bar_that_lies_askew_costs_more() -> None:
    aligned, askew = (weigh(Boxes(BAR), top_down(yaw=yaw), free=0.0, gap=0.0, slant=1.0) for yaw in (0.0, 0.35))
    assert aligned == pytest.approx(0.0, abs=1e-3)
    assert askew == pytest.approx(-2 * math.tan(0.35), abs=0.25)  # pieces of 2 mm, and walls without a gradient


def test_nothing_has_no_slope() -> None:
    assert weigh(
        Boxes(((0.2, 0.2, 0.0), (0.21, 0.21, 0.01))), top_down(), free=0.0, gap=0.0, slant=1.0
    ) == pytest.approx(0.0, abs=1e-5)


def test_where_a_line_meets_something() -> None:
    depths = torch.tensor([[0.0, 0.0, 50.0, 50.0], [50.0, 0.0, 0.0, 0.0], [0.0, math.log(2.0), 0.0, 50.0]])
    torch.testing.assert_close(meeting(depths), torch.tensor([2.5, 0.5, 2.5]), atol=1e-4, rtol=0)
    torch.testing.assert_close(opacity(depths[:, :2]), torch.tensor([0.0, 1.0, 0.5]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("weight", ["free", "gap", "slant"])
def test_weights_scale(weight: str) -> None:
    field, T = Boxes(BAR), top_down(x=0.03, y=0.03, z=0.06, yaw=0.3)
    only = {"free": 0.0, "gap": 0.0, "slant": 0.0}
    one, three = (weigh(field, T, **{**only, weight: w}) for w in (1.0, 3.0))
    assert one < -0.01
    assert three == pytest.approx(3 * one)
