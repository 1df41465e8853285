"""How near a rendered image comes to the truth."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from nerfgrasp.errors import UserError

LPIPS_LEAST_SIDE = 32
"""Pixels below which an image is too small for LPIPS's network."""


def image_scores(rendered: Tensor, truth: Tensor, inside: Tensor, objects: Tensor) -> dict[str, Tensor]:
    """Returns one image's `psnr` and `ssim` over the workspace and `psnr_objects` over the objects' pixels.

    Args:
        rendered: `[3, H, W]` in [0, 1].
        truth: `[3, H, W]`.
        inside: `[H, W]` bool: pixels whose rays meet the workspace. Elsewhere the truth stands in.
        objects: `[H, W]` bool: pixels that show an object. Without any, `psnr_objects` is left out.
    """
    rendered = torch.where(inside, rendered, truth)
    scores = {
        "psnr": peak_signal_noise_ratio(rendered[:, inside], truth[:, inside], data_range=1.0),
        "ssim": structural_similarity_index_measure(rendered[None], truth[None], data_range=1.0),
    }
    if objects.any():
        scores["psnr_objects"] = peak_signal_noise_ratio(rendered[:, objects], truth[:, objects], data_range=1.0)
    return scores  # type: ignore[return-value]


def load_lpips() -> Callable[[Tensor, Tensor], Tensor]:
    """Returns LPIPS (on AlexNet): a function of two batches of images `[B, 3, H, W]` in [0, 1]; 0 is alike.

    Its network's weights are not fetched: they are a large file that a user may not want.

    Source: Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric".

    Raises:
        UserError: the packages or the weights are not here; the line says which, and how to get them.
    """
    try:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
        from torchvision.models import AlexNet_Weights
    except ImportError as error:
        raise UserError(f"its package is not installed: {error}") from error
    weights = Path(torch.hub.get_dir()) / "checkpoints" / Path(AlexNet_Weights.DEFAULT.url).name
    if not weights.is_file():
        raise UserError(f"no {weights} (torchvision.models.alexnet(weights='DEFAULT') fetches it)")
    return LearnedPerceptualImagePatchSimilarity("alex", normalize=True).eval()
