from collections.abc import Callable

import numpy as np
import pytest
import torch

from nerfgrasp.geometry import Camera
from nerfgrasp.grippers import FRANKA
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.attempt import Outcome, attempt_grasp
from nerfgrasp.sim.film import film_grasp, gripper_prisms
from nerfgrasp.sim.rendering import render_scene

Scenes = Callable[..., Truth]
Grasps = Callable[..., torch.Tensor]


def corners(prism) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Returns the corners `[8, 3]` of a prism of one rectangle in the world."""
    flat = np.asarray(prism.parts[0])
    own = np.concatenate([np.column_stack([flat, np.full(4, z)]) for z in (0.0, prism.height)])
    T = prism.T_world_object.double().numpy()
    return own @ T[:3, :3].T + T[:3, 3]


def test_stages_of_a_success(scene_of: Scenes, grasp_at: Grasps) -> None:
    truth = scene_of()  # 40 mm wide along x, where the grasp closes
    attempt, frames = film_grasp(truth, grasp_at())
    assert attempt.outcome == Outcome.SUCCESS
    assert [frame.stage for frame in frames] == ["pregrasp", "grasp", "closed", "lifted", "held", "after"]
    boxes = {frame.stage: [corners(prism) for prism in frame.truth.objects[1:]] for frame in frames}
    # The hand starts 75 mm above the grasp and rises by 100 mm from it.
    lowest = {stage: min(box[:, 2].min() for box in hand) for stage, hand in boxes.items() if hand}
    assert lowest["pregrasp"] - lowest["grasp"] == pytest.approx(0.075, abs=0.002)
    assert lowest["held"] - lowest["closed"] == pytest.approx(0.1, abs=0.002)
    # The grasp is turned over: its +x finger is the one at +x, and between the pads lies the object.
    _, left, right = boxes["closed"]
    assert right[:, 0].min() - left[:, 0].max() == pytest.approx(0.04, abs=0.002)
    _, left, right = boxes["grasp"]
    assert right[:, 0].min() - left[:, 0].max() == pytest.approx(0.085, abs=0.001)
    # The object goes along, and is gone at the end.
    rise = frames[4].truth.objects[0].T_world_object[2, 3] - frames[0].truth.objects[0].T_world_object[2, 3]
    assert float(rise) == pytest.approx(0.1, abs=0.005)
    assert frames[-1].truth.objects == ()


@pytest.mark.parametrize(("x", "z", "stages"), [
    (0.05 - 0.0465, 0.075, ["pregrasp", "collision", "after"]),  # a finger lands on the object
    (0.2, 0.05, ["pregrasp", "grasp", "closed", "after"]),
    (0.05, 0.01, ["refused", "after"]),
])  # fmt: skip
def test_attempts_that_end_early(x: float, z: float, stages: list[str], scene_of: Scenes, grasp_at: Grasps) -> None:
    _, frames = film_grasp(scene_of(), grasp_at(x=x, z=z))
    assert [frame.stage for frame in frames] == stages
    assert len(frames[0].truth.objects) == 1 + 3


def test_being_watched_changes_nothing(scene_of: Scenes, grasp_at: Grasps) -> None:
    truth, grasp = scene_of(), grasp_at(x=0.06, z=0.03)
    filmed, plain = film_grasp(truth, grasp)[0], attempt_grasp(truth, grasp)
    assert filmed == plain
    assert filmed.lifted == plain.lifted


def test_an_open_gripper_is_its_boxes_where_the_grasp_is(grasp_at: Grasps) -> None:
    T = grasp_at().double().numpy()
    for prism, (centre, half) in zip(gripper_prisms(T, (0.0, 0.0), FRANKA), FRANKA.open_boxes(), strict=True):
        box = corners(prism)
        middle = T[:3, :3] @ centre + T[:3, 3]
        assert (box.min(axis=0) + box.max(axis=0)) / 2 == pytest.approx(middle, abs=1e-6)
        assert np.ptp(box, axis=0) / 2 == pytest.approx(half, abs=1e-6)


def test_the_gripper_is_seen(scene_of: Scenes, grasp_at: Grasps, cameras: Callable[..., Camera]) -> None:
    _, frames = film_grasp(scene_of(), grasp_at(x=0.2, z=0.05))
    _, masks = render_scene(frames[1].truth, cameras(3, 64))
    assert set(np.unique(masks)) == {0, 1, 2, 3, 4}
