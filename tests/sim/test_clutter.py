"""The clutter task: what its scenes promise; and tasks by their names."""

import colorsys
from pathlib import Path

import numpy as np
import pytest

from nerfgrasp.errors import UserError
from nerfgrasp.scenes.prisms import corners_in_world
from nerfgrasp.sim.settling import stable
from nerfgrasp.sim.tasks import TASKS, clutter_scene, find_task, simple_scene


@pytest.fixture(scope="module")
def scenes():
    return [clutter_scene(4, index) for index in range(6)]


def plain(truth):
    return [thing.to_json() for thing in truth.objects]


def test_scenes_are_a_function_of_seed_and_index(scenes):
    assert plain(clutter_scene(4, 1)) == plain(scenes[1])
    assert len({str(plain(scene)) for scene in scenes}) == len(scenes)


def test_five_objects_lie_inside_of_the_workspace(scenes):
    for scene in scenes:
        assert (scene.task, scene.seed, len(scene.objects)) == ("clutter", 4, 5)
        corners = np.concatenate([corners_in_world(prism) for prism in scene.objects])
        assert np.abs(corners[:, :2]).max() <= 0.23
        assert -2e-3 <= corners[:, 2].min() <= corners[:, 2].max() <= 0.2


def test_objects_touch_or_nearly_so_and_stay_where_they_are(scenes):
    for scene in scenes:
        centres = np.array([corners_in_world(prism).mean(axis=0) for prism in scene.objects])
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1) + np.eye(5)
        assert np.median(apart.min(axis=1)) < 0.09
        assert stable(scene.objects)


def test_poses_and_colours_vary(scenes):
    prisms = [prism for scene in scenes for prism in scene.objects]
    upright = [abs(float(prism.T_world_object[2, 2])) > 0.999 for prism in prisms]
    assert 0.2 <= np.mean(upright) <= 0.9
    assert len({prism.colour for prism in prisms}) == len(prisms)
    assert all(colorsys.rgb_to_hsv(*prism.colour)[1] >= 0.75 - 1e-9 for prism in prisms)
    assert all(0.025 <= prism.height <= 0.07 for prism in prisms)


def test_tasks_are_found_by_name():
    simple, clutter = find_task("simple"), find_task("clutter")
    assert (simple.attempts, clutter.attempts) == (1, 10)
    assert simple.catalogue is clutter.catalogue is None
    assert plain(simple.draw(3, 2)) == plain(simple_scene(3, 2))
    assert clutter.draw is clutter_scene
    assert {"simple", "clutter", "novel"} == set(TASKS)


def test_an_unknown_task_and_a_folder_for_a_task_that_takes_none_are_the_users_mistakes():
    with pytest.raises(UserError, match="unknown task 'cluter': did you mean 'clutter'"):
        find_task("cluter")
    with pytest.raises(UserError, match="only 'novel' takes a folder"):
        find_task("simple", Path("objects"))
