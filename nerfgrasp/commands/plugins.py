"""`nerfgrasp plugins list [--check]`: what is installed, read from metadata; with `--check`, whether it works."""

import sys

from nerfgrasp import registry
from nerfgrasp.commands.arguments import Arguments
from nerfgrasp.errors import UserError
from nerfgrasp.registry import Entry


def main(args: list[str]) -> int:
    """Runs the command on its arguments and returns its exit status: 2 if a check failed."""
    parser = Arguments(prog="nerfgrasp plugins", description="List and check what is installed.", allow_abbrev=False)
    commands = parser.add_subparsers(metavar="COMMAND", required=True, dest="command")
    listing = commands.add_parser("list", help="list every plug-in", description="List every plug-in.")
    listing.add_argument("--check", action="store_true", help="import each and run its conformance checks")
    return list_plugins(check=parser.parse_args(args).check)


def list_plugins(*, check: bool = False) -> int:
    """Prints a table of all plug-ins; returns 0, or 2 if one of them fails its check.

    Args:
        check: import each plug-in and run its group's conformance checks. A failure is reported on stderr, and the
            others are checked all the same.
    """
    found = [entry for group in registry.GROUPS for entry in registry.entries(group)]
    failures = {entry: _failure(entry) for entry in found} if check else {}
    header = ["group", "name", "distribution", "version", "object"]
    rows = [[entry.group, entry.name, entry.distribution, entry.version, entry.value] for entry in found]
    if check:
        header.append("check")
        rows = [[*row, "failed" if failures[entry] else "ok"] for row, entry in zip(rows, found, strict=True)]
    print(_table([header, *rows]))
    broken = list(dict.fromkeys(line for line in failures.values() if line))
    for line in broken:
        print(f"nerfgrasp: error: {line}", file=sys.stderr)
    return 2 if broken else 0


def _failure(entry: Entry) -> str | None:
    """Returns what is wrong with a plug-in, in one line, or None."""
    from nerfgrasp.testing import CHECKS

    try:
        plugin = registry.load(entry.group, entry.name)
    except UserError as error:
        return str(error)
    try:
        CHECKS[entry.group](plugin)
    except Exception as error:  # a stranger's code may raise anything
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        return f"{registry.GROUPS[entry.group]} {entry.name!r} ({entry}) fails its check: {cause}"
    return None


def _table(rows: list[list[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(lines)
