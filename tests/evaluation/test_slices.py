from collections.abc import Callable
from typing import Any

import pytest
import torch
from elsewhere import another_device

from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.slices import central_grasp, learned_values, means_by_kind, rank_correlation, true_values
from nerfgrasp.geometry import Camera, make_pose
from nerfgrasp.methods.psi import Psi
from nerfgrasp.models import GraspValue, GraspValueConfig
from nerfgrasp.scenes.oracle import negative_grasp_error, valid_grasps
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Observations, Truth, Workspace
from nerfgrasp.scenes.slices import cut_slice

BAR = Prism(
    "box", (((-0.02, -0.06), (0.02, -0.06), (0.02, 0.06), (-0.02, 0.06)),), 0.06, (1, 0, 0), 500.0, torch.eye(4)
)
"""Along world y."""
ACROSS = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0.0, 0.04]))


def truth(demonstration: torch.Tensor | None = None) -> Truth:
    return Truth("simple", 0, 0, (BAR,), demonstration)


def test_the_demonstrated_grasp_comes_first_and_else_the_seed_draws_a_valid_one() -> None:
    valid, workspace = valid_grasps([BAR]), Workspace()
    assert torch.equal(central_grasp(truth(ACROSS), valid, workspace, seed=3)[0], ACROSS)
    drawn = [central_grasp(truth(), valid, workspace, seed=seed)[0] for seed in (3, 3, 4)]
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    assert negative_grasp_error(drawn[0].double(), valid) == pytest.approx(0.0, abs=1e-3)


def test_without_a_valid_grasp_in_the_workspace_there_is_nothing_to_look_at() -> None:
    with pytest.raises(UserError, match="no valid grasp"):
        central_grasp(truth(ACROSS), valid_grasps([]), Workspace(), seed=0)
    far = ACROSS + 0.0
    far[0, 3] = 1.0
    with pytest.raises(UserError, match="outside of the workspace"):
        central_grasp(truth(far), valid_grasps([BAR]), Workspace(), seed=0)


def test_moving_along_the_bar_costs_nothing() -> None:
    cut = cut_slice(ACROSS, "tx-ty", Workspace(), size=5, reach=0.03)
    values = true_values(cut, valid_grasps([BAR]))
    assert torch.allclose(values[:, 2], torch.zeros(5), atol=1e-3)
    assert torch.allclose(values[2], torch.tensor([-0.3, -0.15, 0.0, -0.15, -0.3]), atol=1e-3)  # half of 30 / 50 mm


def test_outside_of_the_workspace_nothing_is_known() -> None:
    turned = ACROSS @ make_pose(torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]), torch.zeros(3))
    cut = cut_slice(turned, "tx-ty", Workspace(), size=7)
    assert torch.equal(true_values(cut, valid_grasps([BAR])).isnan(), ~cut.inside)


def test_a_model_on_another_device_values_the_same(
    tiny_network: Callable[..., Any], cameras: Callable[..., Camera]
) -> None:
    cuts = [cut_slice(ACROSS, "tx-rz", Workspace(), size=3)]
    model = GraspValue(GraspValueConfig(tiny_network(image_size=32))).eval()
    seen = Observations(torch.rand(3, 3, 32, 32), cameras(3))
    [here] = learned_values(Psi(model), seen, Workspace(), cuts)
    with another_device() as send:
        send(model)
        [there] = learned_values(Psi(model), seen, Workspace(), cuts)
    torch.testing.assert_close(there, here, rtol=1e-4, atol=1e-4, equal_nan=True)


def test_rank_correlation_is_spearmans() -> None:
    one = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, torch.nan]])
    assert rank_correlation(one, one.exp()) == pytest.approx(1.0)
    assert rank_correlation(one, -one) == pytest.approx(-1.0)
    # 1 - 6 Σd² / n (n² - 1), with two neighbours swapped among five.
    swapped = torch.tensor([[2.0, 1.0, 3.0], [4.0, 5.0, 9.0]])
    assert rank_correlation(one, swapped) == pytest.approx(1 - 6 * 2 / 120)
    assert rank_correlation(one, torch.zeros(2, 3)) is None
    assert rank_correlation(one, torch.full((2, 3), torch.nan)) is None


def test_means_leave_out_what_is_unknown() -> None:
    cuts = [cut_slice(ACROSS, name, Workspace(), size=2) for name in ("tx-ty", "tx-tz", "rx-ry", "ty-rz")]
    found = {"tx-ty": 0.5, "tx-tz": 0.1, "rx-ry": None, "ty-rz": -1.0}
    assert means_by_kind(cuts, found) == {"translation": pytest.approx(0.3), "mixed": -1.0}
