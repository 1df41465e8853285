"""Where a search starts: random grasp poses in the workspace, and copies around them."""

import math
from collections.abc import Callable, Sequence

import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.schedule import Round

Judge = Callable[[Tensor, Tensor], Tensor]
"""Maps `T_world_grasp` `[P, 4, 4]` and a floor of each, `[P]`, to values `[P]`. What a value that lies at or below its
floor is does not matter, as long as it lies there."""


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
        `[C, N, 4, 4]`.
    """
    shape = (copies, len(T_world_grasp), 3)
    drawn = [torch.randn(shape, generator=generator, device=generator.device).to(T_world_grasp) for _ in range(2)]
    turn = torch.randn(shape[:2], generator=generator, device=generator.device).to(T_world_grasp)[..., None] * angle
    rotation = roma.rotvec_to_rotmat(torch.nn.functional.normalize(drawn[1], dim=-1) * turn)
    position = (T_world_grasp[:, :3, 3] + distance * drawn[0]).clamp(workspace.minimum, workspace.maximum)
    return make_pose(T_world_grasp[:, :3, :3] @ rotation, position)


@torch.no_grad()
def resample(
    judge: Judge,
    T_world_grasp: Tensor,
    value: Tensor,
    rounds: Sequence[Round],
    workspace: Workspace,
    generator: torch.Generator,
    limits: Limits | None = None,
) -> tuple[Tensor, Tensor]:
    """Lets poses give way to better ones nearby.

    In each round every pose is surrounded by copies, and the best of them takes its place if it is better; another's
    copies never do. So poses stay on as many objects as they were.

    Args:
        judge: what is to rise. The floor that it is given is the value of the pose that a copy surrounds.
        T_world_grasp: `[N, 4, 4]`.
        value: `[N]`, of those; none is NaN.
        rounds: how many copies, and how far away.
        workspace: into which positions are clipped.
        generator: the only source of randomness.
        limits: what copies keep to; None for the workspace alone.

    Returns:
        The poses and values that are left, in the same order.
    """
    for one in rounds:
        copies = scatter(T_world_grasp, one.copies, one.distance, one.angle, workspace, generator).flatten(0, 1)
        if limits is not None:
            copies = limits.enforce(copies, workspace)
        found = judge(copies, value.repeat(one.copies)).nan_to_num(nan=-torch.inf)
        poses = torch.cat([T_world_grasp, copies]).unflatten(0, (-1, len(value)))
        values, best = torch.cat([value, found]).unflatten(0, (-1, len(value))).max(dim=0)
        T_world_grasp, value = poses[best, torch.arange(len(value), device=value.device)], values
    return T_world_grasp, value
