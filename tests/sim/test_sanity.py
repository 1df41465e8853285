"""Physics against hand-computed values: friction's limit, pads, rest, and the time step."""

from dataclasses import replace

import numpy as np
import pybullet as p
import pytest
import torch

from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.oracle import sample_top_down, valid_grasps
from nerfgrasp.sim import shapes
from nerfgrasp.sim.attempt import Outcome, attempt_grasp
from nerfgrasp.sim.physics import PHYSICS
from nerfgrasp.sim.sanity import perturbed_grasp
from nerfgrasp.sim.tasks import clutter_scene, simple_scene
from nerfgrasp.sim.world import World

VOLUME = 0.04 * 0.08 * 0.1
"""Of the box in m³."""


@pytest.mark.parametrize(("friction", "holds"), [(0.7, True), (0.05, False)])
def test_a_held_object_slips_at_low_friction_only(friction, holds, scene_of, grasp_at):
    """0.6 kg weigh 5.9 N; two pads at 40 N bear 56 N at a coefficient of 0.7, and 4 N at 0.05."""
    physics = replace(PHYSICS, object_friction=friction, pad_friction=1.0)
    attempt = attempt_grasp(scene_of(density=0.6 / VOLUME), grasp_at(), physics=physics)
    assert attempt.object == 0
    assert attempt.outcome == (Outcome.SUCCESS if holds else Outcome.SLIPPED)
    # In the hand it moves by less than 1 mm, or else out of it.
    assert attempt.lifted == pytest.approx(0.1, abs=0.001) if holds else attempt.lifted < 0.05


@pytest.mark.parametrize(("share", "holds"), [(1.3, True), (0.7, False)])
def test_coulombs_limit(share, holds, scene_of, grasp_at):
    """A box holds where 2 μ F exceeds its weight and the force that lifts it, and slips where it does not."""
    physics = replace(PHYSICS, object_friction=0.3, pad_friction=1.0)
    mass = 2 * 0.3 * PHYSICS.closing_force / PHYSICS.gravity / share
    attempt = attempt_grasp(scene_of(density=mass / VOLUME), grasp_at(), physics=physics)
    assert (attempt.outcome == Outcome.SUCCESS) == holds


def test_a_grasp_20_mm_beside_the_object_misses(scene_of, grasp_at):
    beside = ROBOTIQ_2F85.fingers.pad_width / 2 + 0.04 + 0.02
    assert attempt_grasp(scene_of(), grasp_at(y=-0.02 + beside)).outcome == Outcome.NOTHING_BETWEEN_FINGERS


def test_through_the_table_is_refused_and_through_another_object_is_a_collision(scene_of, grasp_at):
    scene = scene_of()
    assert attempt_grasp(scene, grasp_at(z=0.01)).outcome == Outcome.TABLE_COLLISION
    (box,) = scene.objects
    blocked = replace(box, T_world_object=box.T_world_object.clone())
    blocked.T_world_object[0, 3] += 0.055
    assert attempt_grasp(replace(scene, objects=(box, blocked)), grasp_at()).outcome == Outcome.OBJECT_COLLISION


@pytest.mark.parametrize(
    ("kind", "parts"),
    [("box", None), ("cylinder", shapes.cylinder(0.05)), ("triangle", shapes.triangle(0.06, 0.055))],
)
def test_pads_do_not_sink_into_what_they_hold(kind, parts, scene_of):
    scene = scene_of(kind, parts, height=0.06)
    grasp = sample_top_down(valid_grasps(scene.objects), torch.Generator().manual_seed(1))
    depths = {}

    def observe(stage, world, hand):
        found = [
            contact[8]
            for finger in hand.fingers
            for contact in p.getContactPoints(hand.body, world.objects[0], finger.link, physicsClientId=world.client)
        ]
        depths[stage] = min(found, default=0.0)

    assert attempt_grasp(scene, grasp, observe=observe).outcome == Outcome.SUCCESS
    assert set(depths) == {"pregrasp", "grasp", "closed", "lifted", "held"}
    assert -0.001 <= depths["closed"] < 0.0
    assert -0.001 <= depths["held"] < 0.0


def test_tipped_objects_stay_at_rest():
    for index in range(3):
        with World(clutter_scene(5, index).objects, PHYSICS) as world:
            before = world.poses()
            world.step(480)
            assert np.abs(world.poses() - before)[:, :3, 3].max() < 1e-3


def test_perturbed_grasps_repeat_and_grow_away_from_valid_ones():
    scene = simple_scene(2, 3)
    near, far = perturbed_grasp(scene, 0.5), perturbed_grasp(scene, 1.0)
    assert torch.equal(near, perturbed_grasp(scene, 0.5))
    valid = perturbed_grasp(scene, 0.0)
    assert 0 < (near - valid)[:3, :2].norm() < (far - valid)[:3, :2].norm()
    assert all(ROBOTIQ_2F85.lowest(grasp) >= 0.0024 for grasp in (near, far))


def test_halving_the_time_step_changes_few_outcomes():
    """Of 12 grasps so wrong that many of them fail; 300 are compared in `benchmarks/physics.py`."""
    scenes = [simple_scene(102, index) for index in range(12)]
    fine = replace(PHYSICS, time_step=PHYSICS.time_step / 2)
    successes = np.array(
        [
            [
                attempt_grasp(scene, perturbed_grasp(scene, 1.0), physics=physics).outcome == Outcome.SUCCESS
                for scene in scenes
            ]
            for physics in (PHYSICS, fine)
        ]
    )
    assert 0.2 <= successes.mean() <= 0.8
    assert (successes[0] != successes[1]).sum() <= 2
