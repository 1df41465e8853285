"""Grasps of prisms in any pose: lying ones by hand, and random ones against a cloud of their points."""

import math

import numpy as np
import pytest
import roma
import torch

from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import ROBOTIQ_2F85, ROBOTIQ_2F140
from nerfgrasp.scenes.oracle import ValidGrasps, grasp_errors, sample_top_down, valid_grasps
from nerfgrasp.scenes.prisms import Prism, corners_in_world

BOX = ((-0.02, -0.045), (0.02, -0.045), (0.02, 0.045), (-0.02, 0.045))
TEE = (
    ((-0.04, 0.0), (0.04, 0.0), (0.04, 0.03), (-0.04, 0.03)),
    ((-0.015, -0.05), (0.015, -0.05), (0.015, 0.0), (-0.015, 0.0)),
)
ELL = (
    ((-0.03, -0.03), (0.06, -0.03), (0.06, 0.0), (-0.03, 0.0)),
    ((-0.03, 0.0), (0.0, 0.0), (0.0, 0.06), (-0.03, 0.06)),
)
TRIANGLE = (((-0.03, -0.02), (0.03, -0.02), (0.0, 0.03)),)
ROUND = (tuple((0.025 * math.cos(k * math.pi / 16), 0.025 * math.sin(k * math.pi / 16)) for k in range(32)),)


def resting(kind, parts, height, rotvec, above=0.0):
    """A prism turned about the origin and moved straight up until its lowest corner is `above` the table."""
    rotation = roma.rotvec_to_rotmat(torch.tensor(rotvec, dtype=torch.float32))
    turned = Prism(kind, parts, height, (1.0, 0.0, 0.0), 400.0, make_pose(rotation, torch.zeros(3)))
    lift = torch.tensor([0.0, 0.0, above - corners_in_world(turned)[:, 2].min()], dtype=torch.float32)
    return Prism(kind, parts, height, (1.0, 0.0, 0.0), 400.0, make_pose(rotation, lift))


def heights(valid: ValidGrasps):
    """The lowest and the highest tool centre point."""
    z = torch.stack([valid.corner[:, 2], (valid.corner + valid.edge_v)[:, 2]])
    return float(z.min()), float(z.max())


def test_on_a_pedestal_and_upside_down_a_prism_is_grasped_as_high_over_its_foot():
    on_table, raised = (valid_grasps([resting("box", (BOX,), 0.1, [0.0, 0.0, 0.3], z)]) for z in (0.0, 0.05))
    assert heights(raised) == pytest.approx([z + 0.05 for z in heights(on_table)], abs=1e-6)
    flipped = valid_grasps([resting("box", (BOX,), 0.1, [math.pi, 0.0, 0.0])])
    assert heights(flipped) == pytest.approx(heights(on_table), abs=1e-6)
    assert flipped.closing[0].abs().tolist() == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)


def test_box_on_its_side_is_grasped_across_its_height():
    """It is 60 mm along x, 90 along y and 40 high; tool centre points are 21.25 to 32 mm over the table."""
    valid = valid_grasps([resting("box", (BOX,), 0.06, [0.0, math.pi / 2, 0.0])])
    assert len(valid) == 1
    assert valid.closing[0].abs().tolist() == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert heights(valid) == pytest.approx((0.02125, 0.032), abs=1e-6)
    ends = torch.stack([valid.corner[0], valid.corner[0] + valid.edge_u[0]])
    assert ends[:, 0].tolist() == pytest.approx([0.03, 0.03], abs=1e-6)
    assert sorted(ends[:, 1].tolist()) == pytest.approx([-0.04, 0.04], abs=1.5e-3)


def test_too_high_a_box_on_its_broad_side_cannot_be_grasped():
    assert len(valid_grasps([resting("box", (BOX,), 0.08, [0.0, math.pi / 2, 0.0])])) == 0
    wide = valid_grasps([resting("box", (BOX,), 0.08, [0.0, math.pi / 2, 0.0])], ROBOTIQ_2F140)
    assert len(wide) > 0


def test_stem_of_a_t_is_grasped_clear_of_its_bar():
    """On its bar, 30 mm high, the stem reaches to 80 mm: tips stay 3 mm over the bar, pads 8 mm below the top."""
    valid = valid_grasps([resting("t", TEE, 0.1, [-math.pi / 2, 0.0, 0.0])])
    assert len(valid) == 1
    assert valid.closing[0].abs().tolist() == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert heights(valid) == pytest.approx((0.03 + 0.003 + 0.01875, 0.072), abs=1e-4)


def test_lying_cylinder_is_grasped_across_at_every_tilt_that_the_table_allows():
    valid = valid_grasps([resting("cylinder", ROUND, 0.1, [math.pi / 2, 0.0, 0.0])])
    assert valid.closing[:, 1].abs().max() < 1e-6
    tilts = torch.rad2deg(torch.asin(valid.closing[:, 2])).round()
    assert 0.0 in tilts.tolist()
    assert tilts.max() == -tilts.min()
    assert 10.0 <= tilts.max() <= 45.0
    across = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, -0.05, 0.025]))
    translation, rotation = grasp_errors(across, valid)
    assert translation < 1e-3
    assert rotation < 1e-3
    along = make_pose(roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, math.radians(30.0)])), torch.zeros(3)) @ across
    assert math.degrees(grasp_errors(along, valid)[1]) == pytest.approx(30.0, abs=0.1)


def inside(points, T, box, margin=0.0):
    """Which points `[N, 3]` of the world are in a box (centre, half extents) of the grasp frame."""
    centre, half = (np.asarray(v) for v in box)
    local = (points - T[:3, 3]) @ T[:3, :3]
    return (np.abs(local - centre) <= half + margin).all(axis=1)


def cloud(prism, generator, count=3000):
    """Random points in a prism's parts, in the world."""
    points = []
    for part in prism.parts:
        corners = np.asarray(part)
        weights = generator.dirichlet(np.full(len(corners), 0.3), count)
        points.append(np.column_stack([weights @ corners, generator.uniform(0.0, prism.height, count)]))
    T = prism.T_world_object.double().numpy()
    return np.concatenate(points) @ T[:3, :3].T + T[:3, 3]


@pytest.mark.parametrize(
    ("kind", "parts"), [("box", (BOX,)), ("t", TEE), ("l", ELL), ("triangle", TRIANGLE), ("cylinder", ROUND)]
)
def test_the_open_gripper_at_a_valid_grasp_meets_nothing_and_has_the_object_between_its_pads(kind, parts):
    generator, torch_generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    body, *fingers = ROBOTIQ_2F85.open_boxes()
    pads = ROBOTIQ_2F85.fingers
    between = ((0.0, 0.0, 0.0), (pads.stroke / 2, pads.pad_width / 2, pads.pad_height / 2))
    found = 0
    for _ in range(25):
        prism = resting(kind, parts, 0.06, generator.normal(size=3) * 1.5)
        valid = valid_grasps([prism])
        points = cloud(prism, generator)
        for _ in range(min(len(valid), 4)):
            grasp = sample_top_down(valid, torch_generator)
            T = grasp.double().numpy()
            found += 1
            assert not any(inside(points, T, box, -1e-4).any() for box in (body, *fingers))
            assert inside(points, T, between).sum() > 20
            assert ROBOTIQ_2F85.lowest(grasp) >= 0.0024
            assert T[2, 2] <= -math.cos(math.radians(45.1))
    assert found >= 25


def test_valid_grasps_of_a_tipped_prism_move_with_it():
    still = resting("l", ELL, 0.05, [0.7, 0.9, 0.0])
    turn = make_pose(roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, 1.1])), torch.tensor([0.1, -0.05, 0.0]))
    moved = Prism("l", ELL, 0.05, still.colour, still.density, turn @ still.T_world_object)
    grasp = sample_top_down(valid_grasps([still]), torch.Generator().manual_seed(0))
    translation, rotation = grasp_errors(turn @ grasp, valid_grasps([moved]))
    assert translation < 3e-3
    assert rotation < 1e-2
