"""Pictures agree with the cameras to the pixel, and with the scene."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfgrasp.geometry import Camera, box_intersection, pixel_centres, pixel_rays, project
from nerfgrasp.scenes.prisms import mass_properties
from nerfgrasp.sim import shapes
from nerfgrasp.sim.rendering import prism_mesh, render_scene, scene_lighting
from nerfgrasp.sim.tasks import scene_cameras, simple_scene


def ray_cast(prism, camera):
    """Whether each pixel's centre sees a box that is unturned, by ray and box alone."""
    pixels = pixel_centres(camera.width, camera.height).reshape(-1, 2)
    origins, directions = pixel_rays(camera, pixels)
    corners = torch.tensor(prism.parts[0])
    place = prism.T_world_object[:3, 3]
    low = torch.cat([corners.min(0).values, torch.zeros(1)]) + place
    high = torch.cat([corners.max(0).values, torch.tensor([prism.height])]) + place
    near, far = box_intersection(origins, directions, low, high)
    return (far > near).reshape(camera.height, camera.width).numpy()


@pytest.mark.parametrize(("focal", "centre"), [((60.0, 60.0), (32.0, 32.0)), ((70.0, 55.0), (29.3, 36.8))])
def test_mask_is_what_rays_through_pixel_centres_hit(scene_of, focal, centre):
    scene = scene_of()
    spread = scene_cameras(0, 0, 4, size=64)
    intrinsics = torch.tensor([[focal[0], 0.0, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]])
    camera = Camera(intrinsics.repeat(4, 1, 1), spread.T_world_camera, 64, 64)
    _, masks = render_scene(scene, camera)
    for view in range(4):
        expected = ray_cast(scene.objects[0], camera[view])
        assert expected.sum() > 30
        assert (expected != (masks[view] == 1)).sum() <= 2


def test_projected_corners_frame_the_mask():
    scene, camera = simple_scene(0, 3), scene_cameras(0, 3, 3)
    _, masks = render_scene(scene, camera)
    lone = [i for i in range(len(scene.objects)) if (masks == i + 1).any(axis=(1, 2)).all()]
    assert lone
    for number in lone:
        vertices, _, _ = prism_mesh(scene.objects[number])
        pose = scene.objects[number].T_world_object
        points = torch.from_numpy(vertices).float() @ pose[:3, :3].T + pose[:3, 3]
        pixels, _ = project(camera, points.expand(3, -1, 3))
        for view in range(3):
            rows, columns = np.nonzero(masks[view] == number + 1)
            low, high = pixels[view].amin(0), pixels[view].amax(0)
            # Objects in front may hide some of it, never the other way round.
            assert low[0] - 1 <= columns.min() + 0.5
            assert columns.max() + 0.5 <= high[0] + 1
            assert low[1] - 1 <= rows.min() + 0.5
            assert rows.max() + 0.5 <= high[1] + 1


def test_pictures_are_repeatable_and_of_the_stated_form():
    scene, camera = simple_scene(1, 2), scene_cameras(1, 2, 2, size=48)
    images, masks = render_scene(scene, camera)
    again, masks_again = render_scene(scene, camera)
    assert images.dtype == masks.dtype == np.uint8
    assert images.shape == (2, 48, 48, 3)
    assert masks.shape == (2, 48, 48)
    assert np.array_equal(images, again)
    assert np.array_equal(masks, masks_again)
    assert set(np.unique(masks)) == set(range(len(scene.objects) + 1))


def test_an_object_is_its_colour_darker_or_lighter_and_the_table_is_one_grey(scene_of):
    images, masks = render_scene(scene_of(), scene_cameras(0, 0, 1))
    red, green, blue = images[masks == 1].reshape(-1, 3).T
    assert red.min() > 100
    assert green.max() == blue.max() == 0
    assert len(np.unique(images[masks == 0].reshape(-1, 3), axis=0)) == 1


def test_faces_are_lit_by_their_normals(scene_of):
    """Lambert's law: ambient + diffuse max(0, n · l), so the top of a red box is as bright as the table is."""
    scene = scene_of()
    lighting = scene_lighting(scene.seed, scene.index)
    camera = scene_cameras(0, 0, 1)
    images, _ = render_scene(scene, camera)
    top = torch.tensor([[[0.05, -0.02, 0.1]]])
    (x, y), _ = (v[0, 0] for v in project(camera, top))
    brightness = lighting.ambient + (1 - lighting.ambient) * lighting.direction[2]
    assert images[0, int(y), int(x), 0] == pytest.approx(255 * brightness, abs=2)


def test_light_and_table_differ_between_scenes():
    assert len({scene_lighting(0, index) for index in range(20)}) == 20


def test_a_box_upside_down_looks_like_one_that_stands(scene_of):
    scene, camera = scene_of(), scene_cameras(0, 0, 3, size=64)
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    pose[:3, 3] = scene.objects[0].T_world_object[:3, 3] + torch.tensor([0.0, 0.0, scene.objects[0].height])
    turned = replace(scene, objects=(replace(scene.objects[0], T_world_object=pose),))
    for upright, upside_down in zip(render_scene(scene, camera), render_scene(turned, camera), strict=True):
        assert np.array_equal(upright, upside_down)


def test_mesh_is_closed_and_faces_outwards(scene_of):
    """The divergence theorem over all triangles gives the volume of every part, wherever it is."""
    (prism,) = scene_of("u", shapes.channel(0.04, 0.02, 0.035, 0.03)).objects
    vertices, normals, indices = prism_mesh(prism)
    triangles = vertices[np.reshape(indices, (-1, 3))] + np.array([0.3, 0.2, 1.0])
    volume = np.linalg.det(triangles).sum() / 6
    assert volume * prism.density == pytest.approx(mass_properties(prism).mass)
    faces = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert ((faces * normals[np.reshape(indices, (-1, 3))[:, 0]]).sum(axis=1) > 0).all()


def test_depth_of_a_box_and_the_table_is_what_a_hand_computes(scene_of):
    """A camera one metre up that looks straight down: 1.0 m to the table, 0.9 m to the top of a box 0.1 m high."""
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    down[:3, 3] = torch.tensor([0.05, -0.02, 1.0])
    intrinsics = torch.tensor([[120.0, 0.0, 16.0], [0.0, 120.0, 16.0], [0.0, 0.0, 1.0]])
    camera = Camera(intrinsics[None], down[None], 32, 32)
    _, masks, depth = render_scene(scene_of(), camera, depth=True)
    assert depth.dtype == np.float32
    assert depth.shape == (1, 32, 32)
    # 40 mm by 80 mm at 0.9 m are 5.3 by 10.7 pixels.
    assert (masks == 1).sum() == pytest.approx(5.33 * 10.67, abs=12)
    assert depth[masks == 1] == pytest.approx(0.9, abs=1e-3)
    assert depth[masks == 0] == pytest.approx(1.0, abs=1e-6)


def test_depth_puts_every_pixel_on_the_box_or_on_the_table(scene_of):
    scene, camera = scene_of(), scene_cameras(0, 0, 3, size=64)
    prism = scene.objects[0]
    _, masks, depth = render_scene(scene, camera, depth=True)
    for view in range(3):
        origins, directions = pixel_rays(camera[view], pixel_centres(64, 64).reshape(-1, 2))
        along = directions @ camera.T_world_camera[view, :3, 2]
        points = origins + directions * (torch.from_numpy(depth[view]).reshape(-1) / along)[:, None]
        on_box = torch.from_numpy(masks[view].reshape(-1) == 1)
        assert points[~on_box, 2].abs().max() < 1e-4
        inside = points[on_box] - prism.T_world_object[:3, 3]
        faces = torch.stack(
            [(inside[:, 0].abs() - 0.02).abs(), (inside[:, 1].abs() - 0.04).abs(), (inside[:, 2] - 0.1).abs()]
        )
        assert faces.amin(dim=0).quantile(0.95) < 2e-3


def test_depth_is_infinite_above_the_horizon(scene_of):
    level = torch.tensor([[0.0, 0.0, 1.0, -1.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
    intrinsics = torch.tensor([[30.0, 0.0, 16.0], [0.0, 30.0, 16.0], [0.0, 0.0, 1.0]])
    _, masks, depth = render_scene(scene_of(), Camera(intrinsics[None], level[None], 32, 32), depth=True)
    assert not masks[0, :16].any()
    assert np.isinf(depth[0, :16]).all()
    assert np.isfinite(depth[0, 16:]).all()


def test_a_tipped_prism_is_seen_where_it_lies(scene_of):
    """A box 0.04 x 0.08 x 0.1 m laid on its side is 0.04 m high, and the depth says so."""
    (prism,) = scene_of().objects
    lying = torch.tensor([[0.0, 0.0, 1.0, -0.05], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.02], [0.0, 0.0, 0.0, 1.0]])
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    down[2, 3] = 1.0
    intrinsics = torch.tensor([[120.0, 0.0, 16.0], [0.0, 120.0, 16.0], [0.0, 0.0, 1.0]])
    scene = replace(scene_of(), objects=(replace(prism, T_world_object=lying),))
    _, masks, depth = render_scene(scene, Camera(intrinsics[None], down[None], 32, 32), depth=True)
    assert depth[masks == 1] == pytest.approx(0.96, abs=1e-3)
    rows, columns = np.nonzero(masks[0])
    assert columns.max() - columns.min() + 1 == pytest.approx(0.1 * 120 / 0.96, abs=1)
    assert rows.max() - rows.min() + 1 == pytest.approx(0.08 * 120 / 0.96, abs=1)
