from collections.abc import Callable
from dataclasses import replace
from typing import Any

import plain_mvnerf
import pytest
import torch

from nerfgrasp.geometry import Camera, pixel_rays
from nerfgrasp.models import MVNeRF, MVNeRFConfig
from nerfgrasp.scenes.scene import Workspace

Case = tuple[MVNeRF, tuple[torch.Tensor, Camera], tuple[torch.Tensor, torch.Tensor]]


@pytest.fixture(params=["the paper's", "all options"])
def case(request: pytest.FixtureRequest, tiny_network: Callable[..., Any], cameras: Callable[..., Camera]) -> Case:
    torch.manual_seed(0)
    config: MVNeRFConfig = tiny_network()
    if request.param == "all options":
        config = replace(
            config,
            fine=replace(config.fine, pool_variance=True, blend=8, height_frequencies=3),
            reuse_coarse_samples=False,
        )
    flat = cameras(6)
    camera = Camera(flat.intrinsics.unflatten(0, (2, 3)), flat.T_world_camera.unflatten(0, (2, 3)), 32, 32)
    pixels = 32 * torch.rand(2, 12, 2)
    return MVNeRF(config), (torch.rand(2, 3, 3, 32, 32), camera), pixel_rays(cameras(2, seed=7), pixels)


def test_fast_and_plain_agree(case: Case) -> None:
    model, views, rays = case
    found = model.render(model.observe(*views, Workspace()), *rays, Workspace())
    plain = plain_mvnerf.render(model, *views, *rays, Workspace())
    for one, other in zip(found, plain, strict=True):
        torch.testing.assert_close(one.colour, other.colour, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(one.weights, other.weights, rtol=1e-4, atol=1e-6)


def test_their_gradients_agree(case: Case) -> None:
    model, views, rays = case
    gradients = []
    for render in (
        lambda: model.render(model.observe(*views, Workspace()), *rays, Workspace()),
        lambda: plain_mvnerf.render(model, *views, *rays, Workspace()),
    ):
        model.zero_grad()
        found = render()
        (found.coarse.colour.square().sum() + found.fine.colour.square().sum()).backward()
        gradients.append({name: parameter.grad.clone() for name, parameter in model.named_parameters()})
    for name, one in gradients[0].items():
        scale = one.abs().max().item()
        torch.testing.assert_close(one, gradients[1][name], rtol=1e-3, atol=1e-4 * scale + 1e-9, msg=name)


def test_mixed_precision_stays_near(case: Case) -> None:
    model, views, rays = case
    exact = plain_mvnerf.render(model, *views, *rays, Workspace())
    with torch.autocast("cpu", torch.bfloat16):
        found = model.render(model.observe(*views, Workspace()), *rays, Workspace())
    torch.testing.assert_close(found.fine.colour.float(), exact.fine.colour, rtol=2e-2, atol=2e-2)
