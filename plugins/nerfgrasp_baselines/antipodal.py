"""The method `antipodal`: opposite points of the known surfaces, tried in physics. The ceiling of a novel object.

Source of the criterion: Nguyen 1988, "Constructing force-closure grasps": two contacts with friction hold where
the line between them lies in both friction cones.
"""

import math
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.bars import TABLE_CLEARANCE
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.sim.physics import PHYSICS
from nerfgrasp_baselines.oracle import grasp_score, known_truth
from nerfgrasp_baselines.surfaces import Surface, has_room, sample_surface
from nerfgrasp_baselines.trying import first_success
from nerfgrasp_baselines.untrained import Untrained

PAIRS = 256
"""Opposite points that are looked at closer."""
MIN_WIDTH, SLACK = 0.003, 0.004
"""Metres: the least between two opposite points, and what is left of the stroke at the most."""
TILTS = tuple(math.radians(degrees) for degrees in (0.0, -30.0, 30.0, -60.0, 60.0))
"""Approaches of each pair: turns about the closing axis, away from the one nearest to straight down."""
STEEPEST = math.radians(75.0)
"""The most by which an approach may differ from straight down."""
MAX_RAISE = 0.015
"""Metres by which the hand may be drawn back from the table, so that the points lie lower on its pads."""


class Antipodal(Untrained):
    """Draws pairs of opposite points, finds the open gripper room, and proposes the first that lifts in physics."""

    needs: ClassVar[frozenset[str]] = frozenset({"truth"})
    """It is told where everything is."""

    def __init__(self, tries: int = 50) -> None:
        self.tries = tries

    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        """Returns up to `count` grasps, the one that lifted first; none where there are no opposite points in reach.

        Raises:
            UserError: the observations come without the truth, or an object's model is not at hand.
        """
        truth = known_truth(observations, "antipodal")
        surface = sample_surface(truth.objects, generator)
        T = _raised(_approaches(*_opposite_points(surface, generator)))
        T = T[has_room(T, surface)]
        return first_success(truth, T, grasp_score(T, truth.objects), self.tries, count)


def _opposite_points(surface: Surface, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Returns up to `PAIRS` pairs `[N, 3]` of points of one object, each in the other's friction cone."""
    line = surface.points[None] - surface.points[:, None]
    width = line.norm(dim=-1)
    cosine = math.cos(math.atan(PHYSICS.pad_friction * PHYSICS.object_friction))
    # Pushed inwards at both ends: along the line at its start, against it at its end.
    first = -(line * surface.normals[:, None]).sum(-1) >= cosine * width
    second = (line * surface.normals[None]).sum(-1) >= cosine * width
    fits = (width >= MIN_WIDTH) & (width <= ROBOTIQ_2F85.fingers.stroke - SLACK)
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


def _raised(T: Tensor) -> Tensor:
    """Returns grasps drawn back along their approaches until they clear the table; less those too far below it."""
    lacking = (TABLE_CLEARANCE - ROBOTIQ_2F85.lowest(T)).clamp(min=0.0)
    back = lacking / -T[:, 2, 2]
    raised = T.clone()
    raised[:, :3, 3] -= back[:, None] * T[:, :3, 2]
    return raised[back <= MAX_RAISE]
