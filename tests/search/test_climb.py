"""Climbs in which only the best go on, rung by rung."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import PAPER, Phase, PoseParameterization, Schedule, ascend, random_candidates
from nerfgrasp.search.schedule import HALVING, JOINT, Rung

PEAK = torch.tensor([0.1, 0.05, 0.08])


def hill(T: Tensor) -> Tensor:
    """Highest at a point, for approaches from straight above."""
    return -20.0 * (T[:, :3, 3] - PEAK).square().sum(dim=-1) - (1.0 + T[:, 2, 2])


def slope(T: Tensor) -> Tensor:
    return T[:, 0, 3]


@pytest.fixture
def quaternion() -> PoseParameterization:
    return registry.load(registry.POSES, "quaternion")()


def starts(workspace: Workspace, count: int) -> Tensor:
    return random_candidates(count, workspace, torch.Generator().manual_seed(0))


def with_rungs(schedule: Schedule, *rungs: Rung) -> Schedule:
    return replace(schedule, phases=(replace(schedule.phases[0], rungs=rungs), *schedule.phases[1:]))


def test_a_rung_lets_exactly_the_best_go_on(workspace: Workspace, quaternion: PoseParameterization) -> None:
    phase = Phase(("position",), steps=5, learning_rate=0.001)
    schedule = with_rungs(Schedule((phase, phase)), Rung(2, 0.4), Rung(4, 0.5))
    _, trace = ascend(slope, starts(workspace, 10), quaternion, workspace, schedule, chunk=3)
    order = trace.value[0].sort(descending=True).indices
    assert trace.value.shape == (11, 10)
    moved = (trace.T_world_grasp[1:] != trace.T_world_grasp[:-1]).flatten(2).any(dim=2)
    steps = moved.sum(dim=0)[order]
    assert steps.tolist() == [10, 10, 4, 4, 2, 2, 2, 2, 2, 2]  # those left behind stay where they are to the end
    assert torch.equal(trace.value, trace.T_world_grasp[:, :, 0, 3])


def test_who_is_left_behind_is_not_evaluated_again(workspace: Workspace, quaternion: PoseParameterization) -> None:
    asked: list[int] = []

    def counted(T: Tensor) -> Tensor:
        asked.append(len(T))
        return slope(T)

    schedule = with_rungs(Schedule((Phase(("position",), steps=3, learning_rate=0.001),)), Rung(1, 0.5))
    ascend(counted, starts(workspace, 8), quaternion, workspace, schedule, chunk=3)
    assert asked == [3, 3, 2, 3, 3, 2, 3, 1, 3, 1]  # no chunk is larger, and those who are left share them


def test_rungs_that_keep_all_change_nothing(workspace: Workspace, quaternion: PoseParameterization) -> None:
    start = starts(workspace, 3)
    for schedule in (PAPER, JOINT):
        _, plain = ascend(hill, start, quaternion, workspace, schedule)
        _, trace = ascend(hill, start, quaternion, workspace, with_rungs(schedule, Rung(2, 1.0), Rung(9, 1.0)))
        assert torch.equal(trace.T_world_grasp, plain.T_world_grasp)
        assert torch.equal(trace.value, plain.value)


def test_who_goes_on_climbs_as_without_rungs(workspace: Workspace, quaternion: PoseParameterization) -> None:
    start = starts(workspace, 9)
    _, plain = ascend(hill, start, quaternion, workspace)
    rungs = replace(HALVING, go_back=False)
    _, trace = ascend(hill, start, quaternion, workspace, rungs, chunk=4)
    last = (trace.value[-1] != trace.value[-2]).nonzero()[:, 0]
    assert len(last) == 1  # of 9, half went on four times: 4, 2, 1, 1
    assert torch.allclose(trace.T_world_grasp[:, last], plain.T_world_grasp[:, last], atol=1e-5)
    assert torch.allclose(hill(trace.T_world_grasp.flatten(0, 1)), trace.value.flatten(), atol=1e-5)


def test_a_rung_ranks_by_the_best_of_its_window(workspace: Workspace, quaternion: PoseParameterization) -> None:
    """One that overshoots is high before the rung and low at it; the other one rests between the two."""

    def overshot(T: Tensor) -> Tensor:
        x = T[:, 0, 3]
        return torch.where(x > 0, -((x - 0.02).abs()), -0.015 + 1e-3 * x)

    start = make_pose(torch.eye(3), torch.tensor([[0.015, 0.0, 0.1], [-0.2, 0.0, 0.1]]))
    for window, winner in ((1, 1), (2, 0)):
        schedule = with_rungs(Schedule((Phase(("position",), 3, 0.025),)), Rung(1, 0.5, window))
        _, trace = ascend(overshot, start, quaternion, workspace, schedule)
        assert (trace.value[-1] != trace.value[1]).nonzero()[:, 0].tolist() == [winner]


def test_going_back_ends_at_the_best_pose_seen(workspace: Workspace, quaternion: PoseParameterization) -> None:
    start = starts(workspace, 16)
    grasps, trace = ascend(hill, start, quaternion, workspace, HALVING)
    assert trace.value.shape == (PAPER.steps + 1, 16)
    assert torch.equal(trace.value[-1], trace.value.max(dim=0).values)
    assert torch.allclose(hill(trace.T_world_grasp[-1]), trace.value[-1], atol=1e-6)
    assert grasps.value[0] == trace.value.max()


def test_a_value_that_is_no_number_is_left_behind(workspace: Workspace, quaternion: PoseParameterization) -> None:
    def damaged(T: Tensor) -> Tensor:
        return torch.where(T[:, 0, 3] < -0.05, math.nan, hill(T))

    start = starts(workspace, 8)
    sound = start[:, 0, 3] >= -0.05
    assert int(sound.sum()) == 4
    grasps, _ = ascend(damaged, start, quaternion, workspace, HALVING)
    assert bool(grasps.value.isfinite().all())
    assert grasps.value[0] > hill(start[sound]).max()


def test_rungs_out_of_range_are_told() -> None:
    for numbers, message in (
        ((-1, 0.5), "after is -1: it must be at least 0"),
        ((0, 0.0), "share is 0.0: it must be above 0 and at most 1"),
        ((0, 1.5), "share is 1.5: it must be above 0 and at most 1"),
        ((0, 0.5, 0), "window is 0: it must be at least 1"),
    ):
        with pytest.raises(UserError, match=f"a rung's {message}"):
            Rung(*numbers)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="comes after the phase's 4 steps"):
        Phase(("position",), steps=4, learning_rate=0.1, rungs=(Rung(4),))
