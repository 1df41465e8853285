"""Height maps against numbers computed by hand."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfgrasp_baselines.transporter.data import read_heights
from nerfgrasp_baselines.transporter.heights import height_map, map_shape, splat, subpixel_points, within

from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.geometry import Camera
from nerfgrasp.scenes.scene import Workspace

BOX = Workspace(torch.tensor([-0.5, -0.5, 0.0]), torch.tensor([0.5, 0.5, 0.2]))


@pytest.fixture
def from_above() -> Camera:
    """A camera of 4 × 4 pixels, f = 4, a metre above the origin, its x axis the world's and its y axis against it."""
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    pose[2, 3] = 1.0
    intrinsics = torch.tensor([[4.0, 0.0, 2.0], [0.0, 4.0, 2.0], [0.0, 0.0, 1.0]])
    return Camera(intrinsics[None], pose[None], 4, 4)


def test_a_raised_pixel_by_hand(from_above: Camera) -> None:
    # Its centre (2.5, 1.5) is seen along (0.125, 0.125) at depth 1: at 0.9, x = y = 0.1125, so row and column 2.
    depth, images = torch.ones(1, 4, 4), torch.full((1, 3, 4, 4), 0.5)
    depth[0, 1, 2], images[0, :, 1, 2] = 0.9, torch.tensor([1.0, 0.0, 0.0])
    found = height_map(images, depth, from_above, BOX, 0.25)
    assert found.shape == (4, 4, 4)
    expected = torch.zeros(4, 4)
    expected[2, 2] = 0.1
    torch.testing.assert_close(found[3], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(found[:3, 2, 2], torch.tensor([1.0, 0.0, 0.0]))
    torch.testing.assert_close(found[:3, 0, 3], torch.full((3,), 0.5))


def test_where_nothing_is_seen_the_map_is_black_and_at_the_table(from_above: Camera) -> None:
    depth = torch.ones(1, 4, 4)
    depth[0, :, 0] = torch.inf
    found = height_map(torch.ones(1, 3, 4, 4), depth, from_above, BOX, 0.25)
    assert (found[:, :, 0] == 0).all()
    assert (found[:3, :, 1:] == 1).all()


def test_the_highest_point_of_a_cell_counts() -> None:
    points = [
        [0.1, 0.3, 0.05],
        [0.2, 0.4, 0.12],  # the same cell, higher
        [0.1, 0.4, 0.119],  # and so near to the highest that the colours mix
        [-0.1, 0.1, -0.005],  # just below the table: on it
        [-0.4, -0.4, -0.02],  # too far below
        [-0.4, 0.4, 0.25],  # above the workspace
        [0.5, 0.0, 0.1],  # beside it
    ]
    colours = torch.eye(7)[:, :3]
    found = splat(torch.tensor(points), colours, BOX, 0.5)
    torch.testing.assert_close(found[3], torch.tensor([[0.0, 0.0], [0.0, 0.12]]))
    torch.testing.assert_close(found[:3, 1, 1], torch.tensor([0.0, 0.5, 0.5]))
    assert (found[:3, 0] == 0).all()


def test_rows_go_along_y(workspace: Workspace) -> None:
    wide = Workspace(workspace.minimum, workspace.maximum + torch.tensor([0.1, 0.0, 0.0]))
    assert map_shape(wide, 0.1) == (5, 6)
    found = splat(torch.tensor([[0.31, -0.15, 0.1]]), torch.ones(1, 3), wide, 0.1)
    assert found[3].nonzero().tolist() == [[0, 5]]


def test_parts_of_pixels_lie_on_the_plane_that_is_seen(cameras: Callable[..., Camera]) -> None:
    camera = cameras(2, 16)
    whole, _ = subpixel_points(torch.ones(2, 16, 16), camera, 1)
    rays = whole - camera.T_world_camera[:, None, None, :3, 3]
    depth = -camera.T_world_camera[:, 2, 3, None, None] / rays[..., 2]
    points, seen = subpixel_points(depth, camera, 3)
    assert points.shape == (2, 48, 48, 3)
    assert seen.all()
    inner = points[:, 3:-3, 3:-3]
    torch.testing.assert_close(inner[..., 2], torch.zeros(2, 42, 42), atol=1e-5, rtol=0)
    # The middle part of three is the pixel's own ray.
    pixels = camera.T_world_camera[:, None, None, :3, 3] + rays * depth[..., None]
    torch.testing.assert_close(points[:, 4:-3:3, 4:-3:3], pixels[:, 1:-1, 1:-1], atol=1e-5, rtol=0)


def test_no_point_lies_between_two_surfaces(from_above: Camera) -> None:
    depth = torch.ones(1, 4, 4)
    depth[:, :, 2:] = 0.8
    points, _ = subpixel_points(depth, from_above, 4)
    heights = points[..., 2].unique()
    torch.testing.assert_close(heights, torch.tensor([0.0, 0.2]).expand_as(heights.view(-1, 2)[0]), atol=1e-6, rtol=0)


def test_what_lies_on_the_map() -> None:
    points = torch.tensor([[0.45, 0.0], [0.46, 0.0], [-0.45, 0.45], [0.0, -0.7]])
    assert within(points, BOX, 0.045).tolist() == [True, False, True, False]


def test_a_box_stands_where_it_is(make_set: Callable[..., Path], tmp_path: Path) -> None:
    scenes = PackedScenes(make_set(tmp_path / "set", scenes=2, views=3, size=256, demonstrations=True, depth=True))
    grasp = scenes.truth(0).demonstration
    assert grasp is not None
    pixel, middle = 0.0025, grasp[:2, 3]
    heights = read_heights(scenes, 0, np.arange(3), grasp, pixel).maps[3]
    column, row = ((middle + 0.25) / pixel).long()
    assert abs(float(heights[row, column]) - 0.08) < 5e-4
    cells = (heights > 0.04).nonzero().flip(1) + 0.5
    torch.testing.assert_close(cells.mean(dim=0) * pixel - 0.25, middle, atol=1e-3, rtol=0)
    # Half a pixel of the images and half a cell, all around, is what the highest of all views may add to 60 × 160 mm.
    assert -1e-4 < len(cells) * pixel**2 - 0.06 * 0.16 < 0.44 * 0.0035
