from pathlib import Path

import pytest

from nerfgrasp import cli


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Installs a distribution of two plug-ins: one fails to import, one breaks its promises."""
    info = tmp_path / "broken_dist-0.3.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-dist\nVersion: 0.3\n")
    (info / "entry_points.txt").write_text(
        "[nerfgrasp.poses]\nfails_import = plugin_that_fails:Pose\n"
        "[nerfgrasp.baselines]\nno_method = plugin_without_needs:Method\n"
    )
    (tmp_path / "plugin_that_fails.py").write_text("import a_package_that_is_not_there\n")
    (tmp_path / "plugin_without_needs.py").write_text("class Method: ...\n")
    monkeypatch.syspath_prepend(str(tmp_path))


def test_list_shows_where_each_plug_in_comes_from(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plugins", "list"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert rows[0] == ["group", "name", "distribution", "version", "object"]
    row = next(row for row in rows if row[1] == "quaternion")
    assert row[0] == "nerfgrasp.poses"
    assert row[2] == "nerfgrasp"
    assert row[4] == "nerfgrasp_poses.quaternion:Quaternion"


def test_list_shows_a_plug_in_that_cannot_be_imported(broken: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plugins", "list"]) == 0
    out, err = capsys.readouterr()
    assert "broken-dist" in out
    assert err == ""


def test_check_reports_each_failure_and_goes_on(broken: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plugins", "list", "--check"]) == 2
    out, err = capsys.readouterr()
    verdicts = {line.split()[1]: line.split()[-1] for line in out.splitlines()[1:]}
    assert verdicts["fails_import"] == verdicts["no_method"] == "failed"
    assert verdicts["quaternion"] == verdicts["psi"] == "ok"
    fails_import, no_method = err.splitlines()
    assert "broken-dist 0.3" in fails_import
    assert "No module named 'a_package_that_is_not_there'" in fails_import
    assert "broken-dist 0.3" in no_method
    assert "`needs` is a frozenset" in no_method


@pytest.mark.parametrize("args", [[], ["lst"], ["list", "--chek"]])
def test_wrong_arguments_are_one_line(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plugins", *args]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("nerfgrasp: error: plugins: ")
    assert err.count("\n") == 1
