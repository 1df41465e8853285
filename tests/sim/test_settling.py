"""Settling: objects fall, rest and stay, alone, in piles and in huddles, and the same ones every time."""

import math
from dataclasses import replace

import pytest
import roma
import torch

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.prisms import Prism, corners_in_world
from nerfgrasp.sim import shapes
from nerfgrasp.sim.settling import drop, huddle, pile, stable


@pytest.fixture
def box():
    return Prism("box", shapes.box(0.04, 0.08), 0.06, (1.0, 0.0, 0.0), 400.0, torch.eye(4))


def at(prism, x, y, z, rotvec=(0.0, 0.0, 0.0)):
    pose = make_pose(roma.rotvec_to_rotmat(torch.tensor(rotvec)), torch.tensor([x, y, z]))
    return replace(prism, T_world_object=pose)


def lowest(prism):
    return corners_in_world(prism)[:, 2].min()


def test_a_box_let_go_askew_comes_to_rest_on_a_face(box):
    (resting,) = drop((at(box, 0.05, 0.0, 0.08, (0.3, 0.2, 0.0)),))
    assert lowest(resting) == pytest.approx(0.0, abs=5e-4)
    assert resting.T_world_object[2, :3].abs().max() == pytest.approx(1.0, abs=1e-4)
    assert replace(resting, T_world_object=box.T_world_object) is not resting
    assert (resting.kind, resting.parts, resting.colour) == (box.kind, box.parts, box.colour)


def test_settling_repeats_exactly(box):
    falling = (at(box, 0.0, 0.0, 0.1, (0.5, 1.0, 0.2)), at(box, 0.02, 0.02, 0.2, (1.5, 0.2, 0.4)))
    for settle in (drop, pile):
        one, two = settle(falling), settle(falling)
        assert all(torch.equal(a.T_world_object, b.T_world_object) for a, b in zip(one, two, strict=True))


def test_what_rests_stays_and_what_balances_on_an_edge_does_not(box):
    resting = drop((at(box, 0.05, 0.0, 0.08, (0.3, 0.2, 0.0)),))
    assert stable(resting)
    diagonal = 0.5 * math.hypot(0.04, 0.06)
    askew = math.atan2(0.04, 0.06) + 0.02
    balanced = at(box, 0.0, 0.0, 0.0, (0.0, askew, 0.0))
    centre = balanced.T_world_object[:3, :3] @ torch.tensor([0.0, 0.0, 0.03])
    balanced.T_world_object[2, 3] = diagonal - centre[2]
    assert lowest(balanced) == pytest.approx(0.0, abs=1e-3)
    assert not stable((balanced,))


def test_a_pile_is_built_upwards(box):
    """Three flat boxes let go over one another, at whatever height: each rests on the one before."""
    flat = replace(box, height=0.03)
    objects = pile(tuple(at(flat, 0.0, 0.0, z) for z in (0.5, 0.0, -0.2)))
    assert [lowest(thing) for thing in objects] == pytest.approx([0.0, 0.03, 0.06], abs=2e-3)
    assert stable(objects)


def test_a_huddle_is_pushed_together(box):
    far = tuple(at(box, 0.15 * math.cos(a), 0.15 * math.sin(a), 0.0, (0.0, 0.0, a)) for a in (0.0, 2.1, 4.2))
    near = huddle(far)
    distances = [thing.T_world_object[:2, 3].norm() for thing in near]
    assert max(distances) < 0.08
    assert all(lowest(thing) == pytest.approx(0.0, abs=1e-3) for thing in near)
    assert stable(near)
