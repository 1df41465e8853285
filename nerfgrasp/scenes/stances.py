"""Where a gripper's tool centre point (TCP) may be around one prism that lies or stands in any pose.

An upright prism is grasped across its footprint's bars. A tipped one is looked at slab by slab: two parallel faces,
with a plane halfway between them. The gripper comes along the direction in that plane that is nearest to straight
down, and every column of the plane along it says between which depths the TCP may be: with enough object between the
pads, the fingertips clear of the table and of the object's other parts, and the palm clear of its top. Other objects
are not considered.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nerfgrasp.grippers import Fingers
from nerfgrasp.scenes.bars import END_MARGIN, PAD_GRIP, TABLE_CLEARANCE, VERTEX_OFFSET, bars, faces
from nerfgrasp.scenes.prisms import Prism, corners_in_world
from nerfgrasp.scenes.profiles import Array, cut, extent, highest_within, lowest_within, rectangles, topmost

MAX_TILT = math.radians(45.0)
"""Between an approach and straight down."""
UPRIGHT = math.cos(math.radians(1.0))
"""A prism whose axis is as near to the vertical stands upright."""
MIN_DEPTH = 0.012
"""Metres of a tipped object between the pads, along the approach, at least."""
COLUMN = 0.001
"""Metres between the columns at which a tipped object is looked at."""
TOLERANCE = 0.004
"""Metres by which the rectangles of a slanted region may fall short of it."""
AROUND = math.radians(5.0)
"""Between the closing axes around a tipped cylinder."""


@dataclass(frozen=True)
class Stance:
    """A rectangle of TCPs with one closing axis, in the world: corner + a edge_u + b edge_v, a and b in [0, 1]."""

    corner: Array
    """`[3]`, metres."""
    edge_u: Array
    """`[3]`, metres, across the approach."""
    edge_v: Array
    """`[3]`, metres, against the approach."""
    closing: Array
    """`[3]`, unit."""
    free_yaw: bool = False
    """Whether every horizontal closing axis will do."""


@dataclass(frozen=True)
class _Slab:
    """Two parallel faces, or lines, of a prism, in its own frame."""

    closing: Array
    """`[3]`, unit."""
    width: float
    """Metres between the two."""
    contact: tuple[Array, ...]
    """Convex pieces `[K, 3]`, in the plane halfway, that the two have in common."""
    line: bool = False
    """Whether one of the two is only a line; then the TCP lies within the pieces."""


def stances(prism: Prism, fingers: Fingers) -> list[Stance]:
    """Returns where the TCP may be around a prism; the prism alone is considered, above the table z = 0."""
    pose = prism.T_world_object.double().numpy()
    if abs(pose[2, 2]) >= UPRIGHT:
        return _upright(prism, pose, fingers)
    return [stance for slab in _slabs(prism, pose, fingers) for stance in _across(slab, prism, pose, fingers)]


def _upright(prism: Prism, pose: Array, fingers: Fingers) -> list[Stance]:
    """Returns the bars of a prism that stands, on the table or on something else, either way up."""
    up = math.copysign(1.0, pose[2, 2])
    base = pose[2, 3] if up > 0 else pose[2, 3] - prism.height
    floor = fingers.pad_height / 2 + TABLE_CLEARANCE
    low = max(floor, base + prism.height - fingers.palm)
    high = max(floor, base + prism.height - PAD_GRIP)
    first = low - base if up > 0 else prism.height - (low - base)
    found = []
    for bar in bars(prism, fingers):
        corner = pose[:3, :3] @ [*bar.start, first] + pose[:3, 3]
        flat = [[*np.subtract(bar.end, bar.start), 0.0], [0.0, 0.0, up * (high - low)], [*bar.closing, 0.0]]
        edge_u, edge_v, closing = (pose[:3, :3] @ np.transpose(flat)).T
        found.append(Stance(corner, edge_u, edge_v, closing, bar.free_yaw))
    return found


def _slabs(prism: Prism, pose: Array, fingers: Fingers) -> Iterator[_Slab]:
    ends = [np.column_stack([part, np.full(len(part), prism.height / 2)]) for part in prism.parts]
    if prism.height <= fingers.max_width:
        yield _Slab(np.array([0.0, 0.0, 1.0]), prism.height, tuple(ends))
    if prism.kind == "cylinder" and bars(prism, fingers):
        yield from _around(prism, pose)
    elif prism.kind == "triangle":
        for bar in bars(prism, fingers):
            piece = _standing(bar.start, bar.end, PAD_GRIP, prism.height - PAD_GRIP)
            width = 2 * float(np.max(np.asarray(prism.parts[0]) @ bar.closing - np.dot(bar.start, bar.closing)))
            yield _Slab(np.array([*bar.closing, 0.0]), width, (piece,), line=True)
    else:
        for face in faces(prism, fingers):
            piece = _standing(face.start, face.end, 0.0, prism.height)
            yield _Slab(np.array([*face.closing, 0.0]), face.width, (piece,))


def _around(prism: Prism, pose: Array) -> Iterator[_Slab]:
    """Yields the slabs of a tipped cylinder: its two lines across each of many closing axes."""
    up = pose[2, :3]  # of the world, in the object's frame
    level = np.array([-up[1], up[0], 0.0]) / np.hypot(up[0], up[1])
    diameter = 2 * float(np.max(np.linalg.norm(prism.parts[0], axis=1)))
    for angle in np.arange(-math.pi / 2 + AROUND, math.pi / 2, AROUND):
        closing = math.cos(angle) * level + math.sin(angle) * np.array([-level[1], level[0], 0.0])
        aside = VERTEX_OFFSET * np.array([-closing[1], closing[0]])
        start, end = (float(-aside[0]), float(-aside[1])), (float(aside[0]), float(aside[1]))
        yield _Slab(closing, diameter, (_standing(start, end, PAD_GRIP, prism.height - PAD_GRIP),), line=True)


def _standing(start: tuple[float, float], end: tuple[float, float], low: float, high: float) -> Array:
    """Returns the rectangle `[4, 3]` over a stretch of the footprint."""
    return np.array([[*start, low], [*end, low], [*end, high], [*start, high]])


def _across(slab: _Slab, prism: Prism, pose: Array, fingers: Fingers) -> list[Stance]:
    """Returns the rectangles of TCPs between a slab's faces; none where its axis admits no approach from above."""
    closing = pose[:3, :3] @ slab.closing
    if abs(closing[2]) > math.sin(MAX_TILT):
        return []
    up = np.array([0.0, 0.0, 1.0]) - closing[2] * closing
    up /= np.linalg.norm(up)
    axes = np.stack([closing, np.cross(up, closing), up])
    pieces = [(piece @ pose[:3, :3].T + pose[:3, 3]) @ axes.T for piece in slab.contact]
    middle = float(pieces[0][0, 0])
    flat = [piece[:, 1:] for piece in pieces]
    beside = fingers.pad_width / 2 + fingers.clearance
    sideways = np.concatenate(flat)[:, 0]
    at = np.arange(sideways.min() - beside, sideways.max() + beside, COLUMN)
    solids = corners_in_world(prism) @ axes.T - [middle, 0.0, 0.0]
    floor = (_tip_floor(closing[2], up[2], fingers) - middle * closing[2]) / up[2]
    blocked = np.maximum(max(floor, solids[:, 2].max() - fingers.palm), _passing(slab, prism, solids, at, fingers))
    return [
        Stance(np.array([middle, s0, t0]) @ axes, (s1 - s0) * axes[1], (t1 - t0) * axes[2], closing)
        for s0, s1, t0, t1 in rectangles(at, *_depths(slab, flat, at, blocked, fingers), TOLERANCE)
    ]


def _tip_floor(closing: float, up: float, fingers: Fingers) -> float:
    """Returns the height over the table below which a TCP brings a tip of the tilted open fingers too near to it."""
    outside = fingers.stroke / 2 + fingers.thickness
    return TABLE_CLEARANCE + up * fingers.pad_height / 2 + abs(closing) * outside


def _passing(slab: _Slab, prism: Prism, solids: Array, at: Array, fingers: Fingers) -> Array:
    """Returns the lowest TCP `[S]` at which open fingers pass over the prism's other parts on a slab's two sides."""
    near, far = slab.width / 2 + 1e-4, fingers.stroke / 2 + fingers.thickness + fingers.clearance
    top, first, upper = np.full(len(at), -np.inf), 0, len(solids) // 2
    for part in prism.parts:
        # The corners of the lower side come first, part by part, then those of the upper side.
        mine = np.arange(first, first + len(part))
        first += len(part)
        for low, high in ((near, far), (-far, -near)):
            top = np.maximum(top, extent(cut(solids[[*mine, *(mine + upper)]], low, high), at)[1])
    reach = math.ceil((fingers.pad_width / 2 + fingers.clearance) / COLUMN)
    return highest_within(top, reach) + fingers.pad_height / 2 + fingers.clearance


def _depths(slab: _Slab, pieces: list[Array], at: Array, blocked: Array, fingers: Fingers) -> tuple[Array, Array]:
    """Returns the lowest and the highest TCP `[S]` in each column; the latter is lower where there is none."""
    begin, end = topmost(pieces, at)
    half = fingers.pad_height / 2
    if slab.line:
        # Where something is in the way, the line need not cross the pads' middle.
        reach = np.where(begin <= end, end, -np.inf) + half - PAD_GRIP
        low = np.maximum(begin, blocked)
        return low, np.minimum(np.maximum(end, low), reach)
    margin = math.ceil(END_MARGIN / COLUMN)
    begin, end = highest_within(begin, margin), lowest_within(end, margin)
    low = np.maximum(blocked, begin + MIN_DEPTH - half)
    high = np.minimum(np.maximum(end - PAD_GRIP, low), end + half - MIN_DEPTH)
    return low, np.where(end - begin >= MIN_DEPTH, high, -np.inf)
