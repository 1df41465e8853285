import math
from contextlib import suppress
from pathlib import Path

import pytest

from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder, read_json, remove_temporaries, replacing, write_json


def test_json_round_trip(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"x": [1, 0.1, None]})
    assert read_json(tmp_path / "a.json") == {"x": [1, 0.1, None]}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_failed_write_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"old": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"new": math.nan})
    with suppress(KeyboardInterrupt), replacing(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert read_json(path) == {"old": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_folders_appear_whole(tmp_path: Path) -> None:
    with replacing(tmp_path / "folder") as temporary:
        temporary.mkdir()
        (temporary / "file").write_text("x")
        assert not (tmp_path / "folder").exists()
    assert (tmp_path / "folder" / "file").read_text() == "x"


def test_a_full_folder_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "kept").write_text("")
    with pytest.raises(UserError, match=r"cannot write .*folder: "), replacing(tmp_path / "folder") as temporary:
        temporary.mkdir()
    assert [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.rglob("*"))] == ["folder", "folder/kept"]


def test_mistakes_are_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("[]")
    for mistake, message in (
        (lambda: read_json(tmp_path / "none"), "none: no such file"),
        (lambda: read_json(tmp_path / "file"), "is not a JSON object"),
        (lambda: read_json(tmp_path), "cannot read"),
        (lambda: make_folder(tmp_path / "file" / "a"), "cannot write"),
        (lambda: write_json(tmp_path / "file" / "a", {}), "cannot write"),
        (lambda: write_json(tmp_path / "none" / "a", {}), "cannot write"),
    ):
        with pytest.raises(UserError, match=message) as caught:
            mistake()
        assert "\n" not in str(caught.value)


def test_temporaries_go_and_nothing_else(tmp_path: Path) -> None:
    for name in (".a.json.17.tmp", "kept.tmp", ".kept"):
        (tmp_path / name).write_text("")
    (tmp_path / ".scene.3.tmp").mkdir()
    (tmp_path / ".scene.3.tmp" / "image").write_text("")
    remove_temporaries(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".kept", "kept.tmp"]
