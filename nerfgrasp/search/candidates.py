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


def scatter(
    T_world_grasp: Tensor, copies: int, distance: float, angle: float, workspace: Workspace, generator: torch.Generator
) -> Tensor:
    """Surrounds poses by copies that are moved and turned at random.

    Args:
        T_world_grasp: `[N, 4, 4]`.
        copies: how many of each pose, C.
        distance: standard deviation of each coordinate's shift, metres.
        angle: standard deviation of the turn about a random axis, radians.
        workspace: into which positions are clipped.
        generator: the only source of randomness.

    Returns:
        `[N + N C, 4, 4]`: the poses themselves, then their copies.
    """
    shape = (copies, len(T_world_grasp), 3)
    drawn = [torch.randn(shape, generator=generator, device=generator.device).to(T_world_grasp) for _ in range(2)]
    turn = torch.randn(shape[:2], generator=generator, device=generator.device).to(T_world_grasp)[..., None] * angle
    rotation = roma.rotvec_to_rotmat(torch.nn.functional.normalize(drawn[1], dim=-1) * turn)
    position = (T_world_grasp[:, :3, 3] + distance * drawn[0]).clamp(workspace.minimum, workspace.maximum)
    return torch.cat([T_world_grasp, make_pose(T_world_grasp[:, :3, :3] @ rotation, position).flatten(0, 1)])
