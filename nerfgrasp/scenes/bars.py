"""Where two parallel fingers fit around the footprint of a prism.

A bar is a stretch of a footprint with two parallel faces, or a face and the vertex opposite. Grasped across, its
tool centre points lie on a segment halfway between the faces. Everything here is in the object's frame and flat.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfgrasp.grippers import Fingers
from nerfgrasp.scenes.prisms import Polygon, Prism

STEP = 0.0005
"""Metres between the rows at which a footprint is looked at."""
END_MARGIN = 0.005
"""Metres between a tool centre point and the end of its bar's faces."""
MIN_OVERLAP = 0.008
"""Metres of face under each pad, at least."""
VERTEX_OFFSET = 0.004
"""Metres that a vertex may be off the pads' middle."""
PAD_GRIP = 0.008
"""Metres that an object's top reaches above the tool centre point, if the table allows."""
TABLE_CLEARANCE = 0.0025
"""Metres between the fingertips and the table."""


@dataclass(frozen=True)
class Bar:
    """A segment of tool centre points and the axis along which the fingers close there."""

    start: tuple[float, float]
    """Metres."""
    end: tuple[float, float]
    """Metres; the same as `start` for a cylinder."""
    closing: tuple[float, float]
    """Unit."""
    free_yaw: bool = False
    """Whether every horizontal closing axis will do."""


@dataclass(frozen=True)
class Face:
    """Two parallel sides of a footprint with material between them and nothing else in line."""

    start: tuple[float, float]
    """Metres: one end of the line halfway between the two."""
    end: tuple[float, float]
    """Metres: the other."""
    closing: tuple[float, float]
    """Unit: across the sides."""
    width: float
    """Metres between the sides."""


def faces(prism: Prism, fingers: Fingers) -> list[Face]:
    """Returns the pairs of parallel sides that fit between `fingers`, of a footprint made of upright rectangles.

    Whether the fingers meet something else there is not looked at: it depends on where they come from.
    """
    boxes = _boxes(prism)
    along_x, along_y = _rectilinear_faces(boxes, fingers), _rectilinear_faces(boxes[:, [1, 0, 3, 2]], fingers)
    return along_x + [Face(face.start[::-1], face.end[::-1], face.closing[::-1], face.width) for face in along_y]


def bars(prism: Prism, fingers: Fingers) -> list[Bar]:
    """Returns the bars of a prism between whose faces `fingers` fit; for the kinds of `Prism.kind`."""
    if prism.kind == "cylinder":
        if 2 * float(np.max(np.linalg.norm(prism.parts[0], axis=1))) > fingers.max_width + 1e-6:
            return []
        return [Bar((0.0, 0.0), (0.0, 0.0), (1.0, 0.0), free_yaw=True)]
    if prism.kind == "triangle":
        return _triangle_bars(prism.parts[0], fingers)
    boxes = _boxes(prism)
    along_x = _rectilinear_bars(boxes, fingers)
    along_y = _rectilinear_bars(boxes[:, [1, 0, 3, 2]], fingers)
    swapped = [Bar(bar.start[::-1], bar.end[::-1], bar.closing[::-1]) for bar in along_y]
    return along_x + swapped


def _boxes(prism: Prism) -> NDArray[np.float64]:
    """Returns the parts `[N, 4]` (x0, y0, x1, y1) of a footprint made of upright rectangles."""
    return np.array([[*np.min(part, axis=0), *np.max(part, axis=0)] for part in prism.parts])


def _rectilinear_faces(boxes: NDArray[np.float64], fingers: Fingers) -> list[Face]:
    """Returns the faces of a union of boxes `[N, 4]` (x0, y0, x1, y1) that lie across x."""
    rows = np.arange(boxes[:, 1].min() + STEP / 2, boxes[:, 3].max(), STEP)
    stretches = [_stretches(boxes, y) for y in rows]
    found = []
    for low, high in sorted({s for row in stretches for s in row if s[1] - s[0] <= fingers.max_width}):
        middle, face = (low + high) / 2, np.array([(low, high) in row for row in stretches])
        ends = [(a - STEP / 2, b + STEP / 2) for a, b in _runs(rows, face)]
        found += [Face((middle, a), (middle, b), (1.0, 0.0), high - low) for a, b in ends]
    return found


def _rectilinear_bars(boxes: NDArray[np.float64], fingers: Fingers) -> list[Bar]:
    """Returns the bars of a union of boxes `[N, 4]` (x0, y0, x1, y1) whose fingers close along x.

    The footprint is cut into rows; a bar is a run of rows that hold the same stretch of material, such that the
    open fingers, reaching over neighbouring rows, meet nothing but that stretch.
    """
    y0, y1 = boxes[:, 1].min(), boxes[:, 3].max()
    rows = np.arange(y0 + STEP / 2, y1, STEP)
    stretches = [_stretches(boxes, y) for y in rows]
    found = []
    for low, high in sorted({s for row in stretches for s in row if s[1] - s[0] <= fingers.max_width}):
        middle, reach = (low + high) / 2, fingers.stroke / 2 + fingers.thickness + fingers.clearance
        face = np.array([(low, high) in row for row in stretches])
        clash = np.array([_sticks_out(row, low, high, middle - reach, middle + reach) for row in stretches])
        valid = _free_rows(rows, face, clash, fingers)
        found += [Bar((middle, a), (middle, b), (1.0, 0.0)) for a, b in _runs(rows, valid)]
    return found


def _stretches(boxes: NDArray[np.float64], y: float) -> list[tuple[float, float]]:
    """Returns the stretches (x from, x to) of material in row `y`, touching ones merged."""
    merged: list[tuple[float, float]] = []
    for x0, bottom, x1, top in sorted(boxes.tolist()):
        if not bottom < y < top:
            continue
        if merged and x0 <= merged[-1][1] + 1e-6:
            merged[-1] = (merged[-1][0], max(merged[-1][1], x1))
        else:
            merged.append((x0, x1))
    return [(round(a, 6), round(b, 6)) for a, b in merged]


def _sticks_out(row: list[tuple[float, float]], low: float, high: float, x0: float, x1: float) -> bool:
    """Whether anything of a row lies between x0 and x1 but outside of low..high."""
    return any((a < low and b > x0) or (b > high and a < x1) for a, b in row)


def _free_rows(
    rows: NDArray[np.float64], face: NDArray[np.bool_], clash: NDArray[np.bool_], fingers: Fingers
) -> NDArray[np.bool_]:
    """Returns for each row whether a tool centre point in it finds enough face and no obstacle."""
    apart = np.abs(rows[:, None] - rows[None])
    pad, swept = apart <= fingers.pad_width / 2, apart <= fingers.pad_width / 2 + fingers.clearance
    enough = (pad & face).sum(axis=1) * STEP >= MIN_OVERLAP
    ends = np.stack([np.interp(rows + s * END_MARGIN, rows, face, left=0, right=0) for s in (-1, 0, 1)])
    free = ~(swept & clash).any(axis=1)
    return enough & free & (ends > 0.5).all(axis=0)


def _runs(rows: NDArray[np.float64], valid: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Returns the first and last row of every run of valid rows."""
    change = np.diff(np.concatenate([[0], valid.astype(int), [0]]))
    starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    return [(float(rows[a]), float(rows[b])) for a, b in zip(starts, ends, strict=True)]


def _triangle_bars(triangle: Polygon, fingers: Fingers) -> list[Bar]:
    """Returns, for each edge on which the opposite vertex lies square, the line halfway between the two."""
    found = []
    for k in range(3):
        a, b, vertex = (np.asarray(triangle[(k + i) % 3]) for i in range(3))
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        outward = np.array([along[1], -along[0]])
        foot, altitude = float((vertex - a) @ along), float((a - vertex) @ outward)
        first = max(foot - VERTEX_OFFSET, END_MARGIN)
        last = min(foot + VERTEX_OFFSET, length - END_MARGIN)
        if altitude <= fingers.max_width and END_MARGIN <= foot <= length - END_MARGIN:
            start, end = (a + along * at - outward * altitude / 2 for at in (first, last))
            found.append(Bar((start[0], start[1]), (end[0], end[1]), (outward[0], outward[1])))
    return found
