"""The template is a distribution of its own: once installed, it is found, and its conformance test passes."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

TEMPLATE = Path(__file__).parents[2] / "plugins" / "template"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory, install: Callable[[Path, Path], None]) -> dict[str, str]:
    """Installs the template into a folder, and returns an environment that sees it."""
    folder = tmp_path_factory.mktemp("template")
    source = shutil.copytree(TEMPLATE, folder / "source", ignore=shutil.ignore_patterns("__pycache__"))
    install(source, folder / "site")
    return os.environ | {"PYTHONPATH": str(folder / "site")}


def run(environment: dict[str, str], *args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *args], env=environment, capture_output=True, text=True, check=False, cwd=TEMPLATE
    )


def test_list_shows_it(installed: dict[str, str]) -> None:
    done = run(installed, "-m", "nerfgrasp", "plugins", "list")
    assert done.returncode == 0
    row = next(line.split() for line in done.stdout.splitlines() if " sixd " in line)
    assert row == ["nerfgrasp.poses", "sixd", "nerfgrasp-template", "0.1.0", "nerfgrasp_template.sixd:SixD"]


def test_its_conformance_test_passes(installed: dict[str, str]) -> None:
    done = run(installed, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--import-mode=importlib", "tests")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed" in done.stdout


def test_without_it_the_name_is_unknown() -> None:
    done = run(os.environ.copy(), "-m", "nerfgrasp", "plugins", "list")
    assert " sixd " not in done.stdout
