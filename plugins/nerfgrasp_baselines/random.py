"""The method `random`: a pose uniform in the workspace and on SO(3). What no method should fall below."""

from typing import ClassVar

import torch

from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.candidates import random_candidates
from nerfgrasp_baselines.untrained import Untrained


class Random(Untrained):
    """Draws poses as the search draws its candidates, without a look at the scene."""

    needs: ClassVar[frozenset[str]] = frozenset()
    """It uses nothing that it sees."""

    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        """Returns `count` random poses, each of value 0."""
        return Grasps(random_candidates(count, workspace, generator), torch.zeros(count))
