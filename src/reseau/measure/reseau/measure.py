"""Measure the marks of a reseau in one frame.

1. Screen the frame and find candidates by matched filter.
2. Fit the design to the candidates.
3. Match every mark with its formed image, twice: the first round estimates the appearance of the marks
   (width of the point-spread function, contrast, size); the second uses it as prior knowledge.
4. Test each mark by its own image and by its neighbours. A mark that is missing or not distinct from its
   surroundings is reported as not found, with the reason.

A sheet of disks with coded rings is found by its rings; see :mod:`reseau.measure.reseau.sheet`.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import scipy

from ...core.data import Array, Frame, Mask, Rows
from ...core.errors import UsageError
from ...core.failure import Code, Failure, Remark
from ...io import ReseauDesign
from ...optics.field import SmoothField, trend_degree
from ..fitting import on_one_line
from ..marks.judging import columns_of, spread
from ..matching import Matches
from ..mosaic import balanced
from ..points import Measured, Reason, deviating
from ..screening import lost_in_blocks
from .assignment import Assignment, assign, in_sight, spacing
from .grid_search import GridOptions, climbed, grid_steps
from .marks import TOO_WEAK, MarkMeasurement, ReseauOptions, Verdict
from .placement import Placement, PlacingOptions, place
from .sheet import measure_sheet
from .wires import cover, grid_wires

_COINCIDENT, _SYMMETRIC = 0.2, 0.5
"""Distance, in pitches, at which two marks are in one place; share of such marks in a symmetric design."""
_MIRROR = np.diag([1.0, -1.0])


def rival_orientations(
    source: Array, placed: Placement, options: GridOptions, lost: float
) -> list[tuple[str, Assignment]]:
    """Orientations in which about as many marks find a candidate, with their names.

    Parameters
    ----------
    source : ndarray (n, 2)
        Design coordinates.
    placed : Placement
        The position that was found.
    options : GridOptions
        What is known about the orientation.
    lost : float
        Score by which a rival may be lower.

    Returns
    -------
    list of (str, Assignment)
        The highest score first.
    """
    found, valid = placed.assignment, placed.screened.valid
    across = grid_wires(source).directions[:, :, 0].mean(axis=0)
    # Coordinates along and across the wires; the middle of the design stays where it is.
    axes = np.stack([across, [-across[1], across[0]]], axis=1) / np.hypot(*across)
    along = source @ axes
    middle = (along.min(axis=0) + along.max(axis=0)) / 2
    rivals = []
    for quarters, mirrored in itertools.product(range(4), (False, True)):
        if not (quarters or mirrored):
            continue
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
        change = np.array([[c, -s], [s, c]]) @ (_MIRROR if mirrored else np.eye(2))
        moved = ((along - middle) @ change.T + middle) @ axes.T
        if not _allowed(found.field.jacobian(source.mean(axis=0)[None])[0] @ axes @ change @ axes.T, options):
            continue
        near = scipy.spatial.KDTree(source).query(moved)[0] < _COINCIDENT * spacing(source)
        if near.mean() < _SYMMETRIC:
            continue
        rival = assign(source, found.field(moved), placed.candidates, valid, shifts=1)
        if rival is None:
            continue
        if (found.candidate < 0).sum() > found.missed + lost:
            # The frame shows a part of the design, and it may be another part.
            rival = climbed(rival, source, placed.candidates, valid)
        if rival.score >= found.score - lost:
            rivals.append((_name(quarters, mirrored), rival))
    return sorted(rivals, key=lambda rival: -rival[1].score)


def _allowed(linear: Array, options: GridOptions) -> bool:
    """Whether a linear mapping from design to image agrees with what is known of the orientation."""
    mirrored = bool(np.linalg.det(linear) < 0)
    if options.mirrored is not None and mirrored != options.mirrored:
        return False
    plain = linear @ _MIRROR if mirrored else linear
    turn = np.arctan2(plain[1, 0] - plain[0, 1], plain[0, 0] + plain[1, 1])
    return options.max_rotation is None or bool(abs(turn) <= options.max_rotation)


def _name(quarters: int, mirrored: bool) -> str:
    turned = f"turned by {90 * quarters}°" if quarters else ""
    return " and ".join(part for part in ("mirrored" if mirrored else "", turned) if part)


def misfit(source: Array, xy: Array, known: Mask) -> float:
    """Rms of measured positions (n, 2) about the smoothest mapping from the design; infinite for too few."""
    if known.sum() < 10:
        return float("inf")
    degree = trend_degree(int(known.sum()), most=3)
    return float(SmoothField.fit(source[known], xy[known], degree=degree, local=False).noise.max())


_ALIKE = 0.03
"""Share of the marks by which an orientation may explain fewer and still count as a rival."""
_ORIENTATIONS = 3
"""Largest number of orientations that are tried one after the other; the second is the best of all."""
_UNEVEN = 0.5
"""Ratio of the deviations from a smooth mapping below which an uneven grid shows its orientation."""
_FEW, _SAME = 10, 0.2
"""Marks that predict a further row of the grid; distance, in pitches, of two marks at one place."""
_CLEARLY = 0.6
"""Share of the visible marks from which nobody doubts that they are those of the design."""
_LEGIBLE = 0.25
"""Least share of the visible marks in a compressed image: where most are lost, others have other shapes."""
_BY_CHANCE = 1e-5
"""Largest probability that as many marks are found where there are none; many positions were tried."""
_DISTORTED = 0.03
"""Largest rms deviation of marks from their prediction, as a share of their spacing."""
_BEYOND, _MOST = 0.05, 0.75
"""Share of nominal positions beyond the frame, and share of marks found, from which they are doubted."""
_BLURRED, _PIXEL = 2.6, 12**-0.5
"""Margin of a shadow over the width of the blur; width (one sigma) of a pixel."""


@dataclass(frozen=True, eq=False, repr=False)
class ReseauResult(Measured):
    """Marks of a reseau in one frame; `deviation` is from the prediction by all other marks.

    Parameters
    ----------
    psf_px : ndarray (n,)
        Width of the point-spread function of each match, NaN where there was none.
    field : SmoothField
        Smooth mapping from the design to the image: a polynomial with a local model on top.
    notes : tuple of Remark
        Notes for the user.

    Examples
    --------
    >>> plane = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0], [5.0, 5.0]])
    >>> ok, one = np.array([True, True, True, True, False]), np.ones(5)
    >>> xy = np.where(ok[:, None], 4 * plane + 20, np.nan)
    >>> why = (*[""] * 4, Reason("covered by a reflection", Code.HIDDEN))
    >>> columns = [xy, np.tile(1e-4 * np.eye(2), (5, 1, 1)), ok, why]
    >>> field = SmoothField.fit(plane, 4 * plane + 20, degree=1, local=False)
    >>> found = ReseauResult("a.tif", "", tuple("OSTUV"), *columns, field(plane), 0 * xy, *[one] * 4, field)
    >>> found.points.names, found.predicted[4].round(6), found.codes[4]
    (('O', 'S', 'T', 'U'), array([40., 40.]), <Code.HIDDEN: 'hidden'>)
    """

    psf_px: Array
    field: SmoothField
    notes: tuple[Remark, ...] = ()

    def need(self, trials: int = 499, seed: int = 0) -> Array:
        """Probability, per axis (2,), that white noise alone would require an equally strong local model."""
        f = self.field
        return SmoothField.fit(f.source, f.target, sigma=f.sigma, trials=trials, seed=seed).need

    def shadow(self, design: ReseauDesign, shape: tuple[int, int], margin_px: float | None = None) -> Mask:
        """Mask of the pixels that the reseau hides from what lies behind it.

        Parameters
        ----------
        design : ReseauDesign
            The reseau that was measured.
        shape : tuple
            Height and width of the frame.
        margin_px : float, optional
            Margin on either side of a wire or around a mark, for the blur; by default 2.6 times its width
            (one sigma) in the image of the marks, beyond which half a per cent of an edge remains.

        Returns
        -------
        ndarray (h, w) of bool
        """
        hidden = np.zeros(shape, dtype=np.uint8)
        xy = design.xy[np.isfinite(design.xy).all(axis=1)]
        scale = np.sqrt(np.abs(np.linalg.det(self.field.jacobian(xy)))).max()
        mark = design.mark
        size = (mark.line_width if mark.shape == "line-grid" else mark.size) or 0.0
        if margin_px is None:
            blur = np.nanmedian(self.psf_px) if np.isfinite(self.psf_px).any() else 0.0
            margin_px = _BLURRED * float(np.hypot(blur, _PIXEL))
        if mark.shape != "line-grid":
            width = max(1, round(scale * size + 2 * margin_px))
            for centre in self.field(xy):
                cv2.circle(hidden, tuple(int(c) for c in np.rint(centre)), (width + 1) // 2, 1, -1)
            return hidden > 0
        wires, reach = grid_wires(xy), scale * size / 2 + margin_px
        for family, chains in enumerate(wires.marks):
            for chain in chains:
                ends = xy[chain[[0, -1]]]
                # Through its marks: a wire may be bowed.
                places = np.linspace(0, len(chain) - 1, 120)
                inner = scipy.interpolate.make_interp_spline(
                    np.arange(len(chain)), xy[chain], k=min(3, len(chain) - 1)
                )(places)
                # Wires extend to their frame; there the field is continued along its tangent.
                beyond = (
                    np.hypot(*(ends[1] - ends[0])) / (len(chain) - 1) * wires.directions[chain[0], :, family]
                )
                outer = (self.field.jacobian(ends) @ beyond) * [[-1.0], [1.0]]
                line = self.field(inner)
                line = np.concatenate([line[:1] + outer[:1], line, line[-1:] + outer[1:]])
                cover(hidden, line, reach)
        return hidden > 0


def measure_reseau(
    frame: Frame, design: ReseauDesign, options: ReseauOptions | None = None
) -> ReseauResult | Failure:
    """Measure every mark of a reseau that can be measured.

    Parameters
    ----------
    frame : Frame
        A frame that shows the reseau, whole or in part, in front of any scene. A sheet of disks with coded
        rings may be rotated and tilted by any angle.
    design : ReseauDesign
        The reseau, with or without nominal positions in the image.
    options : ReseauOptions, optional
        Options of the measurement.

    Returns
    -------
    ReseauResult or Failure
        A failure (falsy) if the design is not found in the frame.

    UsageError
        When the design has neither coordinates nor nominal positions, or all its points lie on one line.

    Notes
    -----
    Derived in ``docs/mathematics/reseau.md``.

    Examples
    --------
    Form an image of dark disks and measure their centres:

    >>> import numpy as np
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> from reseau.optics.formation import Outline, draw
    >>> design = regular_reseau(5, 4, 10.0, Mark(shape="disk", size=2.0))
    >>> centres = design.xy * [2.0, -2.0] + [60, 50]
    >>> disk = Outline.circle(2.0, 0.5)
    >>> outlines = Outline(centres[:, None] + disk.xy, np.broadcast_to(disk.dxy, (20, *disk.dxy.shape)))
    >>> grey = 200 * (1 - 0.7 * draw(outlines, (100, 120), 0.8))
    >>> grey += np.random.default_rng(0).normal(0, 1, grey.shape)
    >>> found = measure_reseau(Frame(grey, 255.0), design, ReseauOptions(mark_px=4.0))
    >>> found.found, bool(np.abs(found.xy - centres).max() < 0.05)
    (20, True)
    """
    options, frame = options or ReseauOptions(), balanced(frame)
    source = _source(design)
    known = np.flatnonzero(np.isfinite(source).all(axis=1))
    if len(known) < 4:
        raise UsageError("has fewer than four points with coordinates", where=f"design {design.name}")
    if on_one_line(source[known]):
        raise UsageError(
            "has all its points on one line: at least one beside it is needed", where=f"design {design.name}"
        )
    nominal = design.nominal_px[known]
    use_nominal = options.nominal and bool(np.isfinite(nominal).all())
    if options.mirrored and not use_nominal:
        # The image, with y down, and the reflected design, with y up, have opposite handedness.
        behind = measure_reseau(frame, design.from_behind(), replace(options, mirrored=False))
        return behind if isinstance(behind, Failure) else replace(behind, field=_reflected(behind.field))
    if design.rings is not None and not use_nominal:
        columns = measure_sheet(frame, design, options)
        return columns if isinstance(columns, Failure) else ReseauResult(**columns)
    most = options.max_rotation_deg
    grid = GridOptions(
        None if most is None else float(np.deg2rad(most)), None if options.mirrored is None else True
    )
    placed = place(
        frame,
        design,
        source[known],
        PlacingOptions(
            nominal if use_nominal else None,
            options.nominal_within_px,
            options.mark_px,
            options.psf_px,
            grid,
        ),
    )
    if isinstance(placed, Failure):
        return placed
    lost = lost_in_blocks(frame.pixels)
    measurement = MarkMeasurement(frame, design, source[known], placed, options, lost)
    at, found, judged = measurement.result()
    notes = placed.notes
    for _ in range(0 if use_nominal else _ORIENTATIONS):
        placed, oriented = _oriented(source[known], placed, judged, grid)
        if placed is measurement.placed:
            placed = _as_best_part(source[known], placed, judged)
        if placed is measurement.placed:
            notes += oriented
            break
        measurement = MarkMeasurement(frame, design, source[known], placed, options, lost)
        at, found, judged = measurement.result()
    if not use_nominal or _beyond(frame, nominal):
        notes += _open_names(source[known], judged, placed.screened.valid)
    why_not = _disagreement(source[known], judged, options) or _chance(measurement, at, judged)
    if why_not:
        return Failure(
            f"design {design.name!r} was not found in the frame: {why_not}",
            Code.NOT_FOUND,
            where=frame.name,
            places=judged.xy[judged.why == ""],
        )
    good = np.where((judged.why == "")[:, None], judged.xy, np.nan)
    notes += deviating([design.ids[i] for i in known], source[known], good, judged.cov)
    result = _columns(frame, design, known, at, found, judged, measurement.field, notes)
    if use_nominal and options.nominal_within_px is None and _astray(frame, result, nominal):
        return _without_nominal(frame, design, result, options)
    return result


def _beyond(frame: Frame, nominal: Array) -> bool:
    """Whether nominal positions (n, 2) lie beyond the frame: they may be those before it was cropped."""
    margin, limits = 0.5 * spacing(nominal), np.array([frame.width, frame.height]) - 1
    return bool(((nominal < -margin) | (nominal > limits + margin)).any(axis=1).mean() > _BEYOND)


def _astray(frame: Frame, found: ReseauResult, nominal: Array) -> bool:
    """Whether the nominal positions (n, 2) seem to be those of another image."""
    if all(note.code is not Code.INCONSISTENT for note in found.notes):
        return False
    return _beyond(frame, nominal) or found.found < _MOST * len(found.ids)


def _without_nominal(
    frame: Frame, design: ReseauDesign, found: ReseauResult, options: ReseauOptions
) -> ReseauResult:
    """The marks as found without the nominal positions, if those are where an uneven design has them.

    Of marks whose names are ambiguous without nominal positions, these positions are the only evidence.
    """
    freely = measure_reseau(frame, design, replace(options, nominal=False))
    if isinstance(freely, Failure) or freely.found < _CLEARLY * found.found:
        return found
    if any(note.code is Code.AMBIGUOUS for note in freely.notes):
        return found
    rms, before = (np.sqrt(np.nanmean(each.deviation**2)) for each in (freely, found))
    if not rms < _UNEVEN * before:
        return found
    text = (
        "the nominal positions do not agree with the image, and were not used: without them "
        f"{freely.found} marks deviate by {rms:.2g} px from the prediction by the others, with them "
        f"{found.found} by {before:.2g} px"
    )
    return replace(freely, notes=(Remark(text, Code.DEVIATES), *freely.notes))


def _reflected(field: SmoothField) -> SmoothField:
    """The mapping from a design to the image, from that of the design as seen from behind."""
    local = bool(np.isfinite(field.length))
    return SmoothField.fit(
        field.source * [-1.0, 1.0],
        field.target,
        sigma=field.sigma,
        degree=field.degree,
        local=local,
        length=field.length if local else None,
    )


def _disagreement(source: Array, judged: Verdict, options: ReseauOptions) -> str:
    """Why the measured marks are not those of this design; empty if they agree with it.

    Single specks and patterns of a scene look like marks. Among many of them the design finds some near its
    marks, but no smooth field fits these.
    """
    good = np.flatnonzero(judged.why == "")
    if len(good) < 4:
        return f"{len(good)} marks could be measured"
    if np.isfinite(judged.deviation[good]).all():
        off = np.sqrt((judged.deviation[good] ** 2).mean(axis=0)).max()
    elif len(good) > 4:  # too few to predict each other, but enough to test a plane mapping
        off = SmoothField.fit(source[good], judged.xy[good], degree=1, local=False).noise.max()
    else:
        return ""
    # A few marks of a strongly distorted image do not predict each other to one pixel.
    if off <= max(options.neighbour_px, _DISTORTED * spacing(judged.predicted)):
        return ""
    return f"{len(good)} places look like its marks, but deviate by {off:.1f} px from each other's prediction"


def _oriented(
    source: Array, placed: Placement, judged: Verdict, grid: GridOptions
) -> tuple[Placement, tuple[Remark, ...]]:
    """The orientation that fits the measured marks best, and a note if others fit as well."""
    good = judged.why == ""
    place = np.full(len(placed.candidates), -1)
    has = placed.assignment.candidate >= 0
    place[placed.assignment.candidate[has]] = np.flatnonzero(has)
    chosen = misfit(source, judged.xy, good)
    alike = []
    for name, rival in rival_orientations(source, placed, grid, _ALIKE * len(source)):
        # The rival gives other names to the same measured marks.
        same = np.where(rival.candidate >= 0, place[rival.candidate], -1)
        known = (same >= 0) & good[same]
        fit = misfit(source, judged.xy[same], known)
        clearly = rival.score > placed.assignment.score + _ALIKE * len(source)
        if fit < _UNEVEN * chosen or (clearly and fit < 2 * chosen):
            return replace(placed, assignment=rival), ()
        if chosen >= _UNEVEN * fit:
            alike.append(name)
    if not alike:
        return placed, ()
    others = ", ".join(alike[:-1]) + (" or " if len(alike) > 1 else "") + alike[-1]
    text = (
        f"the orientation is ambiguous: {others}, the design fits as well; its names are those of the "
        "upright one (give nominal positions, or say whether it is mirrored and how far it may be turned: "
        "--not-mirrored, --max-rotation-deg)"
    )
    return placed, (Remark(text, Code.AMBIGUOUS),)


def _as_best_part(source: Array, placed: Placement, judged: Verdict) -> Placement:
    """The placement by another part of a regular grid, where that fits the measured marks better."""
    rival = _another_part(source, judged, placed.screened.valid)
    if rival is None or rival.fit >= _UNEVEN * rival.chosen:
        return placed
    named = assign(source, rival.field(source), placed.candidates, placed.screened.valid, shifts=1)
    return placed if named is None else replace(placed, assignment=named)


def _open_names(source: Array, judged: Verdict, valid: Mask) -> tuple[Remark, ...]:
    """A note where the frame shows a part of a regular grid, and it may be another part."""
    if _another_part(source, judged, valid) is None:
        return ()
    text = (
        f"the frame shows {int((judged.why == '').sum())} of {len(source)} marks of a regular grid, and "
        "shifted by a step they fit as well: names may be off by a row or column (give nominal "
        "positions of this frame)"
    )
    return (Remark(text, Code.AMBIGUOUS),)


class _Part(NamedTuple):
    """Another part of a grid: where its marks are, its misfit, and that of the chosen part."""

    field: SmoothField
    fit: float
    chosen: float


def _another_part(source: Array, judged: Verdict, valid: Mask) -> _Part | None:
    """The part of a regular grid, shifted by a step, that fits the measured marks best and about as well."""
    good = judged.why == ""
    if good.sum() < _FEW or good.all():
        return None
    chosen = misfit(source, judged.xy, good)
    best: _Part | None = None
    tree, pitch = scipy.spatial.KDTree(source), spacing(source)
    # Where a row in the frame is not seen, the picture ends there, and another one may be missing, too.
    missed = 2 * int((in_sight(judged.predicted, valid) & ~good).sum())
    for step in grid_steps(source):
        distance, row = tree.query(source[good] - step)
        if (distance > _SAME * pitch).any():
            continue  # a measured mark would have no name
        renamed = np.full_like(judged.xy, np.nan)
        renamed[row] = judged.xy[good]
        known: Mask = np.asarray(np.isfinite(renamed).all(axis=1))
        field = SmoothField.fit(source[known], renamed[known], local=False)
        missing = int((in_sight(field(source), valid) & ~known).sum())
        fit = misfit(source, renamed, known)
        if missing <= missed + _ALIKE * len(source) and fit < (
            chosen / _UNEVEN if best is None else best.fit
        ):
            best = _Part(field, fit, chosen)
    return best


def _chance(measurement: MarkMeasurement, at: Rows, judged: Verdict) -> str:
    """Why the measured marks may be there by chance; empty if they cannot.

    Where only some of the marks were found, the same measurement is made beside them: in a picture of
    something else, as many places there look like marks.
    """
    good = int((judged.why == "").sum())
    visible = at[[why == "" or getattr(why, "code", None) != Code.OUTSIDE for why in judged.why[at]]]
    if good > _CLEARLY * len(visible):
        return ""
    if good < _LEGIBLE * len(visible) and (judged.why[visible] == TOO_WEAK).any():
        return f"the compression of the image has left {good} of {len(visible)} marks"
    passed, tried = measurement.found_by_chance(visible)
    share = (passed + 1) / (tried + 2)
    if scipy.special.bdtrc(good - 1, len(visible), share) < _BY_CHANCE:
        return ""
    return f"{good} of {len(visible)} places look like its marks, and {passed} of {tried} where it has none"


def _source(design: ReseauDesign) -> Array:
    """Plane coordinates of the design, or its nominal positions if it has none."""
    if np.isfinite(design.xy).all(axis=1).sum() >= 4:
        return design.xy
    return design.nominal_px


def _columns(
    frame: Frame,
    design: ReseauDesign,
    known: Rows,
    at: Rows,
    found: Matches,
    judged: Verdict,
    field: SmoothField,
    notes: tuple[Remark, ...],
) -> ReseauResult:
    """Spread results over all marks of the design, including those without coordinates."""
    n, at = len(design.points), known[at]
    reasons = Reason("the design has no coordinates of it", Code.NO_COORDINATES).repeated(n)
    reasons[known] = judged.why
    return ReseauResult(
        image=frame.name,
        sha256=frame.sha256,
        ids=design.ids,
        predicted=spread(judged.predicted, known, n),
        deviation=spread(judged.deviation, known, n),
        field=field,
        notes=notes,
        **columns_of(found, at, reasons[at], reasons),
    )
