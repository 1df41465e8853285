from pathlib import Path

import numpy as np
import pytest
import torch

from nerfgrasp.geometry import Camera
from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search import Trace
from nerfgrasp.viz.renderings import RenderedView

rerun_chunk = pytest.importorskip("rerun.chunk")
from nerfgrasp.viz import recording  # noqa: E402  # it imports rerun

CAMERAS = {f"/world/{name}" for name in ("camera_0", "camera_1", "camera_2", "imagined", "from_grasp")}


@pytest.fixture
def path(tmp_path: Path, observations: Observations, grasps: Grasps, camera: Camera) -> Path:
    value = torch.tensor([[0.0, 1.0], [0.5, 1.5], [1.0, 2.0]])
    trace = Trace(grasps.T_world_grasp.flip(0).expand(3, 2, 4, 4), value)
    shown = torch.ones(48, 64, dtype=torch.bool)
    views = [RenderedView(camera[i], torch.zeros(48, 64, 3), torch.full((48, 64), 0.25), shown) for i in (1, 2)]
    imagined = dict(zip(("imagined", "from_grasp"), views, strict=True))
    file = tmp_path / "optimization.rrd"
    recording.record_search(file, observations, Workspace(), trace, grasps, imagined, gripper=ROBOTIQ_2F85)
    return file


def read(path: Path, entity: str, component: str) -> list:
    """Returns a component's values in the order of the file."""
    rows = []
    for chunk in rerun_chunk.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if chunk.entity_path == entity and name.endswith(component):
                rows += batch.column(name).to_pylist()
    return rows


def test_the_recording_opens_with_its_blueprint(path: Path) -> None:
    reader = rerun_chunk.RrdReader(path)
    assert len(reader.recordings()) == 1
    assert len(reader.blueprints()) == 1


def test_cameras_images_box_and_winner_are_always_there(path: Path) -> None:
    static = {chunk.entity_path for chunk in rerun_chunk.RrdReader(path).stream() if chunk.is_static}
    images = {f"{camera}/image" for camera in CAMERAS}
    assert static >= CAMERAS | images | {"/world", "/world/workspace", "/world/grasp"}


def test_candidates_and_curves_run_over_iterations(path: Path) -> None:
    for entity in ("/world/candidates", "/value/best", "/value/median"):
        assert read(path, entity, recording.TIMELINE) == [0, 1, 2]
    assert read(path, "/value/best", "scalars") == [[1.0], [1.5], [2.0]]
    assert read(path, "/value/median", "scalars") == [[0.0], [0.5], [1.0]]


def test_the_candidate_that_became_the_result_is_followed(path: Path, grasps: Grasps) -> None:
    # Candidates stand in the trace in the reverse order of the result: its first is their last.
    assert read(path, "/value/winner", "scalars") == [[1.0], [1.5], [2.0]]
    strips = np.array(read(path, "/world/winner", "strips"))
    assert strips.shape == (3, 1, 7, 3)
    fingers = strips[-1, 0, [0, -1]].mean(axis=0)
    assert fingers[:2].tolist() == pytest.approx(grasps.T_world_grasp[0, :2, 3].tolist(), abs=1e-6)


def test_a_result_that_was_polished_is_followed_to_where_its_climb_ended(
    tmp_path: Path, observations: Observations, grasps: Grasps
) -> None:
    climbed = grasps.T_world_grasp.flip(0).clone()
    climbed[:, :3, 3] += 0.004
    trace = Trace(climbed.expand(2, 2, 4, 4), torch.tensor([[0.0, 1.0], [2.0, 3.0]]))
    recording.record_search(tmp_path / "search.rrd", observations, Workspace(), trace, grasps, gripper=ROBOTIQ_2F85)
    assert read(tmp_path / "search.rrd", "/value/winner", "scalars") == [[1.0], [3.0]]


def test_a_result_that_is_no_candidate_is_not_followed(
    tmp_path: Path, observations: Observations, grasps: Grasps
) -> None:
    moved = grasps.T_world_grasp + 0.1
    trace = Trace(moved.expand(2, 2, 4, 4), torch.tensor([[0.0, torch.nan], [1.0, 3.0]]))
    recording.record_search(tmp_path / "search.rrd", observations, Workspace(), trace, grasps, gripper=ROBOTIQ_2F85)
    assert read(tmp_path / "search.rrd", "/value/winner", "scalars") == []
    assert read(tmp_path / "search.rrd", "/value/best", "scalars") == [[0.0], [3.0]]
    assert read(tmp_path / "search.rrd", "/value/median", "scalars") == [[0.0], [1.0]]


def test_values_are_called_what_they_are(
    path: Path, tmp_path: Path, observations: Observations, grasps: Grasps
) -> None:
    value = f"{float(grasps.value[0]):.2f}"
    assert read(path, "/world/grasp", "labels") == [[f"Ψ {value}"]]
    trace = Trace(grasps.T_world_grasp.expand(2, 2, 4, 4), torch.zeros(2, 2))
    judged = recording.WITH_FEASIBILITY
    recording.record_search(
        tmp_path / "search.rrd", observations, Workspace(), trace, grasps, gripper=ROBOTIQ_2F85, judged=judged
    )
    assert read(tmp_path / "search.rrd", "/world/grasp", "labels") == [[f"Ψ and feasibility {value}"]]
    assert recording.CURVES_TITLE.startswith("Ψ during the climb (logit")


def test_what_is_imagined_has_depth_in_metres(path: Path) -> None:
    for name in ("imagined", "from_grasp"):
        (buffer,) = read(path, f"/world/{name}/depth", "buffer")
        depth = np.frombuffer(np.array(buffer, np.uint8).tobytes(), np.float32)
        assert depth.size == 48 * 64
        assert np.all(depth == 0.25)


def test_a_camera_keeps_its_pose_and_lens(path: Path, camera: Camera) -> None:
    translation = np.array(read(path, "/world/camera_1", "translation")).ravel()
    assert translation.tolist() == pytest.approx(camera.T_world_camera[1, :3, 3].tolist())
    matrix = np.array(read(path, "/world/camera_1", "image_from_camera")).reshape(3, 3).T
    assert np.allclose(matrix, camera.intrinsics[1])


def test_every_candidate_is_a_gripper(path: Path) -> None:
    strips = read(path, "/world/candidates", "strips")
    assert np.array(strips).shape == (3, 2, 7, 3)
