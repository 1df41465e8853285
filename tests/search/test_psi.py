import pytest
import torch
from torch import Tensor, nn

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera, make_pose
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search import psi
from nerfgrasp.search.psi import Psi
from nerfgrasp.search.schedule import CLIMB, PAPER


class FakeValue(nn.Module):
    """Stands in for a trained value: the nearer to the point that the first pixel names, the higher."""

    views = 2

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(10.0))
        self.seen: list[int] = []

    def observe(self, observations: Observations, workspace: Workspace) -> Tensor:
        self.seen.append(len(observations))
        return observations.images[0, :, 0, 0]

    def value(self, features: Tensor, T_world_grasp: Tensor) -> Tensor:
        assert len(T_world_grasp) <= 8
        return -self.scale * (T_world_grasp[:, :3, 3] - features).norm(dim=-1)

    def density(self, features: Tensor, points: Tensor, directions: Tensor) -> Tensor:
        """A bar at the origin, 30 mm thick."""
        return 1000.0 * ((points[..., :2].abs() < torch.tensor([0.015, 0.04])) & (points[..., 2:] < 0.06)).all(-1)


def observe(views: int) -> Observations:
    images = torch.zeros(views, 3, 2, 2)
    images[0, :, 0, 0] = torch.tensor([0.05, 0.1, 0.15])
    intrinsics = torch.eye(3).expand(views, 3, 3)
    return Observations(images, Camera(intrinsics, make_pose(torch.eye(3), torch.zeros(views, 3)), 2, 2))


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def method() -> Psi:
    return Psi(FakeValue(), candidates=40, keep=10, chunk=8)  # type: ignore[arg-type]


def test_propose_finds_what_the_images_show(method: Psi, workspace: Workspace) -> None:
    grasps = method.propose(observe(3), workspace, generator=seeded())
    assert len(grasps) == 1
    assert torch.allclose(grasps.T_world_grasp[0, :3, 3], torch.tensor([0.05, 0.1, 0.15]), atol=0.02)


def test_propose_gives_different_grasps_best_first(method: Psi, workspace: Workspace) -> None:
    grasps = method.propose(observe(3), workspace, generator=seeded(), count=3)
    assert len(grasps) == 3
    assert torch.equal(grasps.value, grasps.value.sort(descending=True).values)


def test_the_seed_decides(method: Psi, workspace: Workspace) -> None:
    first, again, other = (method.propose(observe(3), workspace, generator=seeded(seed)) for seed in (1, 1, 2))
    assert torch.equal(first.T_world_grasp, again.T_world_grasp)
    assert not torch.equal(first.T_world_grasp, other.T_world_grasp)


def test_images_are_seen_once_and_no_more_than_asked_for(workspace: Workspace) -> None:
    model = FakeValue()
    Psi(model, candidates=8, keep=8, chunk=8).propose(observe(5), workspace, generator=seeded())  # type: ignore[arg-type]
    Psi(model, candidates=8, images=1, chunk=8).propose(observe(5), workspace, generator=seeded())  # type: ignore[arg-type]
    assert model.seen == [3, 2]


def test_search_takes_its_own_numbers_and_shows_the_way(method: Psi, workspace: Workspace) -> None:
    grasps, trace = method.search(observe(3), workspace, generator=seeded(), candidates=20, keep=5)
    assert len(grasps) == 5
    assert trace.value.shape == (CLIMB.steps + 1, 5)


def test_all_candidates_climb_as_the_paper_has_it(method: Psi, workspace: Workspace) -> None:
    _, trace = method.search(observe(3), workspace, generator=seeded(), candidates=8, keep=8)
    assert trace.value.shape == (PAPER.steps + 1, 8)


def test_a_feasible_grasp_comes_before_one_of_more_value(method: Psi, workspace: Workspace) -> None:
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    beside, around = make_pose(down, torch.tensor([0.1, 0.0, 0.045])), make_pose(down, torch.tensor([0.0, 0.0, 0.045]))
    found = Grasps(torch.stack([beside, around]), torch.tensor([1.0, 0.0]))
    weighed = method._weighed(found, method.model.observe(observe(3), workspace), workspace)
    assert torch.equal(weighed.T_world_grasp[0], around)
    assert weighed.value[0] == pytest.approx(0.0, abs=0.05)
    alone = Psi(FakeValue(), feasibility=None)  # type: ignore[arg-type]
    assert alone._weighed(found, alone.model.observe(observe(3), workspace), workspace) is found


def test_a_search_trains_nothing(method: Psi, workspace: Workspace) -> None:
    method.propose(observe(3), workspace, generator=seeded())
    assert all(not parameter.requires_grad for parameter in method.model.parameters())
    assert float(method.model.scale) == 10.0


def test_an_unknown_pose_lists_near_misses(method: Psi, workspace: Workspace) -> None:
    with pytest.raises(UserError, match="quaternion"):
        method.search(observe(3), workspace, generator=seeded(), pose="quaternoin")


def test_a_model_without_a_value_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(psi, "load_model", lambda name: nn.Linear(1, 1))
    with pytest.raises(UserError, match="model some/folder: a Linear renders scenes but values no grasps"):
        Psi.from_pretrained("some/folder")
