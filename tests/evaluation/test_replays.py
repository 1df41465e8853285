from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from nerfgrasp.errors import UserError
from nerfgrasp.methods.spec import MethodSpec

pytest.importorskip("pybullet")

from nerfgrasp.evaluation.replays import replay_scene
from nerfgrasp.evaluation.results import Row
from nerfgrasp.evaluation.trials import Trials, run_scene
from nerfgrasp.sim.tasks import find_task

TASK = replace(find_task("simple"), attempts=2)
SCENE = next(index for index in range(100) if len(TASK.draw(7, index).objects) == 2)


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    """The oracle's grasps of two objects, one after another: the second attempt meets what the first left."""
    found = [row for row, _ in run_scene(Trials(TASK, 7, MethodSpec("oracle"), None, 32), SCENE)]
    assert [row.outcome for row in found] == ["success", "success"]
    return found


def test_attempts_meet_what_the_one_before_left(rows: list[Row]) -> None:
    first, second = replay_scene(TASK, rows, 32)
    assert [first.row, second.row] == rows
    assert len(second.truth.objects) == len(first.truth.objects) - 1
    assert first.observations.images.shape == (3, 3, 32, 32)
    assert not torch.equal(first.observations.images, second.observations.images)
    assert first.frames[0].stage == "pregrasp"
    assert first.frames[-1].stage == "after"
    assert len(first.frames[-1].truth.objects) == len(second.truth.objects)


def test_where_nothing_was_proposed_nothing_happens(rows: list[Row]) -> None:
    nothing = replace(rows[0], grasp=None, outcome="no_grasp")
    [shown] = replay_scene(TASK, [nothing], 32)
    assert [frame.stage for frame in shown.frames] == ["untouched"]


@pytest.mark.parametrize(
    ("change", "size", "message"),
    [
        (
            lambda row: replace(row, physics="f" * 16),
            32,
            f"scene {SCENE}, attempt 0 is of physics f{{16}}: this program's",
        ),
        (
            lambda row: row,
            48,
            rf"scene {SCENE}, attempt 0 had other objects, or pictures of another size than 48 \(--size\)",
        ),
        (lambda row: replace(row, outcome="slipped"), 32, "attempt 0 ended as slipped, and ends as success now"),
    ],
)
def test_what_cannot_be_repeated_is_told(
    rows: list[Row], change: Callable[[Row], Row], size: int, message: str
) -> None:
    with pytest.raises(UserError, match=message):
        list(replay_scene(TASK, [change(rows[0])], size))
