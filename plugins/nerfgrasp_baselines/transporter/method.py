"""The method `transporter`: the best pixel and rotation of a height map, and its height."""

from typing import ClassVar

import torch

from nerfgrasp.errors import UserError
from nerfgrasp.models.folder import load_stored
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.ranking import best_first, distinct
from nerfgrasp_baselines.transporter.canvases import cell_grasps
from nerfgrasp_baselines.transporter.heights import height_map
from nerfgrasp_baselines.transporter.network import Attention

DEPTH_OF_GRASP = 0.015
"""Metres by which the tool centre point lies below the height at its pixel."""
CONSIDERED = 20_000
"""Cells of the highest values, among which different grasps are looked for."""


class Transporter:
    """Proposes top-down grasps by a fully convolutional attention over pixels × rotations.

    Source: Zeng et al. 2020, "Transporter Networks": its attention module.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"depth"})
    """It alone sees depth."""

    def __init__(self, model: Attention, limits: Limits = Limits()) -> None:
        self.model = model.eval().requires_grad_(False)
        self.limits = limits

    @classmethod
    def from_pretrained(cls, folder: str) -> "Transporter":
        """Loads a model folder.

        Raises:
            UserError: there is no such model, it is damaged, or it holds another kind.
        """
        return cls(load_stored(folder, Attention))

    @torch.no_grad()
    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        """Returns up to `count` different grasps, best first; nothing in it is random. Values are logits.

        Raises:
            UserError: the observations come without depth, or there are fewer than the network was trained on.
        """
        if observations.depth is None:
            raise UserError("method 'transporter' needs depth images, and the scene has none")
        observations.require(self.model.config.views)
        seen, pixel = observations.select(slice(self.model.config.views)), self.model.config.pixel
        assert seen.depth is not None
        maps = height_map(seen.images, seen.depth, seen.camera, workspace, pixel)
        logits, canvases = self.model.look(maps, workspace)
        value, index = logits.flatten().topk(min(CONSIDERED, logits.numel()))
        cells = torch.stack(torch.unravel_index(index, logits.shape), dim=-1)
        T = cell_grasps(cells, canvases, logits.shape[-1], pixel)
        # Where the workspace ends, a cell's centre may lie on the last line.
        at = ((T[:, :2, 3] - workspace.minimum[:2]) / pixel).long()
        column, row = at[:, 0].clamp(0, maps.shape[2] - 1), at[:, 1].clamp(0, maps.shape[1] - 1)
        T[:, 2, 3] = workspace.minimum[2] + maps[3, row, column] - DEPTH_OF_GRASP
        return distinct(best_first(self.limits.enforce(T, workspace), value), count=count)
