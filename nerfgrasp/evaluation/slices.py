"""How alike a learned grasp value and the truth are, in slices through a valid grasp."""

from collections.abc import Callable, Mapping, Sequence

import torch
from scipy.stats import spearmanr
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.methods.psi import Psi
from nerfgrasp.scenes.oracle import ValidGrasps, negative_grasp_error, sample_top_down
from nerfgrasp.scenes.scene import Observations, Truth, Workspace
from nerfgrasp.scenes.slices import Slice

KINDS = ("translation", "rotation", "mixed")
"""Of slices, in the order of tables."""


def central_grasp(truth: Truth, valid: ValidGrasps, workspace: Workspace, seed: int) -> tuple[Tensor, str]:
    """Returns the valid grasp `[4, 4]` that slices go through, and where it comes from.

    Args:
        truth: of the scene; its demonstrated grasp is taken if it has one.
        valid: of the same scene; else one of these is drawn.
        workspace: of the same scene.
        seed: of the draw.

    Raises:
        UserError: the oracle knows no valid grasp in the scene, as with meshes, or it lies outside of the workspace.
    """
    if len(valid) == 0:
        raise UserError("the oracle knows no valid grasp of its objects: there is no grasp error to compare with")
    if truth.demonstration is not None:
        grasp, source = truth.demonstration.float(), "demonstrated"
    else:
        grasp, source = sample_top_down(valid, torch.Generator().manual_seed(seed)).float(), "drawn"
    if not ((grasp[:3, 3] >= workspace.minimum) & (grasp[:3, 3] <= workspace.maximum)).all():
        raise UserError(f"the valid grasp to look at ({source}) lies outside of the workspace")
    return grasp, source


def true_values(cut: Slice, valid: ValidGrasps) -> Tensor:
    """Returns the negative grasp error `[N, N]` of a slice's poses; NaN outside of the workspace."""
    return _spread(cut, negative_grasp_error(cut.T_world_grasp[cut.inside].double(), valid).float())


@torch.no_grad()
def learned_values(
    method: Psi,
    observations: Observations,
    workspace: Workspace,
    cuts: Sequence[Slice],
    progress: Callable[[int], object] = lambda poses: None,
) -> list[Tensor]:
    """Returns Ψ `[N, N]` of each slice's poses, as the search climbs it; NaN outside of the workspace.

    Args:
        method: the value; one that sees one image at a time averages over as many as its search uses.
        observations: the scene's views.
        workspace: what they show.
        cuts: the slices.
        progress: is told how many more poses are done.

    Raises:
        UserError: there are too few views, one sees nothing of the workspace, or a value is not finite.
    """
    features = method.observe(observations, workspace).features
    found = []
    for cut in cuts:
        values = [cut.T_world_grasp.new_zeros(0)]
        for poses in cut.T_world_grasp[cut.inside].split(method.chunk):
            values.append(method.model.value(features, poses.to(method.device)).cpu())
            progress(len(poses))
        if not all(part.isfinite().all() for part in values):
            raise UserError(f"values in slice {cut.name} are not finite: the model's weights may be damaged")
        found.append(_spread(cut, torch.cat(values)))
    return found


def rank_correlation(one: Tensor, other: Tensor) -> float | None:
    """Returns Spearman's rank correlation of two slices `[N, N]`, of the poses where both are known (no NaN).

    None where it does not exist: fewer than two poses, or one that is the same everywhere.

    Example:
        >>> rank_correlation(torch.tensor([[1.0, 2.0], [3.0, torch.nan]]), torch.tensor([[1.0, 4.0], [9.0, 0.0]]))
        1.0
    """
    known = ~(one.isnan() | other.isnan())
    first, second = one[known], other[known]
    if len(first) < 2 or first.min() == first.max() or second.min() == second.max():
        return None
    return float(spearmanr(first.cpu().numpy(), second.cpu().numpy()).statistic)


def means_by_kind(cuts: Sequence[Slice], correlations: Mapping[str, float | None]) -> dict[str, float]:
    """Returns the mean of correlations, by the name of their slices, over the slices of each kind that there are."""
    known = {kind: [correlations[cut.name] for cut in cuts if cut.kind == kind] for kind in KINDS}
    numbers = {kind: [value for value in values if value is not None] for kind, values in known.items()}
    return {kind: sum(values) / len(values) for kind, values in numbers.items() if values}


def _spread(cut: Slice, values: Tensor) -> Tensor:
    """Lays the values of the poses inside out on the slice's grid."""
    grid = torch.full(cut.inside.shape, torch.nan).to(values)
    grid[cut.inside] = values
    return grid
