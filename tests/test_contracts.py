"""What may import what, and what starting the command costs."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

LEARNING = ("nerfgrasp.data", "nerfgrasp.models", "nerfgrasp.training", "nerfgrasp.search")


def loaded_after(statement: str) -> set[str]:
    """Returns the top-level modules that a fresh interpreter has loaded after `statement`."""
    script = f"{statement}\nimport sys\nprint('\\n' + ' '.join({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_learning_packages_import_neither_pybullet_nor_rerun() -> None:
    walk = (
        "import pkgutil, importlib\n"
        f"for package in map(importlib.import_module, {LEARNING!r}):\n"
        "    for found in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        importlib.import_module(found.name)"
    )
    loaded = loaded_after(walk)
    assert "torch" in loaded
    assert not loaded & {"pybullet", "pybullet_data", "rerun"}


@pytest.mark.parametrize("args", [["--help"], ["--version"], ["plugins", "list"]])
def test_light_commands_import_no_heavy_library(args: list[str]) -> None:
    loaded = loaded_after(f"from nerfgrasp.cli import main\nassert main({args!r}) == 0")
    assert "nerfgrasp" in loaded
    assert not loaded & {"torch", "numpy", "jsonargparse", "lightning", "timm", "rerun", "pybullet", "matplotlib"}


@pytest.mark.parametrize("module", ["nerfgrasp", "nerfgrasp.errors", "nerfgrasp.registry", "nerfgrasp.commands"])
def test_light_modules_import_no_torch(module: str) -> None:
    assert "torch" not in loaded_after(f"import {module}")


@pytest.mark.skipif(not (ROOT / "pyproject.toml").exists(), reason="the contracts stand in the checkout")
def test_imports_go_one_way() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()", "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
