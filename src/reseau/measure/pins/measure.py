"""Measure the rods of a design in one frame: find echoes, identify them by the pattern, test them by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from ...core.data import Array, Frame, Mask, Rows
from ...core.errors import UsageError
from ...core.failure import Code, Failure, Remark
from ...io import ReseauDesign, ReseauMeasurement
from ...optics.field import SmoothField, trend_degree
from ..marks.judging import robust_spread
from ..points import Measured, Reason, deviating
from .detection import PinDetections, PinOptions, find_pins
from .wires import Layout, LayoutOptions, Wires, lay_wires

if TYPE_CHECKING:
    from ...core.overlay import Layer


_GROSS = 0.05
"""Share of rods beside whose place something else is seen."""
_ROUNDS = 12
"""Rounds of fitting the field and assigning echoes with it; usually six suffice."""
_FEWEST = 5
"""Minimum number of rods that test a field."""
_LOCAL = 20
"""Minimum number of rods from which a field is more than a polynomial."""


@dataclass
class Assignment:
    """Echoes of rods, and the field that they show.

    Parameters
    ----------
    row : ndarray of int (n,)
        Index of the echo of each rod, -1 where there is none.
    predicted : ndarray (n, 2)
        Places of the rods in the image.
    deviation : ndarray (n, 2)
        Echo minus its prediction by all other rods; NaN where there is none.
    excluded : dict of int to float
        Rods beside whose place something else is seen, and its distance, pixels.
    """

    row: Rows
    predicted: Array
    deviation: Array
    excluded: dict[int, float] = field(default_factory=dict)


def assign(
    source: Array, xy: Array, cov: Array, row: Rows, predicted: Array, gate_px: float, tolerance_px: Array
) -> Assignment:
    """Assign echoes to rods.

    Parameters
    ----------
    source : ndarray (n, 2)
        Rods in the design.
    xy, cov : ndarray (m, 2), (m, 2, 2)
        Echoes.
    row, predicted : ndarray (n,), (n, 2)
        First assignment, -1 for none, and first places of the rods.
    gate_px : float
        Search distance.
    tolerance_px : ndarray (n,)
        Standard deviation of each rod in the design, in pixels.

    Examples
    --------
    A rod whose echo is hidden does not take what lies 12 px beside its place:

    >>> rods = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2) * 100
    >>> echoes = rods + 0.00002 * rods**2
    >>> echoes[7] += [0.0, 12.0]
    >>> cov, none = np.tile(0.01 * np.eye(2), (20, 1, 1)), np.zeros(20)
    >>> found = assign(rods, echoes, cov, np.arange(20), rods, 20.0, none)
    >>> np.flatnonzero(found.row < 0), round(found.excluded[7])
    (array([7]), 12)
    """
    found = Assignment(row.copy(), predicted, np.full(source.shape, np.nan))
    own = np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2)
    sigma, degree, before = gate_px / 2, 1, (-1, row)
    for _ in range(_ROUNDS):
        has = np.flatnonzero(found.row >= 0)
        if len(has) < _FEWEST:
            return found
        degree = max(1, min(degree, trend_degree(len(has)), 3))
        trend = SmoothField.fit(source[has], xy[found.row[has]], degree=degree, local=False)
        found.predicted = trend(source)
        rest = xy[found.row[has]] - found.predicted[has]
        free = 1 - (degree + 1) * (degree + 2) / 2 / len(has)
        scatter = robust_spread(rest, 0.0) / np.sqrt(max(free, 0.1))
        sigma = max(scatter, float(np.median(own[found.row[has]])), sigma / 2)
        found.row = _likeliest(found.predicted, xy, cov, np.full(len(source), sigma), gate_px, tolerance_px)
        if degree == before[0] and (found.row == before[1]).all() and sigma <= 2 * scatter:
            break
        before, degree = (degree, found.row), degree + 1
    _settled(found, source, xy, cov, gate_px, tolerance_px)
    others = xy[np.setdiff1d(np.arange(len(xy)), found.row)]
    for rod in np.flatnonzero(found.row < 0):
        off = np.hypot(*(others - found.predicted[rod]).T)
        if len(off) and off.min() < gate_px:
            found.excluded[int(rod)] = float(off.min())
    return found


def _settled(
    found: Assignment, source: Array, xy: Array, cov: Array, gate_px: float, tolerance_px: Array
) -> None:
    """Assign with the field of all others, which is more than a polynomial."""
    for _ in range(_ROUNDS):
        has = np.flatnonzero(found.row >= 0)
        if len(has) < _FEWEST:
            return
        degree = max(1, min(3, trend_degree(len(has))))
        smooth = SmoothField.fit(source[has], xy[found.row[has]], degree=degree, local=len(has) >= _LOCAL)
        found.predicted = smooth(source)
        found.deviation[:] = np.nan
        found.deviation[has], spread = smooth.leave_one_out()
        wide = np.sqrt((spread**2).mean(axis=1))
        worst = _worst(found.deviation[has], cov[found.row[has]], wide, gate_px, tolerance_px[has])
        if worst >= 0:
            found.row[has[worst]] = -1
            found.deviation[has[worst]] = np.nan
            continue
        scatter = np.full(len(source), np.quantile(wide, 0.9))
        scatter[has] = wide
        again = _likeliest(found.predicted, xy, cov, scatter, gate_px, tolerance_px)
        gained = (found.row < 0) & (again >= 0) & ~np.isin(again, found.row)
        if not gained.any():
            return
        found.row[gained] = again[gained]


def _worst(deviation: Array, cov: Array, sigma: Array, gate_px: float, tolerance_px: Array) -> int:
    """The rod that is most likely a gross error; -1 for none."""
    total = cov + (sigma**2 + tolerance_px**2)[:, None, None] * np.eye(2)
    odds = _misfit(deviation, total) - _limit(total, gate_px)
    return int(odds.argmax()) if odds.max() > 0 else -1


def _likeliest(
    predicted: Array, xy: Array, cov: Array, sigma: Array, gate_px: float, tolerance_px: Array
) -> Rows:
    """The echoes (n,) of the rods with the largest likelihood of all, -1 for none."""
    row = np.full(len(predicted), -1)
    off = xy[None] - predicted[:, None]
    near = np.hypot(off[..., 0], off[..., 1]) < gate_px
    rods, echoes = np.nonzero(near)
    if not len(rods):
        return row
    total = cov[echoes] + (sigma[rods] ** 2 + tolerance_px[rods] ** 2)[:, None, None] * np.eye(2)
    gain: Array = np.zeros(near.shape)
    gain[rods, echoes] = np.maximum(_limit(total, gate_px) - _misfit(off[rods, echoes], total), 0)
    mine, theirs = scipy.optimize.linear_sum_assignment(-gain)
    taken: Mask = gain[mine, theirs] > 0
    row[mine[taken]] = theirs[taken]
    return row


def _misfit(off: Array, cov: Array) -> Array:
    """Half of the weighted squares of offsets (k, 2)."""
    return np.asarray(0.5 * np.einsum("ki,ki->k", off, np.linalg.solve(cov, off[..., None])[..., 0]))


def _limit(cov: Array, gate_px: float) -> Array:
    """The same (k,) from which anything within the search distance is as likely."""
    share = (1 - _GROSS) / _GROSS * gate_px**2 / (2 * np.sqrt(np.linalg.det(cov)))
    return np.asarray(np.log(np.maximum(share, 1.0)))


_BEYOND = 0.05
"""A wire may be seen beyond the ends of its segment by this share of its length: its design is not exact. Its
uncertainty may add as much again."""
_CLEARER = 3.0
"""Factor by which another echo must be farther from a segment than the one that is taken."""
_LEAST = 4
"""Minimum number of points that test an affinity; three define one."""


@dataclass(frozen=True, eq=False)
class Cuts:
    """Echoes on segments, in columns.

    Parameters
    ----------
    row : ndarray of int (k,)
        Index of the echo on each segment, -1 where there is none.
    share, sigma : ndarray (k,)
        Position of the echo on the segment, 0 at its start and 1 at its end, and its standard deviation; NaN
        where there is none.
    ends : ndarray (k, 2, 2)
        Ends of the segments in the image; NaN if their places are unknown.
    why : tuple of str (k,)
        Why a segment has no echo; empty where it has one.
    """

    row: Rows
    share: Array
    sigma: Array
    ends: Array
    why: tuple[str, ...]


def cut_segments(
    segments: Array, xy: Array, cov: Array, source: Array, target: Array, gate_px: float
) -> Cuts:
    """Assign echoes to segments, and determine the shares at which they are cut.

    Parameters
    ----------
    segments : ndarray (k, 2, 2)
        Ends of the segments in the plane of the design.
    xy, cov : ndarray (m, 2), (m, 2, 2)
        Echoes that belong to no point of the design (px, px²).
    source, target : ndarray (f, 2)
        Points of the design that were found, and their echoes (px).
    gate_px : float
        Largest distance of an echo from its segment.

    Examples
    --------
    >>> source = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 15.0], [30.0, 15.0]])
    >>> segment, echo = np.array([[[0.0, 0.0], [30.0, 0.0]]]), np.array([[36.0, 0.2]])
    >>> cuts = cut_segments(segment, echo, 1e-4 * np.eye(2)[None], source, 3 * source, 5.0)
    >>> cuts.row, cuts.share.round(3)
    (array([0]), array([0.4]))
    """
    count = len(segments)
    none = np.full(count, np.nan)
    row = np.full(count, -1)
    if len(source) < _LEAST:
        unknown = Reason(f"fewer than {_LEAST} parallel wires determine its place", Code.TOO_FEW_POINTS)
        return Cuts(row, none, none, np.full((count, 2, 2), np.nan), (unknown,) * count)
    design = np.column_stack([source, np.ones(len(source))])
    inverse = np.linalg.pinv(design)
    matrix = np.asarray(inverse @ target)
    rest = target - design @ matrix
    scatter = float((rest**2).sum() / (2 * (len(source) - 3)))
    ends = segments @ matrix[:2] + matrix[2]
    along = ends[:, 1] - ends[:, 0]
    length = np.hypot(*along.T)
    unit = along / length[:, None]
    offset = xy[None] - ends[:, :1]
    share = (offset * unit[:, None]).sum(axis=-1) / length[:, None]
    across = np.abs(offset[..., 0] * unit[:, None, 1] - offset[..., 1] * unit[:, None, 0])
    # The points tell how well an echo agrees with the affinity, in x and y alike; the point predicted on the
    # segment is that much less certain.
    at = segments[:, :1] + share[..., None] * (segments[:, 1] - segments[:, 0])[:, None]
    lever = np.concatenate([at, np.ones((*at.shape[:2], 1))], axis=-1) @ inverse
    own = np.einsum("ki,mij,kj->km", unit, cov, unit)
    sigma = np.sqrt(np.maximum(own, scatter) + scatter * (lever**2).sum(axis=-1)) / length[:, None]
    beyond = np.abs(share - np.clip(share, 0, 1)) > _BEYOND + np.minimum(3 * sigma, _BEYOND)
    cost = np.where(beyond | (across > gate_px), 2.0, across / gate_px)
    why = Reason("no echo on its segment", Code.NOT_FOUND).repeated(count)
    mine, theirs = scipy.optimize.linear_sum_assignment(cost) if xy.size else (row[:0], row[:0])
    for wire, echo in zip(mine, theirs, strict=True):
        if cost[wire, echo] > 1:
            continue
        others = np.setdiff1d(np.flatnonzero(cost[wire] <= 1), theirs)
        if len(others) and cost[wire, others].min() < _CLEARER * max(float(cost[wire, echo]), 0.1):
            why[wire] = Reason(f"{len(others) + 1} echoes lie on its segment", Code.AMBIGUOUS)
            continue
        row[wire], why[wire] = echo, ""
    found = row >= 0
    taken = (np.flatnonzero(found), row[found])
    picked, spread = none.copy(), none.copy()
    picked[found], spread[found] = share[taken], sigma[taken]
    return Cuts(row, picked, spread, ends, tuple(why))


_AMBIGUOUS = Remark(
    "the design is symmetric and fits in more than one way; the upright one with y up was chosen",
    Code.AMBIGUOUS,
)
_BESIDE_PX = 3.0
"""Minimum distance from the centre line of an echo within which another rod counts as covered by it."""
_FLAT = 1e-3
"""Least extent of a design across, relative to that along."""
_COLUMNS = (
    "contrast",
    "t",
    "noise",
    "correlation",
    "strength",
    "length",
    "thickness",
    "curvature",
    "tilt",
    "reach",
    "shared",
)


@dataclass(frozen=True, eq=False, repr=False)
class PinResult(Measured):
    """Rods of a design in one frame: y is measured on the line, x at its centre.

    `deviation` is from the prediction by all other rods (leave-one-out).

    Parameters
    ----------
    correlation, strength, length, thickness, curvature, tilt : ndarray (n,)
        As in :class:`reseau.measure.pins.PinDetections`; NaN where not measured.
    detections : PinDetections
        All spots of the frame.
    notes : tuple of Remark
        Notes for the user.
    share, share_sigma : ndarray (n,), optional
        Where the image plane cuts slanted wires, 0 at the start of a segment and 1 at its end, and its
        standard deviation; NaN for others. None for a design without slanted wires.
    segments_px : ndarray (n, 2, 2), optional
        Ends of the slanted wires in the image.
    reach, shared : ndarray (n,) and (n, 2, k), optional
        As in :class:`reseau.measure.pins.PinDetections`; NaN where not measured.

    Examples
    --------
    >>> xy, one = np.array([[40.1, 40.2], [np.nan, np.nan]]), np.array([1.0, np.nan])
    >>> cov, why = 1e-4 * one[:, None, None] * np.eye(2), ("", Reason("no echo", Code.NOT_FOUND))
    >>> spots = PinDetections("screen.png", "", xy, cov, one > 0, why, *[one] * 9, xy)
    >>> measured = [xy, cov, one > 0, why, xy, 0.01 * xy, *[one] * 3]
    >>> found = PinResult("screen.png", "", ("R1", "R2"), *measured, *[one] * 6, spots)
    >>> found.found, found.points.names, found.codes[1]
    (1, ('R1',), <Code.NOT_FOUND: 'not-found'>)
    """

    correlation: Array
    strength: Array
    length: Array
    thickness: Array
    curvature: Array
    tilt: Array
    detections: PinDetections
    notes: tuple[Remark, ...] = ()
    share: Array | None = None
    share_sigma: Array | None = None
    segments_px: Array | None = None
    reach: Array | None = None
    shared: Array | None = None

    def _columns(self) -> dict[str, list[Any]]:
        columns = super()._columns()
        if self.share is None or self.share_sigma is None:
            return columns
        return columns | {"share": self.share.tolist(), "share_sigma": self.share_sigma.tolist()}

    def measurement(self) -> ReseauMeasurement:
        """The result as a document."""
        found = super().measurement()
        if self.share is None or self.share_sigma is None:
            return found
        shared = zip(found.points, self.share.tolist(), self.share_sigma.tolist(), strict=True)
        points = tuple(
            point.model_copy(update={"share": t, "s_share": s}) if t == t else point for point, t, s in shared
        )
        return found.model_copy(update={"points": points})

    def layers(self) -> list[Layer]:
        """Rods, then echoes and rejected spots that belong to none."""
        from ...core.overlay import OTHER, Layer

        seen, known = self.detections, self.xy[self.ok]
        apart = np.hypot(*np.moveaxis(seen.xy[:, None] - known, -1, 0)).min(axis=1, initial=np.inf)
        other = seen.ok & (apart > 0)
        layers = super().layers()
        if self.segments_px is not None:
            lines = self.segments_px[np.isfinite(self.segments_px).all(axis=(1, 2))]
            layers.insert(
                0, Layer("slanted wires", np.empty((0, 2)), symbol="_", colour=OTHER, paths=tuple(lines))
            )
        if other.any():
            layers.append(Layer(f"echoes of no rod, {int(other.sum())}", seen.xy[other], colour=OTHER))
        rest = np.flatnonzero(~seen.ok)
        kinds, count = np.unique([str(seen.codes[i] or Code.DECLINED) for i in rest], return_counts=True)
        reasons = ", ".join(f"{kind} {number}" for kind, number in zip(kinds, count, strict=True))
        rejected = Layer(
            f"spots that are no echoes, {len(rest)}: {reasons}", seen.xy[rest], symbol="1", colour=OTHER
        )
        return [*layers, rejected] if len(rest) else layers


def measure_pins(
    frame: Frame,
    design: ReseauDesign,
    options: PinOptions | None = None,
    others: Sequence[Frame] = (),
    hidden: Mask | None = None,
) -> PinResult | Failure:
    """Measure every rod of a test object that can be measured.

    Parameters
    ----------
    frame : Frame
        A frame that shows the echoes of the rods, bright on a dark background.
    design : ReseauDesign
        The rods, with or without nominal positions in the image. Slanted wires, which have segments, are
        found by means of the others.
    options : PinOptions, optional
        Options of the measurement.
    others : sequence of Frame
        Other frames of the sequence, see :func:`reseau.measure.find_pins`.
    hidden : ndarray (h, w) of bool, optional
        Pixels covered by the wires of a reseau, if known.

    Returns
    -------
    PinResult or Failure
        A failure (falsy) if the pattern of the rods is not found among the echoes.

    UsageError
        When the marks of the design are not rods, or fewer than four have coordinates.

    Notes
    -----
    Derived in ``docs/mathematics/pins.md``.

    Examples
    --------
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> from reseau.optics import Arcs
    >>> rods = regular_reseau(4, 2, 10.0, Mark(shape="rod", size=1.0), polarity="bright")
    >>> centres = rods.xy * [3.0, -3.0] + [55.0, 40.0]
    >>> arcs = Arcs(*np.repeat([[6.0], [2.0], [0.01], [0.0]], 8, axis=1))
    >>> light = arcs.image(centres, np.tile(np.arange(110.0), (8, 1)), np.tile(np.arange(80.0), (8, 1)))
    >>> grey = 20 + 150 * light.sum(axis=0) + np.random.default_rng(0).normal(0, 1, (80, 110))
    >>> found = measure_pins(Frame(grey, 255.0), rods)
    >>> found.found, bool(abs(found.xy - centres).max() < 0.05), found.notes[0].code
    (8, True, <Code.AMBIGUOUS: 'ambiguous'>)
    """
    o = options or PinOptions()
    if design.mark.shape != "rod":
        raise UsageError(
            f"has marks of the shape {design.mark.shape!r}",
            where=f"design {design.name}",
            do="use a design of rods",
        )
    known = np.flatnonzero(np.isfinite(design.xy).all(axis=1))
    if o.mirrored and not np.isfinite(design.nominal_px[known]).all():
        # The image, with y down, and the reflected design, with y up, have opposite handedness.
        design = design.from_behind()
    source = design.xy
    if len(known) < 4:
        raise UsageError("has fewer than four points with coordinates", where=f"design {design.name}")
    across = np.linalg.svd(source[known] - source[known].mean(axis=0), compute_uv=False)
    if across[1] < _FLAT * across[0]:
        raise UsageError(
            "has its points on one line, which does not show where they are", where=f"design {design.name}"
        )
    seen = find_pins(frame, o, others, hidden)
    if isinstance(seen, Failure):
        return seen
    echoes = np.flatnonzero(seen.ok)
    layout = _placed_pattern(design, known, seen, o)
    if isinstance(layout, Failure):
        return Failure(
            f"the rods of design {design.name!r} were not found: {layout.reason}",
            layout.code,
            where=frame.name,
            places=seen.xy[echoes],
        )
    names = tuple(design.ids[i] for i in known)
    tolerance = np.array([design.points[i].sigma or 0.0 for i in known])
    work = _Rods(frame, source[known], names, seen, echoes, layout, tolerance)
    return _with_slanted(work.result(design.ids, known), design, echoes, layout.gate_px)


def _placed_pattern(
    design: ReseauDesign, known: Rows, found: PinDetections, o: PinOptions
) -> Layout | Failure:
    """The rods fitted to the echoes, from nominal positions if the design has them.

    Echoes on the segments of slanted wires support a position; only the rods are in the result.
    """
    slanted = np.setdiff1d(np.flatnonzero(np.isfinite(design.segments).all(axis=(1, 2))), known)
    rows = np.concatenate([known, slanted])
    ends = design.segments[rows]
    wires = Wires(tuple(design.ids[i] for i in rows), ends[:, 0], ends[:, 1])
    nominal = design.nominal_px[known]
    seen, mirrored = found.xy[found.ok], None if o.mirrored is None else True
    options = LayoutOptions(o.gate, float(np.deg2rad(o.max_rotation_deg)), mirrored, found.direction)
    start = nominal if np.isfinite(nominal).all() else None
    if start is not None:
        start = np.concatenate([start, np.full((len(slanted), 2), np.nan)])
    layout = lay_wires(wires, seen, options, start)
    if isinstance(layout, Failure) and start is not None:
        # The photograph may be turned or mirrored against the one in which the nominal positions were read.
        anywhere = lay_wires(wires, seen, options)
        layout = layout if isinstance(anywhere, Failure) else anywhere
    return layout if isinstance(layout, Failure) else replace(layout, row=layout.row[: len(known)])


def _with_slanted(result: PinResult, design: ReseauDesign, echoes: Rows, gate_px: float) -> PinResult:
    """The result with the slanted wires of the design, found among the echoes that belong to no rod."""
    segments = design.segments
    slanted = np.flatnonzero(np.isfinite(segments).all(axis=(1, 2)) & np.isnan(design.xy).any(axis=1))
    if not len(slanted):
        return result
    seen, known = result.detections, np.flatnonzero(result.ok)
    apart = np.hypot(*np.moveaxis(seen.xy[echoes][:, None] - result.xy[known], -1, 0))
    free = echoes[apart.min(axis=1, initial=np.inf) > 0]
    cuts = cut_segments(
        segments[slanted], seen.xy[free], seen.cov[free], design.xy[known], result.xy[known], gate_px
    )
    found = cuts.row >= 0
    rows, at = slanted[found], free[cuts.row[found]]
    columns = {name: np.array(getattr(result, name)) for name in ("xy", "cov", *_COLUMNS)}
    for name, values in columns.items():
        values[rows] = getattr(seen, name)[at]
    ok, why, predicted = result.ok.copy(), list(result.why), result.predicted.copy()
    ok[rows] = True
    predicted[slanted] = cuts.ends.mean(axis=1)
    for i, reason in zip(slanted, cuts.why, strict=True):
        why[i] = reason
    full = [np.full(len(ok), np.nan), np.full(len(ok), np.nan), np.full((len(ok), 2, 2), np.nan)]
    full[0][slanted], full[1][slanted], full[2][slanted] = cuts.share, cuts.sigma, cuts.ends
    changed: dict[str, Any] = {"ok": ok, "why": tuple(why), "predicted": predicted} | columns
    return replace(result, **changed, share=full[0], share_sigma=full[1], segments_px=full[2])


class _Rods:
    """Rods and echoes of one frame, and the field that maps rods to echoes."""

    def __init__(
        self,
        frame: Frame,
        source: Array,
        ids: tuple[str, ...],
        seen: PinDetections,
        echoes: Rows,
        layout: Layout,
        tolerance: Array,
    ) -> None:
        self.tolerance_px = tolerance * np.sqrt(np.abs(np.linalg.det(layout.matrix)))
        self.frame, self.source, self.seen, self.echoes = frame, source, seen, echoes
        self.gate_px, self.ids = layout.gate_px, ids
        self.notes = (_AMBIGUOUS,) if layout.ambiguous else ()
        assigned = assign(
            source,
            seen.xy[echoes],
            seen.cov[echoes],
            layout.row,
            layout(source),
            layout.gate_px,
            self.tolerance_px,
        )
        self.row, self.predicted, self.deviation = assigned.row, assigned.predicted, assigned.deviation
        self.why = np.full(len(source), "", dtype=object)
        for rod, distance in assigned.excluded.items():
            text = f"what is seen lies {distance:.1f} px from the position predicted by the other rods"
            self.why[rod] = Reason(text, Code.DEVIATES)
        self._separate()

    def _separate(self) -> None:
        """Reject echoes that cover the predicted places of several rods."""
        seen, at = self.seen, self.echoes
        offset = self.predicted[:, None] - seen.xy[at]
        c, s = np.cos(seen.tilt[at]), np.sin(seen.tilt[at])
        along = np.abs(c * offset[..., 0] + s * offset[..., 1])
        across = np.abs(c * offset[..., 1] - s * offset[..., 0])
        covers = (along < 0.5 * seen.length[at]) & (across < np.maximum(seen.thickness[at], _BESIDE_PX))
        for echo in np.flatnonzero(covers.sum(axis=0) > 1):
            rods = [i for i in np.flatnonzero(covers[:, echo]) if self.row[i] in (-1, echo)]
            for one, other in zip(rods, rods[1:] + rods[:1], strict=True):
                if one == other:
                    continue
                self.why[one] = Reason(f"its echo touches that of {self.ids[other]}", Code.OVERLAPPING)
                self.row[one] = -1
                self.deviation[one] = np.nan

    def result(self, ids: tuple[str, ...], known: Rows) -> PinResult:
        """Spread results over all rods of the design, including those without coordinates."""
        n, found = len(ids), np.flatnonzero(self.row >= 0)
        at = self.echoes[self.row[found]]
        why = Reason("the design has no coordinates of it", Code.NO_COORDINATES).repeated(n)
        why[known] = [self._reason(i) for i in range(len(known))]

        def spread(values: Array) -> Array:
            full = np.full((n, *values.shape[1:]), np.nan)
            full[known[found]] = values
            return full

        ok = np.zeros(n, dtype=bool)
        ok[known[found]] = True
        predicted = np.full((n, 2), np.nan)
        predicted[known] = self.predicted
        expected = self.seen.cov[at] + self.tolerance_px[found, None, None] ** 2 * np.eye(2)
        return PinResult(
            image=self.frame.name,
            sha256=self.frame.sha256,
            ids=ids,
            xy=spread(self.seen.xy[at]),
            cov=spread(self.seen.cov[at]),
            ok=ok,
            why=tuple(why),
            predicted=predicted,
            deviation=spread(self.deviation[found]),
            **{name: spread(getattr(self.seen, name)[at]) for name in _COLUMNS},
            detections=self.seen,
            notes=self.notes
            + deviating([self.ids[i] for i in found], self.source[found], self.seen.xy[at], expected),
        )

    def _reason(self, rod: int) -> str:
        """Why a rod was not measured; empty where it was."""
        if self.row[rod] >= 0 or self.why[rod]:
            declined: str = self.why[rod]
            return declined
        x, y = self.predicted[rod]
        if not (0 <= x <= self.frame.width - 1 and 0 <= y <= self.frame.height - 1):
            return Reason("outside the frame", Code.OUTSIDE)
        distance = np.hypot(*(self.seen.xy - self.predicted[rod]).T)
        distance[self.seen.ok] = np.inf
        nearest = int(distance.argmin()) if len(distance) else -1
        if nearest >= 0 and distance[nearest] < self.gate_px:
            return self.seen.why[nearest]
        return Reason("no echo at the predicted position", Code.NOT_FOUND)
