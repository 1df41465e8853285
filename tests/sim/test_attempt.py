"""Grasp attempts: each outcome where it must be, and demonstrations that lift."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import ROBOTIQ_2F85, ROBOTIQ_2F140
from nerfgrasp.scenes.oracle import grasp_errors, sample_top_down, valid_grasps
from nerfgrasp.sim import shapes
from nerfgrasp.sim.attempt import Outcome, attempt_grasp, cuts_table, demonstrate
from nerfgrasp.sim.physics import PHYSICS, SHAKEN
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
    assert cuts_table(np.asarray(grasp_at(z=0.018)), ROBOTIQ_2F85)
    assert not cuts_table(np.asarray(grasp_at(z=0.0195)), ROBOTIQ_2F85)
    assert attempt_grasp(scene_of(), grasp_at(z=0.018)).outcome == Outcome.TABLE_COLLISION


def test_way_to_the_grasp_through_the_table_is_a_collision(scene_of, grasp_at):
    upwards = make_pose(torch.eye(3), torch.tensor([-0.15, 0.15, 0.16]))
    assert not cuts_table(np.asarray(upwards), ROBOTIQ_2F85)
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


def test_a_lifted_object_is_gone_and_the_others_stay(scene_of, grasp_at):
    scene = scene_of()
    (lone,) = scene.objects
    other = replace(lone, T_world_object=make_pose(torch.eye(3), torch.tensor([-0.12, 0.1, 0.0])))
    attempt = attempt_grasp(replace(scene, objects=(other, lone)), grasp_at())
    assert (attempt.outcome, attempt.object, attempt.remaining) == (Outcome.SUCCESS, 1, (0,))
    (left,) = attempt.after
    torch.testing.assert_close(left.T_world_object, other.T_world_object, atol=5e-4, rtol=0)


def test_nothing_changes_where_nothing_is_carried_out_or_met(scene_of, grasp_at):
    scene = scene_of()
    refused = attempt_grasp(scene, grasp_at(z=0.018))
    assert refused.after is scene.objects
    missed = attempt_grasp(scene, grasp_at(y=0.1))
    assert refused.remaining == missed.remaining == (0,)
    torch.testing.assert_close(missed.after[0].T_world_object, scene.objects[0].T_world_object, atol=5e-4, rtol=0)


def test_a_slipped_object_is_left_on_the_table(scene_of, grasp_at):
    attempt = attempt_grasp(scene_of(density=1200.0), grasp_at(), physics=replace(PHYSICS, object_friction=0.05))
    assert attempt.outcome == Outcome.SLIPPED
    assert attempt.remaining == (0,)
    assert attempt.after[0].T_world_object[:3, 3].tolist() == pytest.approx([0.05, -0.02, 0.0], abs=0.01)
    assert attempt.after[0].T_world_object[2, 2] == pytest.approx(1.0, abs=1e-3)


def test_what_lies_outside_of_the_workspace_is_dropped(scene_of, grasp_at):
    scene = scene_of()
    outside = replace(scene.objects[0], T_world_object=make_pose(torch.eye(3), torch.tensor([0.1, 0.28, 0.0])))
    attempt = attempt_grasp(replace(scene, objects=(outside, *scene.objects)), grasp_at(y=0.1))
    assert attempt.outcome == Outcome.NOTHING_BETWEEN_FINGERS
    assert (attempt.dropped, attempt.remaining, len(attempt.after)) == ((0,), (1,), 1)


def test_the_wider_gripper_lifts_what_is_too_wide_for_the_other(scene_of, grasp_at):
    scene = scene_of(parts=shapes.box(0.11, 0.12))
    assert attempt_grasp(scene, grasp_at(z=0.06)).outcome == Outcome.OBJECT_COLLISION
    attempt = attempt_grasp(scene, grasp_at(z=0.06), gripper=ROBOTIQ_2F140)
    assert attempt.outcome == Outcome.SUCCESS
    assert attempt.lifted == pytest.approx(0.1, abs=0.003)


def test_a_shake_shakes_off_what_barely_holds(scene_of, grasp_at):
    """Both pads bear 2 * 0.35 * 40 N = 28 N: more than a box of 1.9 kg weighs, less than it takes to shake it."""
    light, heavy = scene_of(density=400.0), scene_of(density=6000.0)
    assert attempt_grasp(light, grasp_at(), physics=SHAKEN).outcome == Outcome.SUCCESS
    assert attempt_grasp(heavy, grasp_at()).outcome == Outcome.SUCCESS
    assert attempt_grasp(heavy, grasp_at(), physics=SHAKEN).outcome == Outcome.SLIPPED


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
