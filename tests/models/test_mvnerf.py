from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfgrasp.geometry import Camera, box_intersection, crop_to_box, pixel_rays
from nerfgrasp.models import EncoderConfig, MVNeRF, MVNeRFConfig, SceneFeatures
from nerfgrasp.scenes.scene import Workspace


@pytest.fixture
def network(tiny_network: Callable[..., Any]) -> MVNeRF:
    torch.manual_seed(0)
    return MVNeRF(tiny_network())


@pytest.fixture
def views(cameras: Callable[..., Camera]) -> tuple[Tensor, Camera]:
    torch.manual_seed(1)
    flat = cameras(6)
    camera = Camera(flat.intrinsics.unflatten(0, (2, 3)), flat.T_world_camera.unflatten(0, (2, 3)), 32, 32)
    return torch.rand(2, 3, 3, 32, 32), camera


@pytest.fixture
def rays(cameras: Callable[..., Camera]) -> tuple[Tensor, Tensor]:
    """Rays `[2, 5, 3]` that meet the workspace."""
    pixels = torch.tensor([[16.0, 16.0], [10.5, 16.5], [16.5, 12.5], [18.5, 20.5], [21.5, 15.5]])
    return pixel_rays(cameras(2, seed=7), pixels.expand(2, 5, 2))


def test_the_paper_s_scene_activations_are_four_of_128() -> None:
    with torch.device("meta"):
        network = MVNeRF(MVNeRFConfig(encoder=EncoderConfig(pretrained=False)))
        camera = Camera(torch.zeros(2, 3, 3, 3), torch.zeros(2, 3, 4, 4), 64, 48)
        features = network.observe(torch.zeros(2, 3, 3, 48, 64), camera, Workspace())
        found = network.activations(features, torch.zeros(2, 6, 7, 3), torch.zeros(2, 6, 3))
        rendered = network.render(features, torch.zeros(2, 5, 3), torch.zeros(2, 5, 3), Workspace())
    assert [activation.shape for activation in found] == [(2, 6, 7, 128)] * 4
    assert rendered.coarse.weights.shape == (2, 5, 64)
    assert rendered.fine.weights.shape == (2, 5, 64 + 128)
    assert rendered.fine.colour.shape == (2, 5, 3)
    own = {id(parameter) for parameter in network.coarse.parameters()}
    assert not own & {id(parameter) for parameter in network.fine.parameters()}


def test_activations_are_the_fine_field_s(network: MVNeRF, views, rays) -> None:
    features = network.observe(*views, Workspace())
    points = rays[0][..., None, :].expand(2, 5, 4, 3) + 0.7 * rays[1][..., None, :]
    found = network.activations(features, points, rays[1])
    expected = network.fine.activations(features.fine, points, rays[1])
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    light = network.observe(*views, Workspace(), fine_only=True)
    assert light.coarse is None
    assert torch.equal(light.fine.features, features.fine.features)
    with pytest.raises(ValueError, match="fine_only"):
        network.render(light, *rays, Workspace())


def test_scenes_do_not_mix(network: MVNeRF, views, rays, workspace: Workspace) -> None:
    images, camera = views
    both = network.render(network.observe(images, camera, Workspace()), *rays, workspace)
    one = network.render(network.observe(images[1:], camera[1:], Workspace()), rays[0][1:], rays[1][1:], workspace)
    torch.testing.assert_close(both.fine.colour[1:], one.fine.colour, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(both.coarse.depth[1:], one.coarse.depth, atol=1e-4, rtol=1e-4)


def test_samples_lie_in_the_box_and_its_margin(network: MVNeRF, views, rays, workspace: Workspace) -> None:
    found = network.render(network.observe(*views, Workspace()), *rays, workspace, torch.Generator().manual_seed(0))
    near, far = box_intersection(*rays, workspace.minimum - 0.03, workspace.maximum + 0.03)
    assert (far > near).all()
    for rendering in found:
        assert (rendering.distances >= near[..., None] - 1e-5).all()
        assert (rendering.distances <= far[..., None] + 1e-5).all()
        assert (rendering.distances.diff(dim=-1) >= 0).all()
    assert found.fine.distances.shape[-1] == 12


def test_each_scene_may_have_its_own_box(network: MVNeRF, views, rays, workspace: Workspace) -> None:
    features = network.observe(*views, Workspace())
    corners = [torch.stack([corner, 0.5 * corner])[:, None] for corner in (workspace.minimum, workspace.maximum)]
    found = network.render(features, *rays, Workspace(*corners)).coarse.distances
    assert torch.equal(found[:1], network.render(features, *rays, workspace).coarse.distances[:1])
    small = Workspace(0.5 * workspace.minimum, 0.5 * workspace.maximum)
    assert torch.equal(found[1:], network.render(features, *rays, small).coarse.distances[1:])


def test_the_paper_s_fixed_range_stays_available(tiny_network: Callable[..., Any], views, rays) -> None:
    network = MVNeRF(tiny_network(depth_range=(0.3, 1.3), reuse_coarse_samples=False))
    found = network.render(network.observe(*views, Workspace()), *rays, Workspace())
    middles = 0.3 + (torch.arange(6) + 0.5) / 6
    torch.testing.assert_close(found.coarse.distances, middles.expand(2, 5, 6))
    assert found.fine.distances.shape[-1] == 6


def test_the_generator_alone_decides_the_samples(network: MVNeRF, views, rays, workspace: Workspace) -> None:
    features = network.observe(*views, Workspace())

    def colour(seed: int | None) -> Tensor:
        draw = None if seed is None else torch.Generator().manual_seed(seed)
        return network.render(features, *rays, workspace, draw).fine.colour

    torch.manual_seed(5)
    assert torch.equal(colour(None), colour(None))
    assert torch.equal(colour(1), colour(1))
    assert not torch.equal(colour(1), colour(2))


def test_every_parameter_learns(network: MVNeRF, views, rays, workspace: Workspace) -> None:
    features: SceneFeatures = network.observe(*views, Workspace())
    found = network.render(features, *rays, workspace)
    (found.coarse.colour.square().sum() + found.fine.colour.square().sum()).backward()
    assert [name for name, parameter in network.named_parameters() if parameter.grad is None] == []


def test_images_of_another_size_are_cut_to_the_workspace(
    tiny_network: Callable[..., Any], cameras: Callable[..., Camera]
) -> None:
    network = MVNeRF(tiny_network(image_size=32))
    images, camera, box = torch.rand(2, 3, 3, 48, 64), cameras(6), Workspace()
    shape = (2, 3)
    seen = Camera(camera.intrinsics.unflatten(0, shape), camera.T_world_camera.unflatten(0, shape), 64, 48)
    fitted, near = network.fit_images(images, seen, box)
    assert fitted.shape == (2, 3, 3, 32, 32)
    one = Camera(seen.intrinsics[1], seen.T_world_camera[1], 64, 48)
    alone, own = crop_to_box(images[1], one, box.minimum, box.maximum, 32)
    assert torch.equal(fitted[1], alone)
    assert torch.equal(near.intrinsics[1], own.intrinsics)
    assert network.observe(images, seen, box).fine.images.shape == (2, 3, 3, 32, 32)


def test_images_of_the_known_size_are_left_alone(tiny_network: Callable[..., Any], views) -> None:
    network = MVNeRF(tiny_network(image_size=32))
    images, camera = network.fit_images(*views, Workspace())
    assert images is views[0]
    assert camera is views[1]
