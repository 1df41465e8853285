from collections.abc import Callable
from dataclasses import replace
from typing import Any

import algorithm1
import pytest
import torch

from nerfgrasp.geometry import Camera
from nerfgrasp.methods.psi import ObservedScene, Psi
from nerfgrasp.models import GraspValue, GraspValueConfig
from nerfgrasp.scenes.scene import Observations, Workspace
from nerfgrasp.search import ascend, random_candidates
from nerfgrasp.search.parameterization import load_pose


@pytest.fixture
def method(tiny_network: Callable[..., Any]) -> Psi:
    torch.manual_seed(0)
    config = tiny_network()
    network = replace(config, fine=replace(config.fine, pool_variance=True, height_frequencies=3))
    return Psi(GraspValue(GraspValueConfig(network, symmetric=True)), chunk=8)


@pytest.fixture
def scene(method: Psi, cameras: Callable[..., Camera]) -> ObservedScene:
    torch.manual_seed(1)
    return method.observe(Observations(torch.rand(3, 3, 32, 32), cameras(3)), Workspace())


def test_plain_and_fast_values_agree_and_so_do_their_gradients(method: Psi, scene: ObservedScene) -> None:
    start = random_candidates(6, scene.workspace, torch.Generator().manual_seed(0))
    found = []
    for value in (algorithm1.plain_value(method.model, scene), lambda T: method.model.value(scene.features, T)):
        T = start.clone().requires_grad_()
        values = value(T)
        found.append((values.detach(), *torch.autograd.grad(values.sum(), T)))
    (plain, plain_gradient), (fast, fast_gradient) = found
    torch.testing.assert_close(plain, fast, rtol=1e-4, atol=1e-5)
    scale = float(plain_gradient.abs().max())
    torch.testing.assert_close(plain_gradient, fast_gradient, rtol=1e-3, atol=1e-4 * scale)


def test_the_plain_climb_is_algorithm_1(workspace: Workspace) -> None:
    def hill(T: torch.Tensor) -> torch.Tensor:
        return -20.0 * T[:, :3, 3].square().sum(dim=-1) - (1.0 + T[:, 2, 2])

    pose = load_pose("quaternion", workspace)
    start = random_candidates(5, workspace, torch.Generator().manual_seed(0))
    _, trace = ascend(hill, start, pose, workspace)
    torch.testing.assert_close(algorithm1.plain_climb(hill, start, pose, workspace), trace.value[-1])


def test_a_scene_is_compared(method: Psi, scene: ObservedScene) -> None:
    row = algorithm1.compare(method, scene, 1, 4)
    plain, paper, halving = (row[name] for name in ("plain", "paper", "halving"))
    assert (plain["gradients"], plain["values"]) == (paper["gradients"], paper["values"]) == (128, 4)
    # All 4 for 7 steps, 2 for 4, and 1 for the other 21, which alone is valued at the end.
    assert (halving["gradients"], halving["values"]) == (28 + 8 + 21, 1)
    assert plain["best"] == pytest.approx(paper["best"], abs=1e-3)
    alone = algorithm1.compare(method, scene, 1, 4, plain=False)
    assert {name: way["best"] for name, way in alone.items()} == {"paper": paper["best"], "halving": halving["best"]}


def row(scene: int, plain: float, halving: float) -> dict[str, Any]:
    way = {"gradients": 10, "values": 1, "best": 1.0, "process": 1.0}
    ways = {"plain": {**way, "seconds": plain}, "paper": {**way, "seconds": 1.0}}
    settings = {"seed": 1, "model": "m", "candidates": 4, "threads": 1, "torch": "2"}
    return {"scene": scene, **settings, **ways, "halving": {**way, "seconds": halving, "best": 1.0 + scene}}


def test_the_summary_compares_scene_by_scene() -> None:
    untimed = {name: way for name, way in row(3, 0.0, 9.0).items() if name != "plain"}
    lines = algorithm1.summary([row(0, 2.0, 1.0), row(1, 12.0, 2.0), row(2, 10.0, 2.0), untimed])
    assert lines[1].startswith("3 scenes")
    assert lines[5].startswith("4 scenes")
    assert [line.split()[5:7] for line in lines[6:8]] == [["1.00", "1.00"], ["0.50", "0.29"]]
    assert [line.split()[5:7] for line in lines[2:5]] == [["1.00", "1.00"], ["10.00", "8.00"], ["5.00", "4.80"]]
    assert "paper less plain: +0.000 (standard error 0.000)" in lines[8]
    assert (
        "halving less plain: +1.000 (standard error 0.577), median +1.000, from +0.000 to +2.000, higher in 2 of 3"
        in lines[9]
    )
    assert (
        "halving less paper: +1.500 (standard error 0.645), median +1.500, from +0.000 to +3.000, higher in 3 of 4"
        in lines[10]
    )


def test_the_summary_without_the_plain_search_is_of_the_others() -> None:
    rows = [{name: way for name, way in row(scene, 0.0, 1.0).items() if name != "plain"} for scene in range(2)]
    lines = algorithm1.summary(rows)
    assert len(lines) == 5
    assert lines[-1].startswith("best value, halving less paper: +0.500")
