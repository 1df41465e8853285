from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lightning import Callback, Trainer


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A frozen backbone is meant to be in evaluation mode."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.filterwarnings("ignore:Found .* in eval mode at the start"))


class Losses(Callback):
    """Notes the loss of every step."""

    def __init__(self) -> None:
        self.values: dict[int, float] = {}

    def on_train_batch_end(self, trainer: Trainer, module: Any, outputs: Any, *_: object) -> None:
        self.values[trainer.global_step] = float(outputs["loss"])


@pytest.fixture
def fit(tmp_path: Path) -> Callable[..., tuple[Trainer, dict[int, float]]]:
    """Returns a function that trains a module on a data module and returns the trainer and each step's loss."""

    def run(module: Any, data: Any, steps: int, ckpt_path: Path | None = None) -> tuple[Trainer, dict[int, float]]:
        losses = Losses()
        trainer = Trainer(
            accelerator="cpu",
            max_steps=steps,
            callbacks=[losses],
            default_root_dir=tmp_path,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            check_val_every_n_epoch=None,
            val_check_interval=steps,
            num_sanity_val_steps=0,
        )
        trainer.fit(module, data, ckpt_path=ckpt_path)
        return trainer, losses.values

    return run
