import numpy as np
import torch

from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.scenes.slices import cut_slice
from nerfgrasp.viz.contact_sheet import CAPTION, HEADING, MARGIN
from nerfgrasp.viz.renderings import OUTSIDE
from nerfgrasp.viz.slice_sheet import TILE, VIEW, slice_sheet, spans


def test_rows_lie_under_the_views_bright_where_values_are_high(observations: Observations, grasps: Grasps) -> None:
    T = grasps.T_world_grasp[0]
    cuts = [cut_slice(T, name, Workspace(), size=4) for name in ("tx-ty", "ty-rz")]
    rising = torch.linspace(0.0, 1.0, 4)[:, None].expand(4, 4).clone()  # upward
    rising[:, 0] = torch.nan
    sheet = slice_sheet(observations, T, ROBOTIQ_2F85, cuts, {"truth": [(rising, "a"), (-rising, "b")]})
    top = HEADING + CAPTION + VIEW * 48 // 64 + MARGIN
    assert sheet.size == (3 * (VIEW + MARGIN) + MARGIN, top + HEADING + CAPTION + TILE + MARGIN)
    left, above = MARGIN + TILE - 8, top + HEADING + CAPTION + 8
    bright, middling = (sum(sheet.getpixel((left, above + y))) for y in (0, TILE - 16))
    assert bright > middling + 50
    other = MARGIN + TILE + left
    assert sum(sheet.getpixel((other, above))) < middling  # one scale: the second slice's values are all lower
    assert sheet.getpixel((MARGIN + 8, above)) == (round(255 * OUTSIDE),) * 3


def test_the_grasp_is_ringed_where_it_lies(observations: Observations, grasps: Grasps) -> None:
    T = grasps.T_world_grasp[1]  # at x = y = 0.1 in a workspace of ±0.25
    cut = cut_slice(T, "tx-ty", Workspace(), size=50, axes="world")
    plain = np.asarray(slice_sheet(observations.select([0]), T, ROBOTIQ_2F85, [cut], {"": [(torch.zeros(50, 50), "")]}))
    top = HEADING + CAPTION + VIEW * 48 // 64 + MARGIN + CAPTION
    tile = plain[top : top + TILE, MARGIN : MARGIN + TILE]
    rows, columns = np.nonzero((tile != tile[0, 0]).any(axis=-1))
    assert abs(columns.mean() / TILE - 0.7) < 0.02
    assert abs(rows.mean() / TILE - 0.3) < 0.02


def test_spans_are_told_in_metres_and_degrees(grasps: Grasps) -> None:
    cut = cut_slice(grasps.T_world_grasp[0], "tz-rx", Workspace(), size=2, reach=0.03)
    assert spans(cut) == "tz 0.06 m, rx 180°"
