"""What results show of themselves: a short text, a table for notebooks, columns as a data frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Self

from .errors import UsageError

Facts = Sequence[tuple[str, str]]
Columns = Mapping[str, Sequence[Any]]


class Display:
    """Short texts for a result. Subclasses give facts and, where they have rows, columns.

    A dataclass that inherits from it is declared with ``repr=False``, or its own text would win.

    Examples
    --------
    >>> class Found(Display):
    ...     def _facts(self):
    ...         return [("points", "12 of 14"), ("sigma", "0.006 px")]
    >>> Found()
    <Found: points 12 of 14, sigma 0.006 px>
    """

    def _facts(self) -> Facts:
        """Names and values, with units, of what a user wants to see first."""
        raise NotImplementedError

    def _columns(self) -> Columns:
        """Columns of equal length by their names, with the unit in the name."""
        raise UsageError("has no table", where=type(self).__name__)

    def required(self) -> Self:
        """Return the result itself; a :class:`~reseau.core.failure.Failure` raises instead."""
        return self

    def __repr__(self) -> str:
        facts = ", ".join(f"{name} {value}".strip() for name, value in self._facts())
        return f"<{type(self).__name__}: {facts}>"

    def _repr_html_(self) -> str:
        return html_table(type(self).__name__, self._facts())

    def to_dataframe(self) -> Any:
        """Return the rows of the result as a pandas data frame.

        Raises
        ------
        UsageError
            When the result has no rows, or pandas is not installed.
        """
        return data_frame(self._columns())


def html_table(caption: str, facts: Facts) -> str:
    """Names and values as a table of HTML.

    Examples
    --------
    >>> html_table("Points", [("sigma", "0.006 px")])
    '<table><caption>Points</caption><tr><th style="text-align:left">sigma</th><td>0.006 px</td></tr></table>'
    """
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td>{escape(value)}</td></tr>'
        for name, value in facts
    )
    return f"<table><caption>{escape(caption)}</caption>{rows}</table>"


_SHOWN = 20
"""Rows of a table that a notebook shows."""


@dataclass(frozen=True, eq=False, repr=False)
class Table(Display):
    """Columns of equal length, by their names.

    Parameters
    ----------
    name : str
        What the rows are.
    columns : mapping of str to sequence
        The columns, with the unit in the name.

    Examples
    --------
    >>> found = Table("images", {"image": ["a.jpg", "b.jpg"], "rms_px": [0.041, 0.052]})
    >>> found
    <Table: 2 images, columns image, rms_px>
    >>> found["rms_px"]
    [0.041, 0.052]
    """

    name: str
    columns: Mapping[str, Sequence[Any]]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __getitem__(self, column: str) -> Sequence[Any]:
        return self.columns[column]

    def _facts(self) -> Facts:
        return [(f"{len(self)} {self.name}", ""), ("columns", ", ".join(self.columns))]

    def _columns(self) -> Columns:
        return self.columns

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{escape(name)}</th>" for name in self.columns)
        rows = "".join(
            f"<tr>{''.join(f'<td>{escape(_cell(value))}</td>' for value in row)}</tr>"
            for row in list(zip(*self.columns.values(), strict=True))[:_SHOWN]
        )
        more = len(self) - _SHOWN
        rest = f"<tr><td colspan={len(self.columns)}>… {more} more</td></tr>" if more > 0 else ""
        return f"<table><caption>{len(self)} {escape(self.name)}</caption><tr>{head}</tr>{rows}{rest}</table>"


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def data_frame(columns: Columns) -> Any:
    """Return columns as a pandas data frame.

    Raises
    ------
    UsageError
        When pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise UsageError("needs pandas", where="to_dataframe", do="run `pip install pandas`") from None
    return pd.DataFrame({name: list(column) for name, column in columns.items()})
