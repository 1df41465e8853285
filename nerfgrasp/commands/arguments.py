"""The parser of commands with subcommands of their own, whose usage errors are one line."""

from argparse import ArgumentParser
from typing import NoReturn

from nerfgrasp.errors import UserError


class Arguments(ArgumentParser):
    """An `ArgumentParser` that raises `UserError` instead of leaving the process."""

    def error(self, message: str) -> NoReturn:
        """Raises the error, as argparse expects it of a parser.

        Raises:
            UserError: always; it names the command.
        """
        raise UserError(f"{self.prog.split()[1]}: {message}")
