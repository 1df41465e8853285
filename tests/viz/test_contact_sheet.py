import numpy as np
import pytest
from PIL import Image

from nerfgrasp.viz.contact_sheet import CAPTION, HEADING, MARGIN, Section, contact_sheet

RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
SIDE = 40


def tiles(*colours: tuple[int, int, int]) -> tuple[Image.Image, ...]:
    return tuple(Image.new("RGB", (SIDE, SIDE), colour) for colour in colours)


def test_images_lie_in_rows_under_their_headings() -> None:
    sections = [Section("first", tiles(RED, GREEN, BLUE), ("a", "b", "c")), Section("", tiles(GREEN), ("",))]
    sheet = contact_sheet(sections, columns=2)
    row = CAPTION + SIDE + MARGIN
    assert sheet.size == (2 * SIDE + 3 * MARGIN, HEADING + 3 * row)
    left, right, first = MARGIN + 1, 2 * MARGIN + SIDE + 1, HEADING + CAPTION + 1
    assert [sheet.getpixel((x, first)) for x in (left, right)] == [RED, GREEN]
    assert [sheet.getpixel((x, first + row)) for x in (left, right)] == [BLUE, WHITE]
    assert sheet.getpixel((left, first + 2 * row)) == GREEN
    written = np.asarray(sheet.convert("L"))
    assert written[:HEADING].min() < 100
    assert written[HEADING : HEADING + CAPTION].min() < 200
    assert written[HEADING + 2 * row : HEADING + 2 * row + CAPTION].min() == 255


@pytest.mark.parametrize("sections", [[], [Section("none", (), ())], [Section("", tiles(RED), ())]])
def test_what_cannot_be_drawn_is_an_error(sections: list[Section]) -> None:
    with pytest.raises(ValueError, match="nothing to draw|zip"):
        contact_sheet(sections, columns=2)
