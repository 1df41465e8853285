"""What the model's own density says of a grasp: whether the hand's way is free and something is between the pads."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.models.mvnerf import SceneFeatures
from nerfgrasp.scenes.gripper import ROBOTIQ_2F85, Gripper
from nerfgrasp.scenes.scene import Workspace

_SAMPLES = 20
"""Points on each line, so far apart that no object falls between two."""
_TABLE = 0.001
"""Metres above the table below which density is the table's own."""
_LEAST = 1e-3
"""The least probability that is believed."""


@dataclass(frozen=True)
class Feasibility:
    """Weighs grasps by the opacity of lines through the open gripper, in a grasp's own frame.

    Ψ is learned from single grasps and never told what the hand consists of; the field that it reads was trained to
    render, and a line through it has an opacity: the probability that it meets something. The fingers' and the palm's
    way of the last `reach` should meet nothing, lines from pad to pad should. Each of the three probabilities counts
    as `weight` times its logarithm, in Ψ's unit.
    """

    gripper: Gripper = ROBOTIQ_2F85
    """Whose shape counts."""
    reach: float = 0.06
    """Metres along the approach."""
    weight: float = 3.0
    """How much one probability, e-fold smaller, takes from a grasp's value."""

    @torch.no_grad()
    def __call__(self, model: GraspValue, features: SceneFeatures, T_world_grasp: Tensor, box: Workspace) -> Tensor:
        """Returns what is to be added to the values `[P]` of grasps `[P, 4, 4]`: zero is best.

        Args:
            model: whose backbone knows the density.
            features: of the scene, from `model.observe`.
            T_world_grasp: the grasps.
            box: the workspace; its lower face is the table, outside of it nothing counts.
        """
        fingers, palm, gap = (
            self._opacity(model, features, T_world_grasp, box, *lines)
            for lines in (self.finger_lines(), self.palm_lines(), self.gap_lines())
        )
        chances = torch.stack([1 - fingers.amax(dim=1), 1 - palm.amax(dim=1), gap.mean(dim=1)])
        return self.weight * chances.clamp(min=_LEAST).log().sum(dim=0)

    def finger_lines(self) -> tuple[Tensor, Tensor]:
        """Returns the lines `[L, 3]` (start, vector) that points of the open fingertips draw on their way."""
        fingers = self.gripper.fingers
        inner, outer = (fingers.stroke / 2 + share * fingers.thickness for share in (0.125, 0.75))
        y = 0.36 * fingers.pad_width
        tips = [(s * x, w, fingers.pad_height / 2) for s in (-1.0, 1.0) for x in (inner, outer) for w in (-y, 0.0, y)]
        return self._ways(tips)

    def palm_lines(self) -> tuple[Tensor, Tensor]:
        """Returns the lines `[L, 3]` (start, vector) that points of the palm draw on their way."""
        x, y = 0.35 * self.gripper.body[0], 0.33 * self.gripper.body[1]
        return self._ways([(a * x, b * y, self.gripper.palm) for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)])

    def gap_lines(self) -> tuple[Tensor, Tensor]:
        """Returns the lines `[L, 3]` (start, vector) from pad to pad."""
        fingers = self.gripper.fingers
        y, z = 0.36 * fingers.pad_width, 0.32 * fingers.pad_height
        starts = [(-fingers.stroke / 2, a * y, b * z) for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)]
        return torch.tensor(starts), torch.tensor([[fingers.stroke, 0.0, 0.0]]).repeat(len(starts), 1)

    def _ways(self, ends: list[tuple[float, float, float]]) -> tuple[Tensor, Tensor]:
        way = torch.tensor([0.0, 0.0, self.reach])
        return torch.tensor(ends) - way, way.repeat(len(ends), 1)

    def _opacity(
        self, model: GraspValue, features: SceneFeatures, T: Tensor, box: Workspace, start: Tensor, vector: Tensor
    ) -> Tensor:
        """Returns the opacities `[P, L]` of lines of every grasp's frame."""
        share = (torch.arange(_SAMPLES, device=T.device) + 0.5) / _SAMPLES
        points = start.to(T)[:, None] + share[:, None] * vector.to(T)[:, None]
        world = (T[:, None, None, :3, :3] @ points[..., None])[..., 0] + T[:, None, None, :3, 3]
        length = vector.to(T).norm(dim=-1)
        directions = (T[:, None, :3, :3] @ (vector.to(T) / length[:, None])[..., None])[..., 0]
        density = model.density(features, world.flatten(0, 1), directions.flatten(0, 1)).view(world.shape[:-1])
        low, high = box.minimum.to(T), box.maximum.to(T)
        counts = ((world >= low + torch.tensor([0.0, 0.0, _TABLE]).to(T)) & (world <= high)).all(dim=-1)
        return 1 - torch.exp(-(density * counts).mean(dim=-1) * length)
