"""`nerfgrasp objects import` on archives that the test makes and serves."""

import hashlib
import io
import json
import tarfile
import threading
import zipfile
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest
import trimesh

from nerfgrasp import cli
from nerfgrasp.sim.catalogue import open_catalogue


@pytest.fixture
def scan(tmp_path, make_box, object_cache):
    """`007_brick/google_16k/textured.obj` with its texture, as YCB publishes it."""
    make_box(tmp_path / "scans" / "007_brick" / "google_16k")
    return tmp_path / "scans" / "007_brick"


@pytest.fixture
def archive(scan, tmp_path):
    (tmp_path / "served").mkdir()
    path = tmp_path / "served" / "007_brick_google_16k.tgz"
    with tarfile.open(path, "w:gz") as tar:
        tar.add(scan, "007_brick")
    return path


class Handler(SimpleHTTPRequestHandler):
    """Serves a folder and counts what was asked for."""

    asked: list[str] = []

    def log_message(self, *_):
        self.asked.append(self.path)


@pytest.fixture
def server(tmp_path, monkeypatch):
    """Serves `tmp_path / "served"` on this machine; yields its address."""
    monkeypatch.setattr(Handler, "asked", [])
    monkeypatch.setattr("nerfgrasp.sim.archives.RETRIES", 0)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    (tmp_path / "served").mkdir(exist_ok=True)
    handler = partial(Handler, directory=str(tmp_path / "served"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as served:
        thread = threading.Thread(target=served.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{served.server_port}"
        served.shutdown()
        thread.join()


def run(*args):
    return cli.main(["objects", "import", *map(str, args)])


def test_an_archive_is_fetched_once_and_becomes_a_catalogue(archive, server, tmp_path, capsys):
    url, out = f"{server}/{archive.name}", tmp_path / "ycb"
    digest = hashlib.sha256(archive.read_bytes()).hexdigest()
    assert run(url, "--out", out, "--sha256", digest) == 0
    assert f"{out / 'brick'}: imported" in capsys.readouterr().out
    catalogue = open_catalogue(out)
    assert (catalogue.name, catalogue.names) == ("ycb", ("brick",))
    (model,) = catalogue.models
    assert model.mass == pytest.approx(400 * 2.4e-4)
    assert trimesh.load_mesh(model.visual).extents == pytest.approx([0.04, 0.06, 0.1])
    assert json.loads((out / "brick" / "source.json").read_text())["source"] == url
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    assert run(url, "--out", out) == 0
    assert "brick: is already there" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before
    assert len(Handler.asked) == 1


def test_an_import_that_was_killed_continues(archive, scan, make_box, tmp_path, capsys):
    out = tmp_path / "ycb"
    assert run(archive, "--out", out) == 0
    (out / ".plate.123.tmp").mkdir()
    make_box(scan.parent / "008_plate" / "google_16k", size=(0.1, 0.1, 0.02))
    assert run(scan.parent, "--out", out) == 0
    assert capsys.readouterr().out.splitlines()[1:] == [
        f"{out / 'brick'}: is already there", f"{out / 'plate'}: imported",
    ]  # fmt: skip
    assert sorted(path.name for path in out.iterdir()) == ["brick", "plate"]


def test_zip_archives_and_folders_of_meshes_serve_too(tmp_path, object_cache):
    mesh = trimesh.creation.box((0.05, 0.05, 0.02)).export(file_type="stl")
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as file:
        file.writestr("meshes/flat.stl", mesh)
    assert run(tmp_path / "set.zip", "--out", tmp_path / "out") == 0
    assert open_catalogue(tmp_path / "out").names == ("flat",)


def test_an_imported_object_is_that_of_its_source(archive, scan, tmp_path, object_cache):
    """Mass, centre and inertia survive the way through our own URDF."""
    assert run(archive, "--out", tmp_path / "out") == 0
    (ours,), (theirs,) = open_catalogue(tmp_path / "out").models, open_catalogue(scan).models
    assert ours.mass == pytest.approx(theirs.mass)
    assert ours.inertia[0][0] == pytest.approx(theirs.inertia[0][0], rel=1e-6)


def escaping_tar(tmp_path):
    path = tmp_path / "bad.tgz"
    with tarfile.open(path, "w:gz") as tar:
        info = tarfile.TarInfo("../escaped.obj")
        info.size = 4
        tar.addfile(info, io.BytesIO(b"evil"))
    return path


def linking_tar(tmp_path):
    path = tmp_path / "link.tgz"
    with tarfile.open(path, "w:gz") as tar:
        info = tarfile.TarInfo("link.obj")
        info.type, info.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(info)
    return path


def escaping_zip(tmp_path):
    path = tmp_path / "bad.zip"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("../escaped.obj", "evil")
    return path


def cut_short(tmp_path):
    path = tmp_path / "short.tgz"
    with tarfile.open(path, "w:gz") as tar:
        info = tarfile.TarInfo("noise.obj")
        info.size = 100_000
        tar.addfile(info, io.BytesIO(bytes(range(250)) * 400))
    path.write_bytes(path.read_bytes()[:200])
    return path


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (escaping_tar, "refused, something in it would land outside"),
        (linking_tar, "refused, 'link.obj' is neither a file nor a folder"),
        (escaping_zip, "refused, something in it would land outside"),
        (cut_short, "short.tgz: the archive is damaged"),
        (lambda tmp_path: tmp_path / "none.tgz", "none.tgz: no such file or folder"),
    ],
)
def test_bad_archives_write_nothing(make, message, tmp_path, object_cache, capsys):
    out = tmp_path / "deep" / "out"
    assert run(make(tmp_path), "--out", out) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(out.iterdir())
    assert not list(tmp_path.rglob("escaped*"))


def test_faults_of_an_object_are_named_by_their_source(scan, tmp_path, capsys):
    (scan / "google_16k" / "texture_map.png").unlink()
    archive = tmp_path / "brick.tgz"
    with tarfile.open(archive, "w:gz") as tar:
        tar.add(scan, "007_brick")
    assert run(archive, "--out", tmp_path / "out") == 2
    place = f"{archive}/007_brick/google_16k/textured.mtl"
    assert f"{place}: it names texture_map.png, and there is no such file" in capsys.readouterr().err


def test_wrong_checksums_are_refused(archive, server, tmp_path, capsys):
    for source in (archive, f"{server}/{archive.name}"):
        assert run(source, "--out", tmp_path / "out", "--sha256", "0" * 64) == 2
        assert "checksum" in capsys.readouterr().err
    assert not list((tmp_path / "out").iterdir())


def test_an_address_without_a_file_is_told(server, tmp_path, object_cache, capsys):
    assert run(f"{server}/none.tgz", "--out", tmp_path / "out") == 2
    assert f"cannot fetch {server}/none.tgz: 404" in capsys.readouterr().err


def test_another_object_of_the_same_name_is_not_overwritten(archive, make_box, tmp_path, capsys):
    assert run(archive, "--out", tmp_path / "out") == 0
    make_box(tmp_path / "other" / "007_brick" / "google_16k", size=(0.05, 0.05, 0.05))
    assert run(tmp_path / "other", "--out", tmp_path / "out") == 2
    assert "brick is there already, and it was not made of" in capsys.readouterr().err


def test_usage_errors_are_one_line(tmp_path, capsys):
    assert run("a.tgz") == 2
    assert "objects: the following arguments are required: --out" in capsys.readouterr().err
    assert run("a.tgz", "b.tgz", "--out", tmp_path, "--sha256", "0") == 2
    assert "--sha256 is the checksum of one archive, and there are 2 sources" in capsys.readouterr().err
