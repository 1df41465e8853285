"""Images cut to what matters and brought to one size, their intrinsics with them."""

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from nerfgrasp.geometry.cameras import Camera, project

_NEAR = 0.05
"""Metres in front of a camera within which a point's projection says little."""


def crop_to_box(images: Tensor, camera: Camera, minimum: Tensor, maximum: Tensor, size: int) -> tuple[Tensor, Camera]:
    """Cuts from each image the smallest square of whole pixels that shows a box, and resamples it to one size.

    Pixels of the square that lie outside of the image repeat its border. An image is kept whole where the box
    reaches behind its camera.

    Args:
        images: `[N, C, H, W]`.
        camera: batch shape `[N]`.
        minimum: the box's lower corner, `[3]` or `[N, 3]`, metres, world frame.
        maximum: its upper corner.
        size: side of the results in pixels.

    Returns:
        Images `[N, C, size, size]` (antialiased bilinear) and their cameras, exactly those of the resampled pixels.
    """
    low, sides = _squares(camera, minimum, maximum)
    squares = zip(images, low.tolist(), sides.tolist(), strict=True)
    pieces = [_resampled(image, corner, side, size) for image, corner, side in squares]
    scale = (size / sides).to(camera.intrinsics)
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, :2, 2] -= low.to(intrinsics)
    intrinsics[:, :2] *= scale[:, None, None]
    return torch.stack(pieces), Camera(intrinsics, camera.T_world_camera, size, size)


def _squares(camera: Camera, minimum: Tensor, maximum: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the upper left corners `[N, 2]` (x, y) and the sides `[N]` of squares, in whole pixels."""
    choose = torch.cartesian_prod(*[torch.arange(2, device=minimum.device)] * 3).bool()
    corners = torch.where(choose, maximum[..., None, :], minimum[..., None, :]).expand(len(camera), 8, 3)
    pixels, depth = project(camera, corners)
    whole = torch.tensor([camera.width, camera.height], device=pixels.device, dtype=pixels.dtype)
    seen = (depth > _NEAR).all(dim=-1)[:, None]
    low = torch.where(seen, pixels.amin(dim=-2), torch.zeros_like(whole)).floor()
    high = torch.where(seen, pixels.amax(dim=-2), whole).ceil()
    sides = (high - low).amax(dim=-1).clamp(1, 2 * max(camera.width, camera.height))
    corner = (low + 0.5 * (high - low - sides[:, None])).floor()
    return corner.long(), sides.long()


def _resampled(image: Tensor, low: list[int], side: int, size: int) -> Tensor:
    height, width = image.shape[-2:]
    reach = torch.arange(side, device=image.device)
    rows, columns = (low[1] + reach).clamp(0, height - 1), (low[0] + reach).clamp(0, width - 1)
    piece = image[:, rows][:, :, columns]
    return interpolate(piece[None], size=(size, size), mode="bilinear", align_corners=False, antialias=True)[0]
