import pytest
import roma
import torch

from nerfgrasp.geometry import is_rigid, make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import random_candidates
from nerfgrasp.search.candidates import resample, scatter
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.schedule import Round


def draw(count: int, workspace: Workspace, seed: int = 0) -> torch.Tensor:
    return random_candidates(count, workspace, torch.Generator().manual_seed(seed))


def test_positions_fill_the_workspace_evenly(workspace: Workspace) -> None:
    position = draw(20_000, workspace)[:, :3, 3]
    assert (position >= workspace.minimum).all()
    assert (position <= workspace.maximum).all()
    share = (position - workspace.minimum) / (workspace.maximum - workspace.minimum)
    assert torch.allclose(share.mean(dim=0), torch.full((3,), 0.5), atol=0.01)
    assert torch.allclose(share.var(dim=0), torch.full((3,), 1 / 12), atol=0.003)


def test_orientations_are_uniform_on_so3(workspace: Workspace) -> None:
    T = draw(20_000, workspace)
    assert is_rigid(T).all()
    rotation = T[:, :3, :3]
    # Under the Haar measure every entry has mean 0 and variance 1/3, and the trace has mean 0 and variance 1.
    assert rotation.mean(dim=0).abs().max() < 0.02
    assert (rotation.var(dim=0) - 1 / 3).abs().max() < 0.02
    trace = rotation.diagonal(dim1=1, dim2=2).sum(dim=1)
    assert abs(float(trace.mean())) < 0.03
    assert abs(float(trace.var()) - 1.0) < 0.05


def test_seed_decides_and_the_global_state_does_not(workspace: Workspace) -> None:
    first = draw(5, workspace)
    torch.rand(3)
    assert torch.equal(first, draw(5, workspace))
    assert not torch.equal(first, draw(5, workspace, seed=1))


def test_scatter_spreads_copies_as_asked(workspace: Workspace) -> None:
    generator = torch.Generator().manual_seed(0)
    middle = (workspace.minimum + workspace.maximum) / 2
    pose = make_pose(torch.eye(3), middle)[None]
    scattered = scatter(pose, 4000, 0.01, 0.1, workspace, generator)
    assert scattered.shape == (4000, 1, 4, 4)
    assert is_rigid(scattered).all()
    assert torch.allclose((scattered[:, 0, :3, 3] - middle).std(dim=0), torch.full((3,), 0.01), rtol=0.1)
    angle = roma.rotmat_to_rotvec(scattered[:, 0, :3, :3]).norm(dim=-1)
    assert angle.square().mean().sqrt().item() == pytest.approx(0.1, rel=0.1)


def test_scatter_stays_in_the_workspace(workspace: Workspace) -> None:
    corner = make_pose(torch.eye(3), workspace.maximum)[None]
    position = scatter(corner, 100, 0.05, 0.1, workspace, torch.Generator().manual_seed(0))[..., :3, 3]
    assert (position >= workspace.minimum).all()
    assert (position <= workspace.maximum).all()


def test_resampled_poses_rise_each_by_its_own_copies(workspace: Workspace) -> None:
    goal = (workspace.minimum + workspace.maximum) / 2
    shift = torch.tensor([[0.03, 0.0, 0.0], [0.0, -0.05, 0.0]])
    start = make_pose(torch.eye(3), goal + shift)
    floors: list[torch.Tensor] = []

    def judge(T: torch.Tensor, floor: torch.Tensor) -> torch.Tensor:
        floors.append(floor)
        return -(T[:, :3, 3] - goal).norm(dim=-1)

    value = -shift.norm(dim=-1)
    rounds = (Round(40, 0.01, 0.1),) * 6
    poses, values = resample(judge, start, value, rounds, workspace, torch.Generator().manual_seed(0))
    assert torch.equal(floors[0], value.repeat(40))
    assert (values > -0.005).all()
    assert torch.allclose(values, judge(poses, values))
    # One round moves no further than its own copies go: nobody takes another's place.
    once, _ = resample(judge, start, value, rounds[:1], workspace, torch.Generator().manual_seed(0))
    assert ((once - start)[:, :3, 3].norm(dim=-1) < 0.04).all()


def test_what_is_worse_or_no_number_replaces_nothing(workspace: Workspace) -> None:
    start = draw(5, workspace)
    for found in (-1.0, float("nan")):
        poses, values = resample(
            lambda T, floor, found=found: torch.full_like(floor, found),  # type: ignore[misc]
            start,
            torch.zeros(5),
            (Round(3, 0.01, 0.1),),
            workspace,
            torch.Generator().manual_seed(0),
        )
        assert torch.equal(poses, start)
        assert torch.equal(values, torch.zeros(5))


def test_copies_keep_the_limits(workspace: Workspace) -> None:
    start = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([[0.0, 0.0, 0.1]]))
    seen: list[torch.Tensor] = []

    def judge(T: torch.Tensor, floor: torch.Tensor) -> torch.Tensor:
        seen.append(T)
        return torch.zeros_like(floor)

    limits = Limits(max_tilt=0.1)
    rounds = (Round(50, 0.05, 1.0),)
    resample(judge, start, torch.ones(1), rounds, workspace, torch.Generator().manual_seed(0), limits)
    assert torch.allclose(seen[0], limits.enforce(seen[0], workspace), atol=1e-6)
