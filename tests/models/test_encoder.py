from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import timm
import torch
from safetensors.torch import save_file

from nerfgrasp.errors import UserError
from nerfgrasp.models import Encoder, EncoderConfig


@pytest.fixture
def config(tiny_network: Callable[..., Any]) -> EncoderConfig:
    return tiny_network().encoder


def test_the_paper_s_shapes() -> None:
    with torch.device("meta"):
        encoder = Encoder(EncoderConfig(pretrained=False))
        features = encoder(torch.zeros(2, 3, 480, 640))
        half = Encoder(EncoderConfig(pretrained=False, upsample=False))(torch.zeros(2, 3, 480, 640))
        grids = [tap(torch.zeros(1, 768, 14, 14)).shape for tap in encoder.taps]
    assert features.shape == (2, 256, 480, 640)
    assert half.shape == (2, 256, 240, 320)
    assert grids == [(1, 256, side, side) for side in (56, 28, 14, 7)]
    assert len(encoder.vit.blocks) == 12
    assert encoder.vit.patch_embed.proj.weight.shape == (768, 3, 16, 16)
    assert encoder.conv[0].weight.shape == (64, 3, 7, 7)
    assert [block.body[0].weight.shape[:2] for block in encoder.conv[3:]] == [(128, 64), (128, 128), (128, 128)]


def test_an_image_s_features_do_not_depend_on_its_batch(config: EncoderConfig) -> None:
    encoder = Encoder(config)
    images = torch.rand(3, 3, 40, 48)
    together = encoder(images)
    assert together.shape == (3, 24, 20, 24)
    assert encoder.channels == 24
    torch.testing.assert_close(together[1:2], encoder(images[1:2]), atol=1e-5, rtol=1e-5)


def test_every_parameter_is_used(config: EncoderConfig) -> None:
    encoder = Encoder(config)
    encoder(torch.rand(1, 3, 32, 32)).square().sum().backward()
    assert [name for name, parameter in encoder.named_parameters() if parameter.grad is None] == []


def test_weights_from_a_local_file(config: EncoderConfig, tmp_path: Path) -> None:
    vit = timm.create_model(config.vit, img_size=config.vit_size, num_classes=0, **config.vit_options)
    save_file(vit.state_dict(), tmp_path / "vit.safetensors")
    encoder = Encoder(replace(config, pretrained=str(tmp_path / "vit.safetensors")))
    assert torch.equal(encoder.vit.blocks[3].mlp.fc1.weight, vit.blocks[3].mlp.fc1.weight)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"vit": "vit_tiny_patch16_24"},
            "unknown timm model 'vit_tiny_patch16_24': did you mean 'vit_tiny_patch16_224'",
        ),
        ({"vit_options": {"dpeth": 4}}, "encoder.vit_options: vit_tiny_patch16_224: .*'dpeth'"),
        ({"taps": (0, 1, 2)}, r"encoder.taps: \[0, 1, 2\]: they must be four blocks, from 0 to 3"),
        ({"taps": (0, 1, 2, 4)}, "from 0 to 3"),
        ({"taps": (3, 2, 1, 0)}, "in ascending order"),
        ({"pretrained": "nowhere.safetensors"}, "encoder.pretrained: no such file: nowhere.safetensors"),
        ({"pretrained": True}, "cannot load weights for vit_tiny_patch16_224 .*give a local file, or false"),
    ],
)
def test_mistakes_are_one_line(config: EncoderConfig, change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        Encoder(replace(config, **change))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", ["safetensors", "pth", "npz"])
@pytest.mark.parametrize("content", [b"", b"no weights, but long enough to be looked at closely"])
def test_a_damaged_file_of_weights(config: EncoderConfig, tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"vit.{suffix}"
    path.write_bytes(content)
    with pytest.raises(UserError, match="encoder.pretrained: cannot load weights") as error:
        Encoder(replace(config, pretrained=str(path)))
    assert "\n" not in str(error.value)
