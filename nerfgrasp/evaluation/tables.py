"""Tables of text, aligned for a terminal or as Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Format = Literal["text", "markdown"]


@dataclass(frozen=True)
class Table:
    """A titled table with the notes that belong under it."""

    title: str
    """The heading."""
    header: tuple[str, ...]
    """The columns' names, as many as each row has cells."""
    rows: tuple[tuple[str, ...], ...]
    """The cells; an empty one says that there is nothing."""
    notes: tuple[str, ...] = ()
    """Lines under the table."""


def format_tables(tables: Sequence[Table], form: Format = "text") -> str:
    """Returns tables one under another, with a line's end at the end.

    Example:
        >>> print(format_tables([Table("Fruit", ("kind", "eaten"), (("apple", "12"), ("fig", "7")))]), end="")
        Fruit
          kind   eaten
          apple     12
          fig        7
    """
    draw = _markdown if form == "markdown" else _text
    return "\n".join("".join(f"{line}\n" for line in draw(table)) for table in tables)


def _text(table: Table) -> list[str]:
    lines = [f"  {'  '.join(cells)}".rstrip() for cells in _aligned(table)]
    return [table.title, *lines, *(f"  {note}" for note in table.notes)]


def _markdown(table: Table) -> list[str]:
    header, *rows = (f"| {' | '.join(cells)} |" for cells in _aligned(table))
    rule = "".join(f"|{'-' * (width + 1)}{':' if column else '-'}" for column, width in enumerate(_widths(table)))
    notes = [line for note in table.notes for line in ("", note)]
    return [f"### {table.title}", "", header, f"{rule}|", *rows, *notes]


def _aligned(table: Table) -> list[list[str]]:
    """Returns header and rows with the first column to the left, the others to the right."""
    first, *widths = _widths(table)
    return [
        [row[0].ljust(first), *(cell.rjust(width) for cell, width in zip(row[1:], widths, strict=True))]
        for row in (table.header, *table.rows)
    ]


def _widths(table: Table) -> list[int]:
    return [max(map(len, column)) for column in zip(table.header, *table.rows, strict=True)]
