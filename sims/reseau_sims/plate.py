"""A reseau in front of the screen, whose marks change the light on its way to the camera."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from reseau.core.data import Array, Mask
from reseau.core.errors import UsageError
from reseau.designs import regular_reseau
from reseau.io import Mark, ReseauDesign
from reseau.optics.formation import Outline, draw, mark_outline
from reseau.optics.grids import Wires, line_grid, wire_grid

from .camera import FilmCamera

_SPACING_PX = 0.7
"""Distance of the nodes of an outline in widths of the point-spread function; see `Outline.polygon`."""

_APART_MM = 1e-3
"""Largest distance of a mark of a design from the crossing of two wires that it is."""


def uneven_wires(
    rng: np.random.Generator,
    columns: int = 15,
    rows: int = 11,
    pitch: float = 10.0,
    *,
    turn_deg: float = 0.0,
    skew_deg: float = 0.0,
    slope: float = 0.003,
    offset: float = 0.05,
    bend: float = 0.0,
) -> tuple[Wires, Wires]:
    """Wires that were strung by hand, in the system of a comparator that is not parallel to them.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random numbers.
    columns, rows, pitch
        Number of wires of either direction, and their mean distance (mm).
    turn_deg : float
        Rotation of all wires against the axes of the coordinates.
    skew_deg : float
        Deviation of the two directions from a right angle.
    slope, offset, bend : float
        Largest deviation of a single wire in direction (rad), position (mm) and curvature (1/mm).

    Returns
    -------
    (Wires, Wires)
        Wires that run down from the left to the right, and wires that run right from the top to the bottom.

    Examples
    --------
    >>> upright, level = uneven_wires(np.random.default_rng(1), 3, 2, turn_deg=30.0)
    >>> level.crossings(upright).shape
    (2, 3, 2)
    """

    def one(angle: float, at: Array) -> Wires:
        n = len(at)
        single = [rng.uniform(-most, most, n) for most in (slope, offset, bend)]
        return Wires(angle + np.deg2rad(turn_deg) + single[0], at + single[1], single[2])

    x: Array = np.asarray((np.arange(columns) - (columns - 1) / 2) * pitch, dtype=np.float64)
    y: Array = np.asarray(((rows - 1) / 2 - np.arange(rows)) * pitch, dtype=np.float64)
    # To the left of a wire that runs down, x grows; to the left of one that runs right, y does.
    return one(-np.pi / 2 + np.deg2rad(skew_deg), x), one(0.0, y)


def wired(wires: tuple[Wires, Wires], line_width: float = 0.3, name: str = "wires") -> ReseauDesign:
    """The design of a reseau of such wires: its marks are their crossings, as a comparator measures them.

    Examples
    --------
    >>> design = wired(uneven_wires(np.random.default_rng(1), 3, 2, slope=0.0, offset=0.0))
    >>> design.ids, design.xy[0].round(6).tolist()
    (('A1', 'A2', 'A3', 'B1', 'B2', 'B3'), [-10.0, 5.0])
    """
    upright, level = wires
    crossings = level.crossings(upright)
    mark = Mark(shape="line-grid", line_width=line_width)
    grid = regular_reseau(len(upright), len(level), 100 * line_width, mark, name=name)
    points = tuple(
        point.model_copy(update={"x": float(x), "y": float(y)})
        for point, (x, y) in zip(grid.points, crossings.reshape(-1, 2), strict=True)
    )
    return grid.model_copy(update={"points": points})


@dataclass
class Plate:
    """The marks of a design, in the plane of the screen.

    Parameters
    ----------
    design : ReseauDesign
        Coordinates in millimetres, y up, in the system of the screen.
    opacity : float
        Fraction of the light behind it that a dark mark absorbs; a wire reflects a little ambient light.
    brightness : float
        Grey values added by a bright mark.
    beyond_mm : float
        Length of the wires beyond the outermost crossings.
    missing : frozenset of str
        Broken marks.
    false_marks : ndarray (k, 2)
        Positions of dirt that looks like a mark (mm).
    wires : (Wires, Wires), optional
        The wires of a line grid, each with its own direction; the marks of the design are their crossings. By
        default they are parallel to the axes of the design, through its marks.

    Raises
    ------
    UsageError
        When marks of the design have no coordinates, or are no crossings of the wires.

    Examples
    --------
    >>> from reseau.designs import standard_reseau
    >>> len(Plate(standard_reseau()).design.ids)
    165
    """

    design: ReseauDesign
    opacity: float = 0.94
    brightness: float = 90.0
    beyond_mm: float = 13.0
    missing: frozenset[str] = frozenset()
    false_marks: Array = field(default_factory=lambda: np.empty((0, 2)))
    wires: tuple[Wires, Wires] | None = None
    _kept: tuple[tuple[object, ...], Array] = field(
        default=((None,), np.empty(0)), init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        if not np.isfinite(self.design.xy).all():
            raise UsageError("lacks coordinates of marks", where=f"design {self.design.name}")

    def over(self, light: Array, camera: FilmCamera, row_shifts: Array | None = None) -> Array:
        """The light (height, width) that reaches the camera past the marks."""
        share = self._share(camera, row_shifts)
        if self.design.polarity == "bright":
            return light + self.brightness * share
        return light * (1 - self.opacity * share)

    def _share(self, camera: FilmCamera, row_shifts: Array | None) -> Array:
        """Fraction (height, width) of the light that falls on marks; the last result is cached."""
        of = (camera, self.design, self.missing, self.false_marks, self.beyond_mm, self.wires)
        # The reseau is the same in consecutive photographs, and drawing it takes most of the time.
        if row_shifts is None and all(a is b for a, b in zip(self._kept[0], of, strict=False)):
            return self._kept[1]
        share = np.zeros(camera.shape)
        for outline in self._outlines(_mm_per_px(camera) * _SPACING_PX * camera.psf_px):
            image = outline.mapped(lambda xy: camera.view.derivatives(xy)[:2]).oriented()
            share += draw(image, camera.shape, camera.psf_px, camera.response, row_shifts)
        np.clip(share, 0.0, 1.0, out=share)
        if row_shifts is None:
            self._kept = (of, share)
        return share

    def _outlines(self, spacing: float) -> list[Outline]:
        """All marks in the plane of the design, in batches of like outlines."""
        mark, ids = self.design.mark, self.design.ids
        there = np.array([name not in self.missing for name in ids])
        dirt = [] if not len(self.false_marks) else [_at(self._dirt(spacing), self.false_marks)]
        if mark.shape == "line-grid":
            return [*self._wires(there, spacing), *dirt]
        if mark.size is None:
            raise UsageError("has no size of its marks", where=f"design {self.design.name}")
        outline = mark_outline(mark.shape, mark.size, mark.line_width, spacing)
        return [_at(outline, self.design.xy[there]), *dirt]

    def _wires(self, there: Mask, spacing: float) -> list[Outline]:
        xy = self.design.xy
        if self.wires is not None:
            upright, level = self.wires
            crossings = level.crossings(upright)
            apart = np.hypot(*np.moveaxis(crossings.reshape(-1, 1, 2) - xy, -1, 0))
            if self.design.mark.line_width is None or not (apart.min(axis=0) < _APART_MM).all():
                raise UsageError("has marks that are no crossings", where=f"design {self.design.name}")
            gone = np.zeros(len(apart), dtype=bool)
            gone[apart.argmin(axis=0)[~there]] = True
            width, broken = self.design.mark.line_width, gone.reshape(crossings.shape[:2])
            return wire_grid(upright, level, width, spacing, beyond=self.beyond_mm, broken=broken)
        x, column = np.unique(xy[:, 0], return_inverse=True)
        y, row = np.unique(xy[:, 1], return_inverse=True)
        if len(x) * len(y) != len(xy) or self.design.mark.line_width is None:
            raise UsageError("is no grid of wires", where=f"design {self.design.name}")
        broken = np.zeros((len(y), len(x)), dtype=bool)
        broken[row, column] = ~there
        return list(
            line_grid(x, y, self.design.mark.line_width, spacing, beyond=self.beyond_mm, broken=broken)
        )

    def _dirt(self, spacing: float) -> Outline:
        """A false mark: one of the design, or two crossed splinters of wire."""
        mark = self.design.mark
        if mark.shape == "line-grid":
            width = mark.line_width or 0.0
            return mark_outline("cross", 8 * width, width, spacing)
        return mark_outline(mark.shape, mark.size or 0.0, mark.line_width, spacing)


def _at(outline: Outline, xy: Array) -> Outline:
    return outline.affine(np.tile(np.eye(2), (len(xy), 1, 1)), xy)


def _mm_per_px(camera: FilmCamera) -> float:
    """Smallest length in the plane that a pixel sees, at the corners and the centre of the frame."""
    height, width = camera.shape
    corners = np.array([(x, y) for x in (0, width / 2, width) for y in (0, height / 2, height)])
    slope = camera.view.derivatives(camera.view.inverse(corners)).d_xy
    return float(1 / np.sqrt(np.abs(np.linalg.det(slope))).max())
