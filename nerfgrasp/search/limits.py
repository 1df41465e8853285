"""What a grasp must keep to, whatever its value: the table is not to be met, and the hand comes from above."""

import math
from dataclasses import dataclass

import roma
import torch
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper
from nerfgrasp.scenes.bars import TABLE_CLEARANCE
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.schedule import PoseParameterization

_ROUNDING = 1e-6
"""Metres by which a hand may lack room."""
_HALVINGS = 20
"""Of the range in which a tilt is sought: to less than a thousandth of a degree."""


@dataclass(frozen=True)
class Limits:
    """Moves poses that break a limit to near ones that keep it. The table is the workspace's lower face."""

    max_tilt: float = math.radians(60.0)
    """The most by which the approach may differ from straight down, radians; π for none."""
    clearance: float | None = TABLE_CLEARANCE
    """Metres to keep free between the open gripper and the table; None lets it go anywhere."""
    gripper: Gripper = DEFAULT_GRIPPER
    """Whose shape counts."""

    def __post_init__(self) -> None:
        """Checks the numbers; one out of its range is a UserError."""
        if not 0 <= self.max_tilt <= math.pi:
            raise UserError(f"max_tilt is {self.max_tilt}: it must be from 0 to π radians")
        if self.clearance is not None and not 0 <= self.clearance < math.inf:
            raise UserError(f"clearance is {self.clearance}: it must be 0 metres or more")

    def check_room(self, workspace: Workspace) -> None:
        """Checks that the workspace has room above the clearance; too low a one is a UserError."""
        at_the_top = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), workspace.maximum.detach().cpu())
        room = float(self.gripper.lowest(at_the_top)) - float(workspace.minimum[2])
        if self.clearance is not None and self.clearance > room:
            at_most = f"{room:.4f} m at most" if room > 0 else "none"
            raise UserError(f"clearance is {self.clearance} m: the workspace's height leaves room for {at_most}")

    def enforce(self, T_world_grasp: Tensor, workspace: Workspace) -> Tensor:
        """Returns grasps `[..., 4, 4]`, turned no more than it takes and then lifted no more than it takes.

        Where the workspace is too shallow to lift a tilted hand clear of the table, it is turned further, until it can
        be; `check_room` tells whether it ever can.
        """
        turned = _turned(T_world_grasp, self.max_tilt)
        upright = torch.where(self._too_tilted(T_world_grasp)[..., None, None], turned, T_world_grasp).clone()
        if self.clearance is None:
            return upright
        cramped = self._lack(upright, workspace, workspace.maximum[2].to(upright)) > _ROUNDING
        if bool(cramped.any()):
            upright[cramped] = self._fitted(upright[cramped], workspace)
        upright[..., 2, 3] += self._lack(upright, workspace).clamp(min=0.0)
        return upright

    def project(self, pose: PoseParameterization, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        """Returns the parameters of the poses that keep the limits; what need not change stays as it is."""
        before = pose.decode(params)
        after = self.enforce(before, workspace)
        turned = (after != before)[..., :3, :3].flatten(-2).any(dim=-1, keepdim=True)
        moved = (after != before).flatten(-2).any(dim=-1, keepdim=True)
        # Parameters are not unique: encoded anew, an orientation that stays may come out as another one.
        changed = {"position": moved, "orientation": turned}
        encoded = pose.encode(after)
        return {group: torch.where(changed.get(group, moved), encoded[group], params[group]) for group in params}

    def _too_tilted(self, T_world_grasp: Tensor) -> Tensor:
        return -T_world_grasp[..., 2, 2] < math.cos(self.max_tilt) - 1e-6

    def _lack(self, T_world_grasp: Tensor, workspace: Workspace, height: Tensor | None = None) -> Tensor:
        """Returns how much too low `[...]` grasps are for the clearance, or would be at another height."""
        least = workspace.minimum[2].to(T_world_grasp) + (self.clearance or 0.0)
        lacking = least - self.gripper.lowest(T_world_grasp)
        return lacking if height is None else lacking + T_world_grasp[..., 2, 3] - height

    def _fitted(self, T_world_grasp: Tensor, workspace: Workspace) -> Tensor:
        """Returns grasps `[N, 4, 4]` turned down until there is room for them under the workspace's top: bisection."""
        fits = torch.zeros_like(T_world_grasp[..., 0, 0])
        too_much = _tilt(T_world_grasp)
        for _ in range(_HALVINGS):
            middle = (fits + too_much) / 2
            lacks = self._lack(_turned(T_world_grasp, middle), workspace, workspace.maximum[2].to(middle)) > 0
            fits, too_much = torch.where(lacks, fits, middle), torch.where(lacks, middle, too_much)
        return _turned(T_world_grasp, fits)


def _tilt(T_world_grasp: Tensor) -> Tensor:
    """Returns the angles `[...]` between approaches and straight down, radians."""
    approach = T_world_grasp[..., :3, 2]
    return torch.atan2(approach[..., :2].norm(dim=-1), -approach[..., 2])


def _turned(T_world_grasp: Tensor, tilt: Tensor | float) -> Tensor:
    """Returns grasps whose approach differs from straight down by no more than `tilt`, turned about the horizontal."""
    approach = T_world_grasp[..., :3, 2]
    # approach × down; straight up, any horizontal axis will do.
    axis = torch.stack([-approach[..., 1], approach[..., 0], torch.zeros_like(approach[..., 0])], dim=-1)
    length = axis.norm(dim=-1, keepdim=True)
    unit = torch.where(length > 1e-6, axis / length.clamp(min=1e-6), torch.tensor([1.0, 0.0, 0.0]).to(axis))
    turn = roma.rotvec_to_rotmat(unit * (_tilt(T_world_grasp) - tilt).clamp(min=0.0)[..., None])
    return make_pose(turn @ T_world_grasp[..., :3, :3], T_world_grasp[..., :3, 3])
