from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from elsewhere import DEVICE, another_device
from lightning.pytorch.utilities import move_data_to_device

from nerfgrasp.data.rays import RayData
from nerfgrasp.data.streams import SceneSet
from nerfgrasp.training import MVNeRFTraining
from nerfgrasp.training.schedule import LearningRate

CONSTANT = LearningRate(warmup_steps=0, decay="constant")


@pytest.fixture
def data(packed_set: Path) -> Callable[[], RayData]:
    scenes = SceneSet(packed_set, scenes=4, views=6, seed=5, size=32)
    options: dict[str, Any] = {"scenes_per_step": 2, "rays_per_scene": 32, "validation_scenes": 1}
    return lambda: RayData(scenes, scenes, **options)


def training(network: Any, **changes: Any) -> MVNeRFTraining:
    rates = {"learning_rate": 3e-3, "encoder_learning_rate": 3e-3}
    return MVNeRFTraining(network, **{**rates, "schedule": CONSTANT, **changes})


def test_training_reduces_the_loss_and_validates(tiny_network: Callable[..., Any], data, fit) -> None:
    trainer, losses = fit(training(tiny_network()), data(), 40)
    values = list(losses.values())
    assert sum(values[-5:]) < 0.5 * sum(values[:5]), values
    scores = {name: float(value) for name, value in trainer.callback_metrics.items() if name.startswith("val/")}
    assert scores.keys() == {"val/psnr", "val/psnr_objects", "val/ssim"}
    assert 3.0 < scores["val/psnr"] < 40.0
    assert -1.0 <= scores["val/ssim"] <= 1.0


def test_a_resumed_training_is_the_unbroken_one(tiny_network, data, fit, tmp_path: Path) -> None:
    unbroken = training(tiny_network())
    _, whole = fit(unbroken, data(), 6)
    trainer, first = fit(training(tiny_network()), data(), 3)
    trainer.save_checkpoint(tmp_path / "3.ckpt")
    # Another start, so that everything must come from the checkpoint.
    resumed = training(tiny_network())
    torch.nn.init.zeros_(resumed.network.fine.readout.weight)
    _, rest = fit(resumed, data(), 6, tmp_path / "3.ckpt")
    assert list(rest) == [4, 5, 6]
    assert {**first, **rest} == whole
    for one, other in zip(unbroken.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(one, other)


def test_the_start_is_a_function_of_the_seed(tiny_network: Callable[..., Any]) -> None:
    def readout(seed: int) -> torch.Tensor:
        torch.rand(1)  # what was drawn elsewhere changes nothing
        return training(tiny_network(), seed=seed).network.fine.readout.weight

    before = torch.get_rng_state()
    assert torch.equal(readout(1), readout(1))
    assert not torch.equal(readout(1), readout(2))
    torch.set_rng_state(before)


def test_two_learning_rates(tiny_network: Callable[..., Any]) -> None:
    module = training(tiny_network(), learning_rate=0.2, encoder_learning_rate=0.1)
    optimizer = module.configure_optimizers()["optimizer"]
    encoder, fields = optimizer.param_groups
    assert (encoder["lr"], fields["lr"]) == (0.1, 0.2)
    assert len(encoder["params"]) + len(fields["params"]) == len(list(module.network.parameters()))


def test_compiled_parts_keep_their_names(tiny_network: Callable[..., Any]) -> None:
    plain, compiled = training(tiny_network()), training(tiny_network(), compile=True)
    assert list(compiled.state_dict()) == list(plain.state_dict())
    parts = [compiled.network.encoder, compiled.network.coarse, compiled.network.fine]
    assert all(part._compiled_call_impl is not None for part in parts)
    assert plain.network.fine._compiled_call_impl is None


def test_every_batch_of_every_process_has_its_own_samples(tiny_network: Callable[..., Any]) -> None:
    class Placed(MVNeRFTraining):
        global_step, global_rank = 0, 0

    module, seeds = Placed(tiny_network()), set()
    module._trainer = SimpleNamespace(accumulate_grad_batches=2)  # type: ignore[assignment]
    for module.global_step in (0, 1):
        for module.global_rank in (0, 1):
            for batch in (0, 1):
                seeds.add(module._generator(2 * module.global_step + batch).initial_seed())
    assert len(seeds) == 8


def test_it_trains_and_validates_on_another_device(
    tiny_network: Callable[..., Any], data: Callable[[], RayData]
) -> None:
    module, rays = training(tiny_network()), data()
    rays.setup("fit")
    batch, view = next(iter(rays.train_dataloader())), next(iter(rays.val_dataloader()))
    here, rendered = module.errors(batch, module._generator(0)), module.validation_step(view, 0)
    with another_device() as send:
        send(module.network)
        there = module.errors(move_data_to_device(batch, DEVICE), module._generator(0))
        sum(there).backward()
        assert all(parameter.grad is not None for parameter in module.network.parameters())
        seen = module.validation_step(move_data_to_device(view, DEVICE), 0)
        torch.testing.assert_close([error.cpu() for error in there], list(here))
        torch.testing.assert_close(seen["rgb"].cpu(), rendered["rgb"], rtol=1e-4, atol=1e-4)
