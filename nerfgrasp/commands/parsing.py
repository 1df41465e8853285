"""How arguments and configs are parsed: jsonargparse, with one-line errors that name near misses."""

import json
import re
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from typing import Any, NoReturn, get_origin, get_type_hints

from jsonargparse import ArgumentParser, auto_cli

from nerfgrasp.errors import UserError


class OneLineErrors:
    """A mixin for jsonargparse parsers: usage errors become `UserError`, unknown options list near misses.

    Put it before the parser class: `class Parser(OneLineErrors, LightningArgumentParser)`.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Raises the error, as jsonargparse expects it of a parser.

        Raises:
            UserError: the user's arguments or config are wrong.
        """
        line = one_line(message) + _near_misses(message, self._actions)  # type: ignore[attr-defined]
        if not self.exit_on_error:  # type: ignore[attr-defined]
            super().error(line, ex)  # type: ignore[misc]  # a parser inside another, which may still try other types
        raise UserError(line) from ex


class Parser(OneLineErrors, ArgumentParser):
    """The parser of every command that is a plain function."""


def call(function: Callable[..., Any], args: list[str], *, prog: str) -> Any:
    """Parses `args` by the signature of `function`, calls it, and returns what it returns.

    Raises:
        UserError: the arguments or a `--config` do not fit the signature.
    """
    given = _lists_gathered(function, flags_set(function, renamed(args)))
    return auto_cli(function, args=given, as_positional=False, parser_class=Parser, prog=prog)


ALIASES = {"--schedule": "--strategy"}
"""Former names of options, which are accepted for one release."""


def renamed(args: list[str]) -> list[str]:
    """Returns the arguments with the present names of options in place of former ones.

    Example:
        >>> renamed(["--schedule=paper", "--seed", "1"])
        ['--strategy=paper', '--seed', '1']
    """
    pairs = [argument.partition("=") for argument in args]
    return [f"{ALIASES.get(option, option)}{joined}{value}" for option, joined, value in pairs]


def flags_set(function: Callable[..., Any], args: list[str]) -> list[str]:
    """Returns the arguments with `--flag` written as `--flag=true` where a bool's option stands without a value."""
    flags = {f"--{name}" for name, kind in get_type_hints(function).items() if kind is bool}
    following = [*args[1:], "--"]
    return [
        f"{argument}=true" if argument in flags and after.startswith("-") else argument
        for argument, after in zip(args, following, strict=False)
    ]


def _lists_gathered(function: Callable[..., Any], args: list[str]) -> list[str]:
    """Returns the arguments with `--names one two` written as `--names=["one", "two"]` where an option takes many."""
    several = {f"--{name}" for name, kind in get_type_hints(function).items() if get_origin(kind) in (list, tuple)}
    gathered: list[str] = []
    left = list(args)
    while left:
        option, joined, value = left.pop(0).partition("=")
        values = [value] if joined else []
        while option in several and left and not left[0].startswith("-"):
            values.append(left.pop(0))
        plain = option in several and values and not values[0].startswith("[")
        gathered += (
            [f"{option}={json.dumps(values)}"] if plain else [f"{option}{joined}{value}", *values[bool(joined) :]]
        )
    return gathered


def one_line(message: str) -> str:
    r"""Returns jsonargparse's message on one line, less what only a programmer reads.

    Example:
        >>> one_line('Parser key "scenes":\n  Expected a <class \'int\'>. Got value: many')
        "'scenes': expected int. Got value: many"
    """
    line = " ".join(message.split())
    line = re.sub(r"Does not validate against any of the Union subtypes Subtypes: .*? Errors: - ", "", line)
    line = re.sub(r" - Expected a <class 'NoneType'>", "", line)
    line = re.sub(r" Given value type: <class '[^']*'>", ".", line)
    line = re.sub(r"(Problem with given class_path .*?)\. Given value: .*", r"\1", line)
    line = re.sub(r"Expected a (?:<class '([\w.]+)'>|typing\.)", r"expected \1", line)
    return re.sub(r'^Parser key "([^"]+)"', r"'\1'", line)


def _near_misses(message: str, actions: Iterable[Any]) -> str:
    """Returns ` (did you mean ...?)` for a message about an unknown option, as near as `actions` come to it."""
    keys = [action.dest for action in actions if action.dest not in ("help", "print_shtab")]
    form = "'{}'"
    if "(did you mean" in message:
        return ""
    if found := re.match(r"unrecognized arguments: --([^\s=]+)", message):
        form, unknown = "--{}", found[1]
    elif found := re.match(r"Option '([^']+)' is not accepted", message):
        unknown = found[1]
    elif found := re.match(r"Subcommand '([^']+)' does not accept option '([^']+)'", message):
        unknown, keys = found[2], _keys_of_subcommand(found[1], actions)
    elif found := re.match(r"Group '([^']+)' does not accept option '([^']+)'", message):
        group, unknown = found[1], found[2]
        keys = [key.removeprefix(f"{group}.") for key in keys if key.startswith(f"{group}.")]
    else:
        return ""
    top = unknown.split(".")[0]
    near = get_close_matches(unknown, keys, n=2, cutoff=0.75) or get_close_matches(top, keys, n=2, cutoff=0.75)
    return f" (did you mean {' or '.join(map(form.format, near))}?)" if near else ""


def _keys_of_subcommand(name: str, actions: Iterable[Any]) -> list[str]:
    choices = [action.choices for action in actions if isinstance(action.choices, dict)]
    return [action.dest for parsers in choices if name in parsers for action in parsers[name]._actions]
