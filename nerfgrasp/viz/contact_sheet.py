"""Many images on one sheet, with captions and headings."""

from collections.abc import Sequence
from dataclasses import dataclass

from PIL import Image, ImageDraw, ImageFont

MARGIN, CAPTION = 12, 26
"""Pixels between images, and above an image for its caption."""
HEADING = 44
"""Pixels for a section's heading."""
PAPER, INK, FAINT = (255, 255, 255), (28, 28, 32), (110, 110, 118)


@dataclass(frozen=True)
class Section:
    """Images that belong together."""

    heading: str
    """Stands above them; none if empty."""
    images: tuple[Image.Image, ...]
    """In reading order."""
    captions: tuple[str, ...]
    """One for each image."""


def contact_sheet(sections: Sequence[Section], columns: int) -> Image.Image:
    """Draws sections one under another, each of rows of at most `columns` images.

    Raises:
        ValueError: there is nothing to draw, or a section has not as many captions as images.
    """
    rows: list[list[Image.Image]] = []
    headings: dict[int, str] = {}
    for section in sections:
        headings[len(rows)] = section.heading
        panels = [captioned(*pair) for pair in zip(section.images, section.captions, strict=True)]
        rows += [panels[start : start + columns] for start in range(0, len(panels), columns)]
    return stack(rows, headings)


def captioned(image: Image.Image, caption: str) -> Image.Image:
    """Returns the image with a line of text above it."""
    canvas = Image.new("RGB", (image.width, image.height + CAPTION), PAPER)
    canvas.paste(image, (0, CAPTION))
    ImageDraw.Draw(canvas).text((0, CAPTION - 6), caption, fill=FAINT, font=font(15), anchor="ls")
    return canvas


def stack(rows: Sequence[Sequence[Image.Image]], headings: dict[int, str] | None = None) -> Image.Image:
    """Draws rows of images one under another, with a heading above those rows that `headings` has by number.

    Raises:
        ValueError: there is no row, or one without images.
    """
    if not rows or not all(rows):
        raise ValueError("nothing to draw")
    above = [HEADING if (headings or {}).get(row) else 0 for row in range(len(rows))]
    heights = [max(image.height for image in row) for row in rows]
    width = max(sum(image.width + MARGIN for image in row) for row in rows) + MARGIN
    canvas = Image.new("RGB", (width, sum(above) + sum(heights) + MARGIN * len(rows)), PAPER)
    top = 0
    for number, row in enumerate(rows):
        if above[number]:
            place = (MARGIN, top + HEADING - 12)
            ImageDraw.Draw(canvas).text(place, (headings or {})[number], fill=INK, font=font(22), anchor="ls")
        left, top = MARGIN, top + above[number]
        for image in row:
            canvas.paste(image, (left, top))
            left += image.width + MARGIN
        top += heights[number] + MARGIN
    return canvas


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Returns the font of all that is written in pictures, so many pixels high."""
    return ImageFont.load_default(size=size)
