"""What a command ends with in one line: the user can mend it, or there is nothing to be found."""

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(Exception):
    """A mistake in what the user gave. Its message is one line that says what is wrong and where.

    The command prints it without a traceback and exits with its status.
    """

    status = 2
    """The command's exit status."""


class NoGraspError(UserError):
    """Nothing was wrong, but the scene holds no grasp as good as asked for."""

    status = 1


def unknown_name(what: str, name: str, choices: Iterable[str]) -> UserError:
    """Returns the error for a `name` that is none of `choices`, with near misses first.

    Example:
        >>> str(unknown_name("pose", "quaternoin", ["matrix", "quaternion"]))
        "unknown pose 'quaternoin': did you mean 'quaternion'? (choices: matrix, quaternion)"
    """
    return UserError(f"unknown {what} {name!r}: {choices_hint(name, choices)}")


def choices_hint(name: str, choices: Iterable[str]) -> str:
    """Returns the near misses of `name` among `choices`, then all of the choices.

    Example:
        >>> choices_hint("quaternoin", ["matrix", "quaternion"])
        "did you mean 'quaternion'? (choices: matrix, quaternion)"
    """
    known = sorted(choices)
    near = get_close_matches(name, known, n=2)
    hint = f"did you mean {' or '.join(repr(n) for n in near)}? " if near else ""
    return f"{hint}(choices: {', '.join(known) or 'none'})"
