import numpy as np
import pytest
import torch
from torch import Tensor

from nerfgrasp.geometry import Camera
from nerfgrasp.viz.contact_sheet import CAPTION, HEADING, MARGIN
from nerfgrasp.viz.rendering_sheet import WIDTH, animation, orbit_sheet, views_sheet
from nerfgrasp.viz.renderings import (
    OUTSIDE,
    WORST,
    RenderedView,
    colour_depth,
    colour_error,
    depth_limits,
    panels,
)

RED, GREY = (255, 0, 0), (round(255 * OUTSIDE),) * 3
HEIGHT = WIDTH * 48 // 64


def view(camera: Camera, truth: Tensor | None = None, true_depth: Tensor | None = None) -> RenderedView:
    """Red, from 1 m at its left to 2 m at its right; its lower half lies outside of the box."""
    rgb = torch.tensor([1.0, 0.0, 0.0]).expand(48, 64, 3)
    inside = torch.arange(48)[:, None].expand(48, 64) < 24
    depth = torch.linspace(1.0, 2.0, 64).expand(48, 64)
    return RenderedView(camera[0], rgb, torch.where(inside, depth, torch.zeros(1)), inside, truth, true_depth)


def test_near_is_bright_and_outside_is_grey() -> None:
    depth = torch.linspace(0.5, 1.5, 64).view(8, 8)
    inside = torch.ones(8, 8, dtype=torch.bool)
    inside[3] = False
    colour = colour_depth(depth, inside, (0.5, 1.5))
    assert colour.shape == (8, 8, 3)
    assert float(colour[0, 0].mean()) > 0.8
    assert float(colour[-1, -1].mean()) < 0.1
    assert torch.equal(colour[3], torch.full((8, 3), OUTSIDE))


def test_what_is_right_is_black_and_what_is_wrong_is_bright() -> None:
    truth, inside = torch.full((2, 2, 3), 0.5), torch.tensor([[True, True], [True, False]])
    rgb = truth.clone()
    rgb[0, 1] += WORST / 2
    rgb[1] += WORST
    colour = colour_error(rgb, truth, inside)
    right, middling, wrong = (float(colour[at].mean()) for at in ((0, 0), (0, 1), (1, 0)))
    assert right < 0.02
    assert right < middling < wrong
    assert wrong > 0.8
    assert colour[1, 1].tolist() == pytest.approx([OUTSIDE] * 3)


def test_depth_limits_are_those_of_the_truth_and_never_infinite(camera: Camera) -> None:
    assert depth_limits([view(camera)]) == pytest.approx((1.01, 1.99), abs=0.02)
    true_depth = torch.full((48, 64), 3.0)
    true_depth[0] = torch.inf
    assert depth_limits([view(camera, true_depth=true_depth)]) == (3.0, 3.0)
    nothing = RenderedView(camera[0], torch.zeros(48, 64, 3), torch.zeros(48, 64), torch.zeros(48, 64).bool())
    near, far = depth_limits([nothing])
    assert near < far


def test_panels_show_what_is_known(camera: Camera) -> None:
    assert list(panels(view(camera))) == ["rendered", "depth"]
    known = panels(view(camera, torch.ones(48, 64, 3), torch.ones(48, 64)))
    assert list(known) == ["truth", "rendered", "error", "true depth", "depth"]
    assert torch.equal(known["truth"].image, torch.ones(48, 64, 3))
    assert torch.equal(known["rendered"].image[-1], torch.full((64, 3), OUTSIDE))


def test_a_sheet_holds_the_inputs_above_and_a_row_a_view(camera: Camera) -> None:
    inputs = {"view 0": torch.zeros(48, 64, 3), "view 1": torch.ones(48, 64, 3)}
    sheet = views_sheet(inputs, {"view 2": view(camera, torch.full((48, 64, 3), 0.2)), "view 3": view(camera)})
    row = HEADING + CAPTION + HEIGHT + MARGIN
    assert sheet.size == (4 * (WIDTH + MARGIN) + MARGIN, 3 * row)
    left = [MARGIN + 5 + column * (WIDTH + MARGIN) for column in range(4)]
    top = [HEADING + CAPTION + 5 + number * row for number in range(3)]
    assert [sheet.getpixel((x, top[0])) for x in left[:2]] == [(0, 0, 0), (255, 255, 255)]
    assert [sheet.getpixel((x, top[1])) for x in left[:2]] == [(51, 51, 51), RED]
    assert sheet.getpixel((left[0], top[2])) == RED
    assert sheet.getpixel((left[0], top[2] + HEIGHT - 10)) == GREY


def test_an_orbit_is_a_sheet_and_frames_of_colour_beside_depth(camera: Camera) -> None:
    around = {"0°": view(camera), "180°": view(camera)}
    sheet = orbit_sheet({"view 0": torch.zeros(48, 64, 3)}, around)
    assert sheet.height == 3 * (HEADING + CAPTION + HEIGHT + MARGIN)
    assert sheet.getpixel((MARGIN + 5, 2 * (HEADING + CAPTION) + HEIGHT + MARGIN + 5)) == RED
    frames = animation(list(around.values()))
    assert [frame.size for frame in frames] == [(2 * WIDTH, HEIGHT)] * 2
    assert frames[0].getpixel((5, 5)) == RED
    assert np.mean(frames[0].getpixel((WIDTH + 5, 5))) > 180  # near, on the left
    assert np.mean(frames[0].getpixel((2 * WIDTH - 5, 5))) < 40  # far
