"""Image files to tensors."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from nerfgrasp.errors import UserError

IMAGE_SIZE = 192
"""Side in pixels of the simulated scenes' square images, unless another is asked for: what the shipped models know."""


def image_size(path: Path, where: str) -> tuple[int, int]:
    """Returns an image's width and height in pixels, from its head alone.

    Raises:
        UserError: the file is no image. Begins with `where`.
    """
    try:
        with Image.open(path) as file:
            return file.size
    # Pillow's decoders raise many kinds of exception on damaged files.
    except Exception as error:
        raise _unreadable(path, where, error) from error


def read_image(path: Path, where: str) -> Tensor:
    """Reads an 8-bit image as RGB `[3, H, W]` in [0, 1]; transparent pixels are laid on white.

    White because that is the background of the synthetic NeRF scenes, the usual ones with transparency.

    Raises:
        UserError: the file is no image, is truncated, or has more than 8 bits a channel. Begins with `where`.
    """
    try:
        with Image.open(path) as file:
            file.load()
            image = file.copy()
    except Exception as error:
        raise _unreadable(path, where, error) from error
    if image.mode.startswith(("I", "F")):
        raise UserError(f"{where}: the image {path.name} has more than 8 bits a channel: convert it first")
    if image.has_transparency_data:
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image.convert("RGBA"))
    return torch.from_numpy(np.array(image.convert("RGB"))).movedim(-1, 0).contiguous() / 255


def _unreadable(path: Path, where: str, error: Exception) -> UserError:
    return UserError(f"{where}: the image {path.name} cannot be read ({type(error).__name__})")
