"""The method `antipodal`: opposite points of the known surfaces, tried in physics. An upper bound for novel objects.

Source of the criterion: Nguyen 1988, "Constructing force-closure grasps": two contacts with friction hold where
the line between them lies in both friction cones.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import Gripper
from nerfgrasp.scenes.bars import TABLE_CLEARANCE
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.sim.physics import PHYSICS
from nerfgrasp_baselines.oracle import grasp_score, known_truth
from nerfgrasp_baselines.surfaces import Surface, has_room, sample_surface
from nerfgrasp_baselines.trying import TriedInPhysics

PAIRS = 256
"""Maximum number of pairs of opposite points that become grasps."""
MIN_WIDTH, SLACK = 0.003, 0.004
"""Metres: the minimum distance of two opposite points, and the part of the stroke that stays free."""
TILTS = tuple(math.radians(degrees) for degrees in (0.0, -30.0, 30.0, -60.0, 60.0))
"""Angles about the closing axis, relative to the approach nearest to straight down, at which each pair is tried."""
STEEPEST = math.radians(75.0)
"""Maximum angle between an approach and straight down."""
MAX_RAISE = 0.015
"""Maximum distance in metres by which the hand is drawn back from the table; the points then lie lower on its pads."""


class Antipodal(TriedInPhysics):
    """Draws pairs of opposite points, finds room for the open gripper, and proposes the first grasp that lifts."""

    default_tries = 50

    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        """Returns up to `count` grasps, the one that lifted first; none where there are no opposite points in reach.

        Raises:
            UserError: the observations come without the truth, or an object's model is not at hand.
        """
        truth = known_truth(observations, "antipodal")
        surface = sample_surface(truth.objects, generator)
        T = _raised(_approaches(*_opposite_points(surface, self.gripper, generator)), self.gripper)
        T = T[has_room(T, surface, self.gripper)]
        return self.first_success(truth, T, grasp_score(T, truth.objects), count)


def _opposite_points(surface: Surface, gripper: Gripper, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Returns up to `PAIRS` pairs `[N, 3]` of points of one object, each in the other's friction cone."""
    line = surface.points[None] - surface.points[:, None]
    width = line.norm(dim=-1)
    cosine = math.cos(math.atan(PHYSICS.pad_friction * PHYSICS.object_friction))
    # Pushed inwards at both ends: along the line at its start, against it at its end.
    first = -(line * surface.normals[:, None]).sum(-1) >= cosine * width
    second = (line * surface.normals[None]).sum(-1) >= cosine * width
    fits = (width >= MIN_WIDTH) & (width <= gripper.fingers.stroke - SLACK)
    # No approach across a steeper line is from above.
    fits &= line[..., 2].abs() <= math.sin(STEEPEST) * width
    mine = surface.object[:, None] == surface.object[None]
    a, b = (first & second & fits & mine).triu().nonzero().unbind(1)
    chosen = torch.randperm(len(a), generator=generator)[:PAIRS]
    return surface.points[a[chosen]], surface.points[b[chosen]]


def _approaches(a: Tensor, b: Tensor) -> Tensor:
    """Returns grasps `[M, 4, 4]` between points `[N, 3]`, from several sides, all rather from above."""
    x = normalize(b - a, dim=-1)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=x.dtype)
    z = normalize(down - (x @ down)[:, None] * x, dim=-1)
    turned = [math.cos(tilt) * z + math.sin(tilt) * torch.linalg.cross(x, z) for tilt in TILTS]
    approach, closing = torch.cat(turned), x.repeat(len(TILTS), 1)
    rotation = torch.stack([closing, torch.linalg.cross(approach, closing), approach], dim=-1)
    T = make_pose(rotation, ((a + b) / 2).repeat(len(TILTS), 1))
    return T[-T[:, 2, 2] >= math.cos(STEEPEST)]


def _raised(T: Tensor, gripper: Gripper) -> Tensor:
    """Returns grasps drawn back along their approaches until they clear the table, without those too far below it."""
    lacking = (TABLE_CLEARANCE - gripper.lowest(T)).clamp(min=0.0)
    back = lacking / -T[:, 2, 2]
    raised = T.clone()
    raised[:, :3, 3] -= back[:, None] * T[:, :3, 2]
    return raised[back <= MAX_RAISE]
