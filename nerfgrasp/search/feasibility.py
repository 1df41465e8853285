"""What the model's own density says of a grasp: whether the hand's way is free and something is between the pads."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.models.mvnerf import SceneFeatures
from nerfgrasp.scenes.scene import Workspace

_WAY_SAMPLES, _GAP_SAMPLES = 12, 40
"""Pieces of a line: on the hand's way so that no object falls between two, in the gap enough to see faces slant."""
_AT_ONCE = 16
"""Grasps that are weighed at once, which bounds the memory."""
_TABLE = 0.001
"""Metres above the table below which density is the table's own."""
_LEAST = 1e-3
"""The least probability that is believed."""


@dataclass(frozen=True)
class Feasibility:
    """Weighs grasps by what lines through the open gripper meet, in a grasp's own frame.

    Ψ is learned from single grasps and never told what the hand consists of; the field that it reads was trained to
    render, and a line through it has an opacity: the probability that it meets something. The fingers' and the palm's
    way of the last `reach` should meet nothing, lines from pad to pad should: each probability counts by its logarithm.
    Where these lines end, seen from either pad, is the face that the pad will touch; it should not slant.

    The weights are in Ψ's unit; docs/trials.md tells how they were chosen.
    """

    gripper: Gripper = DEFAULT_GRIPPER
    """Whose shape counts."""
    reach: float = 0.06
    """Metres along the approach."""
    free: float = 3.0
    """How much a way that is e-fold less likely free takes from a grasp's value; for the fingers and for the palm."""
    gap: float = 10.0
    """How much a gap that is e-fold less likely filled takes."""
    slant: float = 5.5
    """How much each of the two faces takes at a slant of 45° across the pad."""

    @torch.no_grad()
    def __call__(
        self,
        model: GraspValue,
        features: SceneFeatures,
        T_world_grasp: Tensor,
        box: Workspace,
        least: Tensor | None = None,
    ) -> Tensor:
        """Returns what is to be added to the values `[P]` of grasps `[P, 4, 4]`: zero is best.

        Args:
            model: whose backbone knows the density.
            features: of the scene, from `model.observe`.
            T_world_grasp: the grasps.
            box: the workspace; its lower face is the table, outside of it nothing counts.
            least: `[P]`, what a grasp must have more of to be of use. Where the way alone takes so much that it has
                not, the gap is left out.
        """
        if least is None:
            least = torch.full_like(T_world_grasp[:, 0, 0], -torch.inf)
        parts = zip(T_world_grasp.split(_AT_ONCE), least.split(_AT_ONCE), strict=True)
        added = [self._added(model, features, *part, box) for part in parts if len(part[0])]
        return torch.cat(added) if added else torch.zeros_like(least)

    def _added(
        self, model: GraspValue, features: SceneFeatures, T_world_grasp: Tensor, least: Tensor, box: Workspace
    ) -> Tensor:
        """As `__call__`, of few grasps."""

        def met(T: Tensor, lines: tuple[Tensor, Tensor], samples: int) -> Tensor:
            return self._optical_depths(model, features, T, box, *lines, samples)

        hand = (self.gripper.finger_lines(self.reach), self.gripper.palm_lines(self.reach))
        ways = [met(T_world_grasp, lines, _WAY_SAMPLES) for lines in hand]
        added = torch.stack([self.free * _log(1 - opacity(way).amax(dim=1)) for way in ways]).sum(dim=0)
        useful = added > least
        if bool(useful.any()):
            gap = met(T_world_grasp[useful], self.gripper.gap_lines(), _GAP_SAMPLES)
            filled = opacity(gap)
            slants = sum(self._slant(side, filled).abs() for side in (gap, gap.flip(-1)))
            added[useful] += self.gap * _log(filled.mean(dim=1)) - self.slant * slants
        return added

    def _slant(self, gap: Tensor, filled: Tensor) -> Tensor:
        """Returns the slopes `[P]`, tangents, of the faces that one pad meets: a line fitted through what is there.

        Args:
            gap: optical depths `[P, 9, S]` of the lines that begin at that pad.
            filled: their opacities `[P, 9]`, which weigh them.
        """
        step = self.gripper.fingers.stroke / gap.shape[-1]
        depth = (meeting(gap) * step).unflatten(1, (3, 3))
        weight = filled.unflatten(1, (3, 3))
        across = self.gripper.gap_spacing * torch.tensor([[-1.0], [0.0], [1.0]]).to(gap)
        total = weight.sum(dim=(1, 2), keepdim=True) + 1e-6
        across = across - (weight * across).sum(dim=(1, 2), keepdim=True) / total
        depth = depth - (weight * depth).sum(dim=(1, 2), keepdim=True) / total
        # Where only one row of lines meets anything there is no slope: the second term lets it vanish.
        spread = (weight * across.square()).sum(dim=(1, 2)) + 0.3 * self.gripper.gap_spacing**2
        return (weight * across * depth).sum(dim=(1, 2)) / spread

    def _optical_depths(
        self,
        model: GraspValue,
        features: SceneFeatures,
        T: Tensor,
        box: Workspace,
        start: Tensor,
        vector: Tensor,
        samples: int,
    ) -> Tensor:
        """Returns the optical depths `[P, L, S]` of the pieces of lines in every grasp's frame."""
        share = (torch.arange(samples, device=T.device) + 0.5) / samples
        points = start.to(T)[:, None] + share[:, None] * vector.to(T)[:, None]
        world = (T[:, None, None, :3, :3] @ points[..., None])[..., 0] + T[:, None, None, :3, 3]
        length = vector.to(T).norm(dim=-1)
        directions = (T[:, None, :3, :3] @ (vector.to(T) / length[:, None])[..., None])[..., 0]
        density = model.density(features, world.flatten(0, 1), directions.flatten(0, 1)).view(world.shape[:-1])
        low, high = box.minimum.to(T), box.maximum.to(T)
        counts = ((world >= low + torch.tensor([0.0, 0.0, _TABLE]).to(T)) & (world <= high)).all(dim=-1)
        return density * counts * (length / samples)[:, None]


ONE_VIEW = Feasibility(free=Feasibility.free / 2, gap=Feasibility.gap / 2, slant=Feasibility.slant / 2)
"""For a model that sees one view at a time and smears an object along its line of sight: half the weights, chosen in
96 tuning scenes (docs/trials.md)."""


def opacity(optical_depth: Tensor) -> Tensor:
    """Returns the opacity `[...]`, 1 − exp(−Σ τ), of lines whose pieces have optical depths τ `[..., S]`."""
    return -torch.expm1(-optical_depth.sum(dim=-1))


def meeting(optical_depth: Tensor) -> Tensor:
    """Returns after how many pieces `[...]` lines of optical depths `[..., S]` meet something, if they do: the mean."""
    after = optical_depth.cumsum(dim=-1)
    weights = torch.exp(optical_depth - after) - torch.exp(-after)
    middles = torch.arange(optical_depth.shape[-1], device=optical_depth.device) + 0.5
    return (weights * middles).sum(dim=-1) / (weights.sum(dim=-1) + 1e-6)


def _log(chance: Tensor) -> Tensor:
    return chance.clamp(min=_LEAST).log()
