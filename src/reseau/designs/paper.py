"""Targets on paper: a page as large as the target, one sheet of a usual size, or several to be joined."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..core.data import Array
from ..core.errors import UsageError

PAPERS: dict[str, tuple[float, float]] = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "Letter": (215.9, 279.4),
    "Tabloid": (279.4, 431.8),
}
"""Width and height in mm, upright."""

_MARGIN = 18.0
"""Around a target on a page of its own, mm, for crop marks, bar and title."""
_BAR, _CROP = 100.0, 5.0
_EDGE = 7.0
"""Edge of a sheet on which printers may not print, mm."""
_TITLE, _FOOT = 5.0, 20.0
"""Heights of the title, and of the bar with its notes, mm."""
_FLAP = 10.0
"""Part of a sheet that lies under its neighbour, mm."""
_MOST_SHEETS = 400
_CHECK = "100 mm: measure it. Print at 100 %, no scaling."
HOW = (
    "Fix it to something flat and stiff. Keep focus and zoom. Take 10 to 20 sharp photographs: straight, and",
    "tilted by 30–45° to the left, right, up and down, the camera also turned by 90°; reach all corners.",
)
_JOIN = (
    "Cut the left and upper edges at the marks; lay them on the lines of the sheets to the left and above.",
    "Joints need not be exact: reseau calibrate determines where the points are. Photographs: see sheet 1.",
)


@dataclass(frozen=True)
class Content:
    """The drawn parts of a target in its own plane: millimetres, y up.

    Parameters
    ----------
    low, high : ndarray (2,)
        Lower left and upper right corner of the target.
    polygons : list of ndarray (k, 2)
        Polygons filled with the colour of the marks.
    circles : list of (x, y, radius)
        Circles filled likewise.
    title : str
        Description in one line.
    letters : dict
        Labels and the positions of their lower left corners.
    how : (str, str)
        What to do with the sheet, in two lines.
    between : (ndarray (m,), ndarray (n,))
        Coordinates x and y at which the target is best divided, ascending: as far as possible from marks.
    """

    low: Array
    high: Array
    polygons: list[Array]
    circles: list[tuple[float, float, float]]
    title: str
    letters: dict[str, Array]
    how: tuple[str, str] = HOW
    between: tuple[Array, Array] = (np.zeros(0), np.zeros(0))

    @property
    def size(self) -> Array:
        """Width and height."""
        return self.high - self.low


@dataclass(frozen=True)
class Page:
    """A drawing in millimetres, y down, from the upper left corner of the paper.

    Parameters
    ----------
    width, height : float
        Size of the paper.
    target : (float, float, float, float)
        Left, top, right and bottom of the target; what is outside is not drawn.
    polygons : list of ndarray (k, 2)
        Polygons filled with the colour of the marks.
    circles : list of (x, y, radius)
        Circles filled likewise.
    lines : list of (x0, y0, x1, y1)
        Hairlines outside the target.
    texts : list of (x, y, anchor, text)
        Labels, 2.6 mm high.
    """

    width: float
    height: float
    target: tuple[float, float, float, float]
    polygons: list[Array]
    circles: list[tuple[float, float, float]]
    lines: list[tuple[float, float, float, float]]
    texts: list[tuple[float, float, str, str]]


def page_of(content: Content) -> Page:
    """Lay out a target on a page as large as it needs.

    Examples
    --------
    >>> square = Content(np.zeros(2), np.full(2, 30.0), [], [(15.0, 15.0, 5.0)], "a disk", {})
    >>> page = page_of(square)
    >>> page.width, page.height, page.circles
    (136.0, 74.0, [(68.0, 33.0, 5.0)])
    """
    size = content.size
    # A narrow target has a page that is wide enough for the bar.
    width = max(float(size[0]), _BAR) + 2 * _MARGIN
    left = (width - float(size[0])) / 2
    target = (left, _MARGIN, width - left, float(_MARGIN + size[1]))
    bar = (width - _BAR) / 2, target[3] + 10.0
    texts = [
        (target[0], target[1] - 7.5, "start", content.title),
        (width / 2, bar[1] + 5.2, "middle", _CHECK),
    ]
    drawn = _drawn(content, target, content.low[0], content.high[1])
    return replace(
        drawn, width=width, height=float(size[1]) + 2 * _MARGIN + 8,
        lines=[*_crop_marks(target), *_bar(*bar)], texts=[*texts, *drawn.texts],
    )  # fmt: skip


def room_on(paper: str) -> tuple[float, float]:
    """Width and height (mm) of the largest upright target that fits one sheet with its bar and notes.

    Examples
    --------
    >>> room_on("A4")
    (196.0, 258.0)
    """
    width, height = _size(paper)
    return width - 2 * _EDGE, height - 2 * _EDGE - _TITLE - _FOOT


def largest_pitch(content_of: Callable[[float], Content], paper: str) -> float:
    """Largest pitch with which a target fits one sheet, mm: a whole number, halves below 10, tenths below 2.

    Parameters
    ----------
    content_of : callable
        The target of a pitch; its size is proportional to it.
    paper : {"A4", "A3", "Letter", "Tabloid"}
        The paper.

    Raises
    ------
    UsageError
        When it would be less than 0.1 mm.

    Examples
    --------
    >>> def square(pitch):
    ...     return Content(np.zeros(2), np.full(2, 8 * pitch), [], [], "8 pitches wide", {})
    >>> largest_pitch(square, "A4")
    24.0
    """
    unit = content_of(1.0).size
    narrow, tall = room_on(paper)
    rooms = ((narrow, tall), _room(*_size(paper)[::-1]))
    pitch = max(float(min(w / unit[0], h / unit[1])) for w, h in rooms)
    step = 1.0 if pitch >= 10 else 0.5 if pitch >= 2 else 0.1
    found = round(float(np.floor(pitch / step + 1e-9)) * step, 6)
    if found < 0.1:
        raise UsageError(f"has too many marks for {paper}", where="target", do="use larger paper, or fewer")
    return found


def sheets_of(content: Content, paper: str) -> list[Page]:
    """Lay out a target on one sheet, upright or sideways, or on several that are joined to it.

    Raises
    ------
    UsageError
        When it takes more than 400 sheets.

    Examples
    --------
    >>> wide = Content(np.zeros(2), np.array([500.0, 200.0]), [], [], "wide", {})
    >>> len(sheets_of(wide, "A4")), len(sheets_of(wide, "A3"))
    (3, 2)
    """
    upright = _size(paper)
    for width, height in (upright, upright[::-1]):
        if (content.size <= _room(width, height)).all():
            return [_single(content, width, height)]
    # The fewest sheets; upright where both are as many.
    (across, down), (width, height) = min(
        ((_grid(content, *size), size) for size in (upright, upright[::-1])),
        key=lambda each: np.prod(each[0]),
    )
    if across * down > _MOST_SHEETS:
        raise UsageError(
            f"takes {across * down} sheets of {paper}", where=content.title, do="use larger paper"
        )
    every = ((row, column) for row in range(down) for column in range(across))
    return [_tile(content, (width, height), (across, down), at) for at in every]


def _size(paper: str) -> tuple[float, float]:
    if paper not in PAPERS:
        raise UsageError(f"is not one of {', '.join(PAPERS)}", where=f"paper {paper}")
    return PAPERS[paper]


def _room(width: float, height: float) -> Array:
    return np.array([width - 2 * _EDGE, height - 2 * _EDGE - _TITLE - _FOOT])


def _single(content: Content, width: float, height: float) -> Page:
    """One sheet, with the target in its middle and the bar below."""
    room, size = _room(width, height), content.size
    left, top = _EDGE + (room - size) / 2 + [0, _TITLE]
    target = (float(left), float(top), float(left + size[0]), float(top + size[1]))
    drawn = _drawn(content, target, content.low[0], content.high[1])
    lines, texts = _foot(width, height, _CHECK, content.how)
    title = (target[0], target[1] - 1.6, "start", content.title)
    return replace(drawn, width=width, height=height, lines=lines, texts=[title, *texts, *drawn.texts])


def _cell(width: float, height: float) -> Array:
    """Width and height of the part of a target on one of several sheets."""
    return _room(width, height) - _FLAP


def _grid(content: Content, width: float, height: float) -> tuple[int, int]:
    """Number of sheets in a row and in a column."""
    across, down = np.ceil(content.size / _cell(width, height) - 1e-9).astype(int)
    return max(1, int(across)), max(1, int(down))


def _edges(low: float, high: float, count: int, most: float, between: Array) -> Array:
    """Edges (count + 1) of parts of a length that are at most so long: between marks, where they fit."""
    even = np.linspace(low, high, count + 1)
    if count == 1 or not len(between):
        return even
    edges = even.copy()
    for k in range(1, count):
        # What is left must fit the other sheets.
        room = between[(between <= edges[k - 1] + most) & (between >= high - (count - k) * most)]
        if not len(room):
            return even
        edges[k] = room[np.abs(room - even[k]).argmin()]
    return edges


def _tile(content: Content, paper: tuple[float, float], grid: tuple[int, int], at: tuple[int, int]) -> Page:
    """One of several sheets: its part of the target, and hairlines where its neighbours lie."""
    (width, height), (across, down), (row, column) = paper, grid, at
    cell, (cuts_x, cuts_y) = _cell(*paper), content.between
    across_at = _edges(content.low[0], content.high[0], across, cell[0], cuts_x)
    down_at = -_edges(-content.high[1], -content.low[1], down, cell[1], -cuts_y[::-1])
    x, y = across_at[column], down_at[row]
    # Marks for the upper cut are beside the target, where printers print.
    left, top = _EDGE + _FLAP / 2, _EDGE + _TITLE
    target = (left, top, float(left + across_at[column + 1] - x), float(top + y - down_at[row + 1]))
    drawn = _drawn(content, target, x, y)
    number = row * across + column + 1
    lines, texts = _foot(width, height, _CHECK, content.how if number == 1 else _JOIN)
    where = f"{content.title}; sheet {number} of {across * down}: row {row + 1}, column {column + 1}"
    return replace(
        drawn, width=width, height=height,
        lines=[*lines, *_joints(target, (row > 0, column + 1 < across, row + 1 < down, column > 0))],
        texts=[(left, top - 3.4, "start", where), *texts, *drawn.texts],
    )  # fmt: skip


def _joints(
    target: tuple[float, float, float, float], beside: tuple[bool, bool, bool, bool]
) -> Iterator[tuple[float, float, float, float]]:
    """Marks at which sheets are cut, above and to the left, and lines on which their neighbours are laid."""
    x0, y0, x1, y1 = target
    above, right, below, left = beside
    if above:
        yield from ((x0 - 5, y0, x0 - 1, y0), (x1 + 1, y0, x1 + 5, y0))
    if left:
        yield from ((x0, y0 - 3, x0, y0 - 1), (x0, y1 + 1, x0, y1 + 5))
    if right:
        yield x1, y0, x1, y1
        yield from ((x1, y, x1 + _FLAP / 2, y) for y in (y0, y1))
    if below:
        yield x0, y1, x1, y1
        yield from ((x, y1, x, y1 + _FLAP / 2) for x in (x0, x1))


def _foot(
    width: float, height: float, check: str, notes: tuple[str, str]
) -> tuple[list[tuple[float, float, float, float]], list[tuple[float, float, str, str]]]:
    """Bar and notes at the bottom of a sheet."""
    bottom = height - _EDGE
    texts = [(_EDGE + _BAR + 4, bottom - 8.2, "start", check)]
    texts += [(_EDGE, bottom - 3.9 + 3.6 * k, "start", line) for k, line in enumerate(notes)]
    return list(_bar(_EDGE, bottom - 9.4)), texts


def _drawn(content: Content, target: tuple[float, float, float, float], x: float, y: float) -> Page:
    """The figures in a part of a target whose upper left corner (x, y) is that of `target` on paper."""
    corner, box = np.array([target[0] - x, target[1] + y]), np.array(target).reshape(2, 2)

    def on_paper(at: Array) -> Array:
        return np.asarray(corner + at * [1, -1])

    def near(low: Array, high: Array) -> bool:
        return bool((high > box[0]).all() and (low < box[1]).all())

    polygons = [on_paper(polygon) for polygon in content.polygons]
    centres = [(on_paper(np.array([cx, cy])), radius) for cx, cy, radius in content.circles]
    letters = [(on_paper(at), letter) for letter, at in content.letters.items()]
    return Page(
        0.0, 0.0, target,
        [each for each in polygons if near(each.min(axis=0), each.max(axis=0))],
        [(float(at[0]), float(at[1]), radius) for at, radius in centres if near(at - radius, at + radius)],
        [], [(float(at[0]), float(at[1]), "start", letter) for at, letter in letters if near(at, at)],
    )  # fmt: skip


def _crop_marks(target: tuple[float, ...]) -> Iterator[tuple[float, float, float, float]]:
    x0, y0, x1, y1 = map(float, target)
    for x, out in ((x0, -1), (x1, 1)):
        for y, down in ((y0, -1), (y1, 1)):
            yield x + out, y, x + out * (1 + _CROP), y
            yield x, y + down, x, y + down * (1 + _CROP)


def _bar(left: float, y: float) -> Iterator[tuple[float, float, float, float]]:
    """The scale bar: 100 mm between the centres of its end strokes, with a stroke every 10 mm."""
    yield left, y, left + _BAR, y
    for k in range(11):
        tall = 1.8 if k % 5 == 0 else 1.0
        yield left + 10 * k, y - tall, left + 10 * k, y + tall
