import math

import pytest
import roma
import torch
from torch import Tensor

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import is_rigid, make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import PAPER, Phase, PoseParameterization, Schedule, ascend, random_candidates, search

GOAL = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.1, 0.05, 0.08]))


class Whole:
    """A whole-transform parameterization whose parameters are the matrix itself, sharing its memory."""

    def encode(self, T: Tensor) -> dict[str, Tensor]:
        return {"pose": T}

    def decode(self, params: dict[str, Tensor]) -> Tensor:
        return params["pose"]

    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        T = params["pose"]
        rotation = roma.special_procrustes(T[..., :3, :3])
        return {"pose": make_pose(rotation, T[..., :3, 3].clamp(workspace.minimum, workspace.maximum))}


@pytest.fixture
def quaternion() -> PoseParameterization:
    return registry.load(registry.POSES, "quaternion")()


def nearness(T: Tensor) -> Tensor:
    """0 at the goal: minus the distance in metres, minus the squared chordal distance of the rotations."""
    distance = (T[:, :3, 3] - GOAL[:3, 3]).square().sum(dim=-1).add(1e-12).sqrt()
    return -distance - (T[:, :3, :3] - GOAL[:3, :3]).square().sum(dim=(-1, -2))


def starts(workspace: Workspace, count: int = 6, seed: int = 0) -> Tensor:
    return random_candidates(count, workspace, torch.Generator().manual_seed(seed))


def test_the_papers_schedule() -> None:
    assert PAPER.steps == 32
    assert [phase.groups for phase in PAPER.phases] == [("position",), ("orientation",)]
    assert [(phase.learning_rate, phase.decay) for phase in PAPER.phases] == [(0.05, 0.9), (0.05, 0.99)]
    assert PAPER.clip == 1.0


def test_a_first_adam_step_is_as_long_as_its_rate(workspace: Workspace, quaternion: PoseParameterization) -> None:
    start = make_pose(torch.eye(3), torch.tensor([[0.0, 0.0, 0.1]]))
    slope = torch.tensor([3.0, -0.2, 0.0])
    two = Schedule((Phase(("position",), steps=2, learning_rate=0.04, decay=0.5),))
    _, trace = ascend(lambda T: T[:, :3, 3] @ slope, start, quaternion, workspace, two)
    # Under a constant gradient Adam steps by its rate along each axis: 0.04, then 0.04 · 0.5.
    expected = torch.tensor([[0.0, 0.0, 0.1], [0.04, -0.04, 0.1], [0.06, -0.06, 0.1]])
    assert torch.allclose(trace.T_world_grasp[:, 0, :3, 3], expected, atol=1e-6)
    assert torch.allclose(trace.value[:, 0], expected @ slope, atol=1e-6)


def test_gradients_are_clipped(workspace: Workspace, quaternion: PoseParameterization) -> None:
    def steeper_later(T: Tensor) -> Tensor:
        x = T[:, 0, 3]
        return torch.where(x < 0.005, x, 100.0 * x)

    start = make_pose(torch.eye(3), torch.tensor([[0.0, 0.0, 0.1]]))
    two = Schedule((Phase(("position",), steps=2, learning_rate=0.01),))
    _, trace = ascend(steeper_later, start, quaternion, workspace, two)
    # The second slope, 100, counts as 1, as the first: two equal steps.
    assert trace.T_world_grasp[:, 0, 0, 3].tolist() == pytest.approx([0.0, 0.01, 0.02], abs=1e-6)


def test_positions_move_first_then_orientations(workspace: Workspace, quaternion: PoseParameterization) -> None:
    _, trace = ascend(nearness, starts(workspace), quaternion, workspace)
    position, rotation = trace.T_world_grasp[..., :3, 3], trace.T_world_grasp[..., :3, :3]
    assert torch.allclose(rotation[:17], rotation[:1].expand_as(rotation[:17]), atol=1e-5)
    assert torch.equal(position[16:], position[16:17].expand_as(position[16:]))
    assert not torch.allclose(rotation[17], rotation[16], atol=1e-4)


def test_ascent_reaches_a_lone_peak(workspace: Workspace, quaternion: PoseParameterization) -> None:
    grasps, trace = ascend(nearness, starts(workspace, 32), quaternion, workspace)
    assert (trace.value[-1] > trace.value[0]).float().mean() > 0.95
    assert float((grasps.T_world_grasp[0, :3, 3] - GOAL[:3, 3]).norm()) < 0.02  # the last steps are still 10 mm long
    assert float(roma.rotmat_geodesic_distance(grasps.T_world_grasp[0, :3, :3], GOAL[:3, :3])) < math.radians(5)


def test_trace_runs_from_the_start_to_the_result(workspace: Workspace, quaternion: PoseParameterization) -> None:
    start = starts(workspace)
    grasps, trace = ascend(nearness, start, quaternion, workspace)
    assert trace.T_world_grasp.shape == (33, 6, 4, 4)
    assert torch.allclose(trace.T_world_grasp[0], start, atol=1e-5)
    for poses, value in zip(trace.T_world_grasp, trace.value, strict=True):
        assert torch.allclose(nearness(poses), value, atol=1e-5)
    assert torch.equal(grasps.value, trace.value[-1].sort(descending=True).values)


def test_every_pose_on_the_way_is_rigid_and_inside(workspace: Workspace, quaternion: PoseParameterization) -> None:
    _, trace = ascend(lambda T: 5.0 * T[:, 0, 3] - T[:, 2, 3], starts(workspace), quaternion, workspace)
    assert is_rigid(trace.T_world_grasp).all()
    position = trace.T_world_grasp[..., :3, 3]
    assert ((position >= workspace.minimum - 1e-6) & (position <= workspace.maximum + 1e-6)).all()
    assert torch.allclose(position[-1, :, 2], workspace.minimum[2])  # they were pushed against the table


def test_candidates_do_not_touch_each_other(workspace: Workspace, quaternion: PoseParameterization) -> None:
    start = starts(workspace, 7)
    _, together = ascend(nearness, start, quaternion, workspace)
    _, in_chunks = ascend(nearness, start, quaternion, workspace, chunk=3)
    assert torch.allclose(together.T_world_grasp, in_chunks.T_world_grasp, atol=1e-5)
    _, alone = ascend(nearness, start[4:5], quaternion, workspace)
    assert torch.allclose(together.T_world_grasp[:, 4], alone.T_world_grasp[:, 0], atol=1e-5)


def test_a_whole_pose_moves_in_both_phases(workspace: Workspace) -> None:
    start = starts(workspace)
    _, trace = ascend(nearness, start, Whole(), workspace)
    rotation = trace.T_world_grasp[..., :3, :3]
    assert not torch.allclose(rotation[1], rotation[0], atol=1e-3)
    assert not torch.allclose(rotation[17], rotation[16], atol=1e-5)
    assert torch.allclose(trace.T_world_grasp[0], start, atol=1e-5)  # not overwritten by later steps
    assert trace.value[-1].max() > trace.value[0].max()


def test_the_model_and_the_start_stay_as_they_are(workspace: Workspace, quaternion: PoseParameterization) -> None:
    weight = torch.nn.Parameter(torch.tensor([1.0, 0.0, 0.0]))
    start = starts(workspace)
    before = start.clone()
    with torch.no_grad():  # the search asks for gradients itself
        grasps, trace = ascend(lambda T: T[:, :3, 3] @ weight, start, quaternion, workspace)
    assert torch.equal(start, before)
    assert weight.grad is None
    assert not grasps.value.requires_grad
    assert not trace.T_world_grasp.requires_grad


def test_search_climbs_only_the_best_candidates(workspace: Workspace, quaternion: PoseParameterization) -> None:
    drawn = starts(workspace, 50, seed=3)
    best = nearness(drawn).sort(descending=True).values[:4]
    generator = torch.Generator().manual_seed(3)
    _, trace = search(nearness, quaternion, workspace, candidates=50, keep=4, generator=generator, chunk=16)
    assert torch.allclose(trace.value[0], best, atol=1e-4)


@pytest.mark.parametrize("keep", [None, 5, 9])
def test_search_without_a_choice_climbs_all(
    workspace: Workspace, quaternion: PoseParameterization, keep: int | None
) -> None:
    generator = torch.Generator().manual_seed(3)
    grasps, _ = search(nearness, quaternion, workspace, candidates=5, keep=keep, generator=generator)
    assert len(grasps) == 5


def test_values_that_are_never_finite_are_an_error(workspace: Workspace, quaternion: PoseParameterization) -> None:
    def damaged(T: Tensor) -> Tensor:
        return T[:, 0, 3] * math.nan

    for keep in (None, 2):
        with pytest.raises(UserError, match="finite value"):
            search(damaged, quaternion, workspace, candidates=4, keep=keep, generator=torch.Generator())
