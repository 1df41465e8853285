"""Convex pieces: found where they are, made where they are not, and as heavy as they should be."""

import numpy as np
import pytest
import trimesh

from nerfgrasp.sim import decomposition
from nerfgrasp.sim.decomposition import convex_pieces, decompose, inset, read_objects, solid_properties, write_hulls


def box(size, at=(0.0, 0.0, 0.0)):
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


def angle():
    """An L of one piece: 80 x 80 mm, 30 mm thick, 40 mm high."""
    outline = [(0, 0), (0.08, 0), (0.08, 0.03), (0.03, 0.03), (0.03, 0.08), (0, 0.08)]
    vertices = [(x, y, z) for z in (0.0, 0.04) for x, y in outline]
    floor = [(0, 3, 1), (1, 3, 2), (0, 4, 3), (0, 5, 4)]
    roof = [(a + 6, c + 6, b + 6) for a, b, c in floor]
    walls = [(i, (i + 1) % 6, i + 6) for i in range(6)] + [((i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6)]
    return trimesh.Trimesh(vertices, [*floor, *roof, *walls], process=False)


def encloses(hull, point):
    return ((np.asarray(point) - hull.triangles[:, 0]) * hull.face_normals).sum(axis=1).max() <= 0


def test_pieces_that_are_convex_are_taken_as_they_are():
    two = trimesh.util.concatenate([box((0.1, 0.02, 0.02)), box((0.02, 0.02, 0.1), (0.2, 0, 0))])
    pieces = convex_pieces([two])
    assert sorted(piece.volume for piece in pieces) == pytest.approx([4e-5, 4e-5])


@pytest.mark.parametrize("kind", ["hollow", "open", "too many", "none"])
def test_other_pieces_are_not_taken(kind):
    open_box = box((0.1, 0.1, 0.1))
    open_box.update_faces(np.arange(12) < 7)
    crowd = [box((0.01, 0.01, 0.01), (0.02 * i, 0, 0)) for i in range(decomposition.MAX_HULLS + 1)]
    meshes = {"hollow": [angle()], "open": [open_box], "too many": crowd, "none": []}[kind]
    assert convex_pieces(meshes) is None


def test_an_angle_is_decomposed_into_hulls_that_leave_its_hollow_free(monkeypatch, capfd):
    monkeypatch.setitem(decomposition.VHACD, "resolution", 15_000)
    hulls = decompose(angle())
    assert len(hulls) >= 2
    assert capfd.readouterr() == ("", "")
    # 80 x 80 x 40 less 50 x 50 x 40 mm³; its convex hull has 206 cm³.
    assert sum(hull.volume for hull in hulls) == pytest.approx(1.56e-4, rel=0.1)
    hollow, solid = [0.06, 0.06, 0.02], [0.015, 0.06, 0.02]
    assert not any(encloses(hull, hollow) for hull in hulls)
    assert any(encloses(hull, solid) for hull in hulls)
    again = decompose(angle())
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(hulls, again, strict=True))


def test_inset_moves_every_face_inwards_and_never_turns_a_thin_hull_inside_out():
    assert inset(box((0.1, 0.06, 0.02)), 0.001).extents == pytest.approx([0.098, 0.058, 0.018])
    assert inset(box((0.1, 0.06, 0.001)), 0.001).extents == pytest.approx([0.0995, 0.0595, 0.0005])


def test_hulls_are_written_each_as_an_object(tmp_path):
    write_hulls(tmp_path / "hulls.obj", [box((0.1, 0.1, 0.1)), box((0.05, 0.05, 0.05), (0.025, 0, 0))])
    back = read_objects(tmp_path / "hulls.obj")
    assert [mesh.volume for mesh in back] == pytest.approx([1e-3, 1.25e-4])


def test_mass_properties_of_two_boxes_are_those_of_the_box_that_they_make():
    """A box 40 x 60 x 100 mm of 0.3 kg has m / 12 (b² + c²) about its middle."""
    halves = [box((0.04, 0.06, 0.05), (1.0, 2.0, z)) for z in (-0.025, 0.025)]
    centre, inertia = solid_properties(halves, 0.3)
    assert centre == pytest.approx([1.0, 2.0, 0.0])
    assert np.diag(inertia) == pytest.approx([0.025 * 0.0136, 0.025 * 0.0116, 0.025 * 0.0052])
    assert inertia - np.diag(np.diag(inertia)) == pytest.approx(np.zeros((3, 3)), abs=1e-12)
