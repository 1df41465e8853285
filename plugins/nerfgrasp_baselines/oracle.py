"""The method `oracle`: valid grasps of prisms, known from the truth and tried in physics. An upper bound."""

import math

import torch
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import Gripper
from nerfgrasp.scenes.bars import TABLE_CLEARANCE
from nerfgrasp.scenes.objects import SceneObject
from nerfgrasp.scenes.oracle import sample_top_down, valid_grasps
from nerfgrasp.scenes.scene import Grasps, Observations, Truth, Workspace
from nerfgrasp.scenes.stances import MAX_TILT
from nerfgrasp_baselines.surfaces import centres_of_mass, has_room, sample_surface
from nerfgrasp_baselines.trying import TriedInPhysics

DRAWS = 160
"""Valid grasps from above; each is tilted once more at random."""
OFF_CENTRE, TILTED = 0.02, math.radians(30.0)
"""Metres from the nearest centre of mass, seen from above, and radians of tilt that cost a grasp one unit."""


class Oracle(TriedInPhysics):
    """Draws valid grasps, sorts them by how well they should hold, and proposes the first that lifts in physics."""

    default_tries = 40

    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        """Returns up to `count` grasps, the one that lifted first; none where no prism can be grasped.

        Raises:
            UserError: the observations come without the truth.
        """
        truth = known_truth(observations, "oracle")
        valid = valid_grasps(truth.objects, self.gripper)
        if len(valid) == 0:
            return Grasps(torch.zeros(0, 4, 4), torch.zeros(0))
        upright = torch.stack([sample_top_down(valid, generator) for _ in range(DRAWS)]).double()
        T = torch.cat([upright, _tilted(upright, generator)])
        T = T[self.gripper.lowest(T) >= 0.9 * TABLE_CLEARANCE]
        return self.first_success(truth, T, _score(T, truth.objects, self.gripper, generator), count)


def known_truth(observations: Observations, method: str) -> Truth:
    """Returns the truth that comes with observations of a simulated scene.

    Raises:
        UserError: there is none.
    """
    if observations.truth is None:
        raise UserError(f"method {method!r} needs the truth of a simulated scene")
    return observations.truth


def grasp_score(T: Tensor, objects: tuple[SceneObject, ...]) -> Tensor:
    """Returns scores `[N]` of grasps `[N, 4, 4]`: those over a centre of mass and from above score high."""
    away = (T[:, None, :2, 3] - centres_of_mass(objects)[None, :, :2]).norm(dim=-1).amin(dim=-1)
    tilt = torch.arccos((-T[:, 2, 2]).clamp(-1.0, 1.0))
    return -away / OFF_CENTRE - tilt / TILTED


def _score(T: Tensor, objects: tuple[SceneObject, ...], gripper: Gripper, generator: torch.Generator) -> Tensor:
    """Returns scores `[N]`. Grasps with an obstacle on their way come after all others, but are not left out."""
    free = has_room(T, sample_surface(objects, generator), gripper)
    return grasp_score(T, objects) - 100.0 * (~free)


def _tilted(T: Tensor, generator: torch.Generator) -> Tensor:
    """Returns grasps from above turned about their closing axes, where they stay valid."""
    angle = MAX_TILT * (2 * torch.rand(len(T), generator=generator, dtype=T.dtype) - 1)
    one, zero, cos, sin = torch.ones_like(angle), torch.zeros_like(angle), angle.cos(), angle.sin()
    turn = torch.stack([one, zero, zero, zero, cos, -sin, zero, sin, cos], dim=-1).reshape(-1, 3, 3)
    turned = make_pose(T[:, :3, :3] @ turn, T[:, :3, 3])
    return turned[-turned[:, 2, 2] >= math.cos(MAX_TILT)]
