"""Finding grasps: random candidates climb a value by gradient ascent (Algorithm 1).

The value is any differentiable function of `T_world_grasp`, the pose parameterization any plug-in. The method that
joins the search to a trained model stands in `nerfgrasp.methods.psi`, whole searches by name in
`nerfgrasp.search.strategies`, and the interface for arrays in `nerfgrasp.methods.finder`.
"""

from nerfgrasp.search.ascent import Trace, ascend, search
from nerfgrasp.search.candidates import random_candidates
from nerfgrasp.search.ranking import best_first, distinct
from nerfgrasp.search.schedule import PAPER, Phase, PoseParameterization, Schedule

__all__ = [
    "PAPER",
    "Phase",
    "PoseParameterization",
    "Schedule",
    "Trace",
    "ascend",
    "best_first",
    "distinct",
    "random_candidates",
    "search",
]
