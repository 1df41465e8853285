from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import roma
import torch
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera, invert, make_pose, transform
from nerfgrasp.grippers import FRANKA, Probes
from nerfgrasp.models import EncoderConfig, GraspValue, GraspValueConfig, MVNeRFConfig
from nerfgrasp.models.folder import load_model, save_model
from nerfgrasp.scenes.scene import Observations, Workspace


@pytest.fixture
def observations(cameras: Callable[..., Camera]) -> Observations:
    torch.manual_seed(1)
    return Observations(torch.rand(4, 3, 32, 32), cameras(4))


@pytest.fixture
def model(tiny_network: Callable[..., Any]) -> GraspValue:
    torch.manual_seed(0)
    return GraspValue(GraspValueConfig(tiny_network())).eval()


def poses(count: int) -> Tensor:
    torch.manual_seed(2)
    position = torch.rand(count, 3) * torch.tensor([0.3, 0.3, 0.15]) - torch.tensor([0.15, 0.15, 0.0])
    return make_pose(roma.random_rotmat(count), position)


# Position of each base in millimetres, and its z axis, in the frame of the tool centre point.
BASES = [
    ((0, 15, 0), (0, 0, 1)),
    ((0, -15, 0), (0, 0, 1)),
    ((20, 15, 12.5), (-1, 0, 0)),
    ((20, -15, 12.5), (-1, 0, 0)),
    ((-20, 15, 12.5), (1, 0, 0)),
    ((-20, -15, 12.5), (1, 0, 0)),
]


def test_the_probes_are_the_42_of_the_method(model: GraspValue) -> None:
    points, directions = model._probes(torch.eye(4)[None, None])
    assert points.shape == (1, 1, 6, 7, 3)
    for base, (position, axis) in enumerate(BASES):
        torch.testing.assert_close(directions[0, 0, base], torch.tensor(axis).float(), atol=1e-6, rtol=0)
        for step, distance in enumerate((-15, -10, -5, 0, 5, 10, 15)):
            expected = [0.001 * (p + distance * a) for p, a in zip(position, axis, strict=True)]
            torch.testing.assert_close(points[0, 0, base, step], torch.tensor(expected), atol=1e-7, rtol=0)


def test_bases_are_turned_about_y_alone() -> None:
    rays = Probes().rays()
    assert rays.shape == (6, 4, 4)
    torch.testing.assert_close(rays[:, :3, 1], torch.tensor([0.0, 1.0, 0.0]).expand(6, 3))
    torch.testing.assert_close(torch.det(rays[:, :3, :3]), torch.ones(6))
    assert torch.equal(rays[:2, :3, :3], torch.eye(3).expand(2, 3, 3))
    assert len(Probes().steps()) == 7


def test_mixed_precision_leaves_the_probes_alone(model: GraspValue) -> None:
    T = make_pose(roma.random_rotmat(5), torch.rand(5, 3))[None]
    with torch.autocast("cpu", torch.bfloat16):
        mixed = model._probes(T)
    assert all(torch.equal(*pair) for pair in zip(mixed, model._probes(T), strict=True))


def test_probes_move_with_the_grasp(model: GraspValue) -> None:
    T = poses(1)
    at_home, ahead = model._probes(torch.eye(4)[None, None])
    points, directions = model._probes(T[None])
    torch.testing.assert_close(points[0, 0].flatten(0, 1), transform(T[0], at_home[0, 0].flatten(0, 1)))
    torch.testing.assert_close(directions[0, 0], ahead[0, 0] @ T[0, :3, :3].T)


def test_a_half_turn_asks_at_the_same_places(model: GraspValue) -> None:
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))

    def asked(T: Tensor) -> set[tuple[float, ...]]:
        points, directions = model._probes(T[None, None])
        both = torch.cat([points, directions[..., None, :].expand_as(points)], dim=-1).view(42, 6)
        return {tuple(round(1e4 * value) for value in row) for row in both.tolist()}

    assert asked(half_turn) == asked(torch.eye(4))
    assert len(asked(torch.eye(4))) == 42


def test_the_paper_s_readout() -> None:
    with torch.device("meta"):
        model = GraspValue(GraspValueConfig(MVNeRFConfig(encoder=EncoderConfig(pretrained=False))))
    assert [layer.weight.shape for layer in model.reduce] == [(64, 128)] * 4
    assert model.fuse.weight.shape == (64, 256)
    first, second = model.blocks
    assert (first.first.weight.shape, first.second.weight.shape) == ((128, 42 * 64), (64, 128))
    assert (second.first.weight.shape, second.second.weight.shape) == ((64, 64), (64, 64))
    assert model.readout.weight.shape == (1, 64)


def test_a_grasp_s_value_does_not_depend_on_its_company(model: GraspValue, observations: Observations) -> None:
    features = model.observe(observations, Workspace())
    T = poses(5)
    together = model.value(features, T)
    assert together.shape == (5,)
    assert together.std() > 0
    alone = torch.cat([model.value(features, pose[None]) for pose in T])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-5)


def test_moving_scene_and_grasp_together_changes_nothing(model: GraspValue, observations: Observations) -> None:
    T = make_pose(roma.rotvec_to_rotmat(torch.tensor([0.3, 0.9, -0.4])), torch.tensor([1.0, -0.5, 0.2]))
    camera = observations.camera
    moved = Observations(observations.images, Camera(camera.intrinsics, T @ camera.T_world_camera, 32, 32))
    here = model.value(model.observe(observations, Workspace()), poses(4))
    there = model.value(model.observe(moved, Workspace()), T @ poses(4))
    torch.testing.assert_close(here, there, atol=1e-3, rtol=1e-3)


def test_the_value_sees_position_and_orientation(model: GraspValue, observations: Observations) -> None:
    features = model.observe(observations, Workspace())
    T = poses(1)
    turn = make_pose(roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, 0.4])), torch.tensor([0.0, 0.0, 0.01]))
    assert (model.value(features, T @ turn) - model.value(features, T)).abs() > 1e-6


def test_gradients_in_the_pose_are_right(model: GraspValue, observations: Observations) -> None:
    model = model.double()
    camera = observations.camera
    double = Camera(camera.intrinsics.double(), camera.T_world_camera.double(), 32, 32)
    features = model.observe(Observations(observations.images.double(), double), Workspace())
    start = poses(2).double()

    def value(move: Tensor, turn: Tensor) -> Tensor:
        return model.value(features, start @ make_pose(roma.rotvec_to_rotmat(turn), move))

    parameters = [torch.full((2, 3), 0.01, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    assert torch.autograd.gradcheck(value, parameters, eps=1e-8, atol=1e-5, rtol=1e-3)


def test_one_view_at_a_time_is_the_mean_of_single_values(tiny_network, observations: Observations) -> None:
    torch.manual_seed(0)
    model = GraspValue(GraspValueConfig(tiny_network(views=1))).eval()
    T = poses(3)
    together = model.value(model.observe(observations.select(slice(3)), Workspace()), T)
    single = [model.value(model.observe(observations.select(slice(v, v + 1)), Workspace()), T) for v in range(3)]
    torch.testing.assert_close(together, torch.stack(single).mean(dim=0), atol=1e-5, rtol=1e-5)
    assert (single[0] - single[1]).abs().max() > 1e-5


def test_the_density_of_views_seen_one_at_a_time_is_the_mean(tiny_network, observations: Observations) -> None:
    torch.manual_seed(0)
    model = GraspValue(GraspValueConfig(tiny_network(views=1))).eval()
    points, directions = torch.rand(5, 4, 3) * 0.1, torch.tensor([[0.0, 0.0, -1.0]]).expand(5, 3)
    single = [
        model.density(model.observe(observations.select(slice(i, i + 1)), Workspace()), points, directions)
        for i in range(4)
    ]
    together = model.density(model.observe(observations, Workspace()), points, directions)
    torch.testing.assert_close(together, torch.stack(single).mean(dim=0))
    assert not torch.allclose(together, single[0])


def test_views_beyond_the_last_group_are_not_used(model: GraspValue, observations: Observations) -> None:
    assert model.views == 3
    four, three = (model.value(model.observe(observations.select(slice(n)), Workspace()), poses(3)) for n in (4, 3))
    torch.testing.assert_close(four, three)


def test_fewer_views_than_needed_are_refused(model: GraspValue, observations: Observations) -> None:
    with pytest.raises(UserError, match="^the model needs 3 views, the scene has 2$"):
        model.observe(observations.select(slice(2)), Workspace())


def test_observing_keeps_no_graph_and_the_head_is_all_but_the_backbone(model: GraspValue, observations) -> None:
    assert not model.observe(observations, Workspace()).fine.features.requires_grad
    head, backbone = model.head_parameters(), list(model.backbone.parameters())
    assert len(head) + len(backbone) == len(list(model.parameters()))
    assert not {id(p) for p in head} & {id(p) for p in backbone}


def test_probe_frames_are_not_saved(model: GraspValue) -> None:
    assert not {"rays", "steps"} & set(model.state_dict())
    torch.testing.assert_close(invert(model.rays) @ model.rays, torch.eye(4).expand(6, 4, 4), atol=1e-6, rtol=0)


@pytest.fixture
def symmetric(tiny_network: Callable[..., Any]) -> GraspValue:
    torch.manual_seed(0)
    return GraspValue(GraspValueConfig(tiny_network(), symmetric=True)).eval()


def test_mirrored_rays_are_the_rays_in_another_order() -> None:
    identity, across, along, both = Probes().mirror_orders()
    assert identity.tolist() == [0, 1, 2, 3, 4, 5]
    assert across.tolist() == [0, 1, 4, 5, 2, 3]
    assert along.tolist() == [1, 0, 3, 2, 5, 4]
    assert torch.equal(both, across[along])


def test_symmetric_value_of_a_half_turned_grasp_is_the_same(
    model: GraspValue, symmetric: GraspValue, observations: Observations
) -> None:
    grasps = poses(5)
    turned = grasps @ torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    for network, same in ((symmetric, True), (model, False)):
        features = network.observe(observations, Workspace())
        with torch.no_grad():
            before, after = (network.value(features, T) for T in (grasps, turned))
        assert torch.allclose(before, after, atol=1e-5) == same


def test_symmetric_value_is_the_mean_over_the_orders(symmetric: GraspValue, observations: Observations) -> None:
    features = symmetric.observe(observations, Workspace())
    with torch.no_grad():
        value = symmetric.value(features, poses(5))
        orders, single = symmetric.orders, []
        for order in orders:
            symmetric.orders = order[None]
            single.append(symmetric.value(features, poses(5)))
    torch.testing.assert_close(torch.stack(single).mean(0), value, atol=1e-5, rtol=1e-5)
    assert torch.stack(single).std(0).max() > 1e-4


def test_a_models_probes_are_its_grippers(tiny_network: Callable[..., Any]) -> None:
    franka = GraspValue(GraspValueConfig(tiny_network(), gripper="franka"))
    assert torch.equal(franka.rays, FRANKA.probes.rays())
    assert torch.equal(franka.steps, FRANKA.probes.steps())
    given = GraspValue(GraspValueConfig(tiny_network(), gripper="franka", probes=Probes(closing=0.03)))
    assert torch.equal(given.rays, Probes(closing=0.03).rays())


def test_an_unknown_gripper_is_refused(tiny_network: Callable[..., Any]) -> None:
    with pytest.raises(UserError, match=r"unknown gripper 'frank': did you mean 'franka'\?"):
        GraspValue(GraspValueConfig(tiny_network(), gripper="frank"))


def test_a_model_for_a_hand_in_a_file_keeps_its_probes(tiny_network: Callable[..., Any], tmp_path: Path) -> None:
    path = tmp_path / "hand.yaml"
    path.write_text(
        "{name: mine, stroke: 0.1, finger_length: 0.06, finger_thickness: 0.01, pad_width: 0.02, pad_height: 0.03, "
        "body: [0.1, 0.1, 0.1]}"
    )
    model = GraspValue(GraspValueConfig(tiny_network(), gripper=str(path)))
    path.unlink()
    assert model.config.gripper == "mine"
    save_model(tmp_path / "model", model)
    loaded = load_model(tmp_path / "model")
    assert loaded.config == model.config
    assert torch.equal(loaded.rays, model.rays)
