"""Rays and the workspace box."""

import torch
from torch import Tensor


def box_intersection(origins: Tensor, directions: Tensor, minimum: Tensor, maximum: Tensor) -> tuple[Tensor, Tensor]:
    """Intersects rays with an axis-aligned box (slab method).

    Args:
        origins: `[..., 3]` in metres.
        directions: `[..., 3]`, unit.
        minimum: the box's lower corner, broadcastable to `[..., 3]`.
        maximum: its upper corner.

    Returns:
        Distances `near`, `far` `[...]` along each ray in metres, `near >= 0`. A ray that misses has
        `far <= near`.
    """
    safe = torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    to_minimum, to_maximum = (minimum - origins) / safe, (maximum - origins) / safe
    near = torch.minimum(to_minimum, to_maximum).amax(dim=-1)
    far = torch.maximum(to_minimum, to_maximum).amin(dim=-1)
    return near.clamp(min=0.0), far
