"""Pinned results: scenes, physics, models, searches, attempts, pictures and losses hold to the bit.

`pins.json` was recorded with NERFGRASP_RECORD=1, which writes what a test finds instead of comparing it. A pin changes
only where a change of results is intended and announced. Results of a network depend on the processor and on PyTorch's
version: elsewhere than where they were recorded they are compared to 1e-3, and poses by their shape alone.
"""

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinned
import pytest
import torch

pytest.importorskip("pybullet")

PINS = Path(__file__).with_name("pins.json")
SEED = 7
KEYS = ("scene", "attempt", "outcome", "grasp", "value", "objects", "object", "lifted_mm", "dropped", "errors")
KEYS += ("scene_sha256", "physics", "model", "set", "task", "seed", "method")


def machine() -> dict[str, str]:
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    vendor = next((line.split(":")[1].strip() for line in lines if line.startswith("vendor_id")), "unknown")
    return {"torch": torch.__version__, "capability": torch.backends.cpu.get_cpu_capability(), "vendor": vendor}


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def pin() -> Callable[[str, Any], Any]:
    """Returns a function that gives the pinned value of a name, or records the value that was found."""

    def pinned_value(name: str, found: Any) -> Any:
        pins = json.loads(PINS.read_text()) if PINS.exists() else {}
        if os.environ.get("NERFGRASP_RECORD"):
            pins |= {name: found, "machine": machine()}
            PINS.write_text(json.dumps(pins, indent=1, sort_keys=True) + "\n")
            return json.loads(json.dumps(found))
        return pins[name]

    return pinned_value


def recorded_here() -> bool:
    return json.loads(PINS.read_text())["machine"] == machine()


def plain(value: Any) -> Any:
    return json.loads(json.dumps(value))


@pytest.mark.parametrize("task", ["simple", "clutter", "novel"])
def test_scenes(task: str, pin: Callable[[str, Any], Any]) -> None:
    found = [pinned.scene_sha256(task, SEED, index) for index in range(3)]
    assert found == pin(f"scenes {task}", found)


def test_physics(pin: Callable[[str, Any], Any]) -> None:
    found = pinned.default_physics_hash()
    assert found == pin("physics", found)


@pytest.mark.parametrize("model", ["mv3-laptop", "mv1-laptop", "no1-laptop", "no3-laptop", "tn-laptop"])
def test_models(model: str, pin: Callable[[str, Any], Any]) -> None:
    found = pinned.model_sha256(model)
    assert found == pin(f"model {model}", found)


def test_demonstration(pin: Callable[[str, Any], Any]) -> None:
    found = pinned.demonstration("simple", SEED, 0)
    assert found == pin("demonstration", found)


@pytest.mark.parametrize("task", ["simple", "novel"])
def test_pictures(task: str, pin: Callable[[str, Any], Any]) -> None:
    found = pinned.picture_sha256(task, SEED, 0, 96)
    assert found == pin(f"pictures {task}", found)


def test_rendered_image(pin: Callable[[str, Any], Any]) -> None:
    found = pinned.rendered_colours("mv3-laptop", SEED, 0, 16)
    np.testing.assert_allclose(found, pin("rendered image", found), rtol=0, atol=1e-6 if recorded_here() else 1e-3)


SEARCHES = [
    ("mv3-laptop", strategy, index, 64)
    for strategy in ("guided", "resample", "alone", "joint", "prune", "paper", "halving")
    for index in (0, 1)
]
SEARCHES += [("mv1-laptop", "guided", 0, 64), ("no3-laptop", "guided", 0, 64)]


@pytest.mark.parametrize(("model", "strategy", "index", "candidates"), SEARCHES)
def test_searches(model: str, strategy: str, index: int, candidates: int, pin: Callable[[str, Any], Any]) -> None:
    found = plain(pinned.grasps(model, strategy, SEED, index, candidates))
    expected = pin(f"search {model} {strategy} {index}", found)
    if recorded_here():
        assert found == expected
    else:
        np.testing.assert_allclose(found["value"][0], expected["value"][0], rtol=1e-3)
        assert np.shape(found["T_world_grasp"])[1:] == (4, 4)


@pytest.mark.parametrize(
    ("task", "method", "scenes"),
    [("simple", "oracle", 10), ("clutter", "oracle", 2), ("novel", "antipodal", 10)],
)
def test_attempts(task: str, method: str, scenes: int, pin: Callable[[str, Any], Any]) -> None:
    found = plain([{key: row[key] for key in KEYS} for row in pinned.rows(task, method, SEED, scenes)])
    assert len(found) >= 10
    assert found == pin(f"attempts {task}", found)


def test_attempts_of_a_model(pin: Callable[[str, Any], Any]) -> None:
    found = plain([{key: row[key] for key in KEYS} for row in pinned.rows("simple", "mv3-laptop", SEED, 2)])
    expected = pin("attempts mv3", found)
    if recorded_here():
        assert found == expected
    else:
        assert [row["scene_sha256"] for row in found] == [row["scene_sha256"] for row in expected]


@pytest.mark.parametrize("kind", ["mvnerf", "softmax", "binary", "transporter"])
def test_losses(
    kind: str,
    make_set: Callable[..., Path],
    tiny_network: Callable[..., Any],
    tmp_path: Path,
    pin: Callable[[str, Any], Any],
) -> None:
    found = pinned.training_losses(kind, make_set, tiny_network(), tmp_path)
    np.testing.assert_allclose(found, pin(f"losses {kind}", found), rtol=1e-6 if recorded_here() else 1e-3)
