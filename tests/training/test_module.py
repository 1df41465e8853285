from collections.abc import Callable

import pytest
import torch
from nerfgrasp_baselines.transporter.network import TransporterConfig
from nerfgrasp_baselines.transporter.training import TransporterTraining

from nerfgrasp.training.module import seeded

SMALL = TransporterConfig(widths=(8,), blocks=1)


@pytest.mark.parametrize("build", [lambda: seeded(3, lambda: torch.rand(4)), lambda: TransporterTraining(SMALL)])
def test_a_seeded_start_leaves_every_generator_alone(
    build: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    reseeded: list[int] = []
    monkeypatch.setattr(torch.cuda, "manual_seed_all", reseeded.append)
    torch.default_generator.manual_seed(1)
    before = torch.get_rng_state()
    build()
    assert torch.equal(torch.get_rng_state(), before)
    assert reseeded == []


def test_a_seeded_start_is_that_of_manual_seed() -> None:
    torch.manual_seed(3)
    assert torch.equal(torch.rand(4), seeded(3, lambda: torch.rand(4)))
