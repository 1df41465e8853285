"""A parallel gripper as lines, and drawn over an image."""

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from nerfgrasp.geometry import Camera, project, transform

OPENING = 0.085
"""Metres between the fingers."""
TIP, PALM, STEM = 0.012, -0.045, -0.105
"""Where fingertips, palm and the stem's end lie along the approach axis, metres; the tool centre point is at 0."""
THICKNESS = 0.009
"""Metres, as drawn over an image."""

OUTLINE, BODY, CENTRE = (20, 20, 24), (255, 255, 255), (255, 106, 19)
_NEAR = 0.02


def gripper_strip(T_world_grasp: Tensor) -> Tensor:
    """Returns the gripper as one polyline `[..., 7, 3]` in metres, world frame, of grasps `[..., 4, 4]`.

    From a fingertip over the palm to the stem's end, back to the palm and to the other fingertip.
    """
    half = OPENING / 2
    x = torch.tensor([-half, -half, 0.0, 0.0, 0.0, half, half])
    z = torch.tensor([TIP, PALM, PALM, STEM, PALM, PALM, TIP])
    return transform(T_world_grasp, torch.stack([x, torch.zeros(7), z], dim=-1).to(T_world_grasp))


def gripper_lines(T_world_grasp: Tensor) -> Tensor:
    """Returns the gripper's line segments `[..., 6, 2, 3]` in metres, world frame, of grasps `[..., 4, 4]`."""
    points = gripper_strip(T_world_grasp)
    return torch.stack([points[..., :-1, :], points[..., 1:, :]], dim=-2)


def draw_gripper(
    image: Image.Image, camera: Camera, T_world_grasp: Tensor, *, fingers_only: bool = False, oversample: int = 3
) -> Image.Image:
    """Returns the image with a gripper drawn over it, thicker where it is nearer.

    Args:
        image: any size of the camera's aspect ratio.
        camera: batch shape `[]`.
        T_world_grasp: `[4, 4]`.
        fingers_only: whether palm and stem are left out.
        oversample: the drawing is made this many times larger and shrunk, which smooths its edges.
    """
    size = (image.width * oversample, image.height * oversample)
    scale = size[0] / camera.width
    canvas = image.convert("RGB").resize(size, Image.Resampling.BICUBIC)
    lines = gripper_lines(T_world_grasp)
    pixels, depth = project(camera, (lines[[0, -1]] if fingers_only else lines).flatten(0, 1))
    ends, depth = (pixels * scale).unflatten(0, (-1, 2)), depth.unflatten(0, (-1, 2))
    width = float(camera.intrinsics[0, 0]) * scale * THICKNESS / depth.mean(dim=-1)
    order = [i for i in torch.argsort(depth.mean(dim=-1), descending=True).tolist() if depth[i].min() > _NEAR]
    draw, border = ImageDraw.Draw(canvas), oversample * 1.5
    for extra, colour in ((border, OUTLINE), (0.0, BODY)):
        for i in order:
            _draw_bar(draw, ends[i].tolist(), float(width[i]) + 2 * extra, colour)
    centre, distance = project(camera, T_world_grasp[None, :3, 3])
    if distance > _NEAR:
        radius = 0.6 * float(camera.intrinsics[0, 0]) * scale * THICKNESS / float(distance)
        _draw_dot(draw, (centre[0] * scale).tolist(), radius + border, OUTLINE)
        _draw_dot(draw, (centre[0] * scale).tolist(), radius, CENTRE)
    return canvas.resize(image.size, Image.Resampling.LANCZOS)


def _draw_bar(draw: ImageDraw.ImageDraw, ends: list[list[float]], width: float, colour: tuple[int, int, int]) -> None:
    draw.line([(x, y) for x, y in ends], fill=colour, width=max(1, round(width)))
    for end in ends:
        _draw_dot(draw, end, width / 2, colour)


def _draw_dot(draw: ImageDraw.ImageDraw, centre: list[float], radius: float, colour: tuple[int, int, int]) -> None:
    x, y = centre
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
