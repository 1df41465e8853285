"""The command `nerfgrasp`: looks at its first argument and imports that one subcommand, nothing else.

Mistakes of the user end in one line on stderr and exit status 2, a search that finds nothing as good as asked for with
status 1; `--debug` anywhere brings the traceback.
"""

import sys
from collections.abc import Callable, Iterator
from errno import EACCES, EDQUOT, EEXIST, EISDIR, ENOSPC, ENOTDIR, EPERM, EROFS
from importlib import import_module

from nerfgrasp import __version__
from nerfgrasp.errors import UserError, unknown_name

COMMANDS = {
    "optimize": "find grasps in a scene: gradient ascent on the grasp value",
    "render": "show a scene as a model renders it, from its views or on an orbit",
    "slices": "show grasp values beside the truth in slices through a valid grasp",
    "generate": "draw simulated scenes and pack them as a training set",
    "fit": "train a backbone or a grasp value from a config",
    "validate": "run a config's validation on a checkpoint",
    "test": "run a config's test on a checkpoint",
    "evaluate": "try a method in the scenes of a task",
    "replay": "show failed attempts of results: what was seen, imagined and done",
    "report": "print success rates, differences and errors of results",
    "table": "make the paper's table: data, trainings, evaluation, report",
    "objects": "import object models for the task of novel objects",
    "plugins": "list and check what is installed",
}
"""Every subcommand with its line of help."""

GROUPS = ("objects", "plugins")
"""Those with subcommands of their own, which parse their arguments themselves."""

LIGHTNING = ("fit", "validate", "test")
"""The subcommands that one LightningCLI serves."""

STORAGE = {ENOSPC, EDQUOT, EROFS}
"""A full or read-only disk: the user's to mend however deep it was met."""

REFUSED = {EACCES, EPERM, EEXIST, EISDIR, ENOTDIR}
"""A path that cannot be what the user wanted it to be."""


def main(argv: list[str] | None = None) -> int:
    """Runs the command and returns its exit status.

    Args:
        argv: the arguments after the command's name; those of the process by default.
    """
    args = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in args
    try:
        return _run([arg for arg in args if arg != "--debug"])
    except KeyboardInterrupt:
        if debug:
            raise
        return 130
    except Exception as error:
        line = _user_mistake(error)
        if debug or line is None:
            raise
        print(f"nerfgrasp: error: {line}", file=sys.stderr)
        return error.status if isinstance(error, UserError) else UserError.status


def _run(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help", "help"):
        print(_help())
        return 0
    name, rest = args[0], args[1:]
    if name == "--version":
        print(f"nerfgrasp {__version__}")
        return 0
    if name not in COMMANDS:
        raise unknown_name("command", name, COMMANDS)
    status = _command(name)(rest)
    return status if isinstance(status, int) else 0


def _command(name: str) -> Callable[[list[str]], object]:
    """Imports a subcommand and returns what runs it on its arguments.

    Its `main`, if the module has one; else the function of the command's name, whose signature says what to parse.
    """
    if name in LIGHTNING:
        fit = import_module("nerfgrasp.commands.fit")
        return lambda args: fit.main(name, args)
    module = import_module(f"nerfgrasp.commands.{name}")
    if hasattr(module, "main"):
        return module.main
    parsing = import_module("nerfgrasp.commands.parsing")
    return lambda args: parsing.call(getattr(module, name), args, prog=f"nerfgrasp {name}")


def _help() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {line}" for name, line in COMMANDS.items())
    return f"""usage: nerfgrasp COMMAND [options]

6-DoF grasp poses from RGB images.

commands:
{rows}

`nerfgrasp COMMAND --help` lists a command's options. Every command but `objects` and `plugins` takes
`--config FILE` and `--print_config`.

options:
  -h, --help  show this help and exit
  --version   show the version and exit
  --debug     with any command: show the traceback of an error"""


def _user_mistake(error: Exception) -> str | None:
    """Returns the line that tells the user of `error`, or None where the program is at fault."""
    if isinstance(error, UserError):
        return " ".join(str(error).split())
    if isinstance(error, ModuleNotFoundError) and (error.name or "nerfgrasp").split(".")[0] != "nerfgrasp":
        return f"this needs the package {error.name!r}, which is not installed for this Python"
    for cause in _causes(error):
        if isinstance(cause, OSError) and cause.errno in (STORAGE | REFUSED if cause is error else STORAGE):
            where = f": {cause.filename}" if cause.filename else ""
            return f"{cause.strerror}{where}"
    return None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
