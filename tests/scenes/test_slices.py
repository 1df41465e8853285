import math

import pytest
import roma
import torch
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import is_rigid, make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.scenes.slices import SLICES, cut_slice

PLACE = torch.tensor([0.1, 0.05, 0.04])


def grasp(yaw: float = 0.0) -> Tensor:
    """From above, its closing axis turned by `yaw` from world x."""
    turn = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, yaw]))
    return make_pose(turn @ torch.diag(torch.tensor([1.0, -1.0, -1.0])), PLACE)


def test_a_slice_of_the_worlds_translations_spans_the_workspace(workspace: Workspace) -> None:
    cut = cut_slice(grasp(0.3), "tx-tz", workspace, size=5, axes="world")
    assert (cut.name, cut.kind) == ("tx-tz", "translation")
    assert cut.inside.all()
    x, y, z = cut.T_world_grasp[..., :3, 3].unbind(-1)
    assert torch.allclose(x, torch.linspace(-0.25, 0.25, 5).expand(5, 5), atol=1e-6)
    assert torch.allclose(y, PLACE[1])
    assert torch.allclose(z, torch.linspace(0.0, 0.2, 5)[:, None].expand(5, 5), atol=1e-6)
    assert torch.allclose(cut.T_world_grasp[..., :3, :3], grasp(0.3)[:3, :3])


def test_a_grasps_own_axes_are_displaced_along_and_cut_at_the_walls(workspace: Workspace) -> None:
    cut = cut_slice(grasp(math.pi / 2), "tx-tz", workspace, size=5)  # x is the world's y, z is down
    assert cut.across.low == pytest.approx(-0.25, abs=1e-6)
    assert cut.across.high == pytest.approx(0.25, abs=1e-6)
    assert cut.upward.low == pytest.approx(-0.16, abs=1e-6)
    assert cut.upward.high == pytest.approx(0.04, abs=1e-6)
    assert torch.allclose(cut.T_world_grasp[0, 0, :3, 3], torch.tensor([0.1, -0.2, 0.2]), atol=1e-6)
    assert cut.inside.all()


def test_a_slanting_plane_just_holds_the_workspace(workspace: Workspace) -> None:
    cut = cut_slice(grasp(0.5), "tx-ty", workspace, size=41)
    assert 0.4 < cut.inside.float().mean() < 0.9
    for side in (cut.inside[0], cut.inside[-1], cut.inside[:, 0], cut.inside[:, -1]):
        assert side.sum() <= 1  # at most the corner
    for side in (cut.inside[2], cut.inside[-3], cut.inside[:, 2], cut.inside[:, -3]):
        assert side.any()


def test_reach_bounds_translations(workspace: Workspace) -> None:
    cut = cut_slice(grasp(0.5), "ty-rz", workspace, size=3, reach=0.05)
    assert (cut.across.low, cut.across.high) == (-0.05, 0.05)
    assert (cut.upward.low, cut.upward.high) == pytest.approx((-math.pi / 2, math.pi / 2))


@pytest.mark.parametrize("axes", ["grasp", "world"])
def test_a_turn_is_about_an_axis_through_the_grasp(workspace: Workspace, axes: str) -> None:
    T = grasp(0.4)
    cut = cut_slice(T, "rx-rz", workspace, size=3, axes=axes, turn=0.6)
    assert (cut.name, cut.kind) == ("rx-rz", "rotation")
    assert torch.allclose(cut.T_world_grasp[..., :3, 3], PLACE)
    assert torch.allclose(cut.T_world_grasp[1, 1], T, atol=1e-6)
    turn = roma.rotvec_to_rotmat(torch.tensor([0.6, 0.0, 0.0]))
    expected = T[:3, :3] @ turn if axes == "grasp" else turn @ T[:3, :3]
    assert torch.allclose(cut.T_world_grasp[1, 2, :3, :3], expected, atol=1e-6)


@pytest.mark.parametrize("name", SLICES)
def test_every_slice_goes_through_the_grasp(workspace: Workspace, name: str) -> None:
    cut = cut_slice(grasp(0.7), name, workspace, size=4)
    assert is_rigid(cut.T_world_grasp).all()
    for axis in (cut.across, cut.upward):
        assert axis.low < 0 < axis.high
    assert cut.kind in ("translation", "rotation", "mixed")


@pytest.mark.parametrize("name", ["tx", "tx-tx", "tx-ty-tz", "tx-qx", ""])
def test_an_unknown_slice_lists_those_there_are(workspace: Workspace, name: str) -> None:
    with pytest.raises(UserError, match=r"unknown slice.*tx-ty"):
        cut_slice(grasp(), name, workspace, size=3)
