"""Where a design lies in a frame, and how large a mark is there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.data import Array, Frame
from ...core.failure import Code, Failure
from ...io import ReseauDesign
from ...optics.formation import coverage, mark_outline
from ..screening import Screened, screen
from .candidates import Candidates, find_candidates
from .grid import Assignment, GridOptions, assign, lay_out, spacing

__all__ = ["Placement", "PlacingOptions", "place"]

_TRIAL_PX = (3.0, 4.5, 6.5, 10.0, 15.0, 22.0)
"""Sizes of a mark in the image that are tried where nothing tells it."""


@dataclass(frozen=True)
class PlacingOptions:
    """What is known of a design in a frame.

    Parameters
    ----------
    nominal : ndarray (n, 2), optional
        Approximate positions in pixels.
    within_px : float, optional
        How far they may be off, where that is known.
    mark_px : float, optional
        Size of a mark in the image.
    psf_px : float
        Width of the point-spread function.
    grid : GridOptions
        What is known of the grid where there are no approximate positions.
    """

    nominal: Array | None
    within_px: float | None
    mark_px: float | None
    psf_px: float
    grid: GridOptions


@dataclass(frozen=True, eq=False)
class Placement:
    """A design laid over a frame.

    Parameters
    ----------
    screened : Screened
        The frame made ready.
    assignment : Assignment
        Marks with their candidates and the field through them.
    mark_px : float
        Size of a mark in the image, about; the width of the line for a line grid.
    """

    screened: Screened
    assignment: Assignment
    mark_px: float


def place(frame: Frame, design: ReseauDesign, source: Array, options: PlacingOptions) -> Placement | Failure:
    """Lay the design over the frame; the best of the sizes tried.

    Parameters
    ----------
    frame : Frame
        The frame.
    design : ReseauDesign
        What the marks look like.
    source : ndarray (n, 2)
        Plane coordinates of the marks.
    options : PlacingOptions
        What is known.

    Returns
    -------
    Placement or Failure
        A failure when the design is not to be found.

    Raises
    ------
    ImageError
        When the frame is all black, saturated, or of one grey.
    """
    mark = design.mark
    size = mark.line_width if mark.shape == "line-grid" else mark.size
    best: tuple[float, Placement] | None = None
    for mark_px in _sizes(source, size, options):
        screened = screen(frame, run=max(15, round(4 * mark_px)))
        template = _template(design, mark_px, options.psf_px)
        if len(template) > min(frame.pixels.shape):
            continue
        candidates = find_candidates(screened.grey, screened.valid, template)
        found = _lay(source, size, candidates, screened, mark_px, options)
        if found is None:
            continue
        strength = float(np.log1p(candidates.t[found.candidate[found.candidate >= 0]]).sum())
        if best is None or strength + found.score > best[0]:
            best = (strength + found.score, Placement(screened, found, mark_px))
        # Every mark, and as large as the design says: another size would say no better.
        if size is not None and found.score >= len(source) - 1:
            break
    marks = 0 if best is None else int((best[1].assignment.candidate >= 0).sum())
    least = max(4, min(10, len(source) // 3))
    if best is None or marks < least or best[1].assignment.score < -0.1 * len(source):
        return Failure(
            f"design {design.name!r} is not to be found in the frame of "
            f"{frame.width}×{frame.height} px ({marks} of {len(source)} marks lie as it says)",
            Code.NOT_FOUND,
            where=frame.name,
        )
    return best[1]


def _sizes(source: Array, size: float | None, options: PlacingOptions) -> tuple[float, ...]:
    if options.mark_px is not None:
        return (options.mark_px,)
    if options.nominal is not None and size is not None:
        return (max(1.5, size * spacing(options.nominal) / spacing(source)),)
    return _TRIAL_PX


def _template(design: ReseauDesign, mark_px: float, psf_px: float) -> Array:
    """Formed image of a mark of this size, upright."""
    mark, width = design.mark, mark_px
    if mark.shape == "cross" and mark.size and mark.line_width:
        width = mark_px * mark.line_width / mark.size
    half = int(np.ceil((1.5 * mark_px + 2 if mark.shape == "line-grid" else mark_px / 2) + 4))
    pixels = np.arange(-half, half + 1.0)
    outline = mark_outline(mark.shape, mark_px, width, 0.5 * psf_px, 2.0 * half)
    share = coverage(outline, pixels, pixels, psf_px)
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
    found = lay_out(source, candidates, screened.valid, options.grid)
    if found is None or size is None or options.mark_px is not None:
        return found
    # A pattern in the scene may fit the grid, but not with marks of another size than the design's.
    ratio = size * spacing(found.predicted) / spacing(source) / mark_px
    return found if 0.5 < ratio < 2.0 else None
