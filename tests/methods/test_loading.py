import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.methods.loading import find_method, load_method, method_hash
from nerfgrasp.methods.spec import MethodSpec
from nerfgrasp.models.folder import weights_hash


class Trained:
    """A method that cannot do without a model."""

    def __init__(self, folder: str) -> None:
        self.folder, self.model = folder, nn.Linear(2, 2)

    @classmethod
    def from_pretrained(cls, folder: str) -> "Trained":
        return cls(folder)


class Untrained:
    @classmethod
    def from_pretrained(cls, folder: str | None = None) -> "Untrained":
        return cls()


class Faulty:
    @classmethod
    def from_pretrained(cls) -> "Faulty":
        return cls()


class Raising:
    @classmethod
    def from_pretrained(cls, folder: str | None = None) -> "Raising":
        raise KeyError("theirs")


class Placed:
    def __init__(self, device: str) -> None:
        self.device = device

    @classmethod
    def from_pretrained(cls, folder: str = "", *, device: str = "cpu") -> "Placed":
        return cls(device)


class Optional(Trained):
    """A method with options of its own, which the package does not know."""

    def __init__(self, folder: str, temperature: float, pose: str) -> None:
        super().__init__(folder)
        self.temperature, self.pose = temperature, pose

    @classmethod
    def from_pretrained(cls, folder: str, *, temperature: float = 1.0, pose: str = "own") -> "Optional":
        return cls(folder, temperature, pose)


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    methods: dict[str, Any] = {"trained": Trained, "untrained": Untrained, "optional": Optional}
    methods |= {"faulty": Faulty, "raising": Raising, "psi": Raising, "placed": Placed}
    monkeypatch.setattr(registry, "load", lambda group, name: methods[name])
    load_method.cache_clear()
    yield
    load_method.cache_clear()


def test_a_registered_name_needs_no_folder() -> None:
    assert find_method("oracle") == MethodSpec("oracle")


def test_a_folder_names_its_method(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"method": "psi"}))
    assert find_method(str(tmp_path)) == MethodSpec("psi", str(tmp_path))
    (tmp_path / "config.json").write_text(json.dumps({"method": "pis"}))
    with pytest.raises(UserError, match="unknown method 'pis': did you mean 'psi'"):
        find_method(str(tmp_path))


def test_a_shipped_model_goes_by_its_name() -> None:
    spec = find_method("mv3-laptop")
    assert spec.name == "psi"
    assert spec.folder is not None
    assert spec.folder.endswith("mv3-laptop")


def test_a_method_that_needs_a_model_says_so() -> None:
    with pytest.raises(UserError, match="method 'trained' needs a model: give the model's folder"):
        load_method(MethodSpec("trained"))
    assert load_method(MethodSpec("trained", "there")).folder == "there"  # type: ignore[attr-defined]


@pytest.mark.parametrize("folder", [None, "there"])
def test_a_faulty_loader_is_named(folder: str | None) -> None:
    with pytest.raises(
        UserError, match=r"method 'faulty', from_pretrained: TypeError: it takes no folder \(the plug-in"
    ):
        load_method(MethodSpec("faulty", folder))
    with pytest.raises(UserError, match="'raising', from_pretrained: KeyError: 'theirs' .*at fault") as told:
        load_method(MethodSpec("raising", folder))
    assert isinstance(told.value.__cause__, KeyError)
    with pytest.raises(UserError, match=r"'psi' \(nerfgrasp.methods.psi:Psi of nerfgrasp [0-9.]+\), from_pretrained"):
        load_method(MethodSpec("psi", folder))


def test_options_are_the_parameters_of_the_loader() -> None:
    method: Any = load_method(MethodSpec("optional", "there", {"temperature": 0.3}))
    assert (method.temperature, method.pose) == (0.3, "own")
    method = load_method(MethodSpec("optional", "there", {"temperature": None, "pose": "rotvec"}))
    assert (method.temperature, method.pose) == (1.0, "rotvec")
    with pytest.raises(UserError, match="'optional' has no option 'temprature': did you mean 'temperature'"):
        load_method(MethodSpec("optional", "there", {"temprature": 0.3}))
    with pytest.raises(UserError, match=r"method 'trained' has no option 'pose': \(choices: none\)"):
        load_method(MethodSpec("trained", "there", {"pose": "rotvec"}))


def test_a_device_is_for_methods_that_take_one() -> None:
    assert load_method(MethodSpec("placed", options={"device": "cpu:0"})).device == "cpu:0"  # type: ignore[attr-defined]
    assert load_method(MethodSpec("placed")).device == "cpu"  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="method 'trained' has no option 'device'"):
        load_method(MethodSpec("trained", "there", {"device": "cpu:0"}))


def test_the_hash_is_that_of_the_weights() -> None:
    assert method_hash(load_method(MethodSpec("untrained"))) is None
    method: Any = load_method(MethodSpec("trained", "there"))
    before = method_hash(method)
    assert before == weights_hash(method.model)[:16]
    with torch.no_grad():
        method.model.bias += 1
    assert method_hash(method) != before
