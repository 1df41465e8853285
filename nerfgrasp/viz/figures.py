"""The picture of a result: the images that the model saw, those that it renders, and the grasp in both."""

from collections.abc import Sequence
from dataclasses import dataclass

from PIL import Image, ImageDraw
from torch import Tensor

from nerfgrasp.geometry import Camera
from nerfgrasp.grippers import Gripper
from nerfgrasp.scenes.scene import Grasps, Observations
from nerfgrasp.viz.contact_sheet import CAPTION, FAINT, INK, MARGIN, PAPER, captioned, font, stack
from nerfgrasp.viz.gripper import draw_gripper

PANEL_WIDTH = 384


@dataclass(frozen=True)
class Panel:
    """One image with its caption and the camera that took it."""

    title: str
    """The caption."""
    image: Tensor
    """`[H, W, 3]`, RGB in [0, 1]."""
    camera: Camera
    """Batch shape `[]`, of the image's size."""
    fingers_only: bool = False
    """Whether only the gripper's fingers are drawn, because palm and stem would hide the object."""


def picture(
    observations: Observations,
    grasps: Grasps,
    gripper: Gripper,
    imagined: Sequence[Sequence[Panel]] = (),
    facts: Sequence[str] = (),
) -> Image.Image:
    """Draws the best grasp over the input views (top row) and over imagined ones (the rows below).

    Args:
        observations: the views that the search used.
        grasps: best first; only the first is drawn.
        gripper: the hand to draw.
        imagined: rows of further images, see `nerfgrasp.viz.imagination`.
        facts: lines of text at the end of the last row, the first one larger.
    """
    images = observations.images.permute(0, 2, 3, 1)
    views = [Panel(f"input view {i + 1}", images[i], observations.camera[i]) for i in range(len(observations))]
    best = grasps.T_world_grasp[0].detach().cpu()
    rows = [[_render_panel(panel, best, gripper) for panel in row] for row in (views, *imagined)]
    if facts:
        rows[-1].append(_render_facts(facts, rows[-1][0].height))
    return stack(rows)


def to_image(rgb: Tensor) -> Image.Image:
    """Converts RGB `[H, W, 3]` in [0, 1] to an image of 8 bits a channel."""
    return Image.fromarray((rgb.detach().clamp(0.0, 1.0) * 255).round().byte().cpu().numpy())


def at_width(rgb: Tensor, width: int) -> Image.Image:
    """Converts RGB `[H, W, 3]` in [0, 1] to an image of that width."""
    height = max(1, round(width * rgb.shape[0] / rgb.shape[1]))
    return to_image(rgb).resize((width, height), Image.Resampling.BICUBIC)


def _render_panel(panel: Panel, T_world_grasp: Tensor, gripper: Gripper) -> Image.Image:
    image, camera = at_width(panel.image, PANEL_WIDTH), panel.camera.to("cpu")
    drawn = draw_gripper(image, camera, T_world_grasp, gripper, fingers_only=panel.fingers_only)
    return captioned(drawn, panel.title)


def _render_facts(facts: Sequence[str], height: int) -> Image.Image:
    canvas = Image.new("RGB", (PANEL_WIDTH, height), PAPER)
    draw = ImageDraw.Draw(canvas)
    draw.text((MARGIN, CAPTION + 24), facts[0], fill=INK, font=font(24), anchor="ls")
    for line, fact in enumerate(facts[1:]):
        draw.text((MARGIN, CAPTION + 60 + 26 * line), fact, fill=FAINT, font=font(17), anchor="ls")
    return canvas
