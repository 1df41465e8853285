"""What is known of a scene: its images, its workspace and, in simulation, the truth."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera
from nerfgrasp.scenes.objects import SceneObject


@dataclass(frozen=True)
class Workspace:
    """An axis-aligned box in the world frame in which grasps are searched."""

    minimum: Tensor = field(default_factory=lambda: torch.tensor([-0.25, -0.25, 0.0]))
    """`[3]`, metres. Its z is the table's top."""
    maximum: Tensor = field(default_factory=lambda: torch.tensor([0.25, 0.25, 0.2]))
    """`[3]`, metres."""

    def to(self, device: torch.device | str) -> "Workspace":
        """Returns the same box on `device`."""
        return Workspace(self.minimum.to(device), self.maximum.to(device))


@dataclass(frozen=True)
class Truth:
    """What a simulated scene is made of; enough to build it again in physics."""

    task: str
    """The task that drew the scene, e.g. `simple`."""
    seed: int
    """The set's seed."""
    index: int
    """The scene's number in the set of that seed."""
    objects: tuple[SceneObject, ...]
    """The objects where they stand."""
    demonstration: Tensor | None = None
    """`T_world_grasp` `[4, 4]` of the demonstrated grasp that lifted an object, if one was asked for."""


@dataclass(frozen=True)
class Observations:
    """Images with known cameras."""

    images: Tensor
    """`[V, 3, H, W]`, RGB in [0, 1]."""
    camera: Camera
    """Batch shape `[V]`."""
    depth: Tensor | None = None
    """`[V, H, W]` along the optical axis in metres; only for methods that declare that they need it."""
    truth: Truth | None = None
    """Only for methods that declare that they need it."""

    def __len__(self) -> int:
        return self.images.shape[0]

    def select(self, views: slice | list[int]) -> "Observations":
        """Returns the observations of some of the views."""
        depth = None if self.depth is None else self.depth[views]
        return Observations(self.images[views], self.camera[views], depth, self.truth)

    def require(self, views: int) -> None:
        """Compares the views with how many a model sees at once.

        Raises:
            UserError: there are fewer.
        """
        if len(self) < views:
            raise UserError(f"the model needs {views} views, the scene has {len(self)}")

    def to(self, device: torch.device | str) -> "Observations":
        """Returns the same observations on `device`."""
        depth = None if self.depth is None else self.depth.to(device)
        return Observations(self.images.to(device), self.camera.to(device), depth, self.truth)


@dataclass(frozen=True)
class Scene:
    """A scene as it stands in a folder."""

    name: str
    """The folder's name."""
    observations: Observations
    """All its views, in the order of the file; methods take as many from the front as they need."""
    workspace: Workspace
    """Where grasps are searched."""
    truth: Truth | None = None
    """Known in simulation."""


@dataclass(frozen=True)
class Grasps:
    """Proposed grasps, best first."""

    T_world_grasp: Tensor
    """`[N, 4, 4]`. Origin: the tool centre point; +z: approach; +x: closing axis."""
    value: Tensor
    """`[N]`: logits, comparable within one scene only."""

    def __len__(self) -> int:
        return self.value.shape[0]

    def to(self, device: torch.device | str) -> "Grasps":
        """Returns the same grasps on `device`."""
        return Grasps(self.T_world_grasp.to(device), self.value.to(device))
