from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.report import report_tables
from nerfgrasp.evaluation.results import Row, Times
from nerfgrasp.evaluation.runs import load_runs
from nerfgrasp.evaluation.tables import Table, format_tables
from nerfgrasp.sim.physics import physics_hash

Attempts = Callable[..., list[Row]]
Write = Callable[..., Path]
CLUTTER = {"task": "clutter", "set": "clutter-7", "objects": ("box", "l", "t", "u")}


def tables_of(paths: Sequence[Path]) -> dict[str, Table]:
    return {table.title: table for table in report_tables(load_runs(paths))}


def cells(table: Table, row: str) -> dict[str, str]:
    [found] = [cells for cells in table.rows if cells[0] == row]
    return dict(zip(table.header, found, strict=True))


def test_simple_has_wilsons_interval_and_mcnemars_p(attempts: Attempts, write: Write) -> None:
    won = [["success"]] * 8 + [["slipped"]] * 2
    lost = [["success"]] + [["no_grasp"]] * 8 + [["success"]]
    tables = tables_of([write("a.jsonl", attempts(*won)), write("b.jsonl", attempts(*lost, method="random"))])
    assert cells(tables["Success rates [95 % interval]"], "oracle")["simple success"] == "0.80 [0.49, 0.94]"
    pair = cells(tables["simple: paired differences"], "oracle - random")
    assert pair["scenes"] == "10"
    assert pair["success [95 % interval]"].startswith("+0.60 [+0.")
    # Seven scenes for the first alone, one for the second: 2 (1 + 8) / 2^8.
    assert (pair["only first"], pair["only second"], pair["McNemar's p"]) == ("7", "1", "0.070")


def test_clutter_counts_attempts_cleared_and_dropped(attempts: Attempts, write: Write) -> None:
    rows = attempts(["success", "slipped", "success"], ["success", "slipped", "slipped"], **CLUTTER)
    rows[1] = replace(rows[1], dropped=(1,))
    tables = tables_of([write("a.jsonl", rows)])
    row = cells(tables["Success rates [95 % interval]"], "oracle")
    assert row["clutter success"] == "0.50 [0.33, 0.67]"  # 3 of 6; all of the one scene or of the other
    assert row["clutter cleared"] == "0.38 [0.25, 0.50]"  # 3 of 8
    assert row["clutter dropped"] == "0.12 [0.00, 0.25]"  # 1 of 8
    assert "clutter: paired differences" not in tables


def test_clutters_differences_are_over_the_scenes_of_both(attempts: Attempts, write: Write) -> None:
    first = attempts(["success"] * 4, ["success"] * 4, ["slipped"] * 4, **CLUTTER)
    second = attempts(["success", "slipped"], ["success", "slipped"], method="random", **CLUTTER)
    table = tables_of([write("a.jsonl", first), write("b.jsonl", second)])["clutter: paired differences"]
    pair = cells(table, "oracle - random")
    assert pair["scenes"] == "2"
    # The same in both scenes: Newcombe's of 2 of 2 and 1 of 2, 0.5 - hypot(1 - 0.342, 0.905 - 0.5) to 0.5 + 0.405.
    assert pair["success [95 % interval]"] == "+0.50 [-0.27, +0.91]"
    assert pair["cleared [95 % interval]"].startswith("+0.75 [-0.")
    # Two scenes are exchanged in four ways, of which two are as far apart.
    assert (pair["success: p"], pair["cleared: p"], pair["dropped: p"]) == ("0.500", "0.500", "1.000")
    assert "McNemar's p" not in pair
    assert table.notes[1] == "p: paired permutation test over scenes, two-sided."


def test_novel_s_p_is_over_objects(attempts: Attempts, write: Write) -> None:
    names = [name for name in ("banana", "bowl", "mug") for _ in range(10)]
    paths = []
    for method, won in {"oracle": (8, 7, 3), "random": (5, 5, 4)}.items():
        rows = attempts(*(["success" if k < n else "slipped"] for n in won for k in range(10)), method=method)
        rows = [
            replace(row, objects=(name,), task="novel", set="novel-ycb-7")
            for row, name in zip(rows, names, strict=True)
        ]
        paths.append(write(f"{method}.jsonl", rows))
    pair = cells(tables_of(paths)["novel: paired differences"], "oracle - random")
    # Three and two more, one less: of the eight signs of 3, 2 and 1, four give a sum of 4 or more, or -4 or less.
    assert pair["success: p"] == "0.500"


def test_novel_is_resampled_by_object(attempts: Attempts, write: Write) -> None:
    novel = {"task": "novel", "set": "novel-ycb-7", "errors": None}
    rows = attempts(["success"], ["success"], ["success"], ["slipped"], **novel)
    names = ("banana", "banana", "mug", "mug")
    rows = [replace(row, objects=(name,)) for row, name in zip(rows, names, strict=True)]
    tables = tables_of([write("a.jsonl", rows)])
    # Two objects, of rates 1 and 1/2; four scenes would have reached lower.
    assert cells(tables["Success rates [95 % interval]"], "oracle")["novel success"] == "0.75 [0.50, 1.00]"
    objects = tables["novel: objects [95 % interval]"]
    assert cells(objects, "banana")["oracle"] == "1.00 [0.34, 1.00]"
    assert cells(objects, "mug")["oracle"] == "0.50 [0.09, 0.91]"
    assert "novel: pose errors" not in tables
    assert any("too narrow for as few as 2" in note for note in tables["Success rates [95 % interval]"].notes)


def test_a_rate_without_any_variation_is_not_certain(attempts: Attempts, write: Write) -> None:
    rows = [attempts(*[["slipped"] * 10] * 8, method=method, **CLUTTER) for method in ("random", "none")]
    tables = tables_of([write(f"{mine[0].method}.jsonl", mine) for mine in rows])
    # Of 8 scenes, not of 80 attempts: z² / (8 + z²).
    assert cells(tables["Success rates [95 % interval]"], "random")["clutter success"] == "0.00 [0.00, 0.32]"
    pair = cells(tables["clutter: paired differences"], "random - none")
    assert pair["success [95 % interval]"] == "+0.00 [-0.32, +0.32]"


def test_methods_that_agree_everywhere_are_not_known_to_be_equal(attempts: Attempts, write: Write) -> None:
    outcomes = [["success"]] * 17 + [["slipped"]] * 3
    tables = tables_of([write(f"{name}.jsonl", attempts(*outcomes, method=name)) for name in ("oracle", "random")])
    pair = cells(tables["simple: paired differences"], "oracle - random")
    assert pair["success [95 % interval]"] == "+0.00 [-0.23, +0.23]"


def test_one_cluster_has_no_interval(attempts: Attempts, write: Write) -> None:
    tables = tables_of([write("a.jsonl", attempts(["success", "slipped"], **CLUTTER))])
    assert cells(tables["Success rates [95 % interval]"], "oracle")["clutter success"] == "0.50 [unknown]"


def test_outcomes_errors_and_times(attempts: Attempts, write: Write) -> None:
    rows = attempts(["success"], ["slipped"], ["slipped"], ["no_grasp"], ["success"])
    errors = [(1.0, 10.0), (2.0, 20.0), (3.0, 30.0), None, (6.0, 60.0)]
    rows = [
        replace(row, errors=None if error is None else {"distance_mm": error[0], "angle_deg": error[1]})
        for row, error in zip(rows, errors, strict=True)
    ]
    times = [Times(scene, 0, 0.25, propose, 0.5) for scene, propose in enumerate([1.0, 9.0, 2.0])]
    tables = tables_of([write("a.jsonl", rows, times)])
    assert tables["simple: outcomes"].rows == (
        ("success", "2"),
        ("slipped", "2"),
        ("no_grasp", "1"),
        ("attempts", "5"),
    )
    assert tables["simple: pose errors"].rows == (("oracle", "4", "2.5 (1.8, 3.8)", "25.0 (17.5, 37.5)"),)
    assert tables["simple: time"].rows == (("oracle", "0.250", "2.000", "0.500"),)


def test_repeated_trainings_are_compared_apart(attempts: Attempts, write: Write) -> None:
    outcomes = {"MV3": "ss--", "MV3#1": "sss-", "MV3#2": "s---", "random": "----"}
    paths = {}
    for number, (name, letters) in enumerate(outcomes.items()):
        rows = attempts(*(["success" if letter == "s" else "slipped"] for letter in letters))
        paths[write(f"{number}.jsonl", [replace(row, method="psi", model=f"{number}" * 16) for row in rows])] = name
    tables = {table.title: table for table in report_tables(load_runs(list(paths), paths))}
    overview = tables["Success rates [95 % interval]"]
    assert [row[0] for row in overview.rows] == ["MV3", "random"]
    assert f"MV3: method psi, model {'0' * 16}." in overview.notes
    assert tables["Training seeds"].rows == (("MV3", "3", "0.50 (0.25 to 0.75)"),)
    assert [row[0] for row in tables["simple: paired differences"].rows] == ["MV3 - random"]


def test_the_paper_s_figures_stand_beside(attempts: Attempts, write: Write) -> None:
    runs = load_runs([write("a.jsonl", attempts(["success"])), write("b.jsonl", attempts(["success"] * 3, **CLUTTER))])
    tables = report_tables(runs, paper=True)
    assert [table.title for table in tables][:2] == ["Success rates [95 % interval]", "The paper's table I"]
    assert tables[1].header == tables[0].header
    assert tables[1].rows[4] == ("MV3", "0.84", "0.57", "0.80", "0.20")


def test_a_method_without_a_task_leaves_its_cells_empty(attempts: Attempts, write: Write) -> None:
    clutter = attempts(["success"] * 2, ["slipped"] * 2, method="psi", **CLUTTER)
    table = tables_of([write("a.jsonl", attempts(["success"])), write("b.jsonl", clutter)])[
        "Success rates [95 % interval]"
    ]
    assert [row[0] for row in table.rows] == ["oracle", "psi"]
    assert table.rows[0][2:] == ("", "", "")
    assert table.rows[1][1] == ""


def test_physics_of_another_program_is_told(attempts: Attempts, write: Write) -> None:
    def last_note(physics: str) -> str:
        path = write("a.jsonl", attempts(["success"], physics=physics))
        return tables_of([path])["Success rates [95 % interval]"].notes[-1]

    assert "not this program's" in last_note("0123456789abcdef")
    assert "not this program's" not in last_note(physics_hash())


def test_an_unknown_task_is_refused(attempts: Attempts, write: Write) -> None:
    path = write("a.jsonl", attempts(["success"], task="cluter", set="cluter-7"))
    with pytest.raises(UserError, match="task .*a.jsonl.* 'cluter': did you mean 'clutter'?"):
        tables_of([path])


def test_markdown_columns_are_aligned() -> None:
    table = Table("Fruit", ("kind", "eaten"), (("apple", "12"), ("fig", "7")), ("A note.",))
    assert format_tables([table], "markdown").splitlines() == [
        "### Fruit",
        "",
        "| kind  | eaten |",
        "|-------|------:|",
        "| apple |    12 |",
        "| fig   |     7 |",
        "",
        "A note.",
    ]
