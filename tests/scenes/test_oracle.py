"""The oracle: which grasps are valid, and the distance to them, against brute force and by hand."""

import math

import pytest
import roma
import torch

from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.bars import bars
from nerfgrasp.scenes.oracle import (
    ValidGrasps,
    grasp_errors,
    negative_grasp_error,
    sample_top_down,
    valid_grasps,
)
from nerfgrasp.scenes.prisms import Prism

FINGERS = ROBOTIQ_2F85.fingers


def prism(kind, parts, height=0.1, position=(0.0, 0.0, 0.0), yaw=0.0):
    rotation = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, yaw]))
    pose = make_pose(rotation, torch.tensor(position))
    return Prism(kind, tuple(tuple(p) for p in parts), height, (1.0, 0.0, 0.0), 400.0, pose)


def rectangle(x0, y0, x1, y1):
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


BOX = [rectangle(-0.02, -0.045, 0.02, 0.045)]


def one(closing, free_yaw=False, corner=(0.0, 0.0, 0.05), edge_u=(0.04, 0.0, 0.0), edge_v=(0.0, 0.0, 0.02)):
    rows = [torch.tensor([row]) for row in (corner, edge_u, edge_v)]
    closing = torch.nn.functional.normalize(torch.tensor([closing]), dim=-1)
    return ValidGrasps(*rows, closing, torch.tensor([free_yaw]), torch.tensor([0]))


def down_grasp(position, yaw=0.0, tilt=0.0, roll=0.0):
    """A grasp from above: closing axis at `yaw`, then twisted by `tilt` about it, then by `roll` about y."""
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    turns = [roma.rotvec_to_rotmat(torch.tensor(v)) for v in ([0.0, 0.0, yaw], [tilt, 0.0, 0.0], [0.0, roll, 0.0])]
    return make_pose(turns[0] @ down @ turns[1] @ turns[2], torch.tensor(position))


def test_box_is_grasped_across_its_narrow_side_only():
    (bar,) = bars(prism("box", BOX), FINGERS)
    assert bar.closing == (1.0, 0.0)
    assert bar.start == pytest.approx((0.0, -0.04), abs=1e-3)
    assert bar.end == pytest.approx((0.0, 0.04), abs=1e-3)


def test_small_box_is_grasped_both_ways_and_a_wide_one_not_at_all():
    assert len(bars(prism("box", [rectangle(-0.02, -0.03, 0.02, 0.03)]), FINGERS)) == 2
    assert bars(prism("box", [rectangle(-0.04, -0.04, 0.04, 0.04)]), FINGERS) == []


def test_pads_keep_clear_of_the_other_arm_of_an_l():
    arms = [rectangle(0.0, 0.0, 0.09, 0.03), rectangle(0.0, 0.03, 0.03, 0.09)]
    upright = [bar for bar in bars(prism("l", arms), FINGERS) if bar.closing == (1.0, 0.0)]
    (arm,) = upright
    assert arm.start[1] == pytest.approx(0.03 + 0.011 + 0.003, abs=1e-3)
    assert arm.end[1] == pytest.approx(0.085, abs=1e-3)
    assert arm.start[0] == pytest.approx(0.015)


@pytest.mark.parametrize(("gap", "count"), [(0.036, 1), (0.027, 0)])
def test_base_of_a_u_needs_a_gap_as_wide_as_a_finger(gap, count):
    half = gap / 2
    parts = [rectangle(-0.045, 0.0, 0.045, 0.03)]
    parts += [rectangle(-0.045, 0.03, -half, 0.08), rectangle(half, 0.03, 0.045, 0.08)]
    assert len([bar for bar in bars(prism("u", parts), FINGERS) if bar.closing == (0.0, 1.0)]) == count


def test_equilateral_triangle_is_grasped_from_each_side():
    corners = [(0.03 * math.cos(a), 0.03 * math.sin(a)) for a in (0.0, 2 * math.pi / 3, 4 * math.pi / 3)]
    found = bars(prism("triangle", [corners]), FINGERS)
    assert len(found) == 3
    for bar, vertex in zip(found, (corners[2], corners[0], corners[1]), strict=True):
        middle = [(s + e) / 2 for s, e in zip(bar.start, bar.end, strict=True)]
        assert middle == pytest.approx([0.25 * v for v in vertex], abs=1e-6)
        assert math.dist(bar.start, bar.end) == pytest.approx(0.008)


def test_heights_stay_clear_of_table_and_palm():
    low = valid_grasps([prism("box", BOX, height=0.025)])
    high = valid_grasps([prism("box", BOX, height=0.12)])
    assert low.corner[0, 2] == pytest.approx(0.02125)
    assert low.edge_v[0].abs().max() == 0
    assert high.corner[0, 2] == pytest.approx(0.085)
    assert high.edge_v[0, 2] == pytest.approx(0.027)


def test_valid_grasps_move_with_the_object():
    turned = valid_grasps([prism("box", BOX, position=(0.1, -0.05, 0.0), yaw=math.pi / 2)])
    torch.testing.assert_close(turned.closing.abs(), torch.tensor([[0.0, 1.0, 0.0]]), atol=1e-6, rtol=0)
    middle = turned.corner + 0.5 * turned.edge_u
    torch.testing.assert_close(middle[:, :2], torch.tensor([[0.1, -0.05]]), atol=1e-5, rtol=0)


def test_translation_error_is_the_distance_to_the_rectangle():
    valid = one((0.0, 1.0, 0.0))
    for position, distance in [
        ((0.02, 0.0, 0.06), 0.0),
        ((0.02, 0.01, 0.06), 0.01),
        ((0.05, 0.0, 0.06), 0.01),
        ((0.07, 0.0, 0.11), 0.05),
        ((-0.03, 0.0, 0.01), 0.05),
    ]:
        translation, rotation = grasp_errors(down_grasp(position, yaw=math.pi / 2), valid)
        assert translation == pytest.approx(distance, abs=1e-6)
        assert rotation == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("yaw", "tilt", "roll", "free_yaw", "degrees"),
    [
        (0, 0, 0, False, 0),
        (180, 0, 0, False, 0),
        (30, 0, 0, False, 30),
        (120, 0, 0, False, 60),
        (0, 40, 0, False, 0),
        (180, -40, 0, False, 0),
        (0, 60, 0, False, 15),
        (0, 180, 0, False, 135),
        (0, 0, 20, False, 20),
        (75, 0, 0, True, 0),
        (75, 60, 0, True, 15),
        (10, 0, 25, True, 25),
    ],
)
def test_rotation_error_by_hand(yaw, tilt, roll, free_yaw, degrees):
    grasp = down_grasp((0.0, 0.0, 0.05), *(math.radians(a) for a in (yaw, tilt, roll)))
    _, rotation = grasp_errors(grasp, one((1.0, 0.0, 0.0), free_yaw))
    assert math.degrees(rotation) == pytest.approx(degrees, abs=0.05)


def valid_rotations(closing, free_yaw, step=1.0):
    """A fine grid of rotations: closing axis as asked, approach within 45° of straight down."""
    down = torch.tensor([0.0, 0.0, -1.0])
    yaws = torch.arange(0.0, 360.0, step) if free_yaw else torch.zeros(1)
    spin = roma.rotvec_to_rotmat(torch.stack([0 * yaws, 0 * yaws, torch.deg2rad(yaws)], dim=-1))
    axes = torch.cat([spin @ closing, -(spin @ closing)])
    twists = torch.deg2rad(torch.arange(0.0, 360.0, step / 2 if free_yaw else step / 10))
    start = torch.nn.functional.normalize(down - (axes @ down)[:, None] * axes, dim=-1)
    z = roma.rotvec_to_rotmat(axes[:, None] * twists[None, :, None]) @ start[:, None, :, None]
    z, x = z[..., 0].reshape(-1, 3), axes[:, None].expand(-1, len(twists), -1).reshape(-1, 3)
    keep = z @ down >= math.cos(math.radians(45.0)) - 1e-6
    z, x = z[keep], x[keep]
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


@pytest.mark.parametrize(
    ("closing", "free_yaw"), [((1.0, 0.0, 0.0), False), ((0.6, -0.5, 0.4), False), ((0.0, 1.0, 0.0), True)]
)
def test_rotation_error_agrees_with_brute_force(closing, free_yaw):
    valid = one(closing, free_yaw)
    rotations = roma.random_rotmat(40, generator=torch.Generator().manual_seed(3))
    _, found = grasp_errors(make_pose(rotations, torch.zeros(3)), valid)
    grid = valid_rotations(valid.closing[0], free_yaw)
    quaternions = roma.rotmat_to_unitquat(rotations) @ roma.rotmat_to_unitquat(grid).T
    brute = 2 * torch.acos(quaternions.abs().amax(dim=1).clamp(max=1.0))
    assert (brute - found > -2e-3).all()
    assert (brute - found).max() < math.radians(1.0)


def test_nearest_weighs_translation_against_rotation_and_batches_lead():
    here = torch.tensor([[0.0, 0.0, 0.05], [0.09, 0.0, 0.05]])
    closing = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    nowhere, false = torch.zeros(2, 3), torch.tensor([False, False])
    valid = ValidGrasps(here, nowhere, nowhere, closing, false, torch.tensor([0, 1]))
    poses = down_grasp((0.0, 0.0, 0.05)).expand(2, 5, 4, 4)
    translation, rotation = grasp_errors(poses, valid)
    assert translation.shape == rotation.shape == (2, 5)
    torch.testing.assert_close(translation, torch.full((2, 5), 0.09))
    torch.testing.assert_close(negative_grasp_error(poses, valid), torch.full((2, 5), -0.9))


def test_samples_are_valid_and_repeat():
    cylinder = [[(0.02 * math.cos(a * math.pi / 16), 0.02 * math.sin(a * math.pi / 16)) for a in range(32)]]
    valid = valid_grasps([prism("box", BOX, yaw=0.4), prism("cylinder", cylinder, position=(0.15, 0.0, 0.0))])
    generator = torch.Generator().manual_seed(0)
    samples = torch.stack([sample_top_down(valid, generator) for _ in range(40)])
    translation, rotation = grasp_errors(samples, valid)
    assert translation.max() < 1e-6
    assert rotation.max() < 1e-3
    torch.testing.assert_close(samples[:, :3, 2], torch.tensor([0.0, 0.0, -1.0]).expand(40, 3))
    assert {0, 1} == set((samples[:, 0, 3] > 0.1).long().tolist())
    again = sample_top_down(valid, torch.Generator().manual_seed(0))
    assert torch.equal(again, samples[0])


def test_a_scene_without_valid_grasps():
    nothing = valid_grasps([prism("box", [rectangle(-0.04, -0.04, 0.04, 0.04)])])
    assert len(nothing) == 0
    assert torch.isinf(grasp_errors(torch.eye(4), nothing)[0])
    with pytest.raises(ValueError, match="no valid grasp"):
        sample_top_down(nothing)
