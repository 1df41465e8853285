"""Where a search starts: random grasp poses in the workspace."""

import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace


def random_candidates(count: int, workspace: Workspace, generator: torch.Generator) -> Tensor:
    """Draws grasp poses, positions uniform in the workspace and orientations uniform on SO(3).

    The draws happen on the generator's device, so that one seed gives the same poses wherever the search runs.

    Args:
        count: how many, N.
        workspace: the box of the positions.
        generator: the only source of randomness.

    Returns:
        `T_world_grasp` `[N, 4, 4]` on the workspace's device, metres.
    """
    device = workspace.minimum.device
    unit = torch.rand(count, 3, generator=generator, device=generator.device).to(device)
    rotation = roma.random_rotmat(count, generator=generator, device=generator.device).to(device)
    return make_pose(rotation, workspace.minimum + unit * (workspace.maximum - workspace.minimum))
