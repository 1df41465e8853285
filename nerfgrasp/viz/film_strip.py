"""The stages of a grasp attempt, side by side."""

import math
from collections.abc import Sequence

import torch
from PIL import Image
from torch import Tensor

from nerfgrasp.geometry import Camera, look_at
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.film import Frame
from nerfgrasp.sim.rendering import render_scene
from nerfgrasp.viz.contact_sheet import Section

SIDE = 200
"""Pixels of an image."""
_OVERSAMPLE = 2
"""Images are rendered so many times larger and shrunk, which smooths their edges."""
_LENS = 1.4
"""Of the close-up: the focal length in image widths."""
CAPTIONS = {
    "refused": "refused: it would cut the table",
    "pregrasp": "75 mm back",
    "grasp": "at the grasp",
    "collision": "pressing: the attempt ends",
    "closed": "closed",
    "lifted": "lifted",
    "held": "1 s later",
    "after": "what remains",
    "untouched": "nothing is tried",
}
"""By the stage that has just been done."""


def film_strip(heading: str, frames: Sequence[Frame], camera: Camera) -> Section:
    """Returns an attempt's frames, one image each, as a camera of `square_camera` sees them."""
    images = tuple(square_image(frame.truth, camera) for frame in frames)
    return Section(heading, images, tuple(CAPTIONS[frame.stage] for frame in frames))


def close_up(T_world_grasp: Tensor) -> Camera:
    """Returns a camera `[1]` that looks at a grasp across its closing axis, from outside: less is in the way."""
    T = T_world_grasp.float()
    level = T[:2, 1].norm()
    across = T[:2, 1] / level if level > 0 else torch.tensor([1.0, 0.0])
    across = across if across @ T[:2, 3] > 0 else -across
    turn = math.radians(20.0)
    sideways = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ across
    target = torch.tensor([*T[:2, 3].tolist(), 0.1])
    eye = target + 0.6 * torch.tensor([*(math.cos(0.5) * sideways).tolist(), math.sin(0.5)])
    return square_camera(look_at(eye, target)[None], _LENS)


def square_camera(T_world_camera: Tensor, lens: float) -> Camera:
    """Returns a camera `[1]` at poses `[1, 4, 4]` with a focal length in image widths, for `square_image`."""
    side = _OVERSAMPLE * SIDE
    intrinsics = torch.tensor([[lens * side, 0.0, side / 2], [0.0, lens * side, side / 2], [0.0, 0.0, 1.0]])
    return Camera(intrinsics[None], T_world_camera, side, side)


def square_image(truth: Truth, camera: Camera) -> Image.Image:
    """Returns a scene as a camera of `square_camera` sees it, `SIDE` pixels wide and high."""
    images, _ = render_scene(truth, camera)
    return Image.fromarray(images[0]).resize((SIDE, SIDE), Image.Resampling.LANCZOS)
