"""Parametric designs: regular reseaus, coded sheets, and an ultrasonic test object."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..core.errors import UsageError
from ..io import DesignPoint, Mark, ReseauDesign, Rings


def regular_reseau(
    columns: int,
    rows: int,
    pitch: float,
    mark: Mark,
    *,
    name: str = "reseau",
    polarity: Literal["dark", "bright"] = "dark",
    origin: str | None = None,
    axis: str | None = None,
) -> ReseauDesign:
    """Design a grid of marks around the origin of its plane, millimetres, x right, y up.

    Rows are lettered from the top, columns numbered from the left: ``A1`` is the upper left mark.

    Parameters
    ----------
    columns, rows : int
        Number of marks in a row and in a column, at least 2 each.
    pitch : float
        Distance of neighbouring marks, millimetres.
    mark : Mark
        Shape and size of a mark.
    origin, axis : str, optional
        The marks O and S that define the common system; by default the one in the centre and the last of its
        row.

    Raises
    ------
    UsageError
        When a number is not possible, marks would touch, or `origin` or `axis` is not a mark of the design.

    Examples
    --------
    >>> grid = regular_reseau(3, 2, 10.0, Mark(shape="disk", size=1.0))
    >>> grid.ids
    ('A1', 'A2', 'A3', 'B1', 'B2', 'B3')
    >>> grid.origin, grid.axis, grid.points[0].x, grid.points[0].y
    ('B2', 'B3', -10.0, 5.0)
    """
    if min(columns, rows) < 2 or not pitch > 0 or columns * rows > 100_000:
        raise UsageError(
            f"cannot have {columns} × {rows} marks at {pitch} mm", where=f"design {name}",
            do="at least two columns and rows are needed, and a pitch above zero",
        )  # fmt: skip
    extent = (mark.line_width if mark.shape == "line-grid" else mark.size) or 0.0
    if not 0 < extent < pitch:
        raise UsageError(f"marks of {extent} mm do not fit a pitch of {pitch} mm", where=f"design {name}")
    if mark.shape in ("cross", "line-grid") and not mark.line_width:
        raise UsageError(f"marks of shape {mark.shape!r} need a line width", where=f"design {name}")
    points = tuple(
        DesignPoint(
            id=f"{_letters(row)}{column + 1}",
            # Integer micrometres, so that the file contains exact numbers.
            x=float(np.round((column - (columns - 1) / 2) * pitch, 6)),
            y=float(np.round(((rows - 1) / 2 - row) * pitch, 6)),
        )
        for row in range(rows)
        for column in range(columns)
    )
    middle = _letters(rows // 2)
    origin = origin or f"{middle}{(columns + 1) // 2}"
    axis = axis or f"{middle}{columns}"
    for role, mark_id in (("origin", origin), ("axis", axis)):
        if all(point.id != mark_id for point in points):
            raise UsageError(f"{mark_id!r} is not a mark of the design", where=role)
    if origin == axis:
        raise UsageError(f"both are {origin!r}; they must differ", where="origin and axis")
    return ReseauDesign(
        name=name, unit="mm", mark=mark, polarity=polarity, origin=origin, axis=axis, points=points
    )


def _letters(row: int) -> str:
    """A, B, … Z, AA, AB, …"""
    letters = ""
    row += 1
    while row:
        row, letter = divmod(row - 1, 26)
        letters = chr(ord("A") + letter) + letters
    return letters


_CODES = ("000001011111", "001001101110", "000011110011", "001100001111")
"""Sectors of four rings, counter-clockwise from x. Each differs from the others, and from itself rotated by
multiples of 90° or reflected, in at least four of its twelve sectors."""
_DISK, _RING = 0.22, (0.54, 0.96)
"""Diameters of the disks and of the rings, in pitches; a ring leaves a gap to the neighbouring disks."""


def coded_sheet(
    columns: int,
    rows: int,
    pitch: float,
    *,
    size: float | None = None,
    name: str = "sheet",
    polarity: Literal["dark", "bright"] = "dark",
) -> ReseauDesign:
    """Design a sheet of disks, four of them in coded rings; one visible ring identifies all disks.

    Parameters
    ----------
    columns, rows : int
        Number of disks in a row and in a column, at least 4 each.
    pitch : float
        Distance of neighbouring disks in millimetres.
    size : float, optional
        Diameter of a disk in millimetres, by default 0.22 pitches.

    Raises
    ------
    UsageError
        When a number is not possible, or disks do not fit into the rings.

    Examples
    --------
    >>> sheet = coded_sheet(10, 10, 25.0)
    >>> sheet.mark.size, sheet.rings.inner, sheet.rings.outer
    (5.5, 13.5, 24.0)
    >>> tuple(sheet.rings.sectors)
    ('B2', 'B9', 'I2', 'I9')
    """
    if not pitch > 0:
        raise UsageError(f"cannot have disks at {pitch:g} mm", where=f"design {name}")
    if min(columns, rows) < 4:
        raise UsageError(f"{columns} × {rows} disks have no room for four rings", where=f"design {name}")
    inner, outer = (round(part * pitch, 6) for part in _RING)
    size = round(_DISK * pitch, 6) if size is None else size
    if not 0 < size < 0.9 * inner:
        raise UsageError(f"disks of {size:g} mm do not fit rings of {inner:g} mm", where=f"design {name}")
    grid = regular_reseau(columns, rows, pitch, Mark(shape="disk", size=size), name=name, polarity=polarity)
    across, down = max(1, columns // 6), max(1, rows // 6)
    places = [(row, column) for row in (down, rows - 1 - down) for column in (across, columns - 1 - across)]
    sectors = {
        f"{_letters(row)}{column + 1}": _sectors(code)
        for (row, column), code in zip(places, _CODES, strict=True)
    }
    return ReseauDesign(
        name=name,
        unit=grid.unit,
        mark=grid.mark,
        polarity=polarity,
        origin=grid.origin,
        axis=grid.axis,
        points=grid.points,
        rings=Rings(inner=inner, outer=outer, sectors=sectors),
    )


def _sectors(code: str) -> tuple[tuple[float, float], ...]:
    """Start and end in degrees of the dark sectors of a ring: one for each run of ones."""
    n = len(code)
    starts = [k for k in range(n) if code[k] == "1" and code[k - 1] == "0"]
    runs = [(k, next(m for m in range(1, n) if code[(k + m) % n] == "0")) for k in starts]
    return tuple((360.0 / n * k, 360.0 / n * (k + length)) for k, length in runs)


def standard_reseau() -> ReseauDesign:
    """The reseau of the simulated bench: 15 × 11 wires of 0.3 mm in front of a screen of 150 × 120 mm.

    Thin aluminium wires with the dimensions of the screen, as in the first section of Wishahy's procedure;
    the paper does not give their number.

    Examples
    --------
    >>> len(standard_reseau().ids)
    165
    """
    return regular_reseau(15, 11, 10.0, Mark(shape="line-grid", line_width=0.3), name="wires-15x11")


_ROWS = {
    "A": (20.0, (-50, -25, 0, 25, 50)),
    "B": (40.0, (-50, 0, 50)),
    "C": (60.0, (-50, -25, 0, 25, 50)),
    "D": (80.0, (-50, 0, 50)),
    "E": (100.0, (-50, -25, 0, 25, 50)),
}
"""Rows of rods: depth below the upper edge, and positions along it (mm). Those at 0 are the range group."""
_GROUPS = {
    # Decreasing distances along the row, for the lateral resolution.
    "L": ((-39, 90), (-14, 90), (6, 90), (21, 90), (31, 90), (36, 90), (39, 90)),
    # On an inclined line with decreasing distances in depth.
    "X": ((-38, 28), (-36, 33), (-34, 37), (-32, 40), (-30, 42), (-28, 43)),
    # Decreasing distances from the transducer.
    "T": ((18, 12), (28, 9), (38, 6), (48, 4)),
}
"""Groups that show the lateral and the axial resolution, and the dead zone."""


def test_object() -> ReseauDesign:
    """The 100 mm ultrasonic test object: 38 steel rods of 0.75 mm, each at its position within ± 0.25 mm.

    A test object for pulse-echo apparatus as used by Wishahy: rows 20 mm apart with rods every 25 or 50 mm
    (``A1`` … ``E5``), whose middle rods form the range group, a column down to 100 mm; a row of rods with
    decreasing distances for the lateral resolution (``L``), an inclined line for the axial resolution
    (``X``), and rods close to the transducer for the dead zone (``T``). The paper gives diameter and
    tolerance but no positions; these are typical and not taken from a standard's drawing.

    Returns
    -------
    ReseauDesign
        Millimetres, x right, y up from the centre of the upper edge, along which the transducer moves: the
        depth is −y. M and N are the ends of the middle row, ``C1`` and ``C5``.

    Examples
    --------
    >>> rods = test_object()
    >>> len(rods.ids), rods.origin, rods.axis, rods.mark.size, rods.points[0].sigma
    (38, 'C1', 'C5', 0.75, 0.25)
    """
    rods = [
        (f"{row}{i + 1}", float(x), -depth)
        for row, (depth, places) in _ROWS.items()
        for i, x in enumerate(places)
    ]
    rods += [
        (f"{group}{i + 1}", float(x), -float(depth))
        for group, places in _GROUPS.items()
        for i, (x, depth) in enumerate(places)
    ]
    return ReseauDesign(
        name="rods-100mm",
        unit="mm",
        mark=Mark(shape="rod", size=0.75),
        polarity="bright",
        origin="C1",
        axis="C5",
        points=tuple(DesignPoint(id=name, x=x, y=y, sigma=0.25) for name, x, y in rods),
    )


def n_wire_phantom(
    layers: int = 3, width: float = 40.0, spacing: float = 15.0, *, name: str = "n-wires"
) -> ReseauDesign:
    """Design an N-wire phantom: in each layer two parallel wires and one that slants from one to the other.

    In the k-th layer ``Rk`` and ``Lk`` are normal to the plane of the design, and ``Nk`` runs from the place
    of ``Rk`` at the front to that of ``Lk`` at the back; in every other layer the other way. The last ``R``
    is displaced to the inside, so that the phantom is not symmetric.

    Parameters
    ----------
    layers : int
        Number of layers, at least 2.
    width, spacing : float
        Distance of the parallel wires of a layer, and of the layers, millimetres.

    Raises
    ------
    UsageError
        When a number is not possible.

    Examples
    --------
    >>> phantom = n_wire_phantom(2)
    >>> phantom.ids
    ('R1', 'N1', 'L1', 'R2', 'N2', 'L2')
    >>> phantom.segments[1].tolist()
    [[20.0, 0.0], [-20.0, 0.0]]
    """
    if not 2 <= layers <= 100 or not min(width, spacing) > 0:
        raise UsageError(
            f"cannot have {layers} layers of {width:g} mm, {spacing:g} mm apart", where=f"design {name}"
        )
    points = []
    for k in range(layers):
        y = float(np.round(-k * spacing, 6))
        right = float(np.round(width / 2 - (width / 5 if k == layers - 1 else 0.0), 6))
        left = float(np.round(-width / 2, 6))
        front, back = (right, left) if k % 2 == 0 else (left, right)
        points += [
            DesignPoint(id=f"R{k + 1}", x=right, y=y),
            DesignPoint(id=f"N{k + 1}", x=front, y=y, end=(back, y)),
            DesignPoint(id=f"L{k + 1}", x=left, y=y),
        ]
    return ReseauDesign(
        name=name,
        unit="mm",
        mark=Mark(shape="rod", size=0.3),
        polarity="bright",
        origin="L1",
        axis="R1",
        points=tuple(points),
    )


# Prevents collection by pytest, wherever the function is imported.
test_object.__test__ = False  # type: ignore[attr-defined]
