"""Drawings of designs for printing in true size: SVG and PDF, with crop marks and a scale bar.

Both formats are written from one list of filled polygons, circles and texts in millimetres.
"""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..core.data import Array
from ..core.errors import UsageError
from ..io import BoardDesign, ReseauDesign, TestfieldDesign
from ..io.targets import SpaceTargets
from ..optics.targets import target_corners
from .boards import board_figures
from .paper import Content, Page, page_of, room_on, sheets_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Drawable = ReseauDesign | TestfieldDesign | SpaceTargets | BoardDesign

_GREY = "#555555"
_GROUND, _LETTERS = 3.0, 6.0
"""Ground of a single target in its sizes, and room for its name, mm."""
_SINGLE = (
    "Cut the targets out with the white around them. Fix each flat to its place on the frame; note its name.",
    "Keep focus and zoom. Photograph the frame from many sides: each target in several photographs.",
)


def content_of(design: Drawable, across: int | None = None) -> Content:
    """The drawn parts of a target.

    Parameters
    ----------
    design : ReseauDesign, TestfieldDesign, BoardDesign or SpaceTargets
        The target.
    across : int, optional
        Number of single targets in a row; by default they fill a square.

    Raises
    ------
    UsageError
        When coordinates are missing, the unit is not the millimetre, or wires are not parallel to the axes.

    Examples
    --------
    >>> from reseau.designs import standard_reseau
    >>> content_of(standard_reseau()).size
    array([150., 110.])
    """
    if isinstance(design, TestfieldDesign):
        return _testfield(design)
    if isinstance(design, BoardDesign):
        return _board(design)
    return _frame(design, across) if isinstance(design, SpaceTargets) else _reseau(design)


def _pages(design: Drawable, paper: str | None) -> list[Page]:
    """Pages of a drawing; single targets, which are cut out, are never divided."""
    if paper is None:
        return [page_of(content_of(design))]
    if not isinstance(design, SpaceTargets):
        return sheets_of(content_of(design), paper)
    cell, room = _cell(design), room_on(paper)
    across, down = (int(length // cell) for length in room)
    if min(across, down) < 1:
        raise UsageError(f"has targets that do not fit {paper}", where=f"design {design.name}")
    targets, step = design.targets, across * down
    pages = []
    for k in range(0, len(targets.id), step):
        part = {key: column[k : k + step] for key, column in dict(targets).items() if column is not None}
        some = design.model_copy(update={"targets": targets.model_copy(update=part)})
        pages += sheets_of(content_of(some, across), paper)
    return pages


def _reseau(design: ReseauDesign) -> Content:
    """The marks of a reseau, with a margin of half a pitch."""
    xy, mark = design.xy, design.mark
    if design.unit != "mm" or not np.isfinite(xy).all():
        raise UsageError("has no millimetre coordinates for all marks", where=f"design {design.name}")
    size = mark.size or mark.line_width or 0.0
    around = max(size, 0.5 * _gap(xy))
    low, high = xy.min(axis=0) - around, xy.max(axis=0) + around
    polygons, circles = [], []
    if mark.shape == "line-grid":
        w, (columns, rows) = (mark.line_width or 0.0) / 2, (np.unique(xy[:, axis]) for axis in (0, 1))
        if len(columns) * len(rows) != len(xy):
            raise UsageError(
                "has wires that are not parallel to its axes; such a reseau was measured, not drawn",
                where=f"design {design.name}",
            )
        polygons = [_box(x - w, low[1], x + w, high[1]) for x in columns]
        polygons += [_box(low[0], y - w, high[0], y + w) for y in rows]
    elif mark.shape in ("disk", "rod"):
        circles = [(float(x), float(y), size / 2) for x, y in xy]
        polygons = list(_ring_sectors(design))
    else:
        corners = target_corners(mark.shape, size, arm=mark.line_width)
        polygons = [point + corners for point in xy]
    beside = np.full(2, 0.5 * size + 1.0)
    letters = {
        letter: xy[design.ids.index(mark_id)] + beside
        for letter, mark_id in (("O", design.origin), ("S", design.axis))
        if mark_id is not None
    }
    title = f"{design.name}: {len(xy)} marks, {_describe(design)}"
    return Content(low, high, polygons, circles, title, letters, between=_between(xy))


def _between(xy: Array, lines: tuple[ArrayLike, ArrayLike] = ((), ())) -> tuple[Array, Array]:
    """The middles of the widest gaps between columns, and rows, of points, but for those where lines are."""
    found = []
    for values, drawn in zip(xy.T, lines, strict=True):
        at = np.unique(values.round(6))
        gaps, line = np.diff(at), np.asarray(drawn, dtype=np.float64)
        free = ~((line > at[:-1, None]) & (line < at[1:, None])).any(axis=1)
        wide = gaps > 0.9 * gaps[free].max(initial=0.0)
        found.append((at[:-1] + gaps / 2)[free & wide])
    return found[0], found[1]


def _ring_sectors(design: ReseauDesign) -> Iterator[Array]:
    """Sectors of the coded rings as polygons with one corner per degree, within 4e-5 of the radius."""
    if design.rings is None:
        return
    for name, sectors in design.rings.sectors.items():
        centre = design.xy[design.ids.index(name)]
        for start, end in sectors:
            angle = np.deg2rad(np.linspace(start, end, int(end - start) + 2))
            arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            edges = design.rings.outer / 2 * arc, design.rings.inner / 2 * arc[::-1]
            yield centre + np.concatenate(edges)


def _testfield(design: TestfieldDesign) -> Content:
    """Lines and targets, with a margin of most of a square."""
    lines, targets = design.lines, design.targets
    x0, y0, x1, y1 = lines.extent
    around, w = 0.8 * design.pitch, lines.width / 2
    polygons = [_box(x - w, y0, x + w, y1) for x in lines.vertical_x]
    polygons += [_box(x0, y - w, x1, y + w) for y in lines.horizontal_y]
    circles = []
    for at, shape, size, angle in zip(design.xy, targets.shape, targets.size, targets.angle, strict=True):
        corners = target_corners(shape, size, angle)
        if corners is None:
            circles.append((float(at[0]), float(at[1]), size / 2))
        else:
            polygons.append(at + corners)
    title = (
        f"{design.name}: {design.squares[0]} × {design.squares[1]} squares of {design.pitch:g} mm, "
        f"{len(targets.id)} targets"
    )
    low, high = np.array([x0, y0]) - around, np.array([x1, y1]) + around
    between = _between(design.xy, (lines.vertical_x, lines.horizontal_y))
    return Content(low, high, polygons, circles, title, {}, between=between)


def _board(design: BoardDesign) -> Content:
    """A board with a margin: half a square, half a pitch of circles or a gap of tags."""
    polygons, circles = board_figures(design)
    ends = [np.vstack([polygon.min(axis=0), polygon.max(axis=0)]) for polygon in polygons]
    ends += [np.vstack([at[:2] - at[2], at[:2] + at[2]]) for at in circles]
    every = np.concatenate(ends)
    low, high = every.min(axis=0) - design.pitch / 2, every.max(axis=0) + design.pitch / 2
    squares = {"chess": "squares", "puzzle": "squares", "charuco": "squares"}
    what = (squares | {"circles": "circles", "deltille": "corners"}).get(design.kind, "tags")
    title = f"{design.name}: {design.kind}, {design.columns} × {design.rows} {what}"
    title += f", pitch {design.pitch:g} mm"
    if design.kind == "puzzle":
        title += f", from corner {design.start}"
    elif design.size is not None:
        title += f", {'diameter' if design.kind == 'circles' else 'markers'} {design.size:g} mm"
    if design.dictionary is not None:
        title += f", {design.dictionary}"
    title += f", borders of {design.border_bits} bits" if design.border_bits > 1 else ""
    title += f", from marker {design.first_id}" if design.first_id else ""
    title += ", asymmetric" if design.asymmetric else ""
    title += ", legacy layout" if design.legacy else ""
    rounds = [(float(x), float(y), float(radius)) for x, y, radius in circles]
    tags = design.kind in ("aprilgrid", "markers")
    between = _between(design.xy.reshape(-1, 4, 2).mean(axis=1) if tags else design.xy)
    return Content(low, high, polygons, rounds, title, {}, between=between)


def _cell(design: SpaceTargets) -> float:
    """Side of the ground of a single target with its name, mm."""
    return float(_GROUND * max(design.targets.size) + _LETTERS)


def _frame(design: SpaceTargets, columns: int | None) -> Content:
    """Single targets in rows, each on a ground of three times its size, to be cut out."""
    if design.unit != "mm":
        raise UsageError("is not in millimetres", where=f"design {design.name}")
    targets, count = design.targets, len(design.targets.id)
    cell = _cell(design)
    columns = columns or int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    polygons, circles, letters = list[Array](), list[tuple[float, float, float]](), {}
    for k, (name, shape, size) in enumerate(zip(targets.id, targets.shape, targets.size, strict=True)):
        row, column = divmod(k, columns)
        at = np.array([(column + 0.5) * cell, -(row + 0.5) * cell])
        if shape == "disk":
            circles.append((float(at[0]), float(at[1]), size / 2))
        else:
            polygons.append(at + _box(-size / 2, -size / 2, size / 2, size / 2))
        letters[name] = at - 0.5 * cell + 1.5
    low, high = np.array([0.0, -rows * cell]), np.array([columns * cell, 0.0])
    title = f"{design.name}: {count} single targets, cells of {cell:g} mm"
    return Content(low, high, polygons, circles, title, letters, _SINGLE)


def _gap(xy: Array) -> float:
    distance = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))


def _describe(design: ReseauDesign) -> str:
    mark = design.mark
    parts: list[str] = [mark.shape]
    if mark.size:
        parts.append(f"{mark.size:g} mm")
    if mark.line_width:
        parts.append(f"lines {mark.line_width:g} mm")
    return f"{' '.join(parts)}, O = {design.origin or '–'}, S = {design.axis or '–'}"


def _box(x0: float, y0: float, x1: float, y1: float) -> Array:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=np.float64)


def _colours(design: Drawable) -> tuple[str, str]:
    """Colours of background and marks."""
    return ("#ffffff", "#000000") if design.polarity == "dark" else ("#000000", "#ffffff")


def _number(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".")


def design_svg(design: Drawable) -> str:
    """Draw a target as SVG in true size, on a page as large as it needs.

    Parameters
    ----------
    design : ReseauDesign, TestfieldDesign, BoardDesign or SpaceTargets
        The target.

    Returns
    -------
    str
        The SVG document.

    Raises
    ------
    UsageError
        When the design has no millimetre coordinates for all marks.

    Examples
    --------
    >>> from reseau.designs import standard_reseau
    >>> design_svg(standard_reseau())[:4]
    '<svg'
    """
    sheet = page_of(content_of(design))
    ground, ink = _colours(design)
    x0, y0, x1, y1 = sheet.target
    n = _number
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{n(sheet.width)}mm" height="{n(sheet.height)}mm" '
        f'viewBox="0 0 {n(sheet.width)} {n(sheet.height)}">',
        f"<title>{escape(design.name)}</title>",
        f'<rect width="{n(sheet.width)}" height="{n(sheet.height)}" fill="#ffffff"/>',
        f'<rect x="{n(x0)}" y="{n(y0)}" width="{n(x1 - x0)}" height="{n(y1 - y0)}" fill="{ground}"/>',
        f'<g fill="{ink}">',
    ]
    for polygon in sheet.polygons:
        path = "L".join(f"{n(x)} {n(y)}" for x, y in polygon)
        parts.append(f'<path d="M{path}Z"/>')
    parts += [f'<circle cx="{n(x)}" cy="{n(y)}" r="{n(r)}"/>' for x, y, r in sheet.circles]
    parts.append(f'</g><g stroke="{_GREY}" stroke-width="0.1">')
    parts += [f'<path d="M{n(a)} {n(b)}L{n(c)} {n(d)}"/>' for a, b, c, d in sheet.lines]
    parts.append(f'</g><g font-family="Helvetica, Arial, sans-serif" font-size="2.6" fill="{_GREY}">')
    parts += [
        f'<text x="{n(x)}" y="{n(y)}" text-anchor="{anchor}">{escape(text)}</text>'
        for x, y, anchor, text in sheet.texts
    ]
    return "\n".join(parts) + "</g></svg>\n"


def design_pdf(design: Drawable, paper: str | None = None) -> bytes:
    """Draw a target as PDF in true size; all elements are vectors.

    Parameters
    ----------
    design : ReseauDesign, TestfieldDesign, BoardDesign or SpaceTargets
        The target.
    paper : {"A4", "A3", "Letter", "Tabloid"}, optional
        Paper to print on. A target that does not fit one sheet is divided over several, with marks to join
        them. By default one page as large as the target needs.

    Returns
    -------
    bytes
        The PDF document.

    Raises
    ------
    UsageError
        When the design has no millimetre coordinates for all marks, the paper is unknown, or too many sheets
        are needed.
    """
    from io import BytesIO

    from matplotlib.backends.backend_pdf import PdfPages

    from ..core.figures import drawing as house_style

    stream = BytesIO()
    # Without dates: the same design, the same bytes.
    about = {"Title": design.name, "CreationDate": None, "Creator": None}
    with house_style(), PdfPages(stream, metadata=about) as pdf:
        for page in _pages(design, paper):
            pdf.savefig(_figure(page, *_colours(design)))
    return stream.getvalue()


def _figure(page: Page, ground: str, ink: str) -> Figure:
    """A page as a figure in true size."""
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Patch, Polygon, Rectangle

    x0, y0, x1, y1 = page.target
    figure = Figure(figsize=(page.width / 25.4, page.height / 25.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, page.width), ylim=(page.height, 0))
    axes.axis("off")
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fc=ground, ec="none"))
    patches: list[Patch] = [Polygon(polygon, closed=True) for polygon in page.polygons]
    patches += [Circle((x, y), r) for x, y, r in page.circles]
    figures = PatchCollection(patches, facecolor=ink, edgecolor="none", linewidth=0)
    axes.add_collection(figures)
    figures.set_clip_path(Rectangle((x0, y0), x1 - x0, y1 - y0, transform=axes.transData))
    for a, b, c, d in page.lines:
        axes.plot([a, c], [b, d], color=_GREY, lw=0.1 / 25.4 * 72, solid_capstyle="butt")
    sides = {"start": "left", "middle": "center"}
    for x, y, anchor, text in page.texts:
        axes.text(x, y, text, ha=sides[anchor], va="baseline", fontsize=2.6 / 25.4 * 72, color=_GREY)
    return figure
