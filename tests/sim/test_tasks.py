"""The simple task: what its scenes promise, over many of them."""

import colorsys
import math
from itertools import combinations

import numpy as np
import pytest
import torch

from nerfgrasp.geometry import project
from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.bars import bars
from nerfgrasp.scenes.prisms import centroid, clear_gap, footprint_in_world
from nerfgrasp.sim.shapes import RANDOM_FOOTPRINTS
from nerfgrasp.sim.tasks import scene_cameras, simple_scene


@pytest.fixture(scope="module")
def scenes():
    return [simple_scene(7, index) for index in range(60)]


def test_scenes_are_a_function_of_seed_and_index():
    def plain(seed, index):
        return [prism.to_json() for prism in simple_scene(seed, index).objects]

    assert plain(3, 5) == plain(3, 5)
    assert plain(3, 5) != plain(3, 6)
    assert plain(3, 5) != plain(4, 5)


def test_every_number_of_objects_and_every_kind_occurs(scenes):
    assert {len(scene.objects) for scene in scenes} == {1, 2, 3, 4, 5}
    assert {prism.kind for scene in scenes for prism in scene.objects} == set(RANDOM_FOOTPRINTS)


def test_objects_stand_inside_of_the_workspace_and_well_apart(scenes):
    for scene in scenes:
        footprints = [footprint_in_world(prism) for prism in scene.objects]
        assert all(np.abs(part).max() <= 0.23 + 1e-6 for parts in footprints for part in parts)
        assert all(clear_gap(a, b) >= 0.06 for a, b in combinations(footprints, 2))


def test_objects_are_upright_saturated_and_of_the_stated_sizes(scenes):
    for prism in (prism for scene in scenes for prism in scene.objects):
        assert 0.025 <= prism.height <= 0.12
        assert 200 <= prism.density <= 600
        assert colorsys.rgb_to_hsv(*prism.colour)[1] >= 0.75 - 1e-9
        assert prism.T_world_object[2].tolist() == [0.0, 0.0, 1.0, 0.0]


@pytest.mark.parametrize("kind", sorted(RANDOM_FOOTPRINTS))
def test_every_object_can_be_grasped(kind, scenes):
    mine = [prism for scene in scenes for prism in scene.objects if prism.kind == kind]
    assert mine
    assert all(bars(prism, ROBOTIQ_2F85.fingers) for prism in mine)
    assert all(centroid(prism.parts) == pytest.approx((0.0, 0.0), abs=1e-9) for prism in mine)


def test_parts_are_convex_and_counter_clockwise():
    rng = np.random.default_rng(0)
    for draw in RANDOM_FOOTPRINTS.values():
        for part in draw(rng):
            edges = np.roll(part, -1, axis=0) - np.asarray(part)
            following = np.roll(edges, -1, axis=0)
            assert (edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0] > 0).all()


def test_cameras_look_at_the_middle_from_the_stated_sphere():
    camera = scene_cameras(2, 9, 40, size=64)
    pixels, depth = project(camera, torch.zeros(40, 1, 3))
    torch.testing.assert_close(pixels, torch.full((40, 1, 2), 32.0), atol=1e-3, rtol=0)
    torch.testing.assert_close(depth, torch.full((40, 1), 0.8))
    assert camera.intrinsics[0, 0, 0] == 60
    polar = torch.rad2deg(torch.acos(camera.T_world_camera[:, 2, 3] / 0.8))
    assert polar.min() >= 30 - 1e-3
    assert polar.max() <= 60 + 1e-3


def test_first_three_cameras_are_spread_and_more_views_change_none():
    for index in range(30):
        eyes = scene_cameras(0, index, 3).T_world_camera[:, :2, 3]
        azimuths = torch.rad2deg(torch.atan2(eyes[:, 1], eyes[:, 0])).tolist()
        for a, b in combinations(azimuths, 2):
            assert abs((a - b + 180) % 360 - 180) >= 60 - 1e-3
        assert max(abs(a) for a in azimuths) <= 150 + 1e-3
    few, many = scene_cameras(1, 4, 3), scene_cameras(1, 4, 10)
    assert torch.equal(few.T_world_camera, many.T_world_camera[:3])


def test_yaw_is_spread_over_the_whole_circle(scenes):
    poses = torch.stack([prism.T_world_object for scene in scenes for prism in scene.objects])
    quadrants = torch.atan2(poses[:, 1, 0], poses[:, 0, 0]).div(math.pi / 2).floor()
    assert set(quadrants.int().tolist()) == {-2, -1, 0, 1}
