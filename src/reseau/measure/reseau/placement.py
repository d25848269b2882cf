"""Find where a design lies in a frame, by approximate positions or without, at several sizes of its marks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.data import Array, Frame
from ...core.failure import Code, Failure, Remark
from ...io import ReseauDesign
from ...optics.formation import coverage, mark_outline
from ..screening import Screened, screen
from .assignment import Assignment, assign, spacing
from .candidates import Candidates, find_candidates
from .grid_search import NEARLY, UPRIGHT, GridOptions, climbed, place_grid, settled
from .wires import grid_wires

_BETTER = 0.05
"""Share of all marks that another position must find in addition to contradict the nominal positions."""
_OF_ROW = 0.5
"""The same by the likeness of the marks, as a share of a row."""
_TRIAL_PX = (3.0, 4.5, 6.5, 10.0, 15.0, 22.0)
"""Sizes of a mark in the image that are tried if the size is unknown."""


@dataclass(frozen=True)
class PlacingOptions:
    """What is known about a design in a frame.

    Parameters
    ----------
    nominal : ndarray (n, 2), optional
        Approximate positions in pixels.
    within_px : float, optional
        Uncertainty of the approximate positions, if known.
    mark_px : float, optional
        Size of a mark in the image.
    psf_px : float
        Width of the point-spread function.
    grid : GridOptions
        What is known about the grid, used without approximate positions.
    """

    nominal: Array | None
    within_px: float | None
    mark_px: float | None
    psf_px: float
    grid: GridOptions


@dataclass(frozen=True, eq=False)
class Placement:
    """Position of a design in a frame.

    Parameters
    ----------
    screened : Screened
        The screened frame.
    assignment : Assignment
        Marks with their candidates and the field through them.
    candidates : Candidates
        Places that look like a mark.
    mark_px : float
        Approximate size of a mark in the image; the width of the line for a line grid.
    notes : tuple of Remark
        Notes for the user.
    """

    screened: Screened
    assignment: Assignment
    candidates: Candidates
    mark_px: float
    notes: tuple[Remark, ...] = ()

    @property
    def support(self) -> float:
        """See :meth:`Assignment.support`."""
        return self.assignment.support(self.candidates.t)

    @property
    def strength(self) -> float:
        """Score of the assignment, and strength of its marks."""
        has = self.assignment.candidate[self.assignment.candidate >= 0]
        return self.assignment.score + float(np.log1p(self.candidates.t[has]).sum())


def place(frame: Frame, design: ReseauDesign, source: Array, options: PlacingOptions) -> Placement | Failure:
    """Find the design in the frame; tries several mark sizes and keeps the best.

    Parameters
    ----------
    frame : Frame
        The frame.
    design : ReseauDesign
        The design, for the shape of its marks.
    source : ndarray (n, 2)
        Plane coordinates of the marks.
    options : PlacingOptions
        What is known about it.

    Returns
    -------
    Placement or Failure
        A failure if the design is not found.
    """
    best = _placed(frame, design, source, options)
    if isinstance(best, Failure):
        return best
    if options.nominal is not None and options.within_px is None:
        best = _despite_nominal(best, source, options)
    marks = 0 if best is None else int((best.assignment.candidate >= 0).sum())
    least = max(4, min(10, len(source) // 3))
    if best is None or marks < least or best.assignment.score < -0.1 * len(source):
        return Failure(
            f"design {design.name!r} was not found in the frame of "
            f"{frame.width}×{frame.height} px ({marks} of {len(source)} marks agree with it)",
            Code.NOT_FOUND,
            where=frame.name,
            places=np.empty((0, 2)) if best is None else best.candidates.xy[: 3 * len(source)],
        )
    return best


def _placed(
    frame: Frame, design: ReseauDesign, source: Array, options: PlacingOptions
) -> Placement | Failure | None:
    """The best position over all sizes and rotations of a mark."""
    mark = design.mark
    size = mark.line_width if mark.shape == "line-grid" else mark.size
    best: Placement | None = None
    sizes = _sizes(source, size, options)
    strengths: list[tuple[float, float]] = []
    for turn in _turns(design, options):
        if turn:
            # A mark that is not upright still looks most like one of its own size.
            sizes = tuple(size for _, size in sorted(strengths, reverse=True)[:2])
        for mark_px in sizes:
            screened = screen(frame, run=max(15, round(4 * mark_px)))
            if isinstance(screened, Failure):
                return screened
            template = _template(
                design, mark_px, options.psf_px, _axes(design, source, options.nominal, turn)
            )
            if len(template) > min(frame.pixels.shape):
                continue
            candidates = find_candidates(screened.grey, screened.valid, template)
            if not turn:
                strengths.append((float(candidates.t[: len(source)].sum()), mark_px))
            found = _lay(source, size, candidates, screened, mark_px, options)
            if found is None:
                continue
            placed = Placement(screened, found, candidates, mark_px)
            if best is None or placed.strength > best.strength:
                best = placed
            # All marks found, at the size of the design: no other size can be better.
            if size is not None and found.score >= len(source) - 1 and placed.support > NEARLY * len(source):
                return placed
        if best is not None and best.support > NEARLY * len(source):
            break
    return best


def _turns(design: ReseauDesign, options: PlacingOptions) -> tuple[float, ...]:
    """Rotations of a mark (rad) that are tried; marks look the same after a quarter of a turn."""
    most = options.grid.rotations()[-1]
    if options.nominal is not None or most <= UPRIGHT or design.mark.shape in ("disk", "rod"):
        return (0.0,)
    return (0.0, np.pi / 8, -np.pi / 8, np.pi / 4)


def _despite_nominal(best: Placement | None, source: Array, options: PlacingOptions) -> Placement | None:
    """The position found from nominal positions, or a much better one that contradicts them."""
    assert options.nominal is not None
    n = len(source)
    if best is None:
        return None
    here, _ = settled(best.assignment, source, best.candidates, best.screened.valid)
    better = climbed(here, source, best.candidates, best.screened.valid)
    gain = better.support(best.candidates.t) - here.support(best.candidates.t)
    if better.score >= here.score + _BETTER * n or gain >= _OF_ROW * np.sqrt(n):
        best = replace(best, assignment=better)
    off = np.hypot(*np.median(best.assignment.predicted - options.nominal, axis=0))
    if off < 0.5 * spacing(options.nominal):
        return best
    text = (
        f"the nominal positions are wrong by about {off:.0f} px, more than half the distance of the marks: "
        "the names of the marks may be wrong by a row or a column"
    )
    return replace(best, notes=(Remark(text, Code.DEVIATES),))


def _sizes(source: Array, size: float | None, options: PlacingOptions) -> tuple[float, ...]:
    if options.mark_px is not None:
        return (options.mark_px,)
    if options.nominal is not None and size is not None:
        return (max(1.5, size * spacing(options.nominal) / spacing(source)),)
    return _TRIAL_PX


def _axes(design: ReseauDesign, source: Array, nominal: Array | None, turn: float) -> Array:
    """Linear mapping (2, 2) of unit determinant from a mark to its image, by nominal positions if known."""
    if nominal is None:
        c, s = np.cos(turn), np.sin(turn)
        return np.array([[c, -s], [s, c]])
    from_mean = source - source.mean(axis=0)
    linear = np.linalg.lstsq(from_mean, nominal - nominal.mean(axis=0), rcond=None)[0].T
    if design.mark.shape == "line-grid":
        linear = linear @ grid_wires(source).directions.mean(axis=0)
    size = abs(float(np.linalg.det(linear)))
    return np.asarray(linear / np.sqrt(size)) if size > 1e-12 else np.eye(2)


def _template(design: ReseauDesign, mark_px: float, psf_px: float, axes: Array) -> Array:
    """Formed image of a mark of this size, turned and sheared by `axes`."""
    mark, width = design.mark, mark_px
    if mark.shape == "cross" and mark.size and mark.line_width:
        width = mark_px * mark.line_width / mark.size
    half = int(np.ceil((1.5 * mark_px + 2 if mark.shape == "line-grid" else mark_px / 2) + 4))
    pixels = np.arange(-half, half + 1.0)
    outline = mark_outline(mark.shape, mark_px, width, 0.5 * psf_px, 2.0 * half)
    share = coverage(outline.affine(axes).oriented(), pixels, pixels, psf_px)
    return -share if design.polarity == "dark" else share


def _lay(
    source: Array,
    size: float | None,
    candidates: Candidates,
    screened: Screened,
    mark_px: float,
    options: PlacingOptions,
) -> Assignment | None:
    if options.nominal is not None:
        return assign(source, options.nominal, candidates, screened.valid, within_px=options.within_px)
    found = place_grid(source, candidates, screened.valid, options.grid)
    if found is None or size is None or options.mark_px is not None:
        return found
    # A pattern of the scene may fit the grid, but not with marks of another size than the design's.
    ratio = size * spacing(found.predicted) / spacing(source) / mark_px
    return found if 0.5 < ratio < 2.0 else None
