"""Mesh objects in physics and in pictures: where they are put, as they are coloured."""

from dataclasses import replace

import numpy as np
import pybullet as p
import pytest
import torch
import trimesh

from nerfgrasp.geometry import Camera, make_pose
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.catalogue import open_catalogue
from nerfgrasp.sim.physics import PHYSICS
from nerfgrasp.sim.rendering import render_scene, scene_lighting
from nerfgrasp.sim.settling import drop
from nerfgrasp.sim.world import World

FLIPPED = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


@pytest.fixture
def box(tmp_path, make_box, object_cache):
    """A box of 40 x 60 x 100 mm about its frame's origin: red above, green below, blue around."""
    make_box(tmp_path / "shelf")
    return open_catalogue(tmp_path / "shelf").models[0]


@pytest.fixture
def from_above():
    """A camera one metre above the origin."""
    T = make_pose(FLIPPED, torch.tensor([0.0, 0.0, 1.0]))
    intrinsics = torch.tensor([[320.0, 0.0, 32.0], [0.0, 320.0, 32.0], [0.0, 0.0, 1.0]])
    return Camera(intrinsics[None], T[None], 64, 64)


def test_a_body_has_the_models_mass_centre_and_inertia(box):
    thing = replace(box.place(make_pose(FLIPPED, torch.tensor([0.1, 0.0, 0.2]))), centre=(0.0, 0.01, 0.02))
    with World([thing], PHYSICS) as world:
        info = p.getDynamicsInfo(world.objects[0], -1, physicsClientId=world.client)
        assert world.centres()[0] == pytest.approx([0.1, -0.01, 0.18], abs=1e-6)
        assert world.poses()[0] == pytest.approx(thing.T_world_object.numpy(), abs=1e-6)
    assert info[0] == pytest.approx(box.mass)
    assert sorted(info[2]) == pytest.approx(np.linalg.eigvalsh(box.inertia).tolist(), rel=1e-5)


def test_a_box_falls_and_comes_to_rest_on_its_face(box):
    turn = torch.from_numpy(trimesh.transformations.euler_matrix(0.2, 0.1, 0.4)[:3, :3]).float()
    (resting,) = drop((box.place(make_pose(turn, torch.tensor([0.0, 0.0, 0.12]))),))
    # Half its height above the table: what Bullet adds to a hull was taken off before.
    assert resting.T_world_object[2, 3] == pytest.approx(0.05, abs=5e-4)
    assert resting.T_world_object[2, 2] == pytest.approx(1.0, abs=1e-3)


def test_hulls_leave_free_what_their_union_leaves_free(tmp_path, object_cache):
    """Two posts 100 mm apart on a bar: a ray between them meets the bar, 80 mm deeper than the posts."""
    parts = [
        ((0.14, 0.02, 0.02), (0, 0, 0.01)),
        ((0.02, 0.02, 0.08), (0.06, 0, 0.06)),
        ((0.02, 0.02, 0.08), (-0.06, 0, 0.06)),
    ]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in parts]
    (tmp_path / "shelf").mkdir()
    trimesh.util.concatenate(boxes).export(tmp_path / "shelf" / "goal.stl")
    (goal,) = open_catalogue(tmp_path / "shelf").models
    with World([goal.place()], PHYSICS) as world:
        world.step()
        starts, ends = [[0.0, 0.0, 1.0], [0.06, 0.0, 1.0]], [[0.0, 0.0, 0.001], [0.06, 0.0, 0.001]]
        hits = p.rayTestBatch(starts, ends, physicsClientId=world.client)
    assert [hit[3][2] for hit in hits] == pytest.approx([0.02, 0.1], abs=1e-3)


@pytest.mark.parametrize(
    ("rotation", "colour", "size", "height"),
    [
        (torch.eye(3), 0, (0.04, 0.06), 0.1),
        (FLIPPED, 1, (0.04, 0.06), 0.1),
        (torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), 2, (0.1, 0.06), 0.04),
    ],
)
def test_pictures_show_the_texture_the_outline_and_the_depth(rotation, colour, size, height, box, from_above):
    pose = make_pose(rotation, torch.tensor([0.0, 0.0, height / 2]))
    truth = Truth("novel", 0, 0, (box.place(pose),))
    images, masks, depth = render_scene(truth, from_above, depth=True)
    rows, columns = np.nonzero(masks[0] == 1)
    focal = 320 / (1 - height)
    assert np.ptp(columns) + 1 == pytest.approx(size[0] * focal, abs=1)
    assert np.ptp(rows) + 1 == pytest.approx(size[1] * focal, abs=1)
    assert depth[masks == 1] == pytest.approx(1 - height, abs=1e-3)
    # Lambert's law at a level face, in the one colour that the texture has there.
    lighting = scene_lighting(0, 0)
    expected = np.zeros(3)
    expected[colour] = 255 * (lighting.ambient + (1 - lighting.ambient) * lighting.direction[2])
    inner = (abs(rows - rows.mean()) < 5) & (abs(columns - columns.mean()) < 5)
    assert images[0, rows[inner], columns[inner]] == pytest.approx(np.tile(expected, (inner.sum(), 1)), abs=3)


def test_masks_number_meshes_and_prisms_alike(box, from_above, scene_of):
    (prism,) = scene_of().objects
    thing = box.place(make_pose(torch.eye(3), torch.tensor([-0.05, 0.04, 0.05])))
    _, masks = render_scene(Truth("novel", 0, 0, (prism, thing)), from_above)
    assert set(np.unique(masks)) == {0, 1, 2}
    # The mesh is to the left; the image's rows run along -y.
    rows, columns = np.nonzero(masks[0] == 2)
    assert columns.max() < 32
    assert rows.max() < 32
