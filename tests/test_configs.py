"""The configs at the paper's scale, built without memory."""

from typing import Any

import pytest
import torch
import yaml

from nerfgrasp.commands.configs import find_config, laid_over
from nerfgrasp.geometry import Camera
from nerfgrasp.models import MVNeRF, MVNeRFConfig
from nerfgrasp.models.folder import from_plain
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.training.features import FeatureCache

# Parameters; 85.8 million of the encoder's are the transformer's.
COUNTS = {"encoder": 94_332_032, "coarse": 247_300, "fine": 247_300}


def read(name: str) -> dict[str, Any]:
    return yaml.safe_load(find_config(name).read_text())


def build(name: str, **encoder: Any) -> MVNeRF:
    plain = read(name)["model"].get("init_args", {}).get("network", {})
    config = from_plain(MVNeRFConfig, {**plain, "encoder": {"pretrained": False, **encoder}})
    with torch.device("meta"):
        return MVNeRF(config)


def count(module: torch.nn.Module) -> int:
    return sum(weights.numel() for weights in module.parameters())


@pytest.mark.parametrize(("name", "views"), [("mv1.yaml", 1), ("mv3.yaml", 3)])
def test_the_paper_s_networks(name: str, views: int) -> None:
    network = build(name)
    assert network.config.views == views
    assert read(name)["data"]["init_args"].get("views", 3) == views
    assert {part: count(getattr(network, part)) for part in ("encoder", "coarse", "fine")} == COUNTS
    with torch.device("meta"):
        camera = Camera(torch.eye(3).expand(1, views, 3, 3), torch.eye(4).expand(1, views, 4, 4), 480, 480)
        workspace = Workspace(torch.zeros(3), torch.ones(3))
        features = network.observe(torch.zeros(1, views, 3, 480, 480), camera, workspace)
        activations = network.activations(features, torch.zeros(1, 7, 5, 3), torch.zeros(1, 7, 3))
    assert features.fine.features.shape == (1, views, 480, 480, 128)
    assert {part.shape for part in activations} == {(1, 7, 5, 128)}


@pytest.mark.parametrize(("vit", "width"), [("vit_small_patch16_224", 384), ("deit3_medium_patch16_224", 512)])
def test_another_transformer_by_name(vit: str, width: int) -> None:
    network = build("mv3.yaml", vit=vit)
    assert network.encoder.vit.embed_dim == width
    with torch.device("meta"):
        assert network.encoder(torch.zeros(1, 3, 480, 480)).shape == (1, 256, 480, 480)
    assert (count(network.coarse), count(network.fine)) == (COUNTS["coarse"], COUNTS["fine"])


@pytest.mark.parametrize("scale", ["laptop", "workstation"])
@pytest.mark.parametrize(("name", "views"), [("mv1.yaml", 1), ("mv3.yaml", 3)])
def test_the_smaller_networks_fit_into_15_megabytes(scale: str, name: str, views: int) -> None:
    below, above = (read(config)["model"].get("init_args", {}) for config in (name, f"{scale}/{name}"))
    network = laid_over(below.get("network", {}), above["network"])
    with torch.device("meta"):
        model = MVNeRF(from_plain(MVNeRFConfig, network))
    assert model.config.views == views
    assert 2 * count(model) < 15e6  # in float16


@pytest.mark.parametrize("scale", ["", "laptop/"])
@pytest.mark.parametrize("views", [1, 3])
def test_from_scratch_has_the_network_and_the_grasps_of_the_pretrained(scale: str, views: int) -> None:
    scratch, head = read(f"{scale}no{views}_grasp.yaml"), read(f"{scale}mv{views}_grasp.yaml")
    pretraining = read(f"{scale}mv{views}.yaml")["model"].get("init_args", {})
    arguments = scratch["model"]["init_args"]
    assert arguments["network"] == pretraining.get("network", {})
    assert arguments.get("symmetric") == head["model"]["init_args"].get("symmetric")
    assert scratch["data"] == head["data"]


@pytest.mark.parametrize("scale", ["", "laptop/"])
@pytest.mark.parametrize("kind", ["mv", "no"])
def test_grasp_values_of_one_view_and_of_three_differ_in_a_few_lines(scale: str, kind: str) -> None:
    one, three = (read(f"{scale}{kind}{views}_grasp.yaml") for views in (1, 3))
    for config in (one, three):
        config["data"]["init_args"].pop("views", None)
        config["trainer"].pop("default_root_dir")
        for key in ("backbone", "network"):
            config["model"]["init_args"].pop(key, None)
    if (scale, kind) == ("laptop/", "no"):  # what takes as long as pretraining does
        for config in (one, three):
            config["trainer"].pop("max_steps"), config["trainer"].pop("val_check_interval")
            config["model"]["init_args"].pop("schedule")
    assert one == three


def test_one_view_and_three_differ_in_a_few_lines() -> None:
    one, three = read("mv1.yaml"), read("mv3.yaml")
    assert one["model"].pop("init_args") == {"network": {"views": 1}}
    assert one["data"]["init_args"].pop("views") == 1
    assert (one["trainer"].pop("default_root_dir"), three["trainer"].pop("default_root_dir")) == (
        "runs/mv1",
        "runs/mv3",
    )
    assert one == three


def test_features_are_kept_where_there_is_memory_for_them() -> None:
    heads = [f"{scale}mv{views}_grasp.yaml" for scale in ("", "laptop/") for views in (1, 3)]
    assert [read(name)["model"]["init_args"]["cache_features"] for name in heads] == [False, False, True, True]
    laptop = from_plain(MVNeRFConfig, read("laptop/mv3.yaml")["model"]["init_args"]["network"])
    with torch.device("meta"):
        networks = [build("mv3.yaml"), MVNeRF(laptop)]
    gigabytes = []
    for network, name in zip(networks, heads[1::2], strict=True):
        train = read(name)["data"]["init_args"]["train"]
        gigabytes.append(train["scenes"] * train["views"] * FeatureCache(network).view_bytes(train["size"]) / 1e9)
    assert gigabytes == pytest.approx([181.2, 3.22], abs=0.05)
