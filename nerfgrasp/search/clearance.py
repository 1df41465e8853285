"""Keeping the gripper off the table, whose height is known."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfgrasp.scenes.bars import TABLE_CLEARANCE
from nerfgrasp.scenes.gripper import ROBOTIQ_2F85, Gripper
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.schedule import PoseParameterization


@dataclass(frozen=True)
class TableClearance:
    """Lifts poses at which the open gripper would come too near to the table, the workspace's lower face."""

    gripper: Gripper = ROBOTIQ_2F85
    """Whose shape counts."""
    metres: float = TABLE_CLEARANCE
    """To keep free below it."""

    def lifted(self, T_world_grasp: Tensor, workspace: Workspace) -> Tensor:
        """Returns grasps `[..., 4, 4]`, those too low moved straight up until they are clear."""
        lacking = workspace.minimum[2].to(T_world_grasp) + self.metres - self.gripper.lowest(T_world_grasp)
        raised = T_world_grasp.clone()
        raised[..., 2, 3] += lacking.clamp(min=0.0)
        return raised

    def project(self, pose: PoseParameterization, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        """Returns the parameters of the lifted poses; those of poses that are clear stay as they are."""
        before = pose.decode(params)
        after = self.lifted(before, workspace)
        if "position" in params:
            return {**params, "position": after[..., :3, 3]}
        moved = (after != before).flatten(-2).any(dim=-1, keepdim=True)
        return {group: torch.where(moved, new, params[group]) for group, new in pose.encode(after).items()}
