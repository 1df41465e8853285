from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning import Trainer
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from PIL import Image

from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.rays import RayData
from nerfgrasp.data.streams import SceneSet
from nerfgrasp.training import MVNeRFTraining
from nerfgrasp.training.mvnerf import render_image
from nerfgrasp.viz.held_out import HeldOutRenders
from nerfgrasp.viz.renderings import OUTSIDE


def test_renders_of_validation_are_logged(
    tiny_network: Callable[..., Any], packed_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = SceneSet(packed_set, scenes=4, views=6, seed=5, size=32)
    data = RayData(scenes, scenes, validation_scenes=3)
    rendered: list[torch.Tensor] = []

    def render(*args: Any) -> Any:
        result = render_image(*args)
        rendered.append(torch.where(result[2][..., None], result[0], torch.tensor(OUTSIDE)))
        return result

    monkeypatch.setattr("nerfgrasp.training.mvnerf.render_image", render)
    csv, board = CSVLogger(tmp_path / "csv"), TensorBoardLogger(tmp_path / "board")
    trainer = Trainer(
        accelerator="cpu",
        logger=[csv, board],
        callbacks=[HeldOutRenders(count=2)],
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
    )
    trainer.validate(MVNeRFTraining(tiny_network()), data, verbose=False)

    assert len(rendered) == 3, "each held-out view is rendered once"
    files = sorted((Path(csv.log_dir) / "renders").iterdir())
    assert [file.name for file in files] == ["0000000-0.png", "0000000-1.png"]
    for scene, file in enumerate(files):
        picture = np.array(Image.open(file))
        assert picture.shape == (32, 128, 3)
        assert np.array_equal(picture[:, :32], PackedScenes(packed_set).images[scene, 3])
        assert np.array_equal(picture[:, 32:64], (rendered[scene] * 255).round().byte().numpy())
        depth = picture[:, 96:]
        assert len(np.unique(depth.reshape(-1, 3), axis=0)) > 10
    assert _tags(board) == ["held_out/0", "held_out/1"]
    if find_spec("rerun") is not None:
        assert _entities(Path(csv.log_dir) / "renders.rrd") == {
            f"/held_out_{view}/{name}" for view in range(2) for name in ("truth", "rendered", "error", "depth")
        }


def _tags(board: TensorBoardLogger) -> list[str]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(board.log_dir))
    events.Reload()
    return events.Tags()["images"]


def _entities(path: Path) -> set[str]:
    import rerun.chunk

    return {chunk.entity_path for chunk in rerun.chunk.RrdReader(path).stream() if "held_out" in chunk.entity_path}
