"""A gripper's outline as lines, and drawn over an image."""

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from nerfgrasp.geometry import Camera, project, transform
from nerfgrasp.grippers import Gripper

OUTLINE, BODY, CENTRE = (20, 20, 24), (255, 255, 255), (255, 106, 19)
"""Colours, RGB."""
_NEAR = 0.02
"""Minimum distance from the camera at which anything is drawn, metres."""


def gripper_strip(T_world_grasp: Tensor, gripper: Gripper) -> Tensor:
    """Returns a gripper's outline `[..., 7, 3]` at grasps `[..., 4, 4]`: one polyline in metres in the world frame."""
    return transform(T_world_grasp, gripper.outline().to(T_world_grasp))


def gripper_lines(T_world_grasp: Tensor, gripper: Gripper) -> Tensor:
    """Returns the line segments `[..., 6, 2, 3]` of a gripper's outline, as `gripper_strip`."""
    points = gripper_strip(T_world_grasp, gripper)
    return torch.stack([points[..., :-1, :], points[..., 1:, :]], dim=-2)


def draw_gripper(
    image: Image.Image,
    camera: Camera,
    T_world_grasp: Tensor,
    gripper: Gripper,
    *,
    fingers_only: bool = False,
    oversample: int = 3,
) -> Image.Image:
    """Returns the image with a gripper drawn over it. Lines are as thick as the fingers, so nearer ones are thicker.

    Args:
        image: the background, of any size with the camera's aspect ratio.
        camera: the camera of the image, batch shape `[]`.
        T_world_grasp: where the gripper is, `[4, 4]`.
        gripper: the hand to draw.
        fingers_only: leave palm and stem out.
        oversample: factor by which the drawing is larger before it is scaled down, which smooths edges.
    """
    size = (image.width * oversample, image.height * oversample)
    scale = size[0] / camera.width
    canvas = image.convert("RGB").resize(size, Image.Resampling.BICUBIC)
    lines, thickness = gripper_lines(T_world_grasp, gripper), gripper.fingers.thickness
    pixels, depth = project(camera, (lines[[0, -1]] if fingers_only else lines).flatten(0, 1))
    ends, depth = (pixels * scale).unflatten(0, (-1, 2)), depth.unflatten(0, (-1, 2))
    width = float(camera.intrinsics[0, 0]) * scale * thickness / depth.mean(dim=-1)
    order = [i for i in torch.argsort(depth.mean(dim=-1), descending=True).tolist() if depth[i].min() > _NEAR]
    draw, border = ImageDraw.Draw(canvas), oversample * 1.5
    for extra, colour in ((border, OUTLINE), (0.0, BODY)):
        for i in order:
            _draw_bar(draw, ends[i].tolist(), float(width[i]) + 2 * extra, colour)
    centre, distance = project(camera, T_world_grasp[None, :3, 3])
    if distance > _NEAR:
        radius = 0.6 * float(camera.intrinsics[0, 0]) * scale * thickness / float(distance)
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
