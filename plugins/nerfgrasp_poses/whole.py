"""Whole transforms as one group of parameters: position and orientation move together."""

import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp_poses.decoupled import clip


class Transform:
    """`pose` `[..., 16]` is a 4×4 matrix, row after row, whose 3×3 part stands for the rotation nearest to it.

    Its last row counts for nothing.

    Example:
        >>> Transform().encode(torch.eye(4))["pose"].shape
        torch.Size([16])
    """

    def encode(self, T: Tensor) -> dict[str, Tensor]:
        """Returns the parameters of rigid transforms `T` `[..., 4, 4]`."""
        return {"pose": T.flatten(-2)}

    def decode(self, params: dict[str, Tensor]) -> Tensor:
        """Returns the transforms `[..., 4, 4]` nearest to any matrices."""
        matrix = params["pose"].unflatten(-1, (4, 4))
        return make_pose(roma.special_procrustes(matrix[..., :3, :3]), matrix[..., :3, 3])

    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        """Returns the parameters of those transforms, their positions clipped to `workspace`."""
        return self.encode(_clipped(self.decode(params), workspace))


class Screw:
    """`pose` `[..., 6]` is a twist (ω in radians, v in metres): the transform is the exponential of its matrix.

    A turn about an axis and a slide along it. Where the axis lies far from the origin, a small change of ω moves the
    position by much: that is what coupling means.

    Source: Lynch and Park, "Modern Robotics", section 3.3.3.

    Example:
        >>> Screw().encode(torch.eye(4))["pose"].tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """

    def encode(self, T: Tensor) -> dict[str, Tensor]:
        """Returns the twists of rigid transforms `T` `[..., 4, 4]` whose angle is at most π."""
        turn = roma.rotmat_to_rotvec(T[..., :3, :3])
        slide = torch.linalg.solve(_slide_to_position(turn), T[..., :3, 3:])[..., 0]
        return {"pose": torch.cat([turn, slide], dim=-1)}

    def decode(self, params: dict[str, Tensor]) -> Tensor:
        """Returns the transforms `[..., 4, 4]` of any twists."""
        turn, slide = params["pose"].split(3, dim=-1)
        position = (_slide_to_position(turn) @ slide[..., None])[..., 0]
        return make_pose(roma.rotvec_to_rotmat(turn), position)

    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        """Returns the twists, of at most half a turn, of the transforms with positions clipped to `workspace`."""
        return self.encode(_clipped(self.decode(params), workspace))


def _slide_to_position(turn: Tensor) -> Tensor:
    """Returns `[..., 3, 3]`, which maps a twist's slide to its transform's position.

    It is ∫₀¹ exp(s [ω]) ds, and stands in the corner of the exponential of [ω] bordered by ones.
    """
    bordered = turn.new_zeros(*turn.shape[:-1], 6, 6)
    x, y, z = turn.unbind(dim=-1)
    o = torch.zeros_like(x)
    cross = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))
    bordered[..., :3, :3] = cross
    bordered[..., :3, 3:] = torch.eye(3, dtype=turn.dtype, device=turn.device)
    return torch.linalg.matrix_exp(bordered)[..., :3, 3:]


def _clipped(T: Tensor, workspace: Workspace) -> Tensor:
    return make_pose(T[..., :3, :3], clip(T[..., :3, 3], workspace))
