"""What tests of commands share: ones that are killed or refused, tiny trainings, a model that has learned nothing."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import yaml

from nerfgrasp import cli
from nerfgrasp.models.folder import save_model
from nerfgrasp.models.grasp_value import GraspValue, GraspValueConfig

KILLED_WHILE_WRITING = """
import os, signal, {module} as module
write_json, written = module.write_json, []
def dying(path, data):
    written.append(path)
    if len(written) == {number}:
        path.with_name(f".{{path.name}}.{{os.getpid()}}.tmp").write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)
    write_json(path, data)
module.write_json = dying
"""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory, tiny_network: Any) -> Path:
    """A grasp value that has learned nothing."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("psi") / "model"
    save_model(folder, GraspValue(GraspValueConfig(tiny_network())))
    return folder


@pytest.fixture
def run_until_killed() -> Callable[..., None]:
    """Returns a function that runs a command in a process, and a process group, of its own until it is killed.

    It is killed with its workers once `until()` is true; or else it kills itself, half-way through the file that the
    given module writes as its so many-th (`writing=(module, number)`), or through what runs first (`before`).
    """

    def run(
        command: Callable[..., None],
        *,
        until: Callable[[], object] | None = None,
        writing: tuple[ModuleType, int] | None = None,
        before: str = "",
        **arguments: Any,
    ) -> None:
        if writing is not None:
            before = KILLED_WHILE_WRITING.format(module=writing[0].__name__, number=writing[1])
        name = command.__name__
        imports = f"from pathlib import PosixPath\nfrom {command.__module__} import {name}"
        script = f"{imports}\n{before}\n{name}(**{arguments!r})"
        process = subprocess.Popen([sys.executable, "-c", script], start_new_session=True)
        try:
            if until is None:
                assert process.wait(timeout=300) == -signal.SIGKILL
                return
            deadline = time.monotonic() + 300
            while process.poll() is None and not until() and time.monotonic() < deadline:
                time.sleep(0.005)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    return run


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str]) -> Callable[[list[str]], str]:
    """Returns a function that runs a command that must be refused, and returns its one line."""

    def run(args: list[str]) -> str:
        capsys.readouterr()
        assert cli.main(args) == 2
        lines = capsys.readouterr().err.splitlines()
        assert [line for line in lines if line.startswith("nerfgrasp: error: ")] == lines[-1:]
        assert not any("Traceback" in line for line in lines)
        return lines[-1].removeprefix("nerfgrasp: error: ")

    return run


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Path]:
    """The run's folder; what lies in it may be large, so it goes at once."""
    yield tmp_path / "run"
    shutil.rmtree(tmp_path / "run", ignore_errors=True)


@pytest.fixture
def set_entry() -> Callable[..., dict[str, Any]]:
    """Returns a function of a folder and changes: a config's entry of the set that `make_set` makes there."""
    return lambda folder, **changes: {"folder": str(folder), "scenes": 4, "views": 6, "seed": 5, "size": 32, **changes}


@pytest.fixture
def config(
    packed_set: Path,
    tiny_network: Callable[..., Any],
    run: Path,
    tmp_path: Path,
    set_entry: Callable[..., dict[str, Any]],
) -> Path:
    """A config that trains a tiny network for two steps."""
    scenes = set_entry(packed_set)
    data = {"train": scenes, "validation": scenes, "rays_per_scene": 8, "validation_scenes": 1}
    content = {
        "model": {
            "class_path": "nerfgrasp.training.MVNeRFTraining",
            "init_args": {"network": asdict(tiny_network())},
        },
        "data": {"class_path": "nerfgrasp.data.rays.RayData", "init_args": data},
        "trainer": {
            "default_root_dir": str(run),
            "accelerator": "cpu",
            "logger": False,
            "max_steps": 2,
            "val_check_interval": 2,
            "enable_model_summary": False,
        },
    }
    path = tmp_path / "tiny.yaml"
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def grasp_config(
    config: Path, make_set: Callable[..., Path], tiny_network, tmp_path: Path, set_entry: Callable[..., dict[str, Any]]
) -> Path:
    """A config that trains a grasp value for two steps on the backbone in `backbone`."""
    from nerfgrasp.models import MVNeRF
    from nerfgrasp.models.folder import save_model
    from nerfgrasp.sim.physics import PHYSICS, physics_hash

    folder = make_set(tmp_path / "grasps", demonstrations=True, physics=physics_hash(PHYSICS))
    scenes = set_entry(folder, demonstrations=True)
    content = yaml.safe_load(config.read_text())
    negatives = {"uniform": 5, "near": 2}
    content["model"] = {
        "class_path": "nerfgrasp.training.GraspValueTraining",
        "init_args": {"backbone": str(tmp_path / "backbone"), "pose_width": 4, "hidden_width": 8},
    }
    content["data"] = {
        "class_path": "nerfgrasp.data.grasps.GraspData",
        "init_args": {"train": scenes, "validation": scenes, "negatives": negatives},
    }
    path = tmp_path / "grasp.yaml"
    path.write_text(json.dumps(content))
    torch.manual_seed(0)
    save_model(tmp_path / "backbone", MVNeRF(tiny_network()))
    return path
