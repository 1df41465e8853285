from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import roma
import torch
from torch import Tensor

from nerfgrasp.data.grasps import GraspBatch, GraspData, Negatives, demonstrations, draw_negatives, half_turned
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.streams import SceneSet
from nerfgrasp.data.views import to_float
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import invert, is_rigid, make_pose
from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.scene import Workspace

NONE = Negatives(uniform=0, near=0)
HALF_TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))


@pytest.fixture
def grasp() -> Tensor:
    rotation = roma.rotvec_to_rotmat(torch.tensor([3.0, 0.4, 0.2]))
    return make_pose(rotation, torch.tensor([0.05, -0.1, 0.06]))


def drawn(grasp: Tensor, workspace: Workspace, kinds: Negatives, seed: int = 0) -> Tensor:
    found = draw_negatives(grasp, workspace, kinds, np.random.default_rng(seed))
    assert is_rigid(found).all()
    return found


def shifts(grasp: Tensor, found: Tensor) -> Tensor:
    return found[:, :3, 3] - grasp[:3, 3]


def turns(grasp: Tensor, found: Tensor) -> Tensor:
    """The angles in radians between the poses' orientations and the grasp's."""
    return roma.rotmat_geodesic_distance(found[:, :3, :3], grasp[:3, :3].expand(len(found), 3, 3))


def grasps(folder: Path, **changes: Any) -> GraspData:
    scenes = SceneSet(folder, scenes=4, views=6, seed=5, size=32, demonstrations=True)
    kinds = Negatives(uniform=5, near=2, upright=2, perturbed=2)
    data = GraspData(scenes, scenes, **{"views": 2, "scenes_per_step": 3, "negatives": kinds, **changes})
    data.check()
    data.setup("fit")
    return data


def test_the_paper_s_512_poses(grasp: Tensor, workspace: Workspace) -> None:
    assert len(drawn(grasp, workspace, Negatives())) == 511
    assert len(drawn(grasp, workspace, Negatives(3, 4, 5, 6, 7, 8))) == 33
    assert drawn(grasp, workspace, NONE).shape == (0, 4, 4)


def test_uniform_negatives_fill_the_workspace_and_all_orientations(grasp: Tensor, workspace: Workspace) -> None:
    found = drawn(grasp, workspace, Negatives(uniform=2000, near=0))
    position = found[:, :3, 3]
    assert (position >= workspace.minimum).all()
    assert (position <= workspace.maximum).all()
    middle = (workspace.minimum + workspace.maximum) / 2
    torch.testing.assert_close(position.mean(0), middle, atol=0.01, rtol=0)
    torch.testing.assert_close(found[:, :3, :3].mean(0), torch.zeros(3, 3), atol=0.06, rtol=0)
    # The angle of a uniform rotation has the mean π/2 + 2/π.
    assert turns(torch.eye(4), found).mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.06)


def test_near_negatives(grasp: Tensor, workspace: Workspace) -> None:
    found = drawn(grasp, workspace, Negatives(uniform=0, near=500))
    assert shifts(grasp, found).abs().max() <= 0.01
    assert shifts(grasp, found).abs().max() > 0.009
    assert turns(grasp, found).mean() > 1.5


def test_upright_negatives_keep_the_tilt(grasp: Tensor, workspace: Workspace) -> None:
    found = drawn(grasp, workspace, replace(NONE, upright=500))
    torch.testing.assert_close(found[:, 2, :3], grasp[2, :3].expand(500, 3), atol=1e-5, rtol=0)
    assert (found[:, :3, 3] >= workspace.minimum).all()
    assert (found[:, :3, 3] <= workspace.maximum).all()
    assert turns(grasp, found).max() > 2.5


def test_negatives_around_the_grasp_are_turned_about_the_vertical_alone(grasp: Tensor, workspace: Workspace) -> None:
    found = drawn(grasp, workspace, replace(NONE, around=2000))
    shift = shifts(grasp, found).abs().amax(dim=0)
    torch.testing.assert_close(shift, torch.tensor([0.06, 0.06, 0.02]), atol=1e-3, rtol=0)
    torch.testing.assert_close(found[:, 2, :3], grasp[2, :3].expand(2000, 3), atol=1e-6, rtol=0)
    assert turns(grasp, found).max() > 2.8


def test_perturbed_negatives_are_moved_or_turned_as_far_as_stated(grasp: Tensor, workspace: Workspace) -> None:
    kinds = drawn(grasp, workspace, replace(NONE, perturbed=1600)).unflatten(0, (-1, 8)).transpose(0, 1)
    across, anywhere = kinds[[0, 2]].flatten(0, 1), kinds[[6, 7]].flatten(0, 1)
    about_approach, about_others = kinds[[1, 3]].flatten(0, 1), kinds[[4, 5]].flatten(0, 1)
    for moved, least in ((across, 0.006), (anywhere, 0.012)):
        distance = shifts(grasp, moved).norm(dim=-1)
        assert least - 1e-5 <= distance.min() < 1.1 * least
        assert 0.045 < distance.max() <= 0.05 + 1e-5
        assert turns(grasp, moved).max() < 2e-3
    for turned in (about_approach, about_others):
        angle = turns(grasp, turned)
        assert 0.15 - 1e-3 <= angle.min() < 0.17
        assert 1.4 < angle.max() <= 1.5 + 1e-3
        assert shifts(grasp, turned).abs().max() < 1e-6
    along = shifts(grasp, across) @ grasp[:3, 0]
    torch.testing.assert_close(along.abs(), shifts(grasp, across).norm(dim=-1), atol=1e-6, rtol=0)
    assert 150 < (along > 0).sum() < 250  # either way
    torch.testing.assert_close(about_approach[:, :3, 2], grasp[:3, 2].expand(400, 3), atol=1e-5, rtol=0)


def test_small_perturbations_are_as_likely_as_large_ones(grasp: Tensor, workspace: Workspace) -> None:
    found = drawn(grasp, workspace, replace(NONE, perturbed=1600))[::8]
    middle = (0.006 * 0.05) ** 0.5
    assert 70 < (shifts(grasp, found).norm(dim=-1) < middle).sum() < 130


def test_negatives_that_cut_the_table_do_nothing_else(grasp: Tensor, workspace: Workspace) -> None:
    raised = Workspace(workspace.minimum + torch.tensor([0.0, 0.0, 0.03]), workspace.maximum)
    found = drawn(grasp, raised, replace(NONE, cut=400, most_tilt=0.6, most_cut=0.01))
    depth = 0.03 - ROBOTIQ_2F85.lowest(found)
    assert 0 <= depth.min() < 2e-4
    assert 0.0098 < depth.max() <= 0.01 + 1e-6
    assert shifts(grasp, found)[:, :2].abs().max() < 1e-6
    torch.testing.assert_close(found[::2, :3, :3], grasp[:3, :3].expand(200, 3, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(found[:, :3, 0], grasp[:3, 0].expand(400, 3), atol=1e-6, rtol=0)
    assert 0.59 < turns(grasp, found[1::2]).max() < 0.601


def test_other_negatives_are_drawn_as_if_none_cut_the_table(grasp: Tensor, workspace: Workspace) -> None:
    plain, more = (drawn(grasp, workspace, Negatives(3, 4, 5, 6, 7, cut)) for cut in (0, 8))
    assert torch.equal(more[:25], plain)


def test_negatives_are_a_function_of_their_generator(grasp: Tensor, workspace: Workspace) -> None:
    kinds = Negatives(3, 4, 5, 6, 7, 8)
    assert torch.equal(drawn(grasp, workspace, kinds, 1), drawn(grasp, workspace, kinds, 1))
    assert not torch.equal(drawn(grasp, workspace, kinds, 1), drawn(grasp, workspace, kinds, 2))


def test_half_turned(grasp: Tensor) -> None:
    found = half_turned(grasp.expand(200, 4, 4), np.random.default_rng(0))
    same = (found == grasp).all(-1).all(-1)
    turned = torch.isclose(found, grasp @ HALF_TURN, atol=1e-6).all(-1).all(-1)
    assert (same ^ turned).all()
    assert 70 < same.sum() < 130


def test_scenes_without_a_demonstration_are_left_out(packed_set: Path) -> None:
    scenes = PackedScenes(packed_set)
    found = demonstrations(scenes)
    assert sorted(found) == [0, 1, 2]
    assert torch.equal(found[1], scenes.truth(1).demonstration)


def test_a_batch(packed_set: Path) -> None:
    scenes = PackedScenes(packed_set)
    found = grasps(packed_set).draw(np.random.default_rng(3))
    assert sorted(found.scene.tolist()) == [0, 1, 2]
    assert found.view.shape == (3, 2)
    assert found.T_world_grasp.shape == (3, 12, 4, 4)
    assert found.inputs.camera().T_world_camera.shape == (3, 2, 4, 4)
    for b, scene in enumerate(found.scene.tolist()):
        shown = to_float(scenes.images[scene][found.view[b].numpy()])
        assert torch.equal(found.inputs.images[b], shown)
        assert torch.equal(found.inputs.T_world_camera[b], scenes.camera(scene).T_world_camera[found.view[b]])
        demonstrated = scenes.truth(scene).demonstration
        assert demonstrated is not None
        relative = invert(demonstrated) @ found.T_world_grasp[b, 0]
        assert min((relative - same).abs().max() for same in (torch.eye(4), HALF_TURN)) < 1e-5
    again = grasps(packed_set).draw(np.random.default_rng(3))
    torch.testing.assert_close(found, again, rtol=0, atol=0)


def test_views_are_random_or_the_first(packed_set: Path) -> None:
    def views(random: bool) -> Tensor:
        data = grasps(packed_set, random_views=random)
        return torch.cat([data.draw(np.random.default_rng(seed)).view for seed in range(8)])

    assert views(False).tolist() == [[0, 1]] * 24
    assert set(views(True).flatten().tolist()) == set(range(6))
    assert all(a != b for a, b in views(True).tolist())


def test_held_out_negatives_are_the_same_every_time(packed_set: Path) -> None:
    data = grasps(packed_set)
    items: list[GraspBatch] = list(data.val_dataloader())
    assert [item.scene.tolist() for item in items] == [[0], [1], [2]]
    assert all(item.view.tolist() == [[0, 1]] for item in items)
    assert items[0].T_world_grasp.shape == (1, 12, 4, 4)
    for one, other in zip(items, data.val_dataloader(), strict=True):
        assert torch.equal(one.T_world_grasp, other.T_world_grasp)
    assert not torch.equal(items[0].T_world_grasp[0, 1:], items[1].T_world_grasp[0, 1:])


def test_held_out_negatives_do_not_depend_on_the_training_s_seed(packed_set: Path) -> None:
    scenes, kinds = PackedScenes(packed_set), Negatives(uniform=5, near=2, upright=2, perturbed=2)
    generator = np.random.default_rng((0, 1))
    positive = half_turned(demonstrations(scenes)[1][None], generator)
    negatives = draw_negatives(demonstrations(scenes)[1], scenes.workspace, kinds, generator)
    for seed in (0, 7):
        item = list(grasps(packed_set, seed=seed).val_dataloader())[1]
        assert torch.equal(item.T_world_grasp[0], torch.cat([positive, negatives]))


def test_too_few_demonstrations_or_views_are_refused(packed_set: Path) -> None:
    with pytest.raises(UserError, match="4 scenes with a demonstrated grasp are needed at once, the set has 3"):
        grasps(packed_set, scenes_per_step=4)
    with pytest.raises(UserError, match="train: 7 views are needed at once, the set has 6"):
        grasps(packed_set, views=7)
    plain = SceneSet(packed_set, scenes=4, views=6, seed=5)
    with pytest.raises(UserError, match="data.init_args.train: demonstrations is false"):
        GraspData(plain, plain).check()
