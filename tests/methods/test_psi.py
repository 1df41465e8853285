from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera, make_pose
from nerfgrasp.methods import psi
from nerfgrasp.methods.psi import Psi
from nerfgrasp.models import GraspValueConfig
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search import ascent
from nerfgrasp.search.occupancy import Occupancy, occupancy
from nerfgrasp.search.schedule import CLIMB, PAPER
from nerfgrasp.search.strategies import GUIDED, RESAMPLE, Strategy, find_strategy

UNPOLISHED = replace(RESAMPLE, polish=())


class FakeValue(nn.Module):
    """Stands in for a trained value: the nearer to the point that the first pixel names, the higher."""

    views = 2

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(10.0))  # also says on which device it is
        self.seen: list[int] = []
        self.config = GraspValueConfig()

    def observe(self, observations: Observations, workspace: Workspace) -> Tensor:
        self.seen.append(len(observations))
        return observations.images[0, :, 0, 0]

    def value(self, features: Tensor, T_world_grasp: Tensor) -> Tensor:
        assert len(T_world_grasp) <= 8
        return -self.scale * (T_world_grasp[:, :3, 3] - features).norm(dim=-1)

    def density(self, features: Tensor, points: Tensor, directions: Tensor) -> Tensor:
        """A bar at the origin, 30 mm thick."""
        assert len(points) > 0
        return 1000.0 * ((points[..., :2].abs() < torch.tensor([0.015, 0.04])) & (points[..., 2:] < 0.06)).all(-1)


def observe(views: int) -> Observations:
    images = torch.zeros(views, 3, 2, 2)
    images[0, :, 0, 0] = torch.tensor([0.05, 0.1, 0.15])
    intrinsics = torch.eye(3).expand(views, 3, 3)
    return Observations(images, Camera(intrinsics, make_pose(torch.eye(3), torch.zeros(views, 3)), 2, 2))


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def finds(model: FakeValue, strategy: Strategy = RESAMPLE, images: int | None = None) -> Psi:
    return Psi(model, strategy=strategy, images=images, chunk=8)  # type: ignore[arg-type]


def changed(method: Psi, strategy: str | None = None, pose: str | None = None) -> Psi:
    """Returns the method with another strategy or parameterization, both by name."""
    found = method.strategy if strategy is None else find_strategy(strategy)
    return Psi(method.model, strategy=found, pose=pose or method.pose, images=method.asked_images, chunk=method.chunk)


@pytest.fixture
def method() -> Psi:
    return finds(FakeValue(), find_strategy(candidates=40, keep=10))


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
    model, few = FakeValue(), find_strategy(candidates=8, keep=2)
    finds(model, few).propose(observe(5), workspace, generator=seeded())
    finds(model, few, images=1).propose(observe(5), workspace, generator=seeded())
    finds(model, few, images=4).propose(observe(5), workspace, generator=seeded())
    finds(model, few).propose(observe(2), workspace, generator=seeded())
    assert model.seen == [3, 2, 4, 2]


def test_more_images_than_there_are_is_told(workspace: Workspace) -> None:
    method = finds(FakeValue(), images=4)
    for one in (method, changed(method, strategy="paper")):
        with pytest.raises(UserError, match="images is 4: the scene has 3"):
            one.observe(observe(3), workspace)
    with pytest.raises(UserError, match="images is 0: it must be at least 1"):
        finds(FakeValue(), images=0)


def test_an_observed_scene_is_searched_again_without_its_images(method: Psi, workspace: Workspace) -> None:
    scene = method.observe(observe(3), workspace)
    first, _ = method.search(scene, generator=seeded())
    again, _ = method.search(scene, generator=seeded())
    fresh, _ = method.search(observe(3), workspace, generator=seeded())
    assert torch.equal(first.T_world_grasp, again.T_world_grasp)
    assert torch.equal(first.T_world_grasp, fresh.T_world_grasp)
    assert method.model.seen == [3, 3]  # type: ignore[comparison-overlap]


def test_search_takes_another_strategy_and_shows_the_way(method: Psi, workspace: Workspace) -> None:
    strategy = find_strategy("resample", candidates=20, keep=5)
    grasps, trace = method.search(observe(3), workspace, generator=seeded(), strategy=strategy)
    assert len(grasps) == 5
    assert trace.value.shape == (CLIMB.steps + 1, 5)


def test_a_strategy_goes_by_its_name(method: Psi, workspace: Workspace) -> None:
    paper = changed(method, strategy="paper")
    assert paper.strategy == find_strategy("paper")
    assert paper.model is method.model
    few = find_strategy("paper", candidates=8)
    grasps, trace = paper.search(observe(3), workspace, generator=seeded(), strategy=few)
    assert trace.value.shape == (PAPER.steps + 1, 8)
    assert torch.equal(grasps.value, trace.value[-1].sort(descending=True).values)  # Ψ alone judges
    with pytest.raises(UserError, match="unknown strategy 'joit': did you mean 'joint'"):
        changed(method, strategy="joit")


def test_a_pose_goes_by_its_name(method: Psi, workspace: Workspace) -> None:
    screw = changed(method, strategy="paper", pose="screw")
    assert (screw.strategy, screw.pose, method.pose) == (find_strategy("paper"), "screw", "quaternion")
    few = find_strategy("paper", candidates=4)
    own, asked, other = (
        one.search(observe(3), workspace, generator=seeded(), strategy=few, pose=pose)[1].value
        for one, pose in ((screw, None), (method, "screw"), (method, None))
    )
    assert torch.equal(own, asked)
    assert not torch.equal(own, other)
    with pytest.raises(UserError, match="unknown pose 'scerw': did you mean 'screw'"):
        changed(method, pose="scerw").search(observe(3), workspace, generator=seeded())


def test_a_camera_that_sees_nothing_of_the_workspace_is_told(method: Psi) -> None:
    behind = Workspace(torch.tensor([-0.2, -0.2, -0.9]), torch.tensor([0.2, 0.2, -0.5]))
    with pytest.raises(UserError, match=r"camera 0 sees nothing of the workspace from \(-0.2, -0.2, -0.9\)"):
        method.propose(observe(3), behind, generator=seeded())


def test_a_feasible_grasp_comes_before_one_of_more_value(method: Psi, workspace: Workspace) -> None:
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    beside, around = make_pose(down, torch.tensor([0.1, 0.0, 0.045])), make_pose(down, torch.tensor([0.0, 0.0, 0.045]))
    found = Grasps(torch.stack([beside, around]), torch.tensor([1.0, 0.0]))
    scene = method.observe(observe(3), workspace)
    weighed = method._weighed(found, scene, UNPOLISHED, seeded())
    assert torch.equal(weighed.T_world_grasp[0], around)
    assert weighed.value[0] == pytest.approx(0.0, abs=0.05)
    assert method._weighed(found, scene, replace(UNPOLISHED, feasibility=None), seeded()) is found


def test_of_grasps_that_are_nearly_the_same_the_best_is_weighed(method: Psi, workspace: Workspace) -> None:
    position = torch.tensor([[0.0, 0.0, 0.045], [0.0, 0.004, 0.045], [0.0, 0.03, 0.045], [0.0, 0.035, 0.045]])
    found = Grasps(make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), position), torch.tensor([4.0, 3.0, 2.0, 1.0]))
    scene = method.observe(observe(3), workspace)
    weighed = method._weighed(found, scene, replace(UNPOLISHED, weighed=4), seeded())
    assert weighed.T_world_grasp[:, 1, 3].tolist() == pytest.approx([0.0, 0.03])
    assert len(method._weighed(found, scene, replace(UNPOLISHED, weighed=1), seeded())) == 1


def test_polishing_makes_room_for_the_fingers(method: Psi, workspace: Workspace) -> None:
    # A finger stands on the bar; free of it is a few millimetres aside, where the value is a little lower.
    pose = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([[0.03, 0.0, 0.045]]))
    scene = method.observe(observe(3), workspace)
    found = method.weigh(Grasps(pose, method.model.value(scene.features, pose)), scene, RESAMPLE.feasibility)
    polished = method.polish(found, scene, RESAMPLE, seeded())
    assert found.value[0] < -15
    assert polished.value[0] > found.value[0] + 10
    T = polished.T_world_grasp
    again = method.weigh(Grasps(T, method.model.value(scene.features, T)), scene, RESAMPLE.feasibility)
    assert polished.value[0] == pytest.approx(float(again.value[0]), abs=1e-4)
    assert method.polish(found, scene, replace(RESAMPLE, feasibility=None), seeded()) is found
    assert torch.equal(method.polish(found, scene, UNPOLISHED, seeded()).value, found.value)


def test_polishing_leaves_the_best_pose_where_it_is(method: Psi, workspace: Workspace) -> None:
    scene = method.observe(observe(3), workspace)
    peak = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), scene.features[None])  # type: ignore[index]
    found = Grasps(peak, torch.zeros(1))
    polished = method.polish(found, scene, RESAMPLE, seeded())
    assert torch.equal(polished.T_world_grasp, peak)
    assert torch.equal(polished.value, found.value)


def test_a_guided_search_starts_where_something_is(
    method: Psi, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts: list[Tensor] = []
    finite_first = ascent.finite_first

    def remember(T: Tensor, value: Tensor) -> Grasps:
        starts.append(T)
        return finite_first(T, value)

    monkeypatch.setattr(ascent, "finite_first", remember)
    _, trace = method.search(observe(3), workspace, generator=seeded(), strategy=find_strategy(candidates=40, keep=10))
    assert (starts[0][:, :2, 3].abs() < torch.tensor([0.023, 0.048])).all()  # the bar, and half a cell
    assert len(trace.value) == GUIDED.climb.steps + 1


def test_the_default_search_comes_near_a_peak_on_what_is_seen(workspace: Workspace) -> None:
    assert GUIDED.climbers is not None
    assert GUIDED.keep is not None
    assert GUIDED.keep > GUIDED.climbers
    method = finds(FakeValue(), replace(GUIDED, climbers=16))  # of a smooth value's peaks there are not 32 to be had
    observations = observe(3)
    observations.images[0, :, 0, 0] = torch.tensor([0.0, 0.03, 0.05])  # on the bar
    grasps, trace = method.search(observations, workspace, generator=seeded())
    assert trace.value.shape == (GUIDED.climb.steps + 1, 16)
    best = grasps.T_world_grasp[0]
    assert float((best[:3, 3] - torch.tensor([0.0, 0.03, 0.05])).norm()) < 0.025  # polishing gives value for room
    assert float(grasps.value[0]) > -1  # across the bar, its way free
    assert 1 <= len(grasps) <= (GUIDED.weighed or 0)


def test_where_something_is_is_asked_once_a_scene(
    method: Psi, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def counted(model: object, features: object, box: object, spacing: float) -> Occupancy:
        asked.append(spacing)
        return occupancy(model, features, box, spacing)  # type: ignore[arg-type]

    monkeypatch.setattr(psi, "occupancy", counted)
    guided = replace(GUIDED, candidates=12, keep=3)
    scene = method.observe(observe(3), workspace)
    first, again = (method.search(scene, generator=seeded(), strategy=guided)[0] for _ in range(2))
    method.search(scene, generator=seeded(), strategy=replace(guided, spacing=0.03))
    fresh, _ = method.search(observe(3), workspace, generator=seeded(), strategy=guided)
    assert asked == [0.015, 0.03, 0.015]
    assert torch.equal(first.T_world_grasp, again.T_world_grasp)
    assert torch.equal(first.T_world_grasp, fresh.T_world_grasp)


@pytest.mark.parametrize("name", ["guided", "resample"])
def test_a_density_that_is_no_number_everywhere_is_told(name: str, method: Psi, workspace: Workspace) -> None:
    model: Any = method.model
    model.density = lambda features, points, directions: torch.full_like(points[..., 0], torch.nan)
    few = find_strategy(name, candidates=12, keep=3)
    with pytest.raises(UserError, match="no candidate has a finite value: the model's weights may be damaged"):
        method.search(observe(3), workspace, generator=seeded(), strategy=few)


def test_the_density_of_a_model_that_does_not_render_is_not_asked(workspace: Workspace) -> None:
    model = FakeValue()
    model.config = GraspValueConfig(renders=False)
    model.density = None  # type: ignore[assignment, method-assign]
    method = finds(model, find_strategy(candidates=40, keep=10))
    grasps, trace = method.search(observe(3), workspace, generator=seeded())
    assert torch.allclose(grasps.T_world_grasp[0, :3, 3], torch.tensor([0.05, 0.1, 0.15]), atol=0.02)
    # What was given, in the search that takes the guided one's place; of the ten only different ones climb.
    assert len(trace.value) == CLIMB.steps + 1
    assert 1 < trace.value.shape[1] <= 10
    assert method.strategy == find_strategy("alone", candidates=40, keep=10)
    assert method.resolve(GUIDED) == changed(method, strategy="guided").strategy == find_strategy("alone")


def test_a_model_that_sees_one_view_is_believed_less_of_density() -> None:
    model = FakeValue()
    model.views = 1
    method = finds(model, GUIDED)
    assert method.strategy == GUIDED.one_view()
    assert method.resolve(method.strategy) == changed(method, strategy="guided").strategy == method.strategy
    assert finds(FakeValue(), GUIDED).strategy == GUIDED


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


@pytest.mark.parametrize(
    ("device", "message"),
    [("cdua", "unknown device 'cdua': did you mean 'cuda'"), ("cuda:99", "is not there"), ("cpu:x", "unknown device")],
)
def test_a_device_that_is_not_there_is_told(device: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        Psi.from_pretrained(device=device)
