"""What numbers the commands take: one table, so that an option of a name has one range."""

from nerfgrasp.errors import UserError

RANGES = {
    "scenes": (1, 999_999),
    "scene": (0, 999_999),
    "views": (1, 1000),
    "images": (1, 1000),
    "seed": (0, 2**32 - 1),
    "size": (16, 2048),
    "workers": (1, 1024),
    "count": (1, 10_000),
    "slices.size": (2, 1000),
    "clutter_scenes": (0, 999_999),
    "novel_poses": (0, 10_000),
    "seeds": (1, 1000),
    "jobs": (1, 1024),
}
"""The least and the most of each option, and of one that is something else in a command, as `COMMAND.OPTION`."""


def check_ranges(command: str = "", /, **values: int | None) -> None:
    """Checks options by their names against `RANGES`; None is always right.

    Args:
        command: whose own ranges come first, where an option of the name is something else.
        values: by option.

    Raises:
        UserError: one is out of its range.

    Example:
        >>> check_ranges(seed=2**32)
        Traceback (most recent call last):
        nerfgrasp.errors.UserError: seed is 4294967296: it must be from 0 to 4294967295
    """
    for name, value in values.items():
        least, most = RANGES.get(f"{command}.{name}") or RANGES[name]
        if value is not None and not least <= value <= most:
            raise UserError(f"{name} is {value}: it must be from {least} to {most}")
