"""What a generated set is, as `set.json` in its folder says it."""

from dataclasses import asdict, dataclass, fields
from pathlib import Path

from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder, read_json, remove_temporaries, write_json
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.scenes.truth import workspace_from_json, workspace_to_json

FORMAT_VERSION = 1
SET_FILE = "set.json"


@dataclass(frozen=True)
class SetSettings:
    """Everything that the bytes of a set depend on."""

    task: str
    """Name of the task that draws the scenes."""
    seed: int
    """Scene `i` is a function of the seed and `i` alone."""
    scenes: int
    """How many scenes."""
    views: int
    """Images of each."""
    size: int
    """Width and height of an image in pixels."""
    demonstrations: bool
    """Whether a grasp was demonstrated in each scene."""
    physics: str
    """Hash of the physics that objects came to rest and demonstrations were carried out in; empty without either."""
    format: str = "packed"
    """`packed` (arrays) or `folders` (one scene folder each)."""
    catalogue: str = ""
    """Hash of the catalogue that the objects come from; empty where they are prisms."""
    depth: bool = False
    """Whether the images' depth is kept."""


def claim_folder(folder: Path, settings: SetSettings, workspace: Workspace) -> bool:
    """Makes `folder` the place of a set, or checks that it already is the place of the same one.

    Returns:
        Whether the set is new.

    Raises:
        UserError: the folder holds another set or something else, or cannot be written.
    """
    make_folder(folder)
    remove_temporaries(folder)
    if (folder / SET_FILE).exists():
        _check_same(folder, settings)
        return False
    if any(folder.iterdir()):
        raise UserError(f"{folder} is not empty and holds no {SET_FILE}: give a new folder")
    data = {"version": FORMAT_VERSION, **asdict(settings), "workspace": workspace_to_json(workspace)}
    write_json(folder / SET_FILE, data, indent=2)
    return True


def read_settings(folder: Path) -> tuple[SetSettings, Workspace]:
    """Returns what `set.json` in `folder` says.

    Raises:
        UserError: there is no such set, or its `set.json` is damaged or of another version.
    """
    path = folder / SET_FILE
    if not path.exists():
        raise UserError(f"{folder} is no data set: it has no {SET_FILE}")
    data = read_json(path)
    if data.get("version") != FORMAT_VERSION:
        raise UserError(f"{path}: format version {data.get('version')!r}, this program reads {FORMAT_VERSION}")
    for newer in ("catalogue", "depth"):  # sets may be older than these
        data.setdefault(newer, getattr(SetSettings, newer))
    for field in fields(SetSettings):
        if type(data.get(field.name)) is not field.type:
            raise UserError(f"{path}: {field.name!r} is missing or wrong")
    settings = SetSettings(**{field.name: data[field.name] for field in fields(SetSettings)})
    return settings, workspace_from_json(data.get("workspace"), str(path))


def _check_same(folder: Path, settings: SetSettings) -> None:
    there, asked = asdict(read_settings(folder)[0]), asdict(settings)
    differences = [f"{key} {there[key]!r}, asked for {asked[key]!r}" for key in asked if there[key] != asked[key]]
    if differences:
        raise UserError(f"{folder} holds another set ({'; '.join(differences)}): give a new folder")
