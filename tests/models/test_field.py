import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import roma
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from nerfgrasp.geometry import Camera, invert, make_pose, project, transform
from nerfgrasp.models import Field, FieldConfig
from nerfgrasp.models import field as module
from nerfgrasp.models.field import ViewMaps, encode, sample_maps

SMALL = FieldConfig(width=16, view_blocks=2, fused_blocks=3, position_frequencies=5, direction_frequencies=3)


@pytest.fixture
def scene(cameras: Callable[..., Camera]) -> tuple[Tensor, Tensor, Camera]:
    """Features `[2, 3, 8, 16, 16]`, images `[2, 3, 3, 32, 32]` and cameras `[2, 3]`."""
    torch.manual_seed(0)
    flat = cameras(6)
    camera = Camera(flat.intrinsics.unflatten(0, (2, 3)), flat.T_world_camera.unflatten(0, (2, 3)), 32, 32)
    return torch.randn(2, 3, 8, 16, 16), torch.rand(2, 3, 3, 32, 32), camera


@pytest.fixture
def queries() -> tuple[Tensor, Tensor]:
    """Points `[2, 5, 4, 3]` in the workspace and unit directions `[2, 5, 3]`."""
    torch.manual_seed(1)
    points = torch.rand(2, 5, 4, 3) * torch.tensor([0.4, 0.4, 0.2]) - torch.tensor([0.2, 0.2, 0.0])
    return points, torch.nn.functional.normalize(torch.randn(2, 5, 3), dim=-1)


def maps(field: Field, scene: tuple[Tensor, Tensor, Camera]) -> ViewMaps:
    features, images, camera = scene
    projected = field.project_features(features.flatten(0, 1)).unflatten(0, features.shape[:2])
    return ViewMaps(projected, images, camera, torch.zeros(len(images)))


def test_encoding_by_hand() -> None:
    encoded = encode(torch.tensor([0.25, 0.5, -1.0]), 2)
    r = math.sqrt(0.5)
    expected = torch.tensor([r, 1.0, 0.0, 1.0, 0.0, 0.0, r, 0.0, -1.0, 0.0, -1.0, 1.0])
    torch.testing.assert_close(encoded, expected, atol=1e-6, rtol=0)


def test_the_first_layer_is_one_linear_layer_over_the_concatenation(scene, queries) -> None:
    # In double precision: the highest frequency multiplies the rounding of a direction by 1600.
    field = Field(FieldConfig(width=16, view_blocks=0, fused_blocks=0, position_frequencies=5), 8).double()
    features, images, camera = scene
    features, images = features.double(), images.double()
    camera = Camera(camera.intrinsics.double(), camera.T_world_camera.double(), camera.width, camera.height)
    points, directions = (part.double() for part in queries)
    found, _ = field._view_activations(maps(field, (features, images, camera)), points, directions)

    weight = torch.cat(
        [
            field.point_layer.weight[:, :30],
            field.direction_layer.weight,
            field.point_layer.weight[:, 30:],
            field.feature_layer.weight[:, :, 0, 0],
        ],
        dim=1,
    )
    for b in range(2):
        for v in range(3):
            view = camera[b, v]
            flat = points[b].flatten(0, 1)
            pixels, _ = project(view, flat)
            grid = (pixels / 16 - 1)[None, None]
            sampled = [
                grid_sample(m[b, v][None], grid, padding_mode="border", align_corners=False)[0, :, 0].T
                for m in (images, features)
            ]
            T_camera_world = invert(view.T_world_camera)
            turned = (directions[b] @ T_camera_world[:3, :3].T)[:, None].expand(-1, 4, -1).flatten(0, 1)
            row = [encode(transform(T_camera_world, flat), 5), encode(turned, 10), *sampled]
            plain = torch.cat(row, dim=-1) @ weight.T + field.point_layer.bias
            torch.testing.assert_close(found[b, v].flatten(0, 1), plain, atol=1e-9, rtol=1e-9)


def test_the_paper_s_first_layer_has_379_inputs() -> None:
    with torch.device("meta"):
        field = Field(FieldConfig(), 256)
    parts = (field.point_layer, field.direction_layer, field.feature_layer)
    assert sum(part.weight.shape[1] for part in parts) == 60 + 60 + 3 + 256
    assert len(field.view_trunk) == len(field.fused_trunk) == 3
    assert field.readout.weight.shape == (4, 128)


def test_scene_activations(scene, queries) -> None:
    field = Field(SMALL, 8)
    found = field.activations(maps(field, scene), *queries)
    assert field.activation_count == len(found) == 4
    assert all(activation.shape == (2, 5, 4, 16) for activation in found)
    pooled = field._view_activations(maps(field, scene), *queries)[0].mean(dim=1)
    torch.testing.assert_close(found[0], pooled)
    for before, block, after in zip(found, field.fused_trunk, found[1:], strict=False):
        torch.testing.assert_close(block(before), after)


@pytest.mark.parametrize("variance", [False, True])
def test_the_order_of_views_does_not_matter(scene, queries, variance: bool) -> None:
    field = Field(FieldConfig(width=16, pool_variance=variance), 8)
    features, images, camera = scene
    order = torch.tensor([2, 0, 1])
    turned = (features[:, order], images[:, order], camera[:, order])
    for one, other in zip(field(maps(field, scene), *queries), field(maps(field, turned), *queries), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


def test_a_known_table_moves_with_the_scene(scene, queries) -> None:
    torch.manual_seed(2)
    field = Field(FieldConfig(width=16, height_frequencies=4), 8)
    features, images, camera = scene
    points, directions = queries
    there = field(maps(field, scene), points, directions)
    shift = torch.tensor([0.7, -0.4, 0.3])
    T_world_camera = camera.T_world_camera.clone()
    T_world_camera[..., :3, 3] += shift
    moved = maps(field, (features, images, replace(camera, T_world_camera=T_world_camera)))
    raised = replace(moved, table=torch.full((2,), 0.3))
    for one, other in zip(there, field(raised, points + shift, directions), strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    below = field(replace(moved, table=torch.full((2,), 0.1)), points + shift, directions)
    assert (below[1] - there[1]).abs().max() > 1e-3


def test_variance_is_pooled_by_its_formula() -> None:
    field = Field(FieldConfig(width=2, pool_variance=True), 8)
    torch.nn.init.zeros_(field.pool_layer.bias)
    field.pool_layer.weight.data = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    views = torch.tensor([[1.0, 2.0], [3.0, 8.0]])[None, :, None, None]
    torch.testing.assert_close(field._pool(views)[0, 0, 0], torch.tensor([2.0, 9.0]))


@pytest.mark.parametrize("device", ["cpu", "another"])
def test_maps_are_sampled_as_grid_sample_does(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if device == "another":
        monkeypatch.setattr(module, "_weighted_rows", module._gathered_rows)
    torch.manual_seed(0)
    for height, width in ((2, 2), (7, 12)):
        maps, grid = torch.randn(3, height, width, 5), 3.0 * torch.rand(3, 200, 2) - 1.5
        grid[0, :4] = torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0], [1.0, -2.0]])
        pairs = [(maps.clone().requires_grad_(), grid.clone().requires_grad_()) for _ in range(2)]
        found = sample_maps(*pairs[0])
        moved = pairs[1][0].movedim(-1, 1)
        expected = grid_sample(moved, pairs[1][1][:, None], padding_mode="border", align_corners=False)[:, :, 0].mT
        torch.testing.assert_close(found, expected)
        weights = torch.randn_like(found)
        for sampled in (found, expected):
            (sampled * weights).sum().backward()
        torch.testing.assert_close(pairs[0][0].grad, pairs[1][0].grad)
        # At a border the one's slope may be taken on either side.
        inside = (grid.abs() < 0.999 - 1 / width).all(-1)
        torch.testing.assert_close(pairs[0][1].grad[inside], pairs[1][1].grad[inside], atol=1e-4, rtol=1e-4)


def test_samples_at_no_number_are_none() -> None:
    grid = torch.tensor([[[float("nan"), 0.0], [0.0, 0.0]]])
    found = sample_maps(torch.rand(1, 4, 4, 3), grid)
    assert found[0, 0].isnan().all()
    assert found[0, 1].isfinite().all()


def test_mixed_precision_leaves_what_the_layers_see_of_points_alone(scene, queries) -> None:
    field = Field(replace(SMALL, height_frequencies=4), 8)
    given: list[Tensor] = []
    for layer in (field.point_layer, field.direction_layer, field.height_layer):
        layer.register_forward_pre_hook(lambda layer, inputs: given.append(inputs[0]))
    seen = maps(field, scene)
    with torch.autocast("cpu", torch.bfloat16):
        raw = field(seen, *queries)
    field(seen, *queries)
    assert raw[0].dtype == torch.bfloat16, "what follows is in half precision"
    for mixed, full in zip(given[:3], given[3:], strict=True):
        assert torch.equal(mixed, full)


def test_blended_colours_are_those_of_the_views(scene, queries) -> None:
    field = Field(replace(SMALL, blend=4), 8)
    field.readout.weight.data.zero_()
    field.readout.bias.data = torch.tensor([0.0, 0.0, 0.0, 0.0, 50.0])
    features, images, camera = scene
    images = torch.tensor([0.1, 0.5, 0.9])[:, None, None].expand(2, 3, 3, 32, 32)
    colour, _ = field(maps(field, (features, images, camera)), *queries)
    torch.testing.assert_close(colour, torch.tensor([0.1, 0.5, 0.9]).expand_as(colour))
    one_each = torch.tensor([0.2, 0.4, 0.8])[:, None, None, None].expand(2, 3, 3, 32, 32)
    colour, _ = field(maps(field, (features, one_each, camera)), *queries)
    assert ((colour >= 0.2) & (colour <= 0.8)).all()
    assert colour.std() > 1e-3, "points choose among the views"
    field.readout.bias.data[4] = -50.0
    colour, _ = field(maps(field, scene), *queries)
    torch.testing.assert_close(colour, torch.full_like(colour, 0.5))


def test_moving_world_and_cameras_together_changes_nothing(scene, queries) -> None:
    field = Field(SMALL, 8)
    features, images, camera = scene
    points, directions = queries
    T = make_pose(roma.rotvec_to_rotmat(torch.tensor([0.4, -0.8, 0.3])), torch.tensor([0.5, -0.2, 0.1]))
    moved = (features, images, Camera(camera.intrinsics, T @ camera.T_world_camera, 32, 32))
    there = (transform(T, points.flatten(0, 2)).view_as(points), directions @ T[:3, :3].T)
    for one, other in zip(field(maps(field, scene), *queries), field(maps(field, moved), *there), strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)


def test_colour_and_density_by_hand(scene, queries) -> None:
    field = Field(SMALL, 8)
    field.readout.weight.data.zero_()
    field.readout.bias.data = torch.tensor([0.0, math.log(3.0), -math.log(3.0), 2.0])
    colour, density = field(maps(field, scene), *queries)
    torch.testing.assert_close(colour[1, 2, 3], torch.tensor([0.5, 0.75, 0.25]))
    torch.testing.assert_close(density, torch.full((2, 5, 4), 100.0 * math.log(2.0)))
