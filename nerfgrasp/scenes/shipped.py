"""Scenes that come with the package."""

from importlib.resources import files
from pathlib import Path

from nerfgrasp.errors import UserError, unknown_name
from nerfgrasp.scenes.folder import SCENE_FILE


def shipped_scenes() -> dict[str, Path]:
    """Returns the folders of the scenes that come with the package, by name."""
    root = Path(str(files("nerfgrasp"))) / "assets" / "scenes"
    return {path.parent.name: path.parent for path in sorted(root.glob(f"*/{SCENE_FILE}"))}


def find_scene(name_or_folder: str) -> Path:
    """Returns the folder of a scene, given that folder or the name of a shipped scene.

    A folder that holds a scene comes before a shipped scene of that name; any other folder comes after it.

    Raises:
        UserError: there is neither; a name is answered with the names there are.
    """
    folder, shipped = Path(name_or_folder), shipped_scenes()
    if not (folder / SCENE_FILE).is_file() and name_or_folder in shipped:
        return shipped[name_or_folder]
    if folder.is_dir():
        return folder
    if len(folder.parts) > 1 or folder.exists():
        raise UserError(f"{folder}: no such folder")
    raise unknown_name("scene", name_or_folder, shipped)
