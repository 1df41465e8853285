"""The valid grasps of a scene of prisms, and how far any grasp is from them. Pure geometry.

A valid grasp has its tool centre point (TCP) on one of the scene's rectangles, closes along that rectangle's axis
(either way: a parallel gripper is symmetric under a half turn) and approaches within 45° of straight down.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import roma
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper
from nerfgrasp.scenes.objects import SceneObject
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.stances import MAX_TILT, stances

TRANSLATION_SCALE, ROTATION_SCALE = 0.05, math.radians(45.0)
"""What counts as one unit of error: 50 mm and 45°."""
_CHUNK = 20_000


@dataclass(frozen=True)
class ValidGrasps:
    """`G` rectangles of TCPs, in the world frame: corner + a edge_u + b edge_v with a, b in [0, 1]."""

    corner: Tensor
    """`[G, 3]`, metres."""
    edge_u: Tensor
    """`[G, 3]`, metres, horizontal, across the approach; zero for an upright cylinder."""
    edge_v: Tensor
    """`[G, 3]`, metres, against the approach that is nearest to straight down."""
    closing: Tensor
    """`[G, 3]`, unit: the closing axis, up to its sign."""
    free_yaw: Tensor
    """Bool `[G]`: every horizontal closing axis is valid."""
    object: Tensor
    """`[G]`, long: the number of the object that is grasped."""

    def __len__(self) -> int:
        return self.corner.shape[0]


def valid_grasps(objects: Sequence[SceneObject], gripper: Gripper = DEFAULT_GRIPPER) -> ValidGrasps:
    """Returns the valid grasps of the prisms among `objects`, in whatever poses they rest in.

    Each prism is looked at alone, above the table z = 0: that another object may be in the gripper's way is for
    physics to find out. Meshes have none here. A tipped cylinder's closing axes around its own stand every 5°, so
    rotation errors to it are up to 2.5° too large.
    """
    found = [
        (number, stance)
        for number, thing in enumerate(objects)
        if isinstance(thing, Prism)
        for stance in stances(thing, gripper.fingers)
    ]
    rows = [[[*s.corner], [*s.edge_u], [*s.edge_v], [*s.closing]] for _, s in found]
    corner, edge_u, edge_v, closing = torch.tensor(rows, dtype=torch.float32).reshape(-1, 4, 3).unbind(1)
    free_yaw = torch.tensor([stance.free_yaw for _, stance in found], dtype=torch.bool)
    numbers = torch.tensor([number for number, _ in found], dtype=torch.long)
    return ValidGrasps(corner, edge_u, edge_v, closing, free_yaw, numbers)


def grasp_errors(T_world_grasp: Tensor, valid: ValidGrasps) -> tuple[Tensor, Tensor]:
    """Returns the errors to the nearest valid grasp: the one of the smallest d / 50 mm + θ / 45°.

    Args:
        T_world_grasp: `[..., 4, 4]`.
        valid: of the same scene.

    Returns:
        Translation errors `[...]` in metres and rotation errors `[...]` in radians (the geodesic angle to the
        nearest valid rotation); infinite where the scene has no valid grasp.
    """
    batch = T_world_grasp.shape[:-2]
    if len(valid) == 0:
        infinite = T_world_grasp.new_full(batch, torch.inf)
        return infinite, infinite.clone()
    chunks = T_world_grasp.reshape(-1, 4, 4).split(_CHUNK)
    pairs = [_nearest_errors(chunk, valid) for chunk in chunks]
    translation, rotation = (torch.cat(errors) for errors in zip(*pairs, strict=True))
    return translation.reshape(batch), rotation.reshape(batch)


def negative_grasp_error(T_world_grasp: Tensor, valid: ValidGrasps) -> Tensor:
    """Returns -½ (d / 50 mm + θ / 45°) `[...]` of grasps `[..., 4, 4]`: 0 is a valid grasp."""
    translation, rotation = grasp_errors(T_world_grasp, valid)
    return -0.5 * (translation / TRANSLATION_SCALE + rotation / ROTATION_SCALE)


def sample_top_down(valid: ValidGrasps, generator: torch.Generator | None = None) -> Tensor:
    """Returns `T_world_grasp` `[4, 4]` of a random valid grasp from above, as near to straight down as it can be.

    The object is drawn first, then one of its rectangles, then the point and the closing axis's sign. A scene
    without a valid grasp is a ValueError.
    """
    if len(valid) == 0:
        raise ValueError("the scene has no valid grasp")
    objects = valid.object.unique()
    mine = (valid.object == objects[_below(len(objects), generator)]).nonzero()[:, 0]
    g = mine[_below(len(mine), generator)]
    a, b, yaw, sign = torch.rand(4, generator=generator).tolist()
    position = valid.corner[g] + a * valid.edge_u[g] + b * valid.edge_v[g]
    turned = torch.tensor([math.cos(2 * math.pi * yaw), math.sin(2 * math.pi * yaw), 0.0])
    closing = turned if valid.free_yaw[g] else valid.closing[g] * (1.0 if sign < 0.5 else -1.0)
    return make_pose(_downward_rotation(closing), position)


def _below(count: int, generator: torch.Generator | None) -> int:
    return int(torch.randint(count, (), generator=generator))


def _downward_rotation(closing: Tensor) -> Tensor:
    """Returns the rotations `[..., 3, 3]` with x on the closing axes `[..., 3]` and z as near to down as can be."""
    down = torch.tensor([0.0, 0.0, -1.0], dtype=closing.dtype, device=closing.device)
    z = normalize(down - (closing @ down)[..., None] * closing, dim=-1)
    return torch.stack([closing, torch.linalg.cross(z, closing), z], dim=-1)


def _nearest_errors(T: Tensor, valid: ValidGrasps) -> tuple[Tensor, Tensor]:
    # Rectangles of one slab share their closing axis: its rotation errors are found once.
    axes, which = torch.cat([valid.closing, valid.free_yaw[:, None]], dim=1).unique(dim=0, return_inverse=True)
    rotation = _rotations(T[:, :3, :3], axes[:, :3], axes[:, 3] > 0)[:, which.to(T.device)]
    translation = _translations(T[:, :3, 3], valid)
    nearest = (translation / TRANSLATION_SCALE + rotation / ROTATION_SCALE).argmin(dim=1, keepdim=True)
    return translation.gather(1, nearest)[:, 0], rotation.gather(1, nearest)[:, 0]


def _translations(points: Tensor, valid: ValidGrasps) -> Tensor:
    """Returns the distances `[N, G]` of points `[N, 3]` from the rectangles."""
    offset = points[:, None] - valid.corner.to(points)
    for edge in (valid.edge_u.to(points), valid.edge_v.to(points)):
        length = (edge * edge).sum(-1).clamp(min=1e-12)
        offset = offset - ((offset * edge).sum(-1) / length).clamp(0.0, 1.0)[..., None] * edge
    return offset.norm(dim=-1)


def _rotations(rotation: Tensor, closing: Tensor, free_yaw: Tensor) -> Tensor:
    """Returns the geodesic angles `[N, C]` from rotations `[N, 3, 3]` to the nearest that close along axes `[C, 3]`.

    Valid are R0 Rx(φ) with R0 = [c, z0 × c, z0], z0 as near to down as c allows, |φ| ≤ φmax, and the same with -c.
    With Δ = R0ᵀ R as a quaternion, the twist nearest to it is φ = 2 atan2(x, w), clamped; -c swaps (w, x) for
    (z, y). Free yaw adds any Rz(ψ), maximised in closed form before φ.
    """
    down = _downward_rotation(closing.to(rotation))
    max_twist = torch.acos((math.cos(MAX_TILT) / -down[:, 2, 2]).clamp(max=1.0))
    inverse = roma.quat_conjugation(roma.rotmat_to_unitquat(down))
    relative = roma.quat_product(*torch.broadcast_tensors(inverse, roma.rotmat_to_unitquat(rotation)[:, None]))
    x, y, z, w = relative.unbind(-1)
    plain = torch.minimum(_twist_error(w, x, y, z, max_twist), _twist_error(z, y, x, w, max_twist))
    free = _twist_and_yaw_error(w, x, y, z, max_twist)
    return torch.where(free_yaw.to(rotation.device), free, plain)


def _twist_error(w: Tensor, x: Tensor, y: Tensor, z: Tensor, max_twist: Tensor) -> Tensor:
    """Returns the angle left after the best twist about x of at most `max_twist`."""
    half = torch.atan2(torch.where(w < 0, -x, x), w.abs())
    half = torch.minimum(torch.maximum(half, -max_twist / 2), max_twist / 2)
    cos, sin = half.cos(), half.sin()
    rest = ((x * cos - w * sin) ** 2 + y**2 + z**2).sqrt()
    return 2 * torch.atan2(rest, (w * cos + x * sin).abs())


def _twist_and_yaw_error(w: Tensor, x: Tensor, y: Tensor, z: Tensor, max_twist: Tensor) -> Tensor:
    """Returns the angle left after the best Rz(ψ) Rx(φ), ψ free, |φ| at most `max_twist`."""
    twist = torch.atan2(2 * (w * x + z * y), w**2 + z**2 - x**2 - y**2)
    half = torch.minimum(torch.maximum(twist, -max_twist), max_twist) / 2
    cos, sin = half.cos(), half.sin()
    kept = ((w * cos + x * sin) ** 2 + (z * cos + y * sin) ** 2).sqrt()
    return 2 * torch.atan2(((x * cos - w * sin) ** 2 + (y * cos - z * sin) ** 2).sqrt(), kept)
