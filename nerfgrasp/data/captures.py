"""Scene folders as a source of rays: images of any size, one's own captures above all."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera
from nerfgrasp.scenes.folder import SCENE_FILE, open_scene
from nerfgrasp.scenes.scene import Workspace

KEPT_IMAGES = 128
"""So many decoded images stay in memory."""


class CapturedScenes:
    """Scenes as folders, without masks: no pixel is known to show an object. A `SceneSource`.

    Args:
        folder: holds a `transforms.json`, or folders that hold one each; they are taken in the order of their names.

    Raises:
        UserError: there is no scene, or a scene's folder is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self.scenes = [open_scene(path) for path in scene_folders(self.folder)]
        self._image = lru_cache(maxsize=KEPT_IMAGES)(self._decode)

    def __len__(self) -> int:
        return len(self.scenes)

    def camera(self, index: int) -> Camera:
        """Returns the cameras of a scene's views, batch shape `[V]`."""
        return self.scenes[index].camera

    def workspace_of(self, index: int) -> Workspace:
        """Returns a scene's workspace."""
        return self.scenes[index].workspace

    def read_images(self, index: int, views: np.ndarray) -> np.ndarray:
        """Returns views `[n]` of a scene: `[n, H, W, 3]` uint8, RGB."""
        return np.stack([self._image(index, int(view)) for view in views])

    def read_colours(self, index: int, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Returns a scene's pixels at (view, y, x), each `[n]`: `[n, 3]` uint8, RGB."""
        colours = np.empty((len(view), 3), np.uint8)
        for one in np.unique(view):
            chosen = view == one
            colours[chosen] = self._image(index, int(one))[y[chosen], x[chosen]]
        return colours

    def read_masks(self, index: int, views: np.ndarray) -> np.ndarray:
        """Returns `[n, H, W]` zeros: nobody has said what the pixels show."""
        camera = self.camera(index)
        return np.zeros((len(views), camera.height, camera.width), np.uint8)

    def _decode(self, index: int, view: int) -> np.ndarray:
        image = self.scenes[index].image(view)
        return (image * 255).round().byte().movedim(0, -1).contiguous().numpy()


def scene_folders(folder: Path) -> list[Path]:
    """Returns a folder that is a scene, or else those in it that are, in the order of their names.

    Raises:
        UserError: there is none.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder")
    if (folder / SCENE_FILE).is_file():
        return [folder]
    found = sorted(path.parent for path in folder.glob(f"*/{SCENE_FILE}"))
    if not found:
        raise UserError(f"{folder}: no {SCENE_FILE}, neither here nor in a folder of it")
    return found
