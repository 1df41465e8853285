"""Profiles: solids seen column by column, by hand."""

import numpy as np
import pytest

from nerfgrasp.scenes.profiles import cut, extent, highest_within, lowest_within, rectangles, topmost


def square(x0, y0, x1, y1):
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def test_extent_of_a_triangle():
    low, high = extent(np.array([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0]]), np.array([-0.5, 0.5, 1.0, 1.75, 2.5]))
    assert low.tolist() == [np.inf, 0.0, 0.0, 0.0, np.inf]
    assert high == pytest.approx([-np.inf, 0.5, 1.0, 0.25, -np.inf])


def test_topmost_joins_what_touches_and_leaves_what_lies_apart():
    pieces = [square(0, 0, 1, 1), square(0, 1, 1, 2), square(0, 3, 1, 4), square(1, 0, 2, 1)]
    low, high = topmost(pieces[:2] + pieces[3:], np.array([0.5, 1.5]))
    assert (low.tolist(), high.tolist()) == ([0.0, 0.0], [2.0, 1.0])
    low, high = topmost(pieces, np.array([0.5, 1.5, 2.5]))
    assert (low.tolist(), high.tolist()) == ([3.0, 0.0, np.inf], [4.0, 1.0, -np.inf])


def test_cut_is_the_shadow_of_a_slice():
    """A wedge, 1 high at x = 0 and 0 high at x = 2: the slice beyond x = 1 casts a shadow half as high."""
    wedge = np.array([[x, y, z] for y in (0.0, 3.0) for x, z in ((0.0, 0.0), (2.0, 0.0), (0.0, 1.0))])
    low, high = extent(cut(wedge, 1.0, 5.0), np.array([1.5]))
    assert low == pytest.approx([0.0])
    assert high == pytest.approx([0.5])
    assert len(cut(wedge, 2.5, 5.0)) == 0


def test_windows_reach_to_both_sides_and_find_nothing_beyond_the_ends():
    profile = np.array([1.0, 5.0, 2.0, 3.0])
    assert highest_within(profile, 1).tolist() == [5.0, 5.0, 5.0, 3.0]
    assert lowest_within(profile, 1).tolist() == [-np.inf, 1.0, 2.0, -np.inf]


def test_rectangles_are_exact_where_they_can_be_and_inside_where_not():
    at = np.arange(0.0, 0.05, 0.001)
    flat = rectangles(at, np.zeros(50), np.where(at < 0.02, 0.03, -np.inf), 0.004)
    assert flat == [(0.0, pytest.approx(0.019), 0.0, 0.03)]
    slope = rectangles(at, np.zeros(50), at, 0.004)
    assert 10 <= len(slope) <= 13
    assert all(to == pytest.approx(begin, abs=1e-12) for begin, _, _, to in slope)
    assert sum(end - begin for begin, end, _, _ in slope) >= 0.03
