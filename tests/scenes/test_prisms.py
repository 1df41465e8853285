"""Prisms: their mass properties by hand, their gaps, and their way to JSON and back."""

import json
import math

import numpy as np
import pytest
import torch

from nerfgrasp.scenes.prisms import Prism, centroid, clear_gap, footprint_in_world, mass_properties


def rectangle(x0, y0, x1, y1):
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def prism(*parts, height=0.1, density=500.0):
    return Prism("box", parts, height, (0.2, 0.4, 0.9), density, torch.eye(4))


def test_mass_properties_of_a_box_are_the_textbook_ones():
    solid = mass_properties(prism(rectangle(0.01, 0.0, 0.05, 0.06)))
    a, b, h = 0.04, 0.06, 0.1
    mass = 500 * a * b * h
    assert solid.mass == pytest.approx(mass)
    assert solid.centre == pytest.approx([0.03, 0.03, 0.05])
    expected = mass / 12 * np.diag([b * b + h * h, a * a + h * h, a * a + b * b])
    assert solid.inertia == pytest.approx(expected, abs=1e-12)


def test_cutting_a_box_in_parts_changes_nothing():
    whole = mass_properties(prism(rectangle(0.0, 0.0, 0.05, 0.06)))
    cut = mass_properties(prism(rectangle(0.0, 0.0, 0.02, 0.06), rectangle(0.02, 0.0, 0.05, 0.06)))
    assert cut.mass == pytest.approx(whole.mass)
    assert cut.centre == pytest.approx(whole.centre)
    assert cut.inertia == pytest.approx(whole.inertia, abs=1e-12)


def test_an_l_weighs_about_both_its_arms_and_has_a_product_of_inertia():
    parts = (rectangle(0.0, 0.0, 0.09, 0.03), rectangle(0.0, 0.03, 0.03, 0.09))
    # Areas 27 and 18 cm², centred at (4.5, 1.5) and (1.5, 6) cm.
    assert centroid(parts) == pytest.approx(((27 * 0.045 + 18 * 0.015) / 45, (27 * 0.015 + 18 * 0.06) / 45))
    assert abs(mass_properties(prism(*parts)).inertia[0, 1]) > 1e-5


def test_many_sided_cylinder_is_nearly_round():
    corners = tuple((0.03 * math.cos(a * math.pi / 16), 0.03 * math.sin(a * math.pi / 16)) for a in range(32))
    solid = mass_properties(prism(corners))
    assert solid.mass == pytest.approx(500 * 0.1 * math.pi * 0.03**2, rel=0.01)
    assert solid.inertia[2, 2] == pytest.approx(solid.mass * 0.03**2 / 2, rel=0.02)


def test_gap_is_exact_between_faces_and_never_too_wide():
    box = [np.array(rectangle(0.0, 0.0, 1.0, 1.0))]
    assert clear_gap(box, [np.array(rectangle(1.5, 0.2, 2.0, 0.8))]) == pytest.approx(0.5)
    assert clear_gap(box, [np.array(rectangle(0.5, 0.5, 2.0, 2.0))]) < 0
    corner_to_corner = clear_gap(box, [np.array(rectangle(2.0, 2.0, 3.0, 3.0))])
    assert 1.0 <= corner_to_corner <= math.sqrt(2)


def test_footprint_moves_with_the_pose():
    pose = torch.tensor([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    turned = Prism("box", (rectangle(0.0, 0.0, 0.03, 0.01),), 0.1, (1.0, 0.0, 0.0), 300.0, pose)
    (corners,) = footprint_in_world(turned)
    assert corners == pytest.approx(np.array([[0.1, 0.2], [0.1, 0.23], [0.09, 0.23], [0.09, 0.2]]))


def test_json_round_trip_is_exact():
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    original = Prism("l", (rectangle(0.0, 0.1, 0.2, 1 / 3),), 0.07, (0.1, 0.2, 1 / 3), 321.0, pose)
    copy = Prism.from_json(json.loads(json.dumps(original.to_json())))
    assert torch.equal(copy.T_world_object, original.T_world_object)
    assert copy.to_json() == original.to_json()
