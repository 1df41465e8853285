"""Reports of the kept result files: their numbers stay as they are, to the last digit printed.

`kept/NAME.txt` holds one line for each row of a report's tables: the row's label, then each cell's numbers.
"""

import re
from pathlib import Path

import pytest

from nerfgrasp import cli

RESULTS = Path(__file__).parents[2] / "results"
KEPT = Path(__file__).parent / "kept"

TASKS = ("simple", "clutter", "novel")
TABLE = [f"{name}=table/{task}-{name.lower()}" for name in ("MV3", "MV1", "NO3", "NO1", "TN") for task in TASKS]
TABLE += [f"{name}#{seed}=table/simple-{name.lower()}-seed{seed}" for name in ("MV3", "MV1") for seed in (1, 2)]
REPORTS = {
    "table": TABLE,
    "models": ["simple-mv1", "simple-mv3", "clutter-mv3", "novel-mv3"],
    "bounds": ["simple-oracle", "simple-random", "clutter-oracle"],
    "tuning": [
        "MV1=tuning-alone-mv1",
        "MV3=tuning-alone-mv3",
        "NO3=tuning-simple-no3",
        "TN=tuning-simple-tn",
    ],
    "halving": ["halving-mv3"],
}
NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")


def numbers(report: str) -> list[str]:
    """Returns the rows of a report in Markdown: label and numbers, without titles, headers and notes."""
    lines = [line for line in report.splitlines() if line.startswith("|")]
    rules = {number for number, line in enumerate(lines) if line.startswith("|-")}
    rows = [line for number, line in enumerate(lines) if not {number, number + 1} & rules]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    return [" | ".join([label, *(" ".join(NUMBER.findall(cell)) for cell in rest)]).rstrip() for label, *rest in cells]


@pytest.mark.parametrize("name", REPORTS)
def test_kept_results_give_the_same_numbers(name: str, tmp_path: Path) -> None:
    files = []
    for given in REPORTS[name]:
        label, equals, file = given.rpartition("=")
        files.append(f"{label}{equals}{RESULTS / file}.jsonl.gz")
    out = tmp_path / "report.md"
    assert cli.main(["report", *files, "--paper", "true", "--format", "markdown", "--out", str(out)]) == 0
    assert numbers(out.read_text(encoding="utf-8")) == (KEPT / f"{name}.txt").read_text(encoding="utf-8").splitlines()
