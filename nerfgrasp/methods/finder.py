"""The Python interface of three lines: load a model, observe a scene, get ranked grasps."""

import hashlib
from collections import OrderedDict

import torch

from nerfgrasp.errors import UserError
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper
from nerfgrasp.methods.psi import ObservedScene, Psi
from nerfgrasp.scenes.arrays import Array, observations_from_arrays, workspace_from_corners
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.ranking import distinct
from nerfgrasp.search.schedule import PoseParameterization
from nerfgrasp.search.strategies import Strategy, find_strategy


class GraspFinder:
    """Finds grasps in scenes given as arrays: docs/search.md has a whole program.

    One convention everywhere: metres, in the robot's base frame; cameras are camera to world with OpenCV's axes (x
    right, y down, z forward); images are undistorted RGB. A grasp's frame lies at the tool centre point: +z is the
    approach, +x the closing axis.

    Args:
        method: a trained value with its search.
        remember: how many scenes' features are kept: images that are observed again cost their hash alone.
    """

    def __init__(self, method: Psi, *, remember: int = 4) -> None:
        if remember < 0:
            raise UserError(f"remember is {remember}: it must be 0 or more")
        self.method, self.remember = method, remember
        self._scenes: OrderedDict[bytes, ObservedScene] = OrderedDict()

    @classmethod
    def from_pretrained(
        cls,
        model: str | None = None,
        *,
        device: str | torch.device = "cpu",
        remember: int = 4,
        images: int | None = None,
        gripper: str | Gripper = DEFAULT_GRIPPER,
    ) -> "GraspFinder":
        """Loads a model.

        Args:
            model: a model's folder, a Hugging Face repository id, or the name of a shipped one; without it, the
                default.
            device: where to compute: `cpu`, `cuda`, `mps`, or a numbered one, e.g. `cuda:1`.
            remember: see the class.
            images: how many of a scene's images are used, from the front; up to three, or as many as the model needs,
                if not given. See `Psi`.
            gripper: the hand that grasps: a gripper, a registered name or a YAML file.

        Raises:
            UserError: there is no such model or device, the model is damaged or values no grasps, or `images` is out of
                its range.
        """
        return cls(Psi.from_pretrained(model, device=device, images=images, gripper=gripper), remember=remember)

    def observe(
        self,
        images: Array,
        intrinsics: Array,
        T_world_camera: Array,
        workspace: Workspace | Array | None = None,
    ) -> ObservedScene:
        """Encodes a scene's images; the same ones, observed again, come from memory.

        Args:
            images: `[V, H, W, 3]` or `[V, 3, H, W]`, RGB: uint8, or floats in [0, 1]. As many as `from_pretrained` was
                told are used; else as many as the model needs, or three if it needs fewer.
            intrinsics: `[3, 3]` or `[V, 3, 3]` in pixels; pixel centres lie at +0.5.
            T_world_camera: `[V, 4, 4]`, camera to world, OpenCV axes, metres.
            workspace: two corners (minimum, maximum) of the box to search, metres, its lower face the table; the
                default is 0.5 m × 0.5 m × 0.2 m about the world's origin.

        Raises:
            UserError: an array is of another shape than above or holds numbers that cannot be meant, there are too
                few views, or a camera sees nothing of the workspace.
        """
        observations = observations_from_arrays(images, intrinsics, T_world_camera)
        return self.observe_scene(observations.select(slice(self.method.images)), _workspace(workspace))

    def observe_scene(self, observations: Observations, workspace: Workspace) -> ObservedScene:
        """As `observe`, of what `nerfgrasp.scenes.folder.read_scene` reads."""
        key = _digest(observations, workspace)
        if key in self._scenes:
            self._scenes.move_to_end(key)
            return self._scenes[key]
        scene = self._scenes[key] = self.method.observe(observations, workspace)
        while len(self._scenes) > self.remember:
            self._scenes.popitem(last=False)
        return scene

    def grasps(
        self,
        scene: ObservedScene,
        count: int = 5,
        *,
        strategy: str | Strategy | None = None,
        pose: str | PoseParameterization | None = None,
        seed: int = 0,
        least_value: float | None = None,
    ) -> Grasps:
        """Searches an observed scene.

        Args:
            scene: from `observe`.
            count: how many grasps to return at most; there may be fewer that differ.
            strategy: how to search: a name, or what `find_strategy` returns; the method's own if None.
            pose: the parameterization to climb in, or its registered name; the method's own if None.
            seed: the same seed finds the same grasps.
            least_value: what a grasp must be worth, for a model trained with the loss `binary`; there may be none then.

        Returns:
            Grasps that differ from each other by 20 mm or 30° at least, best first, on the CPU: `T_world_grasp`
            `[N, 4, 4]`, and `value` `[N]`, logits that are comparable within one scene only.

        Raises:
            UserError: a name is unknown, a number out of its range, a plug-in breaks its word, or the model's values
                reject no grasp.
        """
        if count < 1:
            raise UserError(f"count is {count}: it must be at least 1")
        if least_value is not None:
            self.method.check_least(least_value)
        strategy = find_strategy(strategy) if isinstance(strategy, str) else strategy
        generator = torch.Generator().manual_seed(seed)
        found, _ = self.method.search(scene, generator=generator, pose=pose, strategy=strategy)
        different = distinct(found.to("cpu"), count=count)
        return different if least_value is None else self.method.at_least(different, least_value)


def _workspace(given: Workspace | Array | None) -> Workspace:
    if given is None:
        return Workspace()
    if isinstance(given, Workspace):
        return workspace_from_corners(given.minimum, given.maximum)
    try:
        minimum, maximum = given
    except (TypeError, ValueError) as error:
        raise UserError("workspace needs two corners, minimum and maximum, of three numbers in metres each") from error
    return workspace_from_corners(minimum, maximum)


def _digest(observations: Observations, workspace: Workspace) -> bytes:
    """Returns a hash of all that features depend on, beside the model."""
    camera = observations.camera
    digest = hashlib.blake2b(f"{tuple(observations.images.shape)}".encode())
    for tensor in (observations.images, camera.intrinsics, camera.T_world_camera, workspace.minimum, workspace.maximum):
        digest.update(tensor.detach().cpu().contiguous().numpy().data)
    return digest.digest()
