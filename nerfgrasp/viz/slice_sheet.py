"""Slices through a grasp on one sheet: the truth above, what models make of it below (the paper's figure 4)."""

import math
from collections.abc import Mapping, Sequence

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from nerfgrasp.geometry import Camera, project
from nerfgrasp.grippers import Gripper
from nerfgrasp.scenes.scene import Observations
from nerfgrasp.scenes.slices import Coordinate, Slice
from nerfgrasp.viz.contact_sheet import Section, contact_sheet
from nerfgrasp.viz.figures import at_width, to_image
from nerfgrasp.viz.gripper import BODY, CENTRE, OUTLINE, draw_gripper
from nerfgrasp.viz.renderings import grey_outside, paint

TILE, VIEW = 160, 256
"""Pixels of a slice and of an input view."""
_LOWEST = 0.02
"""This share of a row's values is drawn darkest."""

Captioned = tuple[Tensor, str]
"""A slice's values `[N, N]`, NaN where there is none, and its caption."""


def slice_sheet(
    observations: Observations,
    T_world_grasp: Tensor,
    gripper: Gripper,
    cuts: Sequence[Slice],
    rows: Mapping[str, Sequence[Captioned]],
) -> Image.Image:
    """Draws the input views with the grasp and the first slice's corners, then a row of slices under each heading.

    In a slice the first coordinate grows to the right and the second upward; a ring is around the grasp. Each row has
    one scale of colours over all its slices: bright is high, grey lies outside of the workspace.

    Args:
        observations: the views to show.
        T_world_grasp: `[4, 4]`.
        gripper: the hand to draw.
        cuts: the slices, at least one.
        rows: by heading, of each slice its values and caption.
    """
    cameras = [observations.camera[number] for number in range(len(observations))]
    views = tuple(
        _view(draw_gripper(at_width(image, VIEW), camera, T_world_grasp, gripper), camera, cuts[0])
        for image, camera in zip(observations.images.movedim(1, -1), cameras, strict=True)
    )
    above = Section(
        f"input views, the grasp, and the corners of {cuts[0].name}",
        views,
        tuple(f"input view {number + 1}" for number in range(len(views))),
    )
    sections = [_row(heading, cuts, row) for heading, row in rows.items()]
    return contact_sheet([above, *sections], columns=max(len(cuts), len(views)))


def spans(cut: Slice) -> str:
    """Returns how far a slice's coordinates go from end to end, e.g. `tx 0.50 m, rz 180°`."""
    return ", ".join(f"{axis.name} {_extent(axis)}" for axis in (cut.across, cut.upward))


def _extent(axis: Coordinate) -> str:
    extent = axis.high - axis.low
    return f"{math.degrees(extent):.0f}°" if axis.turns else f"{extent:.2f} m"


def _row(heading: str, cuts: Sequence[Slice], row: Sequence[Captioned]) -> Section:
    known = torch.cat([values[~values.isnan()] for values, _ in row])
    low, high = (float(known.quantile(share)) for share in (_LOWEST, 1.0)) if len(known) else (0.0, 1.0)
    tiles = tuple(_tile(cut, values, low, high) for cut, (values, _) in zip(cuts, row, strict=True))
    return Section(heading, tiles, tuple(caption for _, caption in row))


def _tile(cut: Slice, values: Tensor, low: float, high: float) -> Image.Image:
    share = (values.nan_to_num(low) - low) / max(high - low, 1e-6)
    coloured = grey_outside(paint(share, "viridis"), ~values.isnan())
    image = to_image(coloured.flip(0)).resize((TILE, TILE), Image.Resampling.NEAREST)
    pixel = TILE / values.shape[0]
    x, y = (
        pixel / 2 + (TILE - pixel) * -axis.low / max(axis.high - axis.low, 1e-9) for axis in (cut.across, cut.upward)
    )
    draw = ImageDraw.Draw(image)
    for radius, colour, width in ((7, OUTLINE, 4), (6, BODY, 2)):
        box = (x - radius, TILE - y - radius, x + radius, TILE - y + radius)
        draw.ellipse(box, outline=colour, width=width)
    return image


def _view(drawn: Image.Image, camera: Camera, cut: Slice) -> Image.Image:
    """Draws the corners of a slice of translations over a view."""
    if cut.kind != "translation":
        return drawn
    corners = cut.T_world_grasp[[0, 0, -1, -1], [0, -1, -1, 0], :3, 3]
    pixels, depth = project(camera, corners)
    if bool((depth > 0).all()):
        ring = [(x, y) for x, y in (pixels * (VIEW / camera.width)).tolist()]
        ImageDraw.Draw(drawn).line([*ring, ring[0]], fill=CENTRE, width=2)
    return drawn
