"""Methods that know the truth and try grasps in physics before they propose one."""

from typing import ClassVar, Self

import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper, find_gripper
from nerfgrasp.scenes.scene import Grasps, Truth
from nerfgrasp.search.ranking import best_first, distinct
from nerfgrasp.sim.attempt import Outcome, attempt_grasp

DISTANCE, ANGLE = 0.008, 0.25
"""Metres and radians. Of grasps that are closer than both, only one is tried."""


class TriedInPhysics:
    """A method that knows the truth, tries its grasps in physics and proposes one that lifts an object.

    Args:
        tries: maximum number of grasps that are tried; None for the method's default.
        gripper: the hand that carries the grasps out: a gripper, a registered name or a YAML file.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"truth"})
    """The method is given the truth about the scene."""
    default_tries: ClassVar[int]
    """Maximum number of grasps that are tried in a scene."""

    def __init__(self, tries: int | None = None, gripper: str | Gripper = DEFAULT_GRIPPER) -> None:
        self.gripper = find_gripper(gripper)
        self.tries = self.default_tries if tries is None else tries

    @classmethod
    def from_pretrained(
        cls, folder: str | None = None, *, tries: int | None = None, gripper: str | Gripper = DEFAULT_GRIPPER
    ) -> Self:
        """Returns the method. There is nothing to load, so `folder` is not read."""
        return cls(tries, gripper)

    def first_success(self, truth: Truth, T_world_grasp: Tensor, score: Tensor, count: int) -> Grasps:
        """Carries grasps out, best score first, until one lifts its object.

        Args:
            truth: the scene.
            T_world_grasp: `[N, 4, 4]`, double.
            score: `[N]`; higher scores are tried first.
            count: maximum number of grasps that are returned.

        Returns:
            The grasp that succeeded with value 1, then those that were not tried with value 0 and by score, then those
            that failed with value -1.
        """
        most = max(self.tries + 1, count)
        grasps = distinct(best_first(exactly_rigid(T_world_grasp), score), DISTANCE, ANGLE, most)
        value = torch.zeros(len(grasps), dtype=torch.float64)
        for number in range(min(self.tries, len(grasps))):
            attempt = attempt_grasp(truth, grasps.T_world_grasp[number], gripper=self.gripper)
            if attempt.outcome == Outcome.SUCCESS:
                value[number] = 1.0
                break
            value[number] = -1.0
        ranked = best_first(grasps.T_world_grasp, value)
        return Grasps(ranked.T_world_grasp[:count], ranked.value[:count])


def exactly_rigid(T: Tensor) -> Tensor:
    """Returns poses `[..., 4, 4]` in double with rotations that are exact to double precision."""
    rotation = roma.unitquat_to_rotmat(roma.rotmat_to_unitquat(T[..., :3, :3].double()))
    return make_pose(rotation, T[..., :3, 3].double())
