"""The novel task: every object in turn, at rest within the workspace, the same on every call."""

import pickle

import numpy as np
import pytest
import trimesh

from nerfgrasp.errors import UserError
from nerfgrasp.scenes.truth import truth_to_json
from nerfgrasp.sim.catalogue import open_catalogue
from nerfgrasp.sim.physics import PHYSICS
from nerfgrasp.sim.tasks import find_task
from nerfgrasp.sim.world import World


@pytest.fixture
def shelf(tmp_path, make_box, object_cache):
    """A folder of three objects, one of them round."""
    folder = tmp_path / "shelf"
    make_box(folder, name="tall")
    trimesh.creation.box((0.05, 0.05, 0.02)).export(folder / "flat.stl")
    trimesh.creation.icosphere(subdivisions=1, radius=0.03).export(folder / "ball.stl")
    return folder


@pytest.fixture
def scenes(shelf):
    task = find_task("novel", shelf)
    return [task.draw(4, index) for index in range(6)]


def test_every_object_has_as_many_scenes(scenes):
    assert [truth.objects[0].name for truth in scenes] == ["ball", "flat", "tall"] * 2
    assert all(len(truth.objects) == 1 and truth.task == "novel" for truth in scenes)


def test_scenes_are_a_function_of_seed_and_index(scenes, shelf):
    draw = find_task("novel", shelf).draw
    assert truth_to_json(draw(4, 2)) == truth_to_json(scenes[2])
    assert truth_to_json(draw(5, 2)) != truth_to_json(scenes[2])


def test_objects_rest_on_the_table_within_the_workspace(scenes, shelf):
    models = {model.name: model for model in open_catalogue(shelf).models}
    for truth in scenes:
        (thing,) = truth.objects
        pose = thing.T_world_object.double().numpy()
        corners = models[thing.name].corners() @ pose[:3, :3].T + pose[:3, 3]
        assert np.abs(corners[:, :2]).max() <= 0.23 + 1e-6
        assert corners[:, 2].min() == pytest.approx(0.0, abs=1e-3)
        with World(truth.objects, PHYSICS) as world:
            start = world.centres()
            world.step(240)
            assert np.abs(world.centres() - start).max() < 1e-3


def test_the_task_says_what_its_objects_are_of(shelf):
    task = find_task("novel", shelf)
    assert (task.name, task.attempts, task.catalogue) == ("novel", 1, "shelf")


def test_a_task_draws_the_same_elsewhere(scenes, shelf, tmp_path, monkeypatch):
    """Workers get the task, not the folder that its maker stood in, nor his variables."""
    monkeypatch.setenv("NERFGRASP_OBJECTS", "shelf")
    monkeypatch.chdir(tmp_path)
    task = pickle.loads(pickle.dumps(find_task("novel")))
    monkeypatch.delenv("NERFGRASP_OBJECTS")
    monkeypatch.chdir("/")
    assert truth_to_json(task.draw(4, 1)) == truth_to_json(scenes[1])


def test_faults_of_the_folder_are_met_at_once(shelf):
    trimesh.creation.box((50.0, 50.0, 20.0)).export(shelf / "zz.stl")
    with pytest.raises(UserError, match="zz.stl: .*millimetres"):
        find_task("novel", shelf)


def test_an_object_too_large_for_the_workspace_is_told(tmp_path, object_cache, monkeypatch):
    monkeypatch.setattr("nerfgrasp.sim.tasks.novel.TRIES", 3)
    (tmp_path / "shelf").mkdir()
    trimesh.creation.box((0.9, 0.05, 0.05)).export(tmp_path / "shelf" / "beam.stl")
    with pytest.raises(UserError, match="'beam' of shelf never comes to rest within the workspace"):
        find_task("novel", tmp_path / "shelf").draw(0, 0)
