"""Grasp attempts: each outcome where it must be, and demonstrations that lift."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.oracle import grasp_errors, sample_top_down, valid_grasps
from nerfgrasp.sim import shapes
from nerfgrasp.sim.attempt import Outcome, attempt_grasp, cuts_table, demonstrate
from nerfgrasp.sim.physics import PHYSICS
from nerfgrasp.sim.tasks import simple_scene


def test_grasp_across_a_box_lifts_it(scene_of, grasp_at):
    attempt = attempt_grasp(scene_of(), grasp_at())
    assert attempt.outcome == Outcome.SUCCESS
    assert attempt.object == 0
    assert attempt.lifted == pytest.approx(0.1, abs=0.01)
    assert attempt.dropped == ()


def test_attempts_repeat_exactly(scene_of, grasp_at):
    grasp = grasp_at(y=0.005)
    assert attempt_grasp(scene_of(), grasp) == attempt_grasp(scene_of(), grasp.double().numpy())


def test_beside_the_object_there_is_nothing_between_the_fingers(scene_of, grasp_at):
    attempt = attempt_grasp(scene_of(), grasp_at(y=-0.02 + 0.04 + 0.011 + 0.02))
    assert attempt.outcome == Outcome.NOTHING_BETWEEN_FINGERS
    assert attempt.object is None


def test_finger_on_top_of_the_object_is_a_collision(scene_of, grasp_at):
    assert attempt_grasp(scene_of(), grasp_at(x=0.05 + 0.045)).outcome == Outcome.OBJECT_COLLISION


def test_palm_on_top_of_the_object_is_a_collision(scene_of, grasp_at):
    assert attempt_grasp(scene_of(), grasp_at(z=0.1 - 0.045)).outcome == Outcome.OBJECT_COLLISION


def test_grasp_through_the_table_is_refused(scene_of, grasp_at):
    assert cuts_table(np.asarray(grasp_at(z=0.018)))
    assert not cuts_table(np.asarray(grasp_at(z=0.0195)))
    assert attempt_grasp(scene_of(), grasp_at(z=0.018)).outcome == Outcome.TABLE_COLLISION


def test_way_to_the_grasp_through_the_table_is_a_collision(scene_of, grasp_at):
    upwards = make_pose(torch.eye(3), torch.tensor([-0.15, 0.15, 0.16]))
    assert not cuts_table(np.asarray(upwards))
    assert attempt_grasp(scene_of(), upwards).outcome == Outcome.TABLE_COLLISION


def test_slippery_objects_slip(scene_of, grasp_at):
    slippery = replace(PHYSICS, object_friction=0.05)
    attempt = attempt_grasp(scene_of(density=1200.0), grasp_at(), physics=slippery)
    assert attempt.outcome == Outcome.SLIPPED
    assert attempt.object == 0
    assert attempt.lifted < 0.05


def test_object_held_off_its_centre_does_not_swing_down(scene_of, grasp_at):
    attempt = attempt_grasp(scene_of(height=0.1, density=600.0), grasp_at(y=-0.02 + 0.03))
    assert attempt.outcome == Outcome.SUCCESS
    assert attempt.lifted == pytest.approx(0.1, abs=0.003)


@pytest.mark.parametrize(
    ("kind", "parts"),
    [
        ("cylinder", shapes.cylinder(0.05)),
        ("l", shapes.angle(0.08, 0.08, 0.03, 0.03)),
        ("t", shapes.tee(0.09, 0.03, 0.05, 0.03)),
        ("u", shapes.channel(0.04, 0.02, 0.035, 0.03)),
        ("cross", shapes.cross(0.09, 0.09, 0.028, 0.028)),
        ("triangle", shapes.triangle(0.06, 0.055)),
    ],
)
def test_valid_grasps_lift_every_kind(kind, parts, scene_of):
    scene = scene_of(kind, parts, height=0.06)
    grasp = sample_top_down(valid_grasps(scene.objects), torch.Generator().manual_seed(1))
    assert attempt_grasp(scene, grasp).outcome == Outcome.SUCCESS


def test_demonstration_is_valid_repeats_and_lifts():
    scene = simple_scene(0, 1)
    grasp = demonstrate(scene)
    assert grasp is not None
    assert torch.equal(grasp, demonstrate(scene))
    translation, rotation = grasp_errors(grasp, valid_grasps(scene.objects))
    assert translation < 1e-6
    assert rotation < 1e-3
    assert attempt_grasp(scene, grasp).outcome == Outcome.SUCCESS


def test_no_demonstration_where_nothing_can_be_grasped(scene_of):
    assert demonstrate(scene_of(parts=shapes.box(0.08, 0.08))) is None
