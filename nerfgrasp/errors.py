"""The one exception that means: the user can mend this, and one line says how."""

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(Exception):
    """A mistake in what the user gave. Its message is one line that says what is wrong and where.

    The command prints it without a traceback and exits with status 2.
    """


def unknown_name(what: str, name: str, choices: Iterable[str]) -> UserError:
    """Returns the error for a `name` that is none of `choices`, with near misses first.

    Example:
        >>> str(unknown_name("pose", "quaternoin", ["matrix", "quaternion"]))
        "unknown pose 'quaternoin': did you mean 'quaternion'? (choices: matrix, quaternion)"
    """
    known = sorted(choices)
    near = get_close_matches(name, known, n=2)
    hint = f"did you mean {' or '.join(repr(n) for n in near)}? " if near else ""
    return UserError(f"unknown {what} {name!r}: {hint}(choices: {', '.join(known) or 'none'})")
