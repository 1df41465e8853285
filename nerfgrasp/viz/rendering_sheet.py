"""Rendered views on one sheet, and as an animation."""

from collections.abc import Mapping, Sequence

from PIL import Image
from torch import Tensor

from nerfgrasp.viz.contact_sheet import Section, contact_sheet
from nerfgrasp.viz.figures import at_width
from nerfgrasp.viz.renderings import WORST, RenderedView, depth_limits, panels

WIDTH = 256
"""Pixels of an image on the sheet and in the animation."""
ORBIT_COLUMNS = 6
CAPTIONS = {"error": f"error (bright: {WORST:g} and more)", "depth": "rendered depth (bright: near)"}
"""Of panels whose names do not say enough."""

Images = Mapping[str, Tensor]
"""RGB `[H, W, 3]` in [0, 1] by caption."""


def views_sheet(inputs: Images, views: Mapping[str, RenderedView]) -> Image.Image:
    """Draws the input images, then a row for each view under its heading, the truth first.

    Args:
        inputs: what the model saw.
        views: by heading; at least one.
    """
    shown = {heading: panels(view) for heading, view in views.items()}
    rows = [
        _section(heading, {CAPTIONS.get(name, name): panel.image for name, panel in row.items()})
        for heading, row in shown.items()
    ]
    return contact_sheet([_section("input", inputs), *rows], columns=max(len(row) for row in shown.values()))


def orbit_sheet(inputs: Images, views: Mapping[str, RenderedView]) -> Image.Image:
    """Draws the input images, then what is rendered on an orbit: all of RGB, then all of depth in one scale.

    Args:
        inputs: what the model saw.
        views: by caption; at least one.
    """
    limits = depth_limits(list(views.values()))
    shown = {caption: panels(view, limits) for caption, view in views.items()}
    rows = [
        _section(heading, {caption: row[name].image for caption, row in shown.items()})
        for name, heading in (("rendered", "rendered"), ("depth", "rendered depth (bright: near)"))
    ]
    return contact_sheet([_section("input", inputs), *rows], ORBIT_COLUMNS)


def animation(views: Sequence[RenderedView]) -> list[Image.Image]:
    """Returns a frame for each view: RGB beside depth, the depth of all in one scale."""
    limits = depth_limits(views)
    return [_side_by_side([panels(view, limits)[name].image for name in ("rendered", "depth")]) for view in views]


def _section(heading: str, images: Images) -> Section:
    return Section(heading, tuple(at_width(image, WIDTH) for image in images.values()), tuple(images))


def _side_by_side(images: Sequence[Tensor]) -> Image.Image:
    drawn = [at_width(image, WIDTH) for image in images]
    canvas = Image.new("RGB", (WIDTH * len(drawn), drawn[0].height))
    for number, image in enumerate(drawn):
        canvas.paste(image, (number * WIDTH, 0))
    return canvas
