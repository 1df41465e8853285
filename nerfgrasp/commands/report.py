"""`nerfgrasp report`: the paper's table out of results files."""

from pathlib import Path

from nerfgrasp.commands.parsing import Parser
from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.report import report_tables
from nerfgrasp.evaluation.runs import load_runs
from nerfgrasp.evaluation.tables import Format, format_tables
from nerfgrasp.files import replacing


def main(args: list[str]) -> None:
    """Runs the command on its arguments.

    Raises:
        UserError: the arguments are wrong, or `report` refuses the files.
    """
    parser = Parser(prog="nerfgrasp report", description="Prints success rates, differences and errors of results.")
    parser.add_argument("--config", action="config", help="a file of these options")
    what = "what `nerfgrasp evaluate --out` wrote, one file a run; NAME=FILE names it, NAME#2=FILE is another training"
    parser.add_argument("files", nargs="+", type=str, help=what)
    parser.add_argument("--paper", type=bool, default=False, help="whether the paper's own figures stand beside")
    parser.add_argument("--format", type=Format, default="text", help="how tables are drawn")
    parser.add_argument("--out", type=Path | None, default=None, help="a file for the report, instead of printing it")
    chosen = parser.parse_args(args)
    report(chosen.files, paper=chosen.paper, format=chosen.format, out=chosen.out)


def report(files: list[str], *, paper: bool = False, format: Format = "text", out: Path | None = None) -> None:
    """Prints the paper's table with 95 % intervals, then each task's differences, outcomes, errors and times.

    Files are compared only where they tell of one physics and of the same scenes.

    Args:
        files: what `nerfgrasp evaluate --out` wrote, one file a method and task; wall times are read from beside.
            `MV3=FILE` names a run in the tables, `MV3#1=FILE` is of another training of it.
        paper: whether the paper's own figures follow the table.
        format: `text`, or `markdown` for a document.
        out: a file for the report instead of printing it.

    Raises:
        UserError: a file is damaged, two files do not compare, or `out` cannot be written.
    """
    given = [_named(file) for file in files]
    paths = [path for path, _ in given]
    if out is not None and out.resolve() in {path.resolve() for path in paths}:
        raise UserError(f"{out} is one of the results files: it would be overwritten")
    names = {path: name for path, name in given if name}
    text = format_tables(report_tables(load_runs(paths, names), paper=paper), format)
    if out is None:
        print(text, end="")
        return
    with replacing(out) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _named(argument: str) -> tuple[Path, str]:
    """Returns the path and the name, if there is one, of a results file as it is given."""
    name, separator, path = argument.partition("=")
    if not separator or "/" in name or Path(argument).exists():
        return Path(argument), ""
    return Path(path), name
