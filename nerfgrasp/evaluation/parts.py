"""Finished scenes of an evaluation that still runs: a file each, so that a killed run loses and doubles nothing."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.results import (
    Row,
    Times,
    row_from_json,
    row_to_json,
    times_from_json,
    times_path,
    write_results,
    write_times,
)
from nerfgrasp.files import make_folder, read_json, remove, remove_temporaries, write_json

SETTINGS_FILE = "settings.json"


class Parts:
    """The folder `OUT.parts` beside a results file to be.

    Args:
        out: the results file.
        settings: JSON data that says what the results depend on; a folder of others is refused.
    """

    def __init__(self, out: Path, settings: dict[str, Any]) -> None:
        self.out, self.settings = out, settings
        self.folder = out.with_name(f"{out.name}.parts")

    def claim(self, scenes: int) -> None:
        """Makes the folder, or takes up what a killed run left there.

        Args:
            scenes: how many are to be published; finished ones after those would be lost.

        Raises:
            UserError: it belongs to another command, holds scenes that would be lost, or cannot be written.
        """
        make_folder(self.folder)
        remove_temporaries(self.folder)
        for path in (self.out, times_path(self.out)):
            for left in path.parent.glob(f".{path.name}.*.tmp"):
                remove(left)
        settings = self.folder / SETTINGS_FILE
        if not settings.exists():
            write_json(settings, self.settings)
        self._check(read_json(settings))
        last = max((int(path.stem) for path in self.folder.glob("[0-9]*.json")), default=-1)
        if last >= scenes:
            raise UserError(
                f"{self.folder} was left by another command: it holds scene {last}, asked for {scenes} scenes; "
                "ask for as many as that command, or remove the folder"
            )

    def discard(self) -> None:
        """Removes what a run left that was killed after it had published; another command's folder stays."""
        if (self.folder / SETTINGS_FILE).exists() and read_json(self.folder / SETTINGS_FILE) == self.settings:
            remove(self.folder)

    def missing(self, scenes: int) -> list[int]:
        """Returns the numbers of the scenes that are not finished, of the first `scenes`."""
        return [scene for scene in range(scenes) if not self._path(scene).exists()]

    def write(self, scene: int, attempts: Sequence[tuple[Row, Times]]) -> None:
        """Keeps a finished scene."""
        rows = [row_to_json(row) for row, _ in attempts]
        write_json(self._path(scene), {"rows": rows, "times": [asdict(times) for _, times in attempts]})

    def read(self, scene: int) -> tuple[list[Row], list[Times]]:
        """Returns what was kept of a scene; a damaged file is a UserError."""
        data = read_json(self._path(scene))
        try:
            return [row_from_json(row) for row in data["rows"]], [times_from_json(times) for times in data["times"]]
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{self._path(scene)} is damaged ({error}): remove it") from error

    def publish(self, scenes: int) -> list[Row]:
        """Writes the results file, in scene order, and the wall times beside it; removes the parts.

        Returns:
            All its rows.
        """
        parts = [self.read(scene) for scene in range(scenes)]
        rows = [row for part, _ in parts for row in part]
        write_times(times_path(self.out), (times for _, part in parts for times in part))
        write_results(self.out, rows)
        remove(self.folder)
        return rows

    def _check(self, there: dict[str, Any]) -> None:
        different = [key for key in {**there, **self.settings} if there.get(key) != self.settings.get(key)]
        if different:
            key = different[0]
            raise UserError(
                f"{self.folder} was left by another command: its {key} is {there.get(key)!r}, "
                f"asked for {self.settings.get(key)!r}; repeat that command, or remove the folder"
            )

    def _path(self, scene: int) -> Path:
        return self.folder / f"{scene:06d}.json"
