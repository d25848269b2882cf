"""Figures of the benchmarks for machines, beside what they print, and their tables in Markdown.

A benchmark calls `record` where it prints a row. `all.py` names a file in ``RESEAU_FIGURES``, to which each
figure is appended as a line of JSON; without it nothing is kept. `benchmarks/figures.json` has those of the
last `make bench`, and docs/benchmarks/peers.md and its pictures show them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

__all__ = ["BOUND", "ORIGIN", "RECORDED", "Figure", "markdown", "read", "record", "recorded"]

RECORDED = Path(__file__).with_name("figures.json")
BOUND, ORIGIN = "beside the bound", "independent origin"
"""Tables to which several benchmarks contribute; others are those of one benchmark."""


@dataclass(frozen=True)
class Figure:
    """A cell of a table.

    Parameters
    ----------
    table : str
        Title of the table.
    row, column : str
        What was measured; by whom, or which quantity of it.
    value : float or None
        The median where there are several values; None if there is no result.
    low, high : float or None
        The least and the greatest of several values.
    count : int
        How many values.
    of : int or None
        The number of which `value` is a part.
    unit : str
        Of `value`, `low` and `high`.
    """

    table: str
    row: str
    column: str
    value: float | None
    low: float | None = None
    high: float | None = None
    count: int = 1
    of: int | None = None
    unit: str = ""

    def __str__(self) -> str:
        """The cell: the median, in brackets the least and the greatest value."""
        if self.value is None:
            return "–"
        text = _number(self.value) if self.of is None else f"{_number(self.value)} of {_number(self.of)}"
        text += f" {self.unit}" if self.unit else ""
        if self.low is None or self.high is None:
            return text
        return f"{text} ({_number(self.low)} to {_number(self.high)})"


def _number(value: float) -> str:
    """With three digits, counts and what is large with all before the point."""
    if float(value).is_integer() and abs(value) < 1e9:
        return f"{value:.0f}"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def record(
    row: str,
    column: str,
    value: float | Sequence[float] | np.ndarray,
    unit: str = "",
    *,
    of: int | None = None,
    table: str = "",
) -> None:
    """Keep a figure; of several values the median, the least and the greatest.

    Values that are not finite are left out.

    Examples
    --------
    >>> record("ladybug-49", "reseau", [0.47, 0.46, 0.51], "s")
    """
    path = os.environ.get("RESEAU_FIGURES")
    if not path:
        return
    values = np.atleast_1d(np.asarray(value, dtype=np.float64))
    values = values[np.isfinite(values)]
    several = len(values) > 1
    found = Figure(
        table, row, column,
        value=_short(np.median(values)) if len(values) else None,
        low=_short(values.min()) if several else None,
        high=_short(values.max()) if several else None,
        count=len(values), of=of, unit=unit,
    )  # fmt: skip
    with Path(path).open("a") as stream:
        stream.write(json.dumps(asdict(found), ensure_ascii=False) + "\n")


def _short(value: float) -> float:
    """With seven digits: more is noise."""
    return float(f"{value:.7g}")


def read(path: Path) -> list[Figure]:
    """The figures that a benchmark has left in a file; of those of one cell the last."""
    lines = path.read_text().splitlines() if path.exists() else []
    found = [Figure(**json.loads(line)) for line in lines]
    return list({(each.table, each.row, each.column): each for each in found}.values())


def recorded(table: str, path: Path = RECORDED) -> list[Figure]:
    """The figures of a table of several benchmarks, from the last `make bench`."""
    entries = json.loads(path.read_text()) if path.exists() else {}
    found = (Figure(**each) for entry in entries.values() for each in entry["figures"])
    return [each for each in found if each.table == table]


def markdown(figures: Iterable[Figure], first: str = "") -> str:
    """A table of figures: rows and columns in the order in which they were recorded."""
    cells = {(each.row, each.column): str(each) for each in figures}
    rows, columns = (list(dict.fromkeys(key[k] for key in cells)) for k in (0, 1))
    lines = [f"| {' | '.join([first, *columns])} |", f"|{'---|' * (1 + len(columns))}"]
    for row in rows:
        lines.append(f"| {' | '.join([row, *(cells.get((row, column), '–') for column in columns)])} |")
    return "\n".join(lines) + "\n"
