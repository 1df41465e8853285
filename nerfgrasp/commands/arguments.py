"""Arguments that several commands share."""

from argparse import ArgumentParser
from collections.abc import Mapping
from typing import Any, NoReturn

from nerfgrasp.errors import UserError


class Arguments(ArgumentParser):
    """An `ArgumentParser` that raises `UserError` instead of ending the process."""

    def error(self, message: str) -> NoReturn:
        """Raises the error, as argparse expects it of a parser.

        Raises:
            UserError: always; it names the command.
        """
        raise UserError(f"{self.prog.split()[1]}: {message}")


def with_shorthands(options: Mapping[str, Any] | None, **shorthands: Any) -> dict[str, Any]:
    """Returns a method's options together with those that were given by options of their own.

    Example:
        >>> with_shorthands({"tries": 3}, strategy="paper", pose=None)
        {'tries': 3, 'strategy': 'paper'}

    Raises:
        UserError: an option was given both ways.
    """
    given = {name: value for name, value in shorthands.items() if value is not None}
    merged = dict(options or {})
    for name in given:
        if name in merged:
            raise UserError(f"{name} is given twice: by itself and in options")
    return merged | given
