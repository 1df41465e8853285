import pytest
import torch
from torch import Tensor

from nerfgrasp.geometry import (
    Camera,
    depth_along_axis,
    is_rigid,
    look_at,
    pixel_centres,
    pixel_rays,
    project,
    sees_box,
    shrink,
)

DTYPES = (torch.float32, torch.float64)


def example_camera(dtype: torch.dtype = torch.float64) -> Camera:
    """Four cameras around the origin with different intrinsics, 12 pixels wide and 10 high."""
    eyes = torch.tensor([[0.5, 0.1, 0.6], [-0.4, 0.3, 0.5], [0.1, -0.6, 0.3], [0.3, 0.3, 0.9]], dtype=dtype)
    intrinsics = torch.tensor([[11.0, 0.0, 6.3], [0.0, 9.0, 4.8], [0.0, 0.0, 1.0]], dtype=dtype).repeat(4, 1, 1)
    intrinsics[:, 0, 0] += torch.arange(4)
    return Camera(intrinsics, look_at(eyes, torch.zeros(3, dtype=dtype)), width=12, height=10)


def test_pixel_centres_lie_at_a_half() -> None:
    centres = pixel_centres(3, 2)
    assert centres.tolist() == [[[0.5, 0.5], [1.5, 0.5], [2.5, 0.5]], [[0.5, 1.5], [1.5, 1.5], [2.5, 1.5]]]


def test_projection_by_hand() -> None:
    # At the origin, OpenCV axes along the world's: x right, y down, z forward.
    intrinsics = torch.tensor([[100.0, 0.0, 64.0], [0.0, 50.0, 32.0], [0.0, 0.0, 1.0]])
    camera = Camera(intrinsics, torch.eye(4), width=128, height=64)
    pixels, depth = project(camera, torch.tensor([[0.2, -0.4, 2.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    assert torch.allclose(pixels[:2], torch.tensor([[74.0, 22.0], [64.0, 32.0]]))
    assert depth.tolist() == [2.0, 1.0, -1.0]


def test_ray_by_hand() -> None:
    # Looking down from 1 m with +y at the image's upper edge: 45° to the right is +x.
    pose = look_at(torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3), up=torch.tensor([0.0, 1.0, 0.0]))
    camera = Camera(torch.tensor([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]]), pose, width=8, height=8)
    origins, directions = pixel_rays(camera, torch.tensor([[12.0, 4.0], [4.0, 4.0], [4.0, -4.0]]))
    half = 0.5**0.5
    assert torch.allclose(origins, torch.tensor([0.0, 0.0, 1.0]))
    assert torch.allclose(directions, torch.tensor([[half, 0.0, -half], [0.0, 0.0, -1.0], [0.0, half, -half]]))


@pytest.mark.parametrize("dtype", DTYPES)
def test_points_on_a_ray_project_to_its_pixel(dtype: torch.dtype) -> None:
    camera = example_camera(dtype)
    pixels = pixel_centres(12, 10).to(dtype).reshape(-1, 2).expand(4, -1, -1)
    origins, directions = pixel_rays(camera, pixels)
    assert torch.allclose(directions.norm(dim=-1), torch.ones(4, 120, dtype=dtype))
    for distance in (0.1, 0.7, 3.0):
        again, depth = project(camera, origins + distance * directions)
        assert torch.allclose(again, pixels, atol=1e-4)
        assert ((depth > 0) & (depth <= distance + 1e-6)).all()


def test_projection_is_the_pinhole_formula() -> None:
    camera, points = example_camera(), torch.rand(4, 5, 3, dtype=torch.float64) * 0.1
    pixels, depth = project(camera, points)
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)
    in_camera = torch.einsum("vij,vnj->vni", torch.linalg.inv(camera.T_world_camera), homogeneous)
    on_image = torch.einsum("vij,vnj->vni", camera.intrinsics, in_camera[..., :3])
    assert torch.allclose(pixels, on_image[..., :2] / on_image[..., 2:])
    assert torch.allclose(depth, in_camera[..., 2])


def test_points_are_shared_among_cameras() -> None:
    camera, points = example_camera(), torch.rand(5, 3, dtype=torch.float64) * 0.1
    together = project(camera, points)[0]
    assert torch.allclose(together, torch.stack([project(camera[i], points)[0] for i in range(4)]))


def test_projection_is_differentiable() -> None:
    camera = example_camera()
    points = (torch.rand(3, 3, dtype=torch.float64) * 0.1).requires_grad_()

    def projected(points: Tensor) -> Tensor:
        return project(camera, points)[0]

    assert torch.autograd.gradcheck(projected, points)


@pytest.mark.parametrize("dtype", DTYPES)
def test_look_at(dtype: torch.dtype) -> None:
    eye = torch.randn(50, 3, dtype=dtype, generator=torch.Generator().manual_seed(0))
    target = torch.tensor([0.1, 0.2, 0.05], dtype=dtype)
    pose = look_at(eye, target)
    right, down, forward = pose[:, :3, :3].unbind(-1)

    assert pose.dtype == dtype
    assert is_rigid(pose).all()
    assert torch.equal(pose[:, :3, 3], eye)
    assert torch.allclose((forward * (target - eye)).sum(-1), (target - eye).norm(dim=-1))
    assert right[:, 2].abs().max() < 1e-6, "the horizon is level"
    assert (down[:, 2] <= 0).all(), "the upper edge faces up"


def test_target_projects_to_the_principal_point() -> None:
    camera = example_camera()
    pixels, depth = project(camera, torch.zeros(1, 3, dtype=torch.float64))
    assert torch.allclose(pixels[:, 0], camera.intrinsics[:, :2, 2])
    assert torch.allclose(depth[:, 0], camera.T_world_camera[:, :3, 3].norm(dim=-1))


def test_indexing_selects_cameras() -> None:
    camera = example_camera()
    assert len(camera) == 4
    assert len(camera[1:3]) == 2
    assert (camera[1:3].width, camera[1:3].height) == (12, 10)
    assert torch.equal(camera[torch.tensor([3, 0])].T_world_camera, camera.T_world_camera[[3, 0]])
    assert camera[2].intrinsics.shape == (3, 3)
    assert [each.intrinsics[0, 0].item() for each in camera] == [11.0, 12.0, 13.0, 14.0]


def test_a_shrunk_camera_sees_the_same() -> None:
    camera = example_camera()
    points = torch.tensor([[0.05, 0.1, 0.02]], dtype=torch.float64).expand(4, 1, 3)
    small = shrink(camera, 6)
    assert (small.width, small.height) == (6, 5)
    assert torch.allclose(project(small, points)[0] * 2, project(camera, points)[0])
    assert shrink(camera, 12) is camera


def test_distances_along_rays_become_depths_along_the_axis() -> None:
    camera = example_camera()[0]
    origins, directions = pixel_rays(camera, pixel_centres(12, 10).double().flatten(0, 1))
    distance = torch.linspace(0.3, 1.2, 120, dtype=torch.float64)
    _, depth = project(camera, origins + distance[:, None] * directions)
    assert torch.allclose(depth_along_axis(camera, distance.view(10, 12)), depth.view(10, 12))


def test_a_camera_sees_a_box_by_any_part_of_it() -> None:
    # 90° of view, at the origin, along the world's axes.
    intrinsics = torch.tensor([[50.0, 0.0, 50.0], [0.0, 50.0, 50.0], [0.0, 0.0, 1.0]])
    camera = Camera(intrinsics, torch.eye(4), width=100, height=100)
    seen = {
        "in the middle": ((-0.1, -0.1, 1.0), (0.1, 0.1, 1.2)),
        "a corner": ((0.9, 0.9, 0.8), (1.4, 1.4, 1.0)),
        "a face larger than the image": ((-9.0, -9.0, 1.0), (9.0, 9.0, 1.1)),
        "an edge through the image, its ends beyond": ((-9.0, -0.01, 1.0), (9.0, 0.01, 1.01)),
        "all around": ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
    }
    unseen = {
        "behind": ((-0.1, -0.1, -1.2), (0.1, 0.1, -1.0)),
        "beside": ((1.1, -0.1, 0.5), (1.3, 0.1, 1.0)),
        "beyond a corner": ((1.0, 1.0, 0.8), (1.4, 1.4, 0.99)),
        "above, though it reaches behind": ((-0.1, -9.0, -5.0), (0.1, -3.0, 2.0)),
    }
    for name, box in (seen | unseen).items():
        assert bool(sees_box(camera, *map(torch.tensor, box))) == (name in seen), name


def test_boxes_are_seen_as_their_points_are() -> None:
    camera = example_camera()
    generator = torch.Generator().manual_seed(0)
    share = torch.stack(torch.meshgrid(*[torch.linspace(0, 1, 21, dtype=torch.float64)] * 3, indexing="ij"), dim=-1)
    both = set()
    for _ in range(60):
        low = 2.4 * torch.rand(3, generator=generator, dtype=torch.float64) - 1.2
        high = low + 0.5 * torch.rand(3, generator=generator, dtype=torch.float64)
        pixels, depth = project(camera, (low + share.flatten(0, 2) * (high - low)).expand(4, -1, 3))
        size = torch.tensor([camera.width, camera.height])
        found = ((depth > 0) & (pixels >= 0).all(-1) & (pixels <= size).all(-1)).any(dim=-1)
        sees = sees_box(camera, low, high)
        assert (sees | ~found).all()
        both |= set(sees[sees == found].tolist())
        assert (sees & ~found).sum() <= 1  # a sliver between the points
    assert both == {True, False}


def test_mixed_precision_leaves_geometry_alone() -> None:
    camera, points = example_camera(torch.float32), 0.2 * torch.rand(4, 50, 3)
    pixels, depth = project(camera, points)
    origins, directions = pixel_rays(camera, pixels)
    with torch.autocast("cpu", torch.bfloat16):
        mixed, again = project(camera, points), pixel_rays(camera, pixels=pixels)
    assert all(torch.equal(*pair) for pair in zip((pixels, depth, origins, directions), (*mixed, *again), strict=True))
