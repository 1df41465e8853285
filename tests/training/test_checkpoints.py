from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from nerfgrasp.training.checkpoints import StepCheckpoint, WholeCheckpoints


def test_a_checkpoint_is_whole_or_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, checkpoints = tmp_path / "checkpoints" / "last.ckpt", WholeCheckpoints()
    checkpoints.save_checkpoint({"step": 1}, path)
    (path.parent / ".last.ckpt.123.tmp").write_bytes(b"left by a killed run")

    def killed(checkpoint: Any, file: Any) -> None:
        file.write(b"half")
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", killed)
        with pytest.raises(SystemExit):
            checkpoints.save_checkpoint({"step": 2}, path)
    assert checkpoints.load_checkpoint(path) == {"step": 1}
    assert list(path.parent.iterdir()) == [path]
    checkpoints.save_checkpoint({"step": 3}, path)
    assert checkpoints.load_checkpoint(path) == {"step": 3}


def test_no_checkpoint_between_the_batches_of_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(ModelCheckpoint, "on_train_batch_end", lambda *args: asked.append(args[-1]))
    callback, trainer = StepCheckpoint(), SimpleNamespace(accumulate_grad_batches=3)
    for batch in range(9):
        callback.on_train_batch_end(trainer, None, None, None, batch)  # type: ignore[arg-type]
    assert asked == [2, 5, 8]
