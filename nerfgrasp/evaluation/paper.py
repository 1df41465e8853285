"""The paper's own figures, to stand beside those that are measured."""

from collections.abc import Sequence

from nerfgrasp.evaluation.measures import TASKS
from nerfgrasp.evaluation.tables import Table

TABLE_I = {
    "TN": {"simple": (0.84,), "clutter": (0.58, 4.2, 0.2), "novel": (0.35,)},
    "NO1": {"simple": (0.40,), "clutter": (0.24, 2.4, 1.2), "novel": (0.07,)},
    "NO3": {"simple": (0.40,), "clutter": (0.12, 1.2, 1.2), "novel": (0.11,)},
    "MV1": {"simple": (0.88,), "clutter": (0.58, 4.4, 0.4), "novel": (0.44,)},
    "MV3": {"simple": (0.84,), "clutter": (0.57, 4.0, 1.0), "novel": (0.50,)},
}
"""Success rates, and of clutter also the objects cleared and dropped out of five; in the order of `TASKS`' measures."""
OBJECTS = 5
"""In a scene of clutter."""


def paper_table(tasks: Sequence[str]) -> Table:
    """Returns the paper's Table I, those columns that belong to `tasks`, counts as shares as in the other tables.

    Source: Sóti, Huang, Wurll and Hein, "6-DoF Grasp Pose Evaluation and Optimization via Transfer Learning from
    NeRFs", Table I.
    """
    columns = [(task, number, measure.name) for task in tasks for number, measure in enumerate(TASKS[task].measures)]
    rows = []
    for method, figures in TABLE_I.items():
        shares = (figures[task][number] / (OBJECTS if number else 1) for task, number, _ in columns)
        rows.append((method, *(f"{share:.2f}" for share in shares)))
    header = ("method", *(f"{task} {name}" for task, _, name in columns))
    note = f"In its own simulation; cleared and dropped are given there as objects out of {OBJECTS}."
    return Table("The paper's table I", header, tuple(rows), (note,))
