"""Sets as scene folders, one each: for looking at, and for other programs. Larger and slower than packed ones."""

from pathlib import Path

import numpy as np
import torch

from nerfgrasp.data.settings import SetSettings, claim_folder, read_settings
from nerfgrasp.errors import UserError
from nerfgrasp.files import remove_temporaries
from nerfgrasp.geometry import Camera
from nerfgrasp.scenes.folder import read_truth, write_scene
from nerfgrasp.scenes.scene import Observations, Scene, Truth, Workspace


class FolderWriter:
    """Writes the scenes of a set as folders `NNNNNN/`; used as `PackedWriter` is. Masks and depth are not kept.

    Args:
        folder: the set's folder.
        settings: what the set is.
    """

    def __init__(self, folder: Path, settings: SetSettings) -> None:
        self.folder = folder
        self.settings = settings

    def prepare(self, workspace: Workspace) -> None:
        """Claims the folder; what a killed run left half-written goes.

        Raises:
            UserError: the folder holds something else or cannot be written.
        """
        claim_folder(self.folder, self.settings, workspace)

    def missing(self) -> list[int]:
        """Returns the numbers of the scenes that are not complete."""
        return [index for index in range(self.settings.scenes) if not self._path(index).exists()]

    def write(
        self,
        index: int,
        images: np.ndarray,
        masks: np.ndarray,
        camera: Camera,
        truth: Truth,
        depth: np.ndarray | None = None,
    ) -> None:
        """Writes scene `index`: images `[V, H, W, 3]` uint8, cameras `[V]`. Another process may have done so.

        Raises:
            UserError: it cannot be written.
        """
        views = torch.from_numpy(images).movedim(-1, -3) / 255
        scene = Scene(f"{index:06d}", Observations(views, camera), read_settings(self.folder)[1], truth)
        try:
            write_scene(self._path(index), scene)
        except UserError:
            if not self._path(index).exists():
                raise

    def clear(self) -> None:
        """Removes what killed processes left half-written; nobody else may be writing."""
        remove_temporaries(self.folder)

    def truth(self, index: int) -> Truth:
        """Returns what scene `index`, a complete one, is made of."""
        truth = read_truth(self._path(index))
        if truth is None:
            raise UserError(f"{self._path(index)}: its truth is missing")
        return truth

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:06d}"
