"""Catalogues: any folder of URDFs or meshes, prepared once, and mistakes in it told in one line."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from nerfgrasp.errors import UserError
from nerfgrasp.sim import catalogue as module
from nerfgrasp.sim import preparation
from nerfgrasp.sim.catalogue import model_of, open_catalogue

URDF = """<robot name="r"><link name="l">
<visual><origin xyz="0 0 {z}" rpy="{rpy}"/><geometry><mesh filename="{mesh}" scale="{scale}"/></geometry></visual>
<inertial><mass value="{mass}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
</link></robot>"""


def write_urdf(folder, mesh="textured.obj", scale="1 1 1", rpy="0 0 0", mass=0.1, z=0.0, name="thing"):
    (folder / f"{name}.urdf").write_text(URDF.format(mesh=mesh, scale=scale, rpy=rpy, mass=mass, z=z))
    return folder


def test_a_folder_of_meshes_is_a_catalogue(tmp_path, make_box, object_cache):
    folder = tmp_path / "shelf"
    make_box(folder, name="tall")
    trimesh.creation.box((0.05, 0.05, 0.02)).export(folder / "flat.stl")
    catalogue = open_catalogue(folder)
    assert catalogue.name == "shelf"
    assert catalogue.names == ("flat", "tall")
    flat, tall = catalogue.models
    # 400 kg/m³ where nothing says more.
    assert flat.mass == pytest.approx(0.02)
    assert tall.mass == pytest.approx(400 * 0.04 * 0.06 * 0.1)
    assert tall.centre == pytest.approx((0, 0, 0), abs=1e-9)
    assert tall.inertia[2][2] == pytest.approx(tall.mass / 12 * (0.04**2 + 0.06**2))
    assert tall.catalogue == "shelf"


def test_origin_scale_and_mass_of_a_urdf_are_used_and_its_inertia_is_not(tmp_path, make_box, object_cache):
    make_box(tmp_path, size=(40.0, 60.0, 100.0))
    # Rolled by a quarter, what was along z lies along -y; then it is lifted.
    write_urdf(tmp_path, scale="0.001 0.001 0.001", rpy="1.5707963267948966 0 0", z=0.03)
    (model,) = open_catalogue(tmp_path).models
    corners = model.corners()
    assert np.ptp(corners, axis=0) == pytest.approx([0.04, 0.1, 0.06])
    assert model.centre == pytest.approx((0.0, 0.0, 0.03), abs=1e-9)
    assert model.mass == pytest.approx(0.1)
    assert model.inertia[1][1] == pytest.approx(0.1 / 12 * (0.04**2 + 0.06**2), rel=1e-6)


def test_an_implausible_mass_is_replaced(tmp_path, make_box, object_cache):
    make_box(tmp_path)
    (model,) = open_catalogue(write_urdf(tmp_path, mass=100.0)).models
    assert model.mass == pytest.approx(400 * 2.4e-4)


def test_models_are_prepared_once(tmp_path, make_box, object_cache, monkeypatch):
    make_box(tmp_path / "shelf")
    first = open_catalogue(tmp_path / "shelf").models
    monkeypatch.setattr(module, "write_model", None)
    assert open_catalogue(tmp_path / "shelf").models == first
    assert first[0].visual.is_relative_to(object_cache / "nerfgrasp" / "objects")
    # Nothing half-written is left.
    assert [path.name for path in first[0].visual.parent.parent.iterdir()] == [first[0].sha256]


def test_the_hash_is_of_what_the_files_hold(tmp_path, make_box, object_cache):
    make_box(tmp_path / "a")
    make_box(tmp_path / "b")
    make_box(tmp_path / "c", size=(0.04, 0.06, 0.101))
    make_box(tmp_path / "d")
    Image.new("RGB", (64, 64)).save(tmp_path / "d" / "texture_map.png")
    a, b, c, d = (open_catalogue(tmp_path / letter) for letter in "abcd")
    assert a.sha256 == b.sha256
    assert len({catalogue.sha256 for catalogue in (a, c, d)}) == 3
    assert a.models[0].sha256 == b.models[0].sha256


def test_the_visual_mesh_keeps_its_place_and_texture(tmp_path, make_box, object_cache):
    make_box(tmp_path / "shelf")
    (model,) = open_catalogue(tmp_path / "shelf").models
    mesh = trimesh.load_mesh(model.visual)
    assert mesh.extents == pytest.approx([0.04, 0.06, 0.1])
    with Image.open(model.visual.parent / "texture.png") as image:
        assert image.getpixel((10, 10)) == (255, 0, 0)


def test_large_textures_are_made_smaller(tmp_path, make_box, object_cache, monkeypatch):
    monkeypatch.setattr(preparation, "MAX_TEXTURE", 16)
    make_box(tmp_path / "shelf")
    (model,) = open_catalogue(tmp_path / "shelf").models
    with Image.open(model.visual.parent / "texture.png") as image:
        assert image.size == (16, 16)


def test_colours_without_a_texture_become_one(tmp_path, object_cache):
    mesh = trimesh.creation.box((0.05, 0.05, 0.05))
    mesh.visual.vertex_colors = np.tile([10, 200, 30, 255], (8, 1))
    (tmp_path / "shelf").mkdir()
    mesh.export(tmp_path / "shelf" / "green.ply")
    (model,) = open_catalogue(tmp_path / "shelf").models
    with Image.open(model.visual.parent / "texture.png") as image:
        assert np.abs(np.asarray(image.convert("RGB"), int) - [10, 200, 30]).max() <= 2


def test_normals_that_are_not_numbers_do_no_harm(tmp_path, make_box, object_cache):
    file = make_box(tmp_path / "shelf")
    lines = ["vn nan nan nan", *file.read_text().splitlines()]
    file.write_text("\n".join(line.replace("/3", "/3/1") if line.startswith("f") else line for line in lines))
    (model,) = open_catalogue(tmp_path / "shelf").models
    assert "nan" not in model.visual.read_text()


def test_an_object_finds_its_model_again(tmp_path, make_box, object_cache, monkeypatch):
    make_box(tmp_path / "shelf")
    (model,) = open_catalogue(tmp_path / "shelf").models
    thing = model.place()
    assert model_of(thing) == model
    monkeypatch.setattr(module, "_opened", {})
    with pytest.raises(UserError, match="'textured' of the catalogue 'shelf' is not here: .*NERFGRASP_OBJECTS"):
        model_of(thing)
    monkeypatch.setenv("NERFGRASP_OBJECTS", str(tmp_path / "shelf"))
    assert model_of(thing) == model
    make_box(tmp_path / "shelf", size=(0.05, 0.05, 0.05))
    monkeypatch.setattr(module, "_opened", {})
    with pytest.raises(UserError, match="is not the scene's: its files' hash is .* made with " + thing.sha256):
        model_of(thing)


def test_without_a_folder_the_objects_of_the_package_serve(object_cache):
    catalogue = open_catalogue()
    assert catalogue.name == "pybullet"
    assert len(catalogue.names) == 1000
    model = catalogue.model("000")
    # Five pieces, as its file has them.
    assert model.hulls.read_text().count("o hull") == 5
    assert model_of(model.place()) == model


def break_urdf(folder, make_box):
    (folder / "thing.urdf").write_text("<robot>")


def missing_mesh(folder, make_box):
    write_urdf(folder, mesh="elsewhere.obj")


def missing_texture(folder, make_box):
    make_box(folder)
    (folder / "texture_map.png").unlink()


def millimetres(folder, make_box):
    make_box(folder, size=(40.0, 60.0, 100.0))


def no_metres(folder, make_box):
    make_box(folder, size=(4e-5, 6e-5, 1e-4))


def broken_mesh(folder, make_box):
    (folder / "thing.stl").write_bytes(b"solid nothing\nendsolid")


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (lambda folder, make_box: None, "shelf: neither a URDF nor a mesh"),
        (break_urdf, "thing.urdf: not a URDF"),
        (missing_mesh, "thing.urdf: it names the mesh elsewhere.obj, and there is no such file"),
        (missing_texture, "textured.mtl: it names texture_map.png, and there is no such file"),
        (millimetres, "textured.obj: the object is 100 m long: is the mesh in millimetres"),
        (no_metres, "textured.obj: the object is 0.1 mm long"),
        (broken_mesh, "thing.stl: (the mesh cannot be read|there are no triangles in it)"),
    ],
)
def test_mistakes_are_told_in_one_line(fault, message, tmp_path, make_box, object_cache):
    folder = tmp_path / "shelf"
    folder.mkdir()
    fault(folder, make_box)
    with pytest.raises(UserError, match=message) as error:
        _ = open_catalogue(folder).models
    assert "\n" not in str(error.value)
    assert not list(object_cache.glob("nerfgrasp/objects/*"))


def test_a_folder_that_is_not_there():
    with pytest.raises(UserError, match="nowhere: no such folder of objects"):
        open_catalogue(Path("nowhere"))


@pytest.mark.skipif("NERFGRASP_OBJECTS" not in os.environ, reason="NERFGRASP_OBJECTS names no folder of YCB's objects")
def test_the_nine_objects_of_ycb_have_plausible_mass_and_size():
    """Prepared in the user's own cache: the first time takes minutes."""
    models = {model.name: model for model in open_catalogue(Path(os.environ["NERFGRASP_OBJECTS"])).models}
    assert len(models) == 9
    ball, hammer = models["tennis_ball"], models["hammer"]
    assert np.ptp(ball.corners(), axis=0) == pytest.approx([0.065] * 3, abs=0.004)
    # A solid ball has 2/5 m r².
    assert np.diag(ball.inertia) == pytest.approx([0.4 * 0.058 * 0.0325**2] * 3, rel=0.1)
    assert hammer.mass == pytest.approx(0.665)
