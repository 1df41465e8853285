"""The world: objects rest where they are put and weigh what they should; the constants are as described."""

from dataclasses import fields, replace

import numpy as np
import pybullet as p
import pytest

from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.prisms import mass_properties
from nerfgrasp.sim import shapes
from nerfgrasp.sim.physics import PHYSICS, physics_hash
from nerfgrasp.sim.tasks import simple_scene
from nerfgrasp.sim.world import World


def test_resting_objects_stay_where_they_are():
    scenes = [simple_scene(3, index) for index in range(4)]
    assert len({prism.kind for scene in scenes for prism in scene.objects}) >= 4
    for scene in scenes:
        with World(scene.objects, PHYSICS) as world:
            start = world.centres()
            world.step(240)
            assert np.abs(world.centres() - start).max() < 5e-4


@pytest.mark.parametrize(
    ("kind", "parts"), [("l", shapes.angle(0.09, 0.07, 0.03, 0.025)), ("triangle", shapes.triangle(0.05, 0.06))]
)
def test_bodies_have_the_mass_and_centre_of_their_solids(kind, parts, scene_of):
    (prism,) = scene_of(kind, parts).objects
    solid = mass_properties(prism)
    with World([prism], PHYSICS) as world:
        info = p.getDynamicsInfo(world.objects[0], -1, physicsClientId=world.client)
        centre = world.centres()[0]
    assert info[0] == pytest.approx(solid.mass)
    assert sorted(info[2]) == pytest.approx(np.linalg.eigvalsh(solid.inertia).tolist(), rel=1e-5)
    assert centre == pytest.approx(prism.T_world_object[:3, 3].numpy() + solid.centre, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "parts"), [("cylinder", shapes.cylinder(0.05)), ("triangle", shapes.triangle(0.05, 0.06))]
)
def test_hulls_end_where_the_solids_do(kind, parts, scene_of):
    """Rays towards the middle, from above and from the side, meet the hull, margin included, at its faces."""
    (prism,) = scene_of(kind, parts).objects
    x, y, _ = prism.T_world_object[:3, 3].tolist()
    # Straight under the centroid lies the triangle's base; the cylinder's lowest corner lies there too.
    lowest = min(corner[1] for corner in parts[0])
    with World([prism], PHYSICS) as world:
        world.step()
        starts, ends = [[x, y, 1.0], [x, y - 1.0, 0.05]], [[x, y, 0.05], [x, y, 0.05]]
        hits = p.rayTestBatch(starts, ends, physicsClientId=world.client)
    assert hits[0][3][2] == pytest.approx(prism.height, abs=5e-4)
    assert hits[1][3][1] == pytest.approx(y + lowest, abs=5e-4)


def test_open_boxes_span_the_gripper():
    body, left, right = ROBOTIQ_2F85.open_boxes()
    assert left[0][2] + left[1][2] == pytest.approx(0.0375 / 2)
    assert right[0][0] - right[1][0] == pytest.approx(0.0425)
    assert body[0][2] + body[1][2] == pytest.approx(left[0][2] - left[1][2])
    assert 2 * ROBOTIQ_2F85.finger_mass + ROBOTIQ_2F85.body_mass == pytest.approx(0.925)


def test_every_constant_is_in_the_hash():
    hashes = {physics_hash()}
    for name in (field.name for field in fields(PHYSICS)):
        hashes.add(physics_hash(replace(PHYSICS, **{name: getattr(PHYSICS, name) + 1})))
    hashes.add(physics_hash(PHYSICS, replace(ROBOTIQ_2F85, finger_length=0.07)))
    assert len(hashes) == len(fields(PHYSICS)) + 2
