"""Plateau-aware climbs: who no longer rises slows down, stands still, and ends at the best pose seen."""

import math

import pytest
import torch
from torch import Tensor

from nerfgrasp import registry
from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import Phase, PoseParameterization, Schedule, ascend, random_candidates
from nerfgrasp.search.pace import Pace
from nerfgrasp.search.schedule import JOINT, Plateau

GOAL = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.1, 0.05, 0.08]))


def hill(T: Tensor) -> Tensor:
    """A quadratic of position and rotation, 0 at the goal."""
    turned = (T[:, :3, :3] - GOAL[:3, :3]).square().sum(dim=(-1, -2))
    return -200.0 * (T[:, :3, 3] - GOAL[:3, 3]).square().sum(dim=-1) - 5.0 * turned


@pytest.fixture
def quaternion() -> PoseParameterization:
    return registry.load(registry.POSES, "quaternion")()


def joint(**changes: float) -> Schedule:
    plateau = Plateau(**changes)  # type: ignore[arg-type]
    return Schedule((Phase(("position", "orientation"), steps=200, learning_rate=0.02, plateau=plateau),))


def starts(workspace: Workspace, count: int = 6, max_tilt: float = 0.5) -> Tensor:
    return random_candidates(count, workspace, torch.Generator().manual_seed(0), max_tilt)


def test_the_climb_ends_early_and_at_the_peak(workspace: Workspace, quaternion: PoseParameterization) -> None:
    grasps, trace = ascend(hill, starts(workspace), quaternion, workspace, joint())
    assert 20 < len(trace.value) < 190
    assert grasps.value.min() > -0.5
    best = grasps.T_world_grasp[0]
    assert float((best[:3, 3] - GOAL[:3, 3]).norm()) < 0.005


def test_nobody_ends_lower_than_it_has_been(workspace: Workspace, quaternion: PoseParameterization) -> None:
    for schedule in (joint(), JOINT):
        _, trace = ascend(hill, starts(workspace, max_tilt=math.pi), quaternion, workspace, schedule)
        assert torch.allclose(trace.value[-1], trace.value.max(dim=0).values, atol=1e-4)
        assert torch.allclose(hill(trace.T_world_grasp[-1]), trace.value[-1], atol=1e-5)


def test_chunks_change_nothing(workspace: Workspace, quaternion: PoseParameterization) -> None:
    start = starts(workspace, 7)
    _, together = ascend(hill, start, quaternion, workspace, joint())
    _, in_chunks = ascend(hill, start, quaternion, workspace, joint(), chunk=3)
    assert torch.allclose(together.value, in_chunks.value, atol=1e-3)
    assert torch.allclose(together.T_world_grasp, in_chunks.T_world_grasp, atol=1e-3)


def test_who_has_converged_is_not_evaluated_again(workspace: Workspace, quaternion: PoseParameterization) -> None:
    asked: list[int] = []

    def counted(T: Tensor) -> Tensor:
        asked.append(len(T))
        return hill(T)

    start = torch.cat([GOAL[None], starts(workspace, 3)])
    _, trace = ascend(counted, start, quaternion, workspace, joint())
    assert asked[0] == 4
    assert min(asked[:-1]) < 4
    assert sum(asked) < 4 * len(trace.value)


def test_a_flat_value_converges_at_once(workspace: Workspace, quaternion: PoseParameterization) -> None:
    flat = joint(patience=0, factor=0.1, least=0.5)
    start = starts(workspace)
    _, trace = ascend(lambda T: 0.0 * T[:, 0, 3], start, quaternion, workspace, flat)
    assert len(trace.value) == 3  # the start counts as a rise, the next one does not
    assert torch.allclose(trace.T_world_grasp[-1], start, atol=1e-5)


def test_rates_fall_by_the_factor_once_patience_ends() -> None:
    params = {"position": torch.zeros(2, 3, requires_grad=True)}
    optimizer = torch.optim.SGD(list(params.values()), lr=0.0)
    pace = Pace(Plateau(patience=1, rise=0.1, factor=0.5, least=0.3), params)
    shares = []
    for step in range(5):
        pace.step(optimizer, list(params.values()), params, torch.tensor([1.0 * step, 0.05 * step]))
        shares.append(pace.share.tolist())
    # The second one rises too slowly: after two steps without a rise its rate halves, then it has converged.
    assert shares == [[1.0, 1.0], [1.0, 1.0], [1.0, 0.5], [1.0, 0.5], [1.0, 0.0]]


def test_a_value_that_is_no_number_ends_the_climb(workspace: Workspace, quaternion: PoseParameterization) -> None:
    def half_damaged(T: Tensor) -> Tensor:
        return torch.where(torch.arange(len(T)) > 0, hill(T), torch.nan)

    grasps, trace = ascend(half_damaged, starts(workspace, 1).repeat(2, 1, 1), quaternion, workspace, joint())
    assert len(grasps) == 1
    assert len(trace.value) < 190
