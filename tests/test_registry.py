from pathlib import Path

import pytest

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.registry import BASELINES, POSES


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Returns a function that installs a distribution with one plug-in, as pip would leave it on the path."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def install(distribution: str, group: str, name: str, value: str, source: str = "", where: str = ".") -> Path:
        folder = tmp_path / where
        info = folder / f"{distribution.replace('-', '_')}-1.2.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {value}\n")
        if source:
            (folder / f"{value.partition(':')[0]}.py").write_text(source)
        return folder

    return install


def test_built_ins_come_through_their_entry_points() -> None:
    assert "quaternion" in registry.names(POSES)
    assert "psi" in registry.names(BASELINES)
    found = registry.find(POSES, "quaternion")
    assert (found.distribution, found.value) == ("nerfgrasp", "nerfgrasp_poses.quaternion:Quaternion")


def test_load_returns_the_object() -> None:
    assert registry.load(POSES, "quaternion").__name__ == "Quaternion"


def test_listing_imports_nothing(install) -> None:
    install("bomb", POSES, "bomb", "bomb_module:Pose", "raise SystemExit('imported')")
    assert "bomb" in registry.names(POSES)
    assert registry.find(POSES, "bomb").version == "1.2"


def test_a_third_partys_plug_in_is_found_and_loaded(install) -> None:
    install("other-poses", POSES, "other", "other_poses_module:Pose", "class Pose: ...")
    assert registry.load(POSES, "other").__module__ == "other_poses_module"


def test_unknown_name_lists_near_misses_and_choices() -> None:
    with pytest.raises(UserError, match=r"unknown pose 'quaternoin': did you mean 'quaternion'\? \(choices: .*quat"):
        registry.load(POSES, "quaternoin")


@pytest.mark.parametrize(
    ("source", "cause"),
    [
        ("import not_there_at_all", "ModuleNotFoundError: No module named 'not_there_at_all'"),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("class Other: ...", "AttributeError"),
        ("class Pose(:", "SyntaxError"),
    ],
)
def test_a_broken_plug_in_breaks_only_itself(install, source: str, cause: str, request) -> None:
    module = f"broken_module_{abs(hash(request.node.name))}"
    install("broken-dist", POSES, "broken", f"{module}:Pose", source)
    with pytest.raises(UserError) as caught:
        registry.load(POSES, "broken")
    line = str(caught.value)
    assert "broken-dist 1.2" in line
    assert cause in line
    assert "\n" not in line
    assert registry.load(POSES, "quaternion")


def test_two_distributions_with_one_name_are_both_named(install) -> None:
    install("first-dist", POSES, "twin", "twin_a:Pose", "class Pose: ...")
    install("second-dist", POSES, "twin", "twin_b:Pose", "class Pose: ...")
    with pytest.raises(UserError, match=r"'twin' is declared twice: .*first-dist 1\.2 and .*second-dist 1\.2"):
        registry.load(POSES, "twin")
    assert len([entry for entry in registry.entries(POSES) if entry.name == "twin"]) == 2
    assert registry.names(POSES).count("twin") == 1


def test_one_distribution_found_twice_is_no_conflict(install, monkeypatch: pytest.MonkeyPatch) -> None:
    install("same-dist", POSES, "same", "same_module:Pose", "class Pose: ...")
    elsewhere = install("same-dist", POSES, "same", "same_module:Pose", where="elsewhere")
    monkeypatch.syspath_prepend(str(elsewhere))
    assert registry.load(POSES, "same").__name__ == "Pose"
