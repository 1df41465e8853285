"""Solids and faces seen column by column: how high they begin and end above places along a line.

A plane is looked at with its first axis sideways and its second upwards; `at` `[S]` are places on the first.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FLAT = 1e-4
"""Metres by which neighbouring columns of no height may be apart and still be joined."""


def extent(points: Array, at: Array) -> tuple[Array, Array]:
    """Returns where the convex hull of `points` `[N, 2]` begins and ends `[S]` in each column.

    Columns beside the hull begin at infinity and end at minus infinity.
    """
    i, j = np.triu_indices(len(points), 1)
    order = points[i, 0] <= points[j, 0]
    left, right = np.where(order[:, None], points[i], points[j]), np.where(order[:, None], points[j], points[i])
    width = (right - left)[:, 0]
    share = (at[:, None] - left[:, 0]) / np.where(width > 1e-9, width, 1.0)
    height = left[:, 1] + share * (right - left)[:, 1]
    within = (width > 1e-9) & (share >= 0.0) & (share <= 1.0)
    return (
        np.where(within, height, np.inf).min(axis=1, initial=np.inf),
        np.where(within, height, -np.inf).max(axis=1, initial=-np.inf),
    )


def topmost(pieces: Sequence[Array], at: Array) -> tuple[Array, Array]:
    """Returns where the topmost stretch `[S]` of a union of convex pieces begins and ends in each column."""
    ranges = [extent(piece, at) for piece in pieces]
    low, high = (np.stack(bounds) for bounds in zip(*ranges, strict=True))
    end = high.max(axis=0)
    begin = np.take_along_axis(low, high.argmax(axis=0)[None], axis=0)[0]
    for _ in pieces:
        touching = (high >= begin - 1e-6) & (low < begin)
        begin = np.minimum(begin, np.where(touching, low, np.inf).min(axis=0))
    return begin, end


def cut(corners: Array, low: float, high: float) -> Array:
    """Returns points `[N, 2]` whose hull is the shadow, along the first axis, of a slice of a convex solid.

    Args:
        corners: `[K, 3]` of the solid.
        low: the slice's beginning on the first axis.
        high: its end.
    """
    i, j = np.triu_indices(len(corners), 1)
    found = [corners[(corners[:, 0] >= low) & (corners[:, 0] <= high), 1:]]
    for level in (low, high):
        a, b = corners[i], corners[j]
        across = (a[:, 0] < level) != (b[:, 0] < level)
        share = (level - a[across, 0]) / (b[across, 0] - a[across, 0])
        found.append((a[across] + share[:, None] * (b[across] - a[across]))[:, 1:])
    return np.concatenate(found)


def highest_within(profile: Array, reach: int) -> Array:
    """Returns the maximum `[S]` of a profile over `reach` columns to either side."""
    return _windows(profile, reach, -np.inf).max(axis=1)


def lowest_within(profile: Array, reach: int) -> Array:
    """Returns the minimum `[S]` of a profile over `reach` columns to either side; nothing lies beyond its ends."""
    return _windows(profile, reach, -np.inf).min(axis=1)


def _windows(profile: Array, reach: int, beyond: float) -> Array:
    padded = np.pad(profile, reach, constant_values=beyond)
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)


def rectangles(at: Array, low: Array, high: Array, tolerance: float) -> list[tuple[float, float, float, float]]:
    """Covers columns by rectangles from within: each (from, to) sideways, then (from, to) upwards.

    Args:
        at: `[S]`, evenly spaced.
        low: where each column begins `[S]`.
        high: where it ends `[S]`; below `low` where the column is empty.
        tolerance: by which a rectangle may fall short of a column's end.
    """
    found = []
    k = 0
    while k < len(at):
        if low[k] > high[k]:
            k += 1
            continue
        end = _run_end(low, high, k, tolerance)
        begin = low[k:end].max()
        found.append((at[k], at[end - 1], begin, max(begin, high[k:end].min())))
        k = end
    return found


def _run_end(low: Array, high: Array, start: int, tolerance: float) -> int:
    """Returns the first column that cannot be joined to those from `start` on."""
    end = start + 1
    while end < len(low) and low[end] <= high[end]:
        lows, highs = low[start : end + 1], high[start : end + 1]
        if np.ptp(lows) > tolerance or np.ptp(highs) > tolerance or lows.max() > highs.min() + FLAT:
            break
        end += 1
    return end
