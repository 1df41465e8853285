from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from elsewhere import DEVICE, DeviceError, another_device

from nerfgrasp import registry
from nerfgrasp.geometry import Camera
from nerfgrasp.methods.psi import Psi
from nerfgrasp.models import GraspValue, GraspValueConfig
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.strategies import GUIDED, STRATEGIES, Strategy


def test_the_other_device_refuses_what_a_gpu_does() -> None:
    with another_device():
        there, here = torch.ones(3).to(DEVICE), torch.ones(3)
        assert (there + 1.0).cpu().tolist() == [2.0, 2.0, 2.0]
        with pytest.raises(DeviceError, match="aten::add of tensors on two devices"):
            there + here
        with pytest.raises(DeviceError, match="float64"):
            there.double()


@pytest.fixture
def find(tiny_network: Callable[..., Any], cameras: Callable[..., Camera]) -> Callable[..., Grasps]:
    """Returns a function that searches a scene, on the CPU or elsewhere; the grasps come back on the CPU."""

    def run(strategy: Strategy, *, elsewhere: bool, pose: str | None = None) -> Grasps:
        torch.manual_seed(0)
        model = GraspValue(GraspValueConfig(tiny_network(image_size=32), symmetric=True)).eval()
        seen = Observations(torch.rand(3, 3, 32, 32), cameras(3))

        def search() -> Grasps:
            method, generator = Psi(model, chunk=8), torch.Generator().manual_seed(0)
            return method.search(seen, Workspace(), generator=generator, strategy=strategy, pose=pose)[0]

        if not elsewhere:
            return search()
        with another_device() as send:
            send(model)
            found = search()
            assert found.T_world_grasp.device == found.value.device == DEVICE
            return found.to("cpu")

    return run


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_search_elsewhere_finds_what_it_finds_here(name: str, find: Callable[..., Grasps]) -> None:
    few = replace(STRATEGIES[name], candidates=4, keep=2)
    here, there = (find(few, elsewhere=elsewhere) for elsewhere in (False, True))
    torch.testing.assert_close(there.value, here.value, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("pose", registry.names(registry.POSES))
def test_every_pose_climbs_elsewhere(pose: str, find: Callable[..., Grasps]) -> None:
    few = replace(GUIDED, candidates=2, rounds=(), feasibility=None)
    here, there = (find(few, elsewhere=elsewhere, pose=pose) for elsewhere in (False, True))
    torch.testing.assert_close(there.value, here.value, rtol=1e-3, atol=1e-3)
