"""The methods that know the truth, or nothing: what they propose, and that it lifts."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("pybullet")

from nerfgrasp_baselines import trying
from nerfgrasp_baselines.antipodal import Antipodal
from nerfgrasp_baselines.oracle import Oracle
from nerfgrasp_baselines.random import Random
from nerfgrasp_baselines.surfaces import centres_of_mass, has_room, sample_surface
from nerfgrasp_baselines.trying import TriedInPhysics

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import ROBOTIQ_2F85, Gripper
from nerfgrasp.scenes.oracle import grasp_errors, valid_grasps
from nerfgrasp.scenes.prisms import Polygon, Prism
from nerfgrasp.scenes.scene import Grasps, Observations, Truth, Workspace
from nerfgrasp.sim import shapes
from nerfgrasp.sim.attempt import Attempt, Outcome, attempt_grasp
from nerfgrasp.sim.catalogue import open_catalogue

DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()


def prism(*parts: Polygon, kind: str = "box", height: float = 0.08, at: tuple[float, float] = (0.05, -0.02)) -> Prism:
    return Prism(kind, parts, height, (1.0, 0.0, 0.0), 400.0, make_pose(torch.eye(3), torch.tensor([*at, 0.0])))


BOX = prism(*shapes.box(0.04, 0.1))
WIDE = prism(*shapes.box(0.12, 0.13))


@pytest.fixture
def observe(cameras: Callable[..., Any]) -> Callable[..., Observations]:
    """Returns a function of objects: pictures of nothing, and the truth."""

    def make(*objects: Any) -> Observations:
        truth = Truth("simple", 0, 0, objects) if objects else None
        return Observations(torch.zeros(3, 3, 32, 32), cameras(3), truth=truth)

    return make


def propose(method: Any, observations: Observations, seed: int = 0, count: int = 1) -> Grasps:
    return method.propose(observations, Workspace(), generator=torch.Generator().manual_seed(seed), count=count)


def corner(x: float, y: float, thick: float) -> tuple[Polygon, ...]:
    """An L of two rectangles that share a face."""
    return ((0.0, 0.0), (x, 0.0), (x, thick), (0.0, thick)), ((0.0, thick), (thick, thick), (thick, y), (0.0, y))


def test_random_poses_are_in_the_workspace_and_of_the_generator(observe: Callable[..., Observations]) -> None:
    grasps = propose(Random(), observe(), count=50)
    position, box = grasps.T_world_grasp[:, :3, 3], Workspace()
    assert ((position >= box.minimum) & (position <= box.maximum)).all()
    assert torch.equal(grasps.T_world_grasp, propose(Random(), observe(), count=50).T_world_grasp)
    assert not torch.equal(grasps.T_world_grasp, propose(Random(), observe(), seed=1, count=50).T_world_grasp)


@pytest.mark.parametrize("method", [Oracle, Antipodal])
def test_what_is_proposed_first_lifts(method: Any, observe: Callable[..., Observations]) -> None:
    observations = observe(BOX)
    grasps = propose(method.from_pretrained(), observations, count=3)
    assert grasps.value.tolist() == sorted(grasps.value.tolist(), reverse=True)
    assert grasps.value[0] == 1
    assert len(grasps) == 3
    assert observations.truth is not None
    assert attempt_grasp(observations.truth, grasps.T_world_grasp[0]).outcome == Outcome.SUCCESS
    assert torch.equal(grasps.T_world_grasp, propose(method(), observations, count=3).T_world_grasp)


@pytest.mark.parametrize("method", [Oracle, Antipodal])
def test_what_is_too_wide_gets_no_grasp(method: Any, observe: Callable[..., Observations]) -> None:
    assert len(propose(method(), observe(WIDE))) == 0


@pytest.mark.parametrize("method", [Oracle, Antipodal])
def test_without_the_truth_one_line_says_so(method: Any, observe: Callable[..., Observations]) -> None:
    with pytest.raises(UserError, match=r"method '(oracle|antipodal)' needs the truth of a simulated scene"):
        propose(method(), observe())


def test_the_oracle_proposes_valid_grasps(observe: Callable[..., Observations]) -> None:
    grasps = propose(Oracle(), observe(BOX, prism(*shapes.box(0.05, 0.05), at=(-0.1, 0.1))), count=20)
    observations = observe(BOX, prism(*shapes.box(0.05, 0.05), at=(-0.1, 0.1)))
    assert observations.truth is not None
    distance, angle = grasp_errors(grasps.T_world_grasp, valid_grasps(observations.truth.objects))
    assert distance.max() < 1e-5
    assert angle.max() < 1e-3


def test_antipodal_closes_across_the_narrow_side(observe: Callable[..., Observations]) -> None:
    T = propose(Antipodal(), observe(BOX)).T_world_grasp[0]
    assert abs(T[0, 0]) > 0.9, "the box is 40 mm wide along x and 100 mm along y"
    assert abs(T[0, 3] - 0.05) < 0.002, "midway between the faces"


def test_antipodal_grasps_a_mesh(
    tmp_path: Path, make_box: Callable[..., Path], object_cache: Path, observe: Callable[..., Observations]
) -> None:
    make_box(tmp_path / "things", size=(0.05, 0.08, 0.06))
    (model,) = open_catalogue(tmp_path / "things").models
    thing = model.place(make_pose(torch.eye(3), torch.tensor([0.0, 0.05, 0.03])))
    grasps = propose(Antipodal(), observe(thing))
    assert grasps.value.tolist() == [1.0]
    assert abs(grasps.T_world_grasp[0, 0, 0]) > 0.9


def test_points_lie_on_the_surface_and_not_within() -> None:
    thing = prism(*corner(0.08, 0.06, 0.03), kind="l")
    surface = sample_surface((thing, BOX), torch.Generator().manual_seed(0))
    mine = surface.object == 0
    local = surface.points[mine] - thing.T_world_object[:3, 3].double()
    x, y, z = local.unbind(-1)
    sides = [x, y, z, x - 0.08, y - 0.06, z - 0.08, x - 0.03, y - 0.03]
    assert torch.stack([side.abs() for side in sides]).amin(dim=0).max() < 1e-6
    shared = ((y - 0.03).abs() < 1e-6) & (x < 0.0299)
    assert not shared.any(), "the face between the two parts is within"
    assert torch.allclose(surface.normals.norm(dim=-1), torch.ones(1, dtype=torch.float64))
    assert len(surface.points[~mine]) > 700


def test_centres_of_mass() -> None:
    assert torch.allclose(centres_of_mass((BOX,)), torch.tensor([[0.05, -0.02, 0.04]], dtype=torch.float64), atol=1e-7)


def test_room_for_the_open_gripper() -> None:
    near = replace(BOX, T_world_object=make_pose(torch.eye(3), torch.tensor([0.11, -0.02, 0.0])))
    above = torch.tensor([0.05, -0.02, 0.065]).double()
    grasp, beside = make_pose(DOWN, above), make_pose(DOWN, above + torch.tensor([0.025, 0.0, 0.0]))
    both = torch.stack([grasp, beside])
    generator = torch.Generator().manual_seed(0)
    assert has_room(both, sample_surface((BOX,), generator), ROBOTIQ_2F85).tolist() == [True, False]
    # A finger is 8 mm thick beyond 42.5 mm; the neighbour begins at 40 mm.
    assert has_room(both, sample_surface((BOX, near), generator), ROBOTIQ_2F85).tolist() == [False, False]


def test_grasps_are_tried_best_first_until_one_lifts(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def attempt(truth: Truth, T: torch.Tensor, *, gripper: Gripper) -> Attempt:
        assert gripper == ROBOTIQ_2F85
        tried.append(round(T[0, 3].item(), 2))
        return Attempt(Outcome.SUCCESS if tried[-1] == 0.2 else Outcome.SLIPPED)

    monkeypatch.setattr(trying, "attempt_grasp", attempt)
    T = make_pose(DOWN.expand(4, 3, 3), torch.tensor([[0.1, 0, 0.1], [0.2, 0, 0.1], [0.3, 0, 0.1], [0.4, 0, 0.1]]))
    truth, score = Truth("simple", 0, 0, (BOX,)), torch.tensor([1.0, 3.0, 4.0, 2.0])
    grasps = TriedInPhysics(tries=3).first_success(truth, T, score, count=4)
    assert tried == [0.3, 0.2]
    assert grasps.T_world_grasp[:, 0, 3].tolist() == pytest.approx([0.2, 0.4, 0.1, 0.3])
    assert grasps.value.tolist() == [1.0, 0.0, 0.0, -1.0]
    tried.clear()
    [best] = TriedInPhysics(tries=2).first_success(truth, T, -score, count=1).T_world_grasp
    assert best[0, 3].item() == pytest.approx(0.2)
    assert tried == [0.1, 0.4], "then one that was not tried is the best bet"


@pytest.mark.parametrize("method", [Oracle, Antipodal])
def test_a_method_grasps_with_the_hand_that_it_is_given(method: Any, observe: Callable[..., Observations]) -> None:
    wide = prism(*shapes.box(0.1, 0.12))  # too wide for all but the 2F-140
    assert len(propose(method.from_pretrained(gripper="franka"), observe(wide))) == 0
    found = propose(method.from_pretrained(gripper="robotiq_2f140", tries=5), observe(wide))
    assert found.value[0] == 1.0
    with pytest.raises(UserError, match="unknown gripper 'hand'"):
        method.from_pretrained(gripper="hand")
