from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from nerfgrasp.data.grasps import GraspBatch
from nerfgrasp.data.views import Views
from nerfgrasp.geometry import Camera
from nerfgrasp.models import MVNeRF
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.training.features import FeatureCache


@pytest.fixture
def backbone(tiny_network: Callable[..., Any]) -> MVNeRF:
    torch.manual_seed(0)
    return MVNeRF(tiny_network()).eval()


def batch(cameras: Callable[..., Camera], scenes: list[int], views: list[list[int]]) -> GraspBatch:
    """A batch whose images are functions of scene and view alone."""
    images = [
        torch.stack([torch.rand(3, 32, 32, generator=torch.Generator().manual_seed(10 * s + v)) for v in of_scene])
        for s, of_scene in zip(scenes, views, strict=True)
    ]
    camera = cameras(2)
    return GraspBatch(
        torch.tensor(scenes),
        torch.tensor(views),
        Views(
            torch.stack(images),
            camera.intrinsics.expand(len(scenes), 2, 3, 3),
            camera.T_world_camera.expand(len(scenes), 2, 4, 4),
            Workspace().minimum.expand(len(scenes), 1, 3),
            Workspace().maximum.expand(len(scenes), 1, 3),
        ),
        torch.eye(4).expand(len(scenes), 5, 4, 4),
    )


def test_the_cache_gives_what_observing_gives(backbone: MVNeRF, cameras: Callable[..., Camera]) -> None:
    asked = batch(cameras, [4, 7], [[0, 2], [1, 0]])
    cached, plain = FeatureCache(backbone)(asked), FeatureCache(backbone, enabled=False)(asked)
    assert cached.coarse is None
    assert plain.coarse is None
    assert cached.fine.features.dtype == torch.float32
    torch.testing.assert_close(cached.fine.features, plain.fine.features, atol=2e-3, rtol=2e-3)
    assert torch.equal(cached.fine.images, asked.inputs.images)
    assert torch.equal(cached.fine.camera.T_world_camera, asked.inputs.T_world_camera)
    assert not cached.fine.features.requires_grad
    assert not plain.fine.features.requires_grad


def test_a_view_is_encoded_once_whatever_its_batch(
    backbone: MVNeRF, cameras: Callable[..., Camera], monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded, forward = [], backbone.encoder.forward

    def counting(images: torch.Tensor) -> torch.Tensor:
        encoded.append(len(images))
        return forward(images)

    monkeypatch.setattr(backbone.encoder, "forward", counting)
    cache = FeatureCache(backbone)
    first = cache(batch(cameras, [4, 7], [[0, 2], [1, 0]]))
    assert encoded == [1, 1, 1, 1]
    again = cache(batch(cameras, [7, 9], [[0, 1], [1, 0]]))
    assert encoded == [1] * 6
    assert torch.equal(again.fine.features[0], first.fine.features[1].flip(0))
    other_order = FeatureCache(backbone)(batch(cameras, [9, 7], [[1, 0], [0, 1]]))
    assert torch.equal(other_order.fine.features, again.fine.features.flip(0))


def test_images_of_another_size_are_cut_once(
    tiny_network: Callable[..., Any], cameras: Callable[..., Camera], monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    backbone = MVNeRF(tiny_network(image_size=24)).eval()
    asked = batch(cameras, [4, 7], [[0, 2], [1, 0]])
    plain, cache = FeatureCache(backbone, enabled=False)(asked).fine, FeatureCache(backbone)
    cache(asked)
    monkeypatch.setattr(backbone, "fit_images", None)
    again = cache(asked).fine
    torch.testing.assert_close(again.features, plain.features, atol=2e-3, rtol=2e-3)
    assert torch.equal(again.images, plain.images)
    assert torch.equal(again.camera.intrinsics, plain.camera.intrinsics)
    assert (again.camera.width, again.camera.height) == (24, 24)


@pytest.mark.parametrize("shape", [{}, {"upsample": True}, {"conv_size": 15}, {"image_size": 24}])
def test_the_memory_that_a_view_takes_is_told_beforehand(
    tiny_network: Callable[..., Any], cameras: Callable[..., Camera], shape: dict[str, Any]
) -> None:
    size = {key: shape[key] for key in shape.keys() & {"image_size"}}
    plain = tiny_network(**size)
    encoder = replace(plain.encoder, **{key: shape[key] for key in shape.keys() - size.keys()})
    cache = FeatureCache(MVNeRF(replace(plain, encoder=encoder)).eval())
    cache(batch(cameras, [4], [[0, 2]]))
    parts = [part for kept in cache._kept.values() for part in kept if part is not None]
    assert sum(part.nbytes for part in parts) == 2 * cache.view_bytes(32)
