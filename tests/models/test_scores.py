import math
from pathlib import Path

import pytest
import torch

from nerfgrasp.errors import UserError
from nerfgrasp.models.scores import image_scores, load_lpips


def test_scores_by_hand() -> None:
    truth = torch.full((3, 16, 16), 0.5)
    rendered = truth.clone()
    inside, objects = torch.zeros(16, 16, dtype=torch.bool), torch.zeros(16, 16, dtype=torch.bool)
    inside[:8], objects[:2] = True, True
    rendered[:, :2] += 0.1  # a quarter of the inside
    rendered[:, 8:] = 0.0  # outside: not judged
    scores = image_scores(rendered, truth, inside, objects)
    assert float(scores["psnr_objects"]) == pytest.approx(20.0, abs=1e-3)
    assert float(scores["psnr"]) == pytest.approx(20.0 + 10 * math.log10(4), abs=1e-3)
    assert 0.0 < float(scores["ssim"]) < 1.0
    assert "psnr_objects" not in image_scores(rendered, truth, inside, torch.zeros_like(objects))
    same = image_scores(torch.where(inside, truth, rendered), truth, inside, objects)
    assert float(same["ssim"]) == pytest.approx(1.0)


def test_lpips_fetches_nothing_and_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(UserError, match=rf"no {tmp_path}.*alexnet.*fetches it"):
        load_lpips()
    assert not list(tmp_path.iterdir())
