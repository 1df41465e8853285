"""Where a search starts: random grasp poses in the workspace."""

import math

import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace


def random_candidates(
    count: int, workspace: Workspace, generator: torch.Generator, max_tilt: float = math.pi
) -> Tensor:
    """Draws grasp poses, positions uniform in the workspace and orientations uniform on SO(3) up to a tilt.

    The draws happen on the generator's device, so that one seed gives the same poses wherever the search runs.

    Args:
        count: how many, N.
        workspace: the box of the positions.
        generator: the only source of randomness.
        max_tilt: the most by which the approach differs from straight down, radians; π is all of SO(3).

    Returns:
        `T_world_grasp` `[N, 4, 4]` on the workspace's device, metres.
    """
    device = workspace.minimum.device
    unit = torch.rand(count, 6, generator=generator, device=generator.device).to(device)
    # Of a uniform rotation, the angle about the vertical, the cosine of the tilt and the spin are each uniform.
    tilt = torch.arccos(1.0 - unit[:, 3] * (1.0 - math.cos(max_tilt)))
    angles = torch.stack([2 * math.pi * unit[:, 4], math.pi - tilt, 2 * math.pi * unit[:, 5]], dim=-1)
    rotation = roma.euler_to_rotmat("ZYZ", angles)
    return make_pose(rotation, workspace.minimum + unit[:, :3] * (workspace.maximum - workspace.minimum))


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
