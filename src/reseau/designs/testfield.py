"""The coded testfield of Vosselman and Förstner: squares of sixteen targets, bounded by straight lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from ..core.errors import UsageError
from ..io import SHAPES, FieldLines, FieldTargets, TestfieldDesign
from .topology import words

_SMALL = (9.0, 13.0, 15.0, 12.0)
_LARGE = (17.0, 25.0, 25.0, 22.0)
"""Sizes of squares, triangles, crosses and circles. The areas of the first two are slightly smaller than
those of the others (the paper's table 3); areas of the small ones are one third of those of the large
ones."""
_PITCH, _LINE, _SPREAD = 125.0, 2.0, 30.0
"""Distance and width of the lines, and distance of the targets, for these sizes."""


def coded_testfield(
    columns: int = 8,
    rows: int = 8,
    pitch: float = 125.0,
    *,
    line_width: float | None = None,
    small: Sequence[float] | None = None,
    large: Sequence[float] | None = None,
    spread: float | None = None,
    turn_seed: int | None = None,
    polarity: Literal["dark", "bright"] = "dark",
    name: str = "testfield",
) -> TestfieldDesign:
    """Design a testfield with targets coded by topology; by default as in the paper (tables 1, 2).

    Parameters
    ----------
    columns, rows : int
        Number of squares; at most 168 in total, the number of words of the code.
    pitch : float
        Distance of the lines, mm.
    line_width : float, optional
        Width of the straight lines, mm; by default in proportion to `pitch`, 2 mm at 125 mm.
    small, large : sequence of 4 float, optional
        Sizes of squares, triangles, crosses and circles, mm; by default in proportion to `pitch`.
    spread : float, optional
        Distance of neighbouring targets in a square, mm; by default 0.24 of `pitch`.
    turn_seed : int, optional
        Rotates every target by an angle drawn with this seed; by default all are upright.
    polarity : {"dark", "bright"}
        Dark targets on a bright background, or bright on dark.

    Returns
    -------
    TestfieldDesign
        Millimetres, the origin in the centre. Squares are numbered in rows from the upper left, and so are
        the targets of a square: ``23.01`` to ``23.16``.

    Raises
    ------
    UsageError
        When a number is not possible, or targets would touch each other or the lines.

    Examples
    --------
    >>> field = coded_testfield()
    >>> len(field.ids), field.ids[0], field.lines.extent, field.targets.shape[0]
    (1024, '1.01', (-501.0, -501.0, 501.0, 501.0), 'cross')
    """
    where, scale = f"design {name}", pitch / _PITCH
    small, large = (
        np.round(np.array(sizes) * scale, 6).tolist() if given is None else given
        for given, sizes in ((small, _SMALL), (large, _LARGE))
    )
    line_width = round(_LINE * scale, 6) if line_width is None else line_width
    spread = round(_SPREAD * scale, 6) if spread is None else spread
    if min(columns, rows) < 1 or not min(pitch, line_width, spread, *small, *large) > 0:
        raise UsageError(f"cannot have {columns} × {rows} squares at {pitch} mm", where=where)
    if len(small) != 4 or len(large) != 4 or not (np.array(large) > np.array(small)).all():
        raise UsageError("needs a size for each of four shapes, the large ones above the small", where=where)
    _check_room(pitch, line_width, large, spread, where)
    symbol = words(columns * rows)
    x, y = (np.round((np.arange(n + 1) - n / 2) * pitch, 6) for n in (columns, rows))
    in_square = np.stack(np.meshgrid(np.arange(4) - 1.5, 1.5 - np.arange(4)), axis=-1).reshape(16, 2) * spread
    middle = np.stack(np.meshgrid(x[:-1] + pitch / 2, y[::-1][1:] + pitch / 2), axis=-1).reshape(-1, 1, 2)
    xy = np.round(middle + in_square, 6).reshape(-1, 2)
    shape, is_large = symbol.ravel() >> 1, symbol.ravel() & 1
    size = np.where(is_large, np.array(large)[shape], np.array(small)[shape])
    angle = np.zeros(len(size))
    if turn_seed is not None:
        angle = np.round(np.random.default_rng(turn_seed).uniform(0, 360, len(size)), 3)
    half = line_width / 2
    extent = (float(x[0] - half), float(y[0] - half), float(x[-1] + half), float(y[-1] + half))
    lines = FieldLines(
        width=line_width, vertical_x=tuple(x.tolist()), horizontal_y=tuple(y.tolist()), extent=extent
    )
    targets = FieldTargets(
        id=tuple(f"{s + 1}.{k + 1:02d}" for s in range(columns * rows) for k in range(16)),
        square=tuple(np.repeat(np.arange(columns * rows) + 1, 16).tolist()),
        shape=tuple(SHAPES[k] for k in shape),
        x=tuple(xy[:, 0].tolist()),
        y=tuple(xy[:, 1].tolist()),
        size=tuple(size.tolist()),
        angle=tuple(angle.tolist()),
    )
    return TestfieldDesign(
        name=name,
        unit="mm",
        squares=(columns, rows),
        pitch=pitch,
        lines=lines,
        targets=targets,
        polarity=polarity,
    )


def _check_room(pitch: float, line_width: float, large: Sequence[float], spread: float, where: str) -> None:
    """Refuse targets that would touch at any rotation."""
    # Radii of their circumscribed circles; the arms of a cross are one third of its length wide.
    around = np.array([1 / np.sqrt(2), 1 / np.sqrt(3), np.hypot(1, 1 / 3) / 2, 0.5]) * np.array(large)
    widest = float(around.max())
    if 2 * widest >= spread:
        raise UsageError(f"targets of {2 * widest:.4g} mm across do not fit {spread:g} mm", where=where)
    if 1.5 * spread + widest + line_width / 2 >= pitch / 2:
        raise UsageError(f"targets {spread:g} mm apart do not fit squares of {pitch:g} mm", where=where)
