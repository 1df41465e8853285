"""`check_pose` accepts valid parameterizations and names the requirement that a broken one violates."""

import pytest
import torch
from nerfgrasp_poses.quaternion import Quaternion
from torch import Tensor

from nerfgrasp.geometry import is_rigid
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.testing import ConformanceError, check_pose, sample_poses


class Unnormalised(Quaternion):
    def decode(self, params: dict[str, Tensor]) -> Tensor:
        x, y, z, w = params["orientation"].unbind(-1)
        rows = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
        rows += [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
        rows += [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
        T = super().decode(params)
        T = T.clone()
        T[..., :3, :3] = torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
        return T


class Detached(Quaternion):
    def decode(self, params: dict[str, Tensor]) -> Tensor:
        return super().decode(params | {"orientation": params["orientation"].detach()})


class Unclipped(Quaternion):
    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        return super().project(params, workspace) | {"position": params["position"]}


class Shrinking(Quaternion):
    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        projected = super().project(params, workspace)
        return projected | {"position": projected["position"] * 0.99}


class InPlace(Quaternion):
    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        projected = super().project(params, workspace)
        params["position"].copy_(projected["position"])
        return projected


class SinglePrecision(Quaternion):
    def encode(self, T: Tensor) -> dict[str, Tensor]:
        return {group: param.float() for group, param in super().encode(T).items()}


class FlatOnly(Quaternion):
    def encode(self, T: Tensor) -> dict[str, Tensor]:
        return super().encode(T.reshape(-1, 4, 4))


class WrongGroups(Quaternion):
    def encode(self, T: Tensor) -> dict[str, Tensor]:
        params = super().encode(T)
        return {"place": params["position"], "orientation": params["orientation"]}


@pytest.mark.parametrize(
    ("broken", "requirement"),
    [
        (Unnormalised, "decode gives rigid transforms"),
        (Detached, "gradients disagree with finite differences"),
        (Unclipped, "project ends in the workspace"),
        (Shrinking, "project leaves valid poses alone"),
        (InPlace, "project leaves its input alone"),
        (SinglePrecision, "float32"),
        (FlatOnly, "batch shape"),
        (WrongGroups, "groups are"),
    ],
)
def test_check_pose_names_the_violated_requirement(broken: type, requirement: str) -> None:
    with pytest.raises(ConformanceError, match=requirement):
        check_pose(broken)


def test_sample_poses_hold_the_hard_rotations() -> None:
    poses = sample_poses(torch.float64)
    assert bool(is_rigid(poses, tolerance=1e-9).all())
    traces = poses[:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1)
    assert bool((traces == 3).any())
    assert bool(((traces + 1).abs() < 1e-12).any())
