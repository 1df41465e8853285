import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from nerfgrasp.errors import UserError
from nerfgrasp.models import FieldConfig, GraspValue, GraspValueConfig, MVNeRF, MVNeRFConfig
from nerfgrasp.models import folder as module
from nerfgrasp.models.folder import find_model, from_plain, load_backbone, load_model, save_model, weights_hash


@pytest.fixture
def network(tiny_network: Callable[..., Any]) -> MVNeRF:
    return MVNeRF(tiny_network(depth_range=(0.3, 1.3)))


@pytest.fixture
def saved(network: MVNeRF, tmp_path: Path) -> Path:
    save_model(tmp_path / "model", network)
    return tmp_path / "model"


def test_a_backbone_comes_back_as_it_was(network: MVNeRF, saved: Path) -> None:
    again = load_model(saved)
    assert type(again) is MVNeRF
    assert again.config == network.config
    assert not again.training
    assert weights_hash(again) == weights_hash(network)
    assert sorted(path.name for path in saved.iterdir()) == ["config.json", "model.safetensors"]
    assert "method" not in json.loads((saved / "config.json").read_text())


def test_a_grasp_value_comes_back_with_its_backbone(tiny_network: Callable[..., Any], tmp_path: Path) -> None:
    model = GraspValue(GraspValueConfig(tiny_network(), pose_width=8))
    save_model(tmp_path / "a" / "b", model)
    again = load_model(str(tmp_path / "a" / "b"))
    assert type(again) is GraspValue
    assert again.config == model.config
    assert weights_hash(again) == weights_hash(model)
    assert json.loads((tmp_path / "a" / "b" / "config.json").read_text())["method"] == "psi"


def test_what_learned_nothing_of_scenes_is_no_backbone(tiny_network: Callable[..., Any], tmp_path: Path) -> None:
    value = GraspValue(GraspValueConfig(backbone=tiny_network(), renders=False))
    save_model(tmp_path / "no3", value)
    with pytest.raises(UserError, match=r"no3 never learned to render: it was trained on grasps alone"):
        load_backbone(tmp_path / "no3")


def test_half_precision_on_disk(network: MVNeRF, saved: Path, tmp_path: Path) -> None:
    save_model(tmp_path / "half", network, dtype=torch.float16)
    full, half = (path.stat().st_size for path in (saved / "model.safetensors", tmp_path / "half/model.safetensors"))
    assert half < 0.7 * full
    assert load_file(tmp_path / "half" / "model.safetensors")["fine.readout.weight"].dtype == torch.float16
    for one, other in zip(network.parameters(), load_model(tmp_path / "half").parameters(), strict=True):
        assert other.dtype == torch.float32
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-3)


def test_nothing_is_fetched_for_the_encoder_of_a_saved_model(saved: Path) -> None:
    config = json.loads((saved / "config.json").read_text())
    config["config"]["encoder"]["pretrained"] = True
    (saved / "config.json").write_text(json.dumps(config))
    assert load_model(saved).config.encoder.pretrained is False


def test_weights_hash_sees_one_changed_value(network: MVNeRF) -> None:
    before = weights_hash(network)
    assert before == weights_hash(network)
    network.fine.readout.bias.data[2] += 1e-6
    assert weights_hash(network) != before


def changed(**entries: Any) -> Callable[[Path], object]:
    """Returns what changes entries of `config` in a `config.json`."""

    def change(path: Path) -> None:
        data = json.loads(path.read_text())
        data["config"] = {**data["config"], **entries}
        path.write_text(json.dumps(data))

    return change


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("config.json", Path.unlink, r"config.json: no such file"),
        ("config.json", lambda path: path.write_text(path.read_text()[:-9]), r"config.json is not valid JSON"),
        ("config.json", lambda path: path.write_bytes(b"\xff\x00"), r"config.json is not valid JSON"),
        ("config.json", lambda path: path.write_text("[]"), r"config.json is not a JSON object"),
        ("config.json", lambda path: path.write_text('{"kind": "ngp", "config": {}}'), "grasp_value, mvnerf"),
        ("config.json", changed(veiws=3), r"config.json: unknown key 'veiws' in MVNeRFConfig"),
        ("config.json", changed(views="3"), r"config.json: MVNeRFConfig.views is '3', not of type int"),
        ("config.json", changed(fine={"width": -1}), r"config.json: "),
        ("config.json", changed(fine={"width": 17}), r"model.safetensors does not fit config.json: "),
        ("config.json", changed(encoder=7), r"config.json: MVNeRFConfig.encoder is 7, not of type EncoderConfig"),
        ("config.json", changed(encoder={"vit": "nothing"}), r"config.json: unknown timm model 'nothing'"),
        ("model.safetensors", Path.unlink, r"model.safetensors: no such file"),
        ("model.safetensors", lambda path: path.write_bytes(b""), r"model.safetensors is damaged or truncated"),
        ("model.safetensors", lambda path: path.write_bytes(path.read_bytes()[:-1]), "is damaged or truncated"),
        ("model.safetensors", lambda path: path.write_bytes(b"PK\x03\x04" * 99), "is damaged or truncated"),
        ("model.safetensors", lambda path: save_file({"a": torch.ones(1)}, path), "does not fit config.json: Missing"),
    ],
)
def test_damage_is_one_line(saved: Path, name: str, damage: Callable[[Path], object], message: str) -> None:
    damage(saved / name)
    with pytest.raises(UserError, match=message) as error:
        load_model(saved)
    assert "\n" not in str(error.value)


def test_from_plain() -> None:
    plain = {"views": 1, "fine": {"width": 7}, "depth_range": [0.3, 1.3], "margin": 1}
    config = from_plain(MVNeRFConfig, plain)
    assert (config.views, config.fine, config.depth_range) == (1, FieldConfig(width=7), (0.3, 1.3))
    assert type(config.margin) is float
    with pytest.raises(ValueError, match="unknown key 'widht' in FieldConfig"):
        from_plain(MVNeRFConfig, {"fine": {"widht": 7}})
    with pytest.raises(ValueError, match="FieldConfig.width is True, not of type int"):
        from_plain(FieldConfig, {"width": True})


def test_unknown_models(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    shipped = tmp_path / "assets" / "models" / "mv3-laptop"
    shipped.mkdir(parents=True)
    (shipped / "config.json").write_text("{}")
    monkeypatch.setattr(module, "files", lambda package: tmp_path)
    assert find_model("mv3-laptop") == shipped
    assert find_model(str(tmp_path)) == tmp_path
    with pytest.raises(UserError, match=r"unknown model .*'mv3-latpop': did you mean 'mv3-laptop'\?"):
        find_model("mv3-latpop")
    with pytest.raises(UserError, match=r"no folder 'runs/nowhere', and it cannot be fetched") as error:
        find_model("runs/nowhere")
    assert "\n" not in str(error.value)


def test_a_failed_write_leaves_the_old_model(saved: Path, network: MVNeRF, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {path.name: path.read_bytes() for path in saved.iterdir()}

    def full(path: Path, data: bytes) -> None:
        path.write_text("half")
        if path.name.startswith(".model"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    nn.init.zeros_(network.fine.readout.weight)
    monkeypatch.setattr(module, "write_through", full)
    with pytest.raises(UserError, match=r"cannot write .*model.safetensors: No space left on device"):
        save_model(saved, network)
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before


def test_a_kill_between_the_two_files_is_told(
    saved: Path, network: MVNeRF, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced, fsync = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(fsync(file)))
    nn.init.zeros_(network.fine.readout.weight)
    save_model(tmp_path / "new", network)
    assert len(synced) == 2
    (tmp_path / "new" / "model.safetensors").replace(saved / "model.safetensors")
    with pytest.raises(UserError, match=r"model.safetensors is not the file that config.json was written with"):
        load_model(saved)
    config = json.loads((saved / "config.json").read_text())
    del config["weights_sha256"]
    (saved / "config.json").write_text(json.dumps(config))
    assert weights_hash(load_model(saved)) == weights_hash(network), "older folders have no hash"


def test_weights_are_as_readable_as_any_other_file(saved: Path) -> None:
    assert (saved / "model.safetensors").stat().st_mode == (saved / "config.json").stat().st_mode


def test_a_folder_that_cannot_be_made_is_told(network: MVNeRF, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write .*file"):
        save_model(tmp_path / "file" / "model", network)
