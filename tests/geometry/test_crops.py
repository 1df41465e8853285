from dataclasses import replace

import pytest
import torch

from nerfgrasp.geometry import Camera, crop_to_box, look_at, pixel_centres, pixel_rays, project

MINIMUM, MAXIMUM = torch.tensor([-0.25, -0.25, 0.0]), torch.tensor([0.25, 0.25, 0.2])


def cameras(width: int = 640, height: int = 480, focal: float = 450.0) -> Camera:
    eyes = torch.tensor([[0.5, 0.0, 0.6], [-0.2, 0.4, 0.6], [0.0, -0.55, 0.5]])
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(intrinsics.expand(3, 3, 3), look_at(eyes, torch.zeros(3)), width, height)


def ramps(camera: Camera) -> torch.Tensor:
    """Images whose channels are the pixel centres' x and y: what a crop's pixels show says where they were."""
    return pixel_centres(camera.width, camera.height).movedim(-1, 0).expand(3, 2, -1, -1)


def test_a_crop_s_camera_sees_what_its_pixels_show() -> None:
    camera = cameras()
    crops, near = crop_to_box(ramps(camera), camera, MINIMUM, MAXIMUM, 96)
    assert crops.shape == (3, 2, 96, 96)
    assert (near.width, near.height) == (96, 96)
    points = torch.rand(3, 50, 3, generator=torch.Generator().manual_seed(0)) * (MAXIMUM - MINIMUM) + MINIMUM
    before, after = project(camera, points)[0], project(near, points)[0]
    for crop, was, now in zip(crops, before, after, strict=True):
        inside = ((now > 1.0) & (now < 95.0)).all(-1) & (was > 0).all(-1) & (was < torch.tensor([640, 480])).all(-1)
        assert inside.sum() > 30
        grid = (2 * now[inside] / 96 - 1)[None, None]
        shown = torch.nn.functional.grid_sample(crop[None], grid, align_corners=False)[0, :, 0].T
        torch.testing.assert_close(shown, was[inside], atol=0.05, rtol=0)


def test_a_crop_is_as_small_as_the_box_allows() -> None:
    camera = cameras()
    _, near = crop_to_box(ramps(camera), camera, MINIMUM, MAXIMUM, 96)
    choose = torch.cartesian_prod(*[torch.arange(2)] * 3).bool()
    corners = project(near, torch.where(choose, MAXIMUM, MINIMUM).expand(3, 8, 3))[0]
    assert (corners > -0.5).all()
    assert (corners < 96.5).all()
    extent = corners.amax(dim=1) - corners.amin(dim=1)
    assert (extent.amax(dim=-1) > 95).all()


def test_rays_stay_where_they_were() -> None:
    camera = cameras()
    crops, near = crop_to_box(ramps(camera), camera, MINIMUM, MAXIMUM, 64)
    middle = torch.full((3, 1, 2), 32.0)
    there = crops[:, :, 31:33, 31:33].mean(dim=(2, 3))[:, None]
    for a, b in zip(pixel_rays(near, middle), pixel_rays(camera, there), strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=0)


def test_what_is_outside_of_the_image_repeats_its_border() -> None:
    camera = cameras(width=64, height=64, focal=150.0)
    images = torch.rand(3, 1, 64, 64, generator=torch.Generator().manual_seed(0))
    crops, _ = crop_to_box(images, camera, MINIMUM, MAXIMUM, 200)
    assert torch.isfinite(crops).all()
    assert (crops[:, :, 0, 0] - images[:, :, 0, 0]).abs().max() < 1e-5


def test_a_camera_within_the_box_keeps_its_whole_image() -> None:
    camera = cameras(width=64, height=64)
    within = replace(camera, T_world_camera=look_at(torch.tensor([[0.1, 0.0, 0.1]]), torch.zeros(3)).expand(3, 4, 4))
    images = torch.rand(3, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    crops, near = crop_to_box(images, within, MINIMUM, MAXIMUM, 64)
    torch.testing.assert_close(crops, images)
    torch.testing.assert_close(near.intrinsics, within.intrinsics)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_types_are_kept(dtype: torch.dtype) -> None:
    camera = cameras()
    double = Camera(camera.intrinsics.to(dtype), camera.T_world_camera.to(dtype), 640, 480)
    crops, near = crop_to_box(ramps(camera).to(dtype), double, MINIMUM.to(dtype), MAXIMUM.to(dtype), 32)
    assert crops.dtype == near.intrinsics.dtype == dtype
