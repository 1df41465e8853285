"""Trying grasps in physics before one is proposed: what only a method may do that knows the truth."""

import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Grasps, Truth
from nerfgrasp.search.ranking import best_first, distinct
from nerfgrasp.sim.attempt import Outcome, attempt_grasp

DISTANCE, ANGLE = 0.008, 0.25
"""Metres and radians; of grasps closer than both, one is tried."""


def first_success(truth: Truth, T_world_grasp: Tensor, score: Tensor, tries: int, count: int) -> Grasps:
    """Carries grasps out, best score first, until one lifts its object.

    Args:
        truth: the scene.
        T_world_grasp: `[N, 4, 4]`, double.
        score: `[N]`: the higher, the sooner it is tried.
        tries: how many different grasps are tried at most.
        count: how many grasps are returned at most.

    Returns:
        The grasp that succeeded, of value 1, before those that were not tried, in the order of their scores and of
        value 0; after them those that failed, of value -1.
    """
    grasps = distinct(best_first(exactly_rigid(T_world_grasp), score), DISTANCE, ANGLE, max(tries + 1, count))
    value = torch.zeros(len(grasps), dtype=torch.float64)
    for number in range(min(tries, len(grasps))):
        if attempt_grasp(truth, grasps.T_world_grasp[number]).outcome == Outcome.SUCCESS:
            value[number] = 1.0
            break
        value[number] = -1.0
    ranked = best_first(grasps.T_world_grasp, value)
    return Grasps(ranked.T_world_grasp[:count], ranked.value[:count])


def exactly_rigid(T: Tensor) -> Tensor:
    """Returns poses `[..., 4, 4]` in double, less what their rotations lack of being rotations."""
    rotation = roma.unitquat_to_rotmat(roma.rotmat_to_unitquat(T[..., :3, :3].double()))
    return make_pose(rotation, T[..., :3, 3].double())
