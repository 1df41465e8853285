"""Grasps that are good but for a random error: those whose outcomes a doubtful physics would change."""

import math

import numpy as np
import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper
from nerfgrasp.scenes.bars import TABLE_CLEARANCE
from nerfgrasp.scenes.oracle import sample_top_down, valid_grasps
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.tasks import scene_generator

OFFSET, TURN = 0.01, math.radians(10.0)
"""Standard deviations of the error at scale 1, along and about each of the grasp's axes."""
_STREAM = 30
"""Grasp k of a scene draws from its stream 30 + k."""


def perturbed_grasp(truth: Truth, scale: float, number: int = 0, gripper: Gripper = DEFAULT_GRIPPER) -> Tensor:
    """Returns a random valid grasp `[4, 4]` of a scene of prisms with a random error, lifted clear of the table.

    The grasp and the error's direction are drawn from the scene's own generator and do not depend on `scale`.

    Args:
        truth: the scene, which has a valid grasp.
        scale: multiplies the error; 0 leaves the valid grasp.
        number: which of the scene's endless sequence of such grasps.
        gripper: the hand that is lifted clear of the table.
    """
    rng = scene_generator(truth.seed, truth.index, _STREAM + number)
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    T_world_grasp = sample_top_down(valid_grasps(truth.objects, gripper), generator)
    turn, offset = torch.from_numpy(rng.normal(size=(2, 3)) * np.array([[TURN], [OFFSET]]) * scale).float()
    T_world_grasp = T_world_grasp @ make_pose(roma.rotvec_to_rotmat(turn), offset)
    T_world_grasp[2, 3] += (TABLE_CLEARANCE - gripper.lowest(T_world_grasp)).clamp(min=0.0)
    return T_world_grasp
