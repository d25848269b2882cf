"""Fiducial marks of a scanned photograph, and the transformation to the camera's coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ...adjust import Adjustment
from ...calibration import scan_coordinates, scan_pixels
from ...calibration.film import TRANSFORMS
from ...core import vocabulary as v
from ...core.data import Array, ImagePoints, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ...io import FiducialDesign
from ...io.scans import Scan
from ...optics import RationalPolynomial
from ..film.roll import Kind
from ..fitting import fit_mapping
from ..points import Reason
from .forms import reach_of
from .result import FiducialResult
from .search import (
    Attitude,
    Candidates,
    Pattern,
    attitudes,
    find_patterns,
    formed_mark,
    least_scales,
    overview_size,
    same_figure,
    same_places,
)
from .windows import fit_of, match_marks, moves_of, tracked

_STATED, _UNKNOWN = 0.03, 0.08
"""Relative uncertainty of the scale that a file states, and of one step of those that are tried."""
_NO_TAG = (72.0, 96.0)
"""Resolutions that programs write which do not know it."""
_TRIED = 2
"""Patterns that are examined at full resolution."""
_MISSING = 2
"""Most marks that may be missing."""
_LEAST_T = 6.0
"""Least contrast of a mark over its standard deviation."""
_ALIKE = 0.55
"""Least correlation of a mark with its formed image."""
_SURE = 0.85
"""Median of these correlations from which no other pattern is examined."""
_ALIKE_ALL = 0.7
"""Least median of these correlations."""
_FILM_MM = 0.005
"""Irregular deformation of film and scanner between marks, one sigma: the least weight of their distances."""
_UNLIKE_MM = 0.02
"""Least rms of the residuals of a contradicted transformation, per 100 mm of the pattern's radius."""
_CERTAIN = float(np.log(1000))
"""Logarithm of the odds at which images of marks decide between attitudes."""
_AFFINE = 0.006
"""Largest shear or difference of scales that film and scanners have."""
_OFF_MM = 0.15
"""Residual of a mark from which it is not the mark, if the others agree without it."""


@dataclass(frozen=True)
class FiducialOptions:
    """What is known of a scan.

    Parameters
    ----------
    dpi : float, optional
        Resolution of the scan, if it is missing or wrong in the file.
    rotation : {0, 90, 180, 270}, optional
        Rotation of the camera's x-axis in the scan, degrees counter-clockwise.
    mirrored : bool, optional
        Whether the scan shows the film from behind.
    negative : bool, optional
        Whether the scan shows bright marks of the design dark, and dark ones bright; by default found.
    transform : {"similarity", "affine", "projective", "bilinear"}
        Kind of the transformation to the calibrated coordinates.
    max_tilt_deg : float
        Largest rotation of the film besides quarter turns.

    Examples
    --------
    >>> FiducialOptions(dpi=1270, mirrored=False).transform
    'affine'
    """

    dpi: v.Dpi | None = None
    rotation: int | None = None
    mirrored: v.Mirrored | None = None
    negative: v.Negative | None = None
    transform: v.Transform = "affine"
    max_tilt_deg: float = 8.0


def measure_fiducials(
    scan: Scan, design: FiducialDesign, options: FiducialOptions | None = None, sha256: str = ""
) -> FiducialResult | Failure:
    """Find and measure the fiducial marks of a scanned photograph.

    Parameters
    ----------
    scan : Scan
        The open scan; only an overview and windows around the marks are read.
    design : FiducialDesign
        The camera.
    options : FiducialOptions, optional
        What is known of the scan.
    sha256 : str
        Hash of the file, for the result.

    Returns
    -------
    FiducialResult or Failure
        A failure if the marks are not in the scan, or too few of them.

    Notes
    -----
    Derived in ``docs/mathematics/fiducials.md``.

    Examples
    --------
    Four crosses of a camera of 40 mm x 30 mm, scanned at 10 px/mm:

    >>> from reseau.io import FiducialMark, FiducialPoint, MarkPart
    >>> from reseau.io.scans import scan_of
    >>> from reseau.optics.formation import Outline, draw
    >>> cross = FiducialMark(polarity="bright", parts=(MarkPart(shape="cross", size=3.0, line_width=0.3),))
    >>> camera = {"1": (20, 15), "2": (-20, 15), "3": (-20, -15), "4": (20, -15)}
    >>> points = tuple(FiducialPoint(id=k, x=x, y=y, mark="cross") for k, (x, y) in camera.items())
    >>> design = FiducialDesign(name="camera", marks={"cross": cross}, points=points)
    >>> from reseau.optics.formation import mark_outline
    >>> places = design.xy * [10, -10] + [235.3, 190.6]
    >>> crosses = mark_outline("cross", 30.0, 3.0, 0.5)
    >>> light = draw(Outline(crosses.xy + places[:, None], np.tile(crosses.dxy, (4, 1, 1))), (380, 470), 1.0)
    >>> grey = 40 + 160 * light + np.random.default_rng(0).normal(0, 2, light.shape)
    >>> found = measure_fiducials(scan_of(grey.astype(np.uint8)), design)
    >>> bool(abs(found.xy - places).max() < 0.05), found.notes[0].code
    (True, <Code.AMBIGUOUS: 'ambiguous'>)
    """
    options = options or FiducialOptions()
    placed, notes = _found(scan, design, options)
    if isinstance(placed, Failure):
        return placed
    best: FiducialResult | None = None
    failure: Failure | None = None
    for pattern, reduction in placed[:_TRIED]:
        result = _measured(scan, design, options, pattern, reduction, sha256)
        if isinstance(result, Failure):
            failure = failure or result
        elif best is None or _quality(result) > _quality(best):
            best = result
        if best is not None and np.median(best.likeness[best.ok]) > _SURE:
            break
    if best is None:
        assert failure is not None
        return failure
    best = _oriented(scan, best, options)
    return replace(best, notes=(*best.notes, *notes, *_remarks(best)))


def _quality(result: FiducialResult) -> tuple[int, float]:
    return int(result.ok.sum()), float(np.median(result.likeness[result.ok]))


def _scales(
    scan: Scan, design: FiducialDesign, options: FiducialOptions
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Scales (px/mm) with relative uncertainties: the stated one, and those at which marks fill the scan."""
    low, high = least_scales(design, (scan.width, scan.height))
    if options.dpi is not None:
        return [(options.dpi / 25.4, _STATED)], []
    steps = int(np.ceil(np.log(high / low) / np.log(1 + 2 * _UNKNOWN)))
    grid = np.geomspace(high, low, steps + 1)
    tried = [(float(k), _UNKNOWN + 0.01) for k in (grid[1:] + grid[:-1]) / 2]
    stated: list[tuple[float, float]] = []
    if _states(scan):
        k = (scan.dpi or 0.0) / 25.4
        if 0.5 * low < k < high:
            stated = [(k, _STATED)]
    return stated, tried


def _states(scan: Scan) -> bool:
    """Whether the file states a resolution that its program may have known."""
    return scan.dpi is not None and not any(abs(scan.dpi - no) < 1 for no in _NO_TAG)


def _found(
    scan: Scan, design: FiducialDesign, options: FiducialOptions
) -> tuple[list[tuple[Pattern, float]] | Failure, tuple[Remark, ...]]:
    """Patterns in an overview with its reduction, the best first, and remarks on the scale."""
    stated, tried = _scales(scan, design, options)
    notes: tuple[Remark, ...] = ()
    for scales in (stated, tried):
        found: list[tuple[Pattern, float]] = []
        for scale, within in scales:
            found += _at_scale(scan, design, options, scale, within)
            if any(each.likeness.min() > _SURE for each, _ in found):
                break  # all marks are there
        found.sort(key=lambda each: -each[0].score)
        found = [each for each in found if _enough(each[0], design)]
        if found:
            k = 25.4 * np.sqrt(abs(np.linalg.det(found[0][0].linear))) * found[0][1]
            if options.dpi is None and _states(scan) and abs((scan.dpi or k) / k - 1) > _STATED:
                text = f"the file states {scan.dpi:.0f} dpi; the marks show about {k:.0f} dpi"
                notes = (Remark(text, Code.INCONSISTENT),)
            return found, notes
    n = len(design.points)
    hint = "" if options.dpi is None else ", and that the resolution is right"
    return Failure(
        f"the pattern of the {n} marks of {design.name!r} is not in the image; check that it is a photograph "
        f"of this camera with all of its borders{hint}",
        Code.NOT_FOUND,
    ), ()


def _enough(pattern: Pattern, design: FiducialDesign) -> bool:
    seen = int((pattern.likeness > 0).sum())
    return seen >= max(3, len(design.points) - _MISSING)


def _at_scale(
    scan: Scan, design: FiducialDesign, options: FiducialOptions, scale: float, within: float
) -> list[tuple[Pattern, float]]:
    """Patterns at one scale: those of the best attitude, and of others as good."""
    candidates = Candidates.of_scan(scan, overview_size(scan, design, scale))
    reduction = candidates.reduction
    negative = (False, True) if options.negative is None else (options.negative,)
    ways = [(attitude, n) for n in negative for attitude in attitudes(options.rotation, options.mirrored)]
    patterns = find_patterns(candidates, design, scale / reduction, within, ways, options.max_tilt_deg)
    if not patterns:
        return []
    # Attitudes that use the same candidates are compared after the measurement.
    distinct: list[Pattern] = []
    for pattern in patterns:
        if not any(same_places(pattern, other) for other in distinct):
            distinct.append(pattern)
    return [(pattern, reduction) for pattern in distinct]


def _measured(
    scan: Scan,
    design: FiducialDesign,
    options: FiducialOptions,
    pattern: Pattern,
    reduction: float,
    sha256: str,
) -> FiducialResult | Failure:
    """Measure the marks of a pattern at full resolution, and fit the transformation."""
    n = len(design.points)
    linear = reduction * pattern.linear
    shift = (pattern.shift + 0.5) * reduction - 0.5
    start = (pattern.xy + 0.5) * reduction - 0.5
    expected = design.xy @ linear.T + shift
    seen: Mask = np.asarray(np.isfinite(start).all(axis=1))
    columns = _Columns.empty(n)
    shown = design.reversed() if pattern.negative else design
    _look(scan, shown, linear, np.where(seen[:, None], start, expected), 2.0 * reduction, columns, range(n))
    scale = float(np.sqrt(abs(np.linalg.det(linear))))
    film = _Film(pattern.attitude, (scan.width, scan.height), scale, pattern.negative)
    for _ in range(2):
        _drop(design, film, columns)
        if columns.ok.sum() < 3:
            break
        fitted = _fitted(
            design, film, columns, columns.ok, "affine" if columns.ok.sum() > 3 else "similarity"
        )
        if isinstance(fitted, Failure):
            return fitted
        near = film.pixels(fitted.model, design)
        linear = _linear_of(design, near, linear)
        again = np.flatnonzero(~columns.ok)
        if not len(again):
            break
        columns.predicted = near
        _look(scan, shown, linear, near, 0.1 * scale, columns, again)
    if columns.ok.sum() < max(3, n - _MISSING):
        ids = design.ids
        lost = [f"{ids[k]}: {columns.why[k]}" for k in np.flatnonzero(~columns.ok)]
        return Failure(
            f"{int(columns.ok.sum())} of {n} fiducial marks of {design.name!r} were found "
            f"({'; '.join(lost[:3])})",
            Code.NOT_FOUND,
            places=expected,
        )
    return _result(scan.name, design, options, film, columns, sha256)


@dataclass(frozen=True)
class _Film:
    """How the film lies in the scan, the size of this, pixels per mm, and whether this is a negative."""

    attitude: Attitude
    size: tuple[int, int]
    scale: float
    negative: bool

    @classmethod
    def of(cls, result: FiducialResult, attitude: Attitude) -> _Film:
        """The film of a result in an attitude."""
        return cls(attitude, result.size, result.px_per_mm, result.negative)

    def coordinates(self, xy: Array) -> Array:
        """Scan coordinates (mm) of pixels (n, 2)."""
        return scan_coordinates(xy, self.size, self.scale, self.attitude.rotation, self.attitude.mirrored)

    def pixels(self, model: RationalPolynomial, design: FiducialDesign) -> Array:
        """Pixels (n, 2) of all marks of the design by a transformation of scan coordinates."""
        uv = np.asarray(model.inverse(design.xy))
        return scan_pixels(uv, self.size, self.scale, self.attitude.rotation, self.attitude.mirrored)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A transformation from scan coordinates to the calibrated ones, and its residuals (m, 2)."""

    fit: Adjustment
    model: RationalPolynomial
    residuals: Array


class _Places(Protocol):
    """Pixels (n, 2) of marks with their covariances (n, 2, 2), and what these have in common."""

    @property
    def xy(self) -> Array: ...
    @property
    def cov(self) -> Array: ...
    @property
    def common(self) -> Array: ...


@dataclass
class _Columns:
    """Results of the marks while they are measured."""

    xy: Array
    cov: Array
    ok: Mask
    why: list[str]
    likeness: Array
    psf_px: Array
    predicted: Array
    common: Array

    @classmethod
    def empty(cls, n: int) -> _Columns:
        none = np.full((n, 2), np.nan)
        return cls(
            none.copy(),
            np.full((n, 2, 2), np.nan),
            np.zeros(n, dtype=bool),
            [""] * n,
            np.zeros(n),
            np.full(n, np.nan),
            none.copy(),
            np.zeros((n, 2, 2)),
        )


def _look(
    scan: Scan,
    design: FiducialDesign,
    linear: Array,
    at: Array,
    error: float,
    columns: _Columns,
    rows: Any,
) -> None:
    """Track marks to full resolution, match them, and judge each."""
    rows = [int(k) for k in rows]
    started = np.array([tracked(scan, design, k, linear, at[k], error)[0] for k in rows])
    found = match_marks(scan, design, rows, linear, started)
    scale = float(np.sqrt(abs(np.linalg.det(linear))))
    for i, k in enumerate(rows):
        one, level = found.matches[i], found.reduction[i]
        sigma = (
            float(np.sqrt(np.nanmax(np.diag(found.cov[i])))) if np.isfinite(found.cov[i]).all() else np.inf
        )
        limit = _OFF_MM * scale  # beyond it the others could not tell whether this is the mark
        why: str = ""
        moved = float(np.hypot(*(found.xy[i] - at[k])))
        if one.seen[0] < 0.5:
            why = Reason("outside the scan", Code.OUTSIDE)
        elif not one.converged[0] or one.contrast[0] <= 0 or moved > 3 * error + 6 * level + 0.1 * scale:
            why = Reason("no such mark where the others expect it", Code.NOT_FOUND)
        elif one.t[0] < _LEAST_T or one.correlation[0] < _ALIKE:
            why = Reason(f"does not look like its mark (correlation {one.correlation[0]:.2f})", Code.UNLIKE)
        elif one.rejected[0] > 0.4:
            why = Reason(f"{one.rejected[0]:.0%} of it is covered or damaged", Code.DISTURBED)
        elif sigma > limit:
            why = Reason(f"its standard deviation would be {sigma:.2g} px", Code.UNCERTAIN)
        columns.ok[k], columns.why[k] = why == "", why
        columns.xy[k], columns.cov[k], columns.common[k] = found.xy[i], found.cov[i], found.common[i]
        columns.likeness[k], columns.psf_px[k] = one.correlation[0], level * one.psf_px[0]
        columns.predicted[k] = at[k]


def _fitted(design: FiducialDesign, film: _Film, marks: _Places, keep: Mask, kind: Kind) -> _Fitted | Failure:
    """Fit a transformation to some of the marks; the weights contain the irregular deformation of film."""
    turn = film.attitude.matrix / film.scale
    cov = turn.T @ (marks.cov - marks.common)[keep] @ turn + _FILM_MM**2 * np.eye(2)
    points = ImagePoints(tuple(np.array(design.ids)[keep].tolist()), film.coordinates(marks.xy[keep]), cov)
    target, sigma = design.xy[keep], np.repeat(design.sigma[keep][:, None], 2, axis=1)
    fit = fit_mapping(TRANSFORMS[kind], points, target, sigma)
    if isinstance(fit, Failure):
        return fit
    model = TRANSFORMS[kind].with_values(fit.values)
    return _Fitted(fit, model, model(points.xy) - target)


def _linear_of(design: FiducialDesign, pixels: Array, start: Array) -> Array:
    """Linear mapping (2, 2) from camera coordinates to pixels by all marks; `start` if undetermined."""
    a, b = design.xy - design.xy.mean(axis=0), pixels - pixels.mean(axis=0)
    if not np.isfinite(b).all():
        return start
    return np.asarray(np.linalg.lstsq(a, b, rcond=None)[0].T)


def _drop(design: FiducialDesign, film: _Film, columns: _Columns) -> None:
    """Reject marks that contradict the others: without them the residuals fall, with them they are large."""
    while columns.ok.sum() > 3:
        kind: Kind = "affine" if columns.ok.sum() > 4 else "similarity"
        whole = _fitted(design, film, columns, columns.ok, kind)
        if isinstance(whole, Failure):
            return
        limit = _OFF_MM + (0.0 if kind == "affine" else _AFFINE / 2 * float(np.ptp(design.xy)))
        if np.abs(whole.residuals).max() < limit:
            return
        rms = []
        for k in np.flatnonzero(columns.ok):
            keep = columns.ok.copy()
            keep[k] = False
            fewer: Kind = "affine" if keep.sum() > 3 and kind == "affine" else "similarity"
            part = _fitted(design, film, columns, keep, fewer)
            rms.append(np.inf if isinstance(part, Failure) else float(np.sqrt((part.residuals**2).mean())))
        worst = np.flatnonzero(columns.ok)[int(np.argmin(rms))]
        columns.ok[worst] = False
        columns.why[worst] = Reason("contradicts the other marks", Code.DEVIATES)


def _result(
    image: str,
    design: FiducialDesign,
    options: FiducialOptions,
    film: _Film,
    columns: _Columns,
    sha256: str,
) -> FiducialResult | Failure:
    """The transformation of the kind that was asked for, after tests of all marks together."""
    ok = columns.ok
    alike = float(np.median(columns.likeness[ok]))
    if alike < _ALIKE_ALL:
        return Failure(
            f"what lies in the pattern of {design.name!r} does not look like its marks (median correlation "
            f"{alike:.2f}); check the kinds of marks in the design",
            Code.UNLIKE,
            places=columns.xy[ok],
        )
    kind = options.transform
    needed = {"similarity": 2, "affine": 3, "projective": 4, "bilinear": 4}[kind]
    if ok.sum() < needed:
        return Failure(
            f"{int(ok.sum())} marks were found, and a transformation of the kind {kind} needs {needed}",
            Code.TOO_FEW_POINTS,
            places=columns.xy[ok],
        )
    affine = _fitted(design, film, columns, ok, "affine")
    if isinstance(affine, Failure):
        return affine
    values = affine.model.derivatives(np.zeros((1, 2))).d_xy[0]
    s = np.linalg.svd(values, compute_uv=False)
    off = np.abs(affine.residuals).max()
    if s[0] / s[1] - 1 > _AFFINE or off > 2 * _OFF_MM:
        return Failure(
            f"the marks found do not form the pattern of {design.name!r}: scales differ by "
            f"{100 * (s[0] / s[1] - 1):.2f} %, residuals of {1000 * off:.0f} µm",
            Code.INCONSISTENT,
            places=columns.xy[ok],
        )
    fitted = _fitted(design, film, columns, ok, kind)
    if isinstance(fitted, Failure):
        return fitted
    columns.xy[~ok], columns.cov[~ok] = np.nan, np.nan
    return FiducialResult(
        image=image,
        sha256=sha256,
        design=design,
        size=film.size,
        attitude=film.attitude,
        px_per_mm=film.scale,
        xy=columns.xy,
        cov=columns.cov,
        common=columns.common,
        negative=film.negative,
        ok=ok,
        why=tuple(columns.why),
        predicted=film.pixels(fitted.model, design),
        likeness=columns.likeness,
        psf_px=columns.psf_px,
        kind=kind,
        fit=fitted.fit,
        shared=_shared(design, film, columns, fitted, kind),
        residuals=_spread(fitted.residuals, ok),
        notes=(),
    )


def _shared(design: FiducialDesign, film: _Film, columns: _Places, fitted: _Fitted, kind: Kind) -> Array:
    """What errors of learnt marks add to the covariance of the transformation's parameters.

    All marks of a kind are displaced alike in the plane of the mark; the transformation is fitted again with
    these displacements.
    """
    ok: Mask = np.asarray(np.isfinite(columns.xy).all(axis=1))
    linear = film.scale * film.attitude.matrix
    total = np.zeros((len(fitted.fit.values),) * 2)
    for name, mark in design.marks.items():
        rows = [k for k in np.flatnonzero(ok).tolist() if design.points[k].mark == name]
        if mark.learnt is None or not rows:
            continue
        moves = {k: moves_of(design, k, linear)[0] for k in rows}
        back = [np.linalg.inv(moves[k]) @ columns.common[k] @ np.linalg.inv(moves[k]).T for k in rows]
        value, vector = np.linalg.eigh(np.mean(back, axis=0))
        for step in (vector * np.sqrt(np.maximum(value, 0.0))).T:
            xy = columns.xy.copy()
            for k in rows:
                xy[k] += moves[k] @ step
            moved = _fitted(design, film, _Moved(xy, columns.cov, columns.common), ok, kind)
            if not isinstance(moved, Failure):
                change = moved.fit.values - fitted.fit.values
                total += np.outer(change, change)
    return total


@dataclass(frozen=True, eq=False)
class _Moved:
    """Marks at other places."""

    xy: Array
    cov: Array
    common: Array


def _spread(residuals: Array, ok: Mask) -> Array:
    """Residuals (n, 2) of all marks, NaN of those that were not used."""
    every = np.full((len(ok), 2), np.nan)
    every[ok] = residuals
    return every


def _oriented(scan: Scan, result: FiducialResult, options: FiducialOptions) -> FiducialResult:
    """Compare the attitudes in which the same marks fit: images and coordinates may tell, or nothing does."""
    ways = attitudes(options.rotation, options.mirrored)
    orders = {attitude: _exchanged(result, attitude) for attitude in ways}
    fits = {attitude: order for attitude, order in orders.items() if order is not None}
    likelihood = _likelihoods(scan, result, fits)
    likely = [attitude for attitude in fits if likelihood[attitude] > max(likelihood.values()) - _CERTAIN]
    every = [(_misfit(result, attitude, fits[attitude]), attitude, fits[attitude]) for attitude in likely]
    if not every:
        return result
    best = min(every, key=lambda each: each[0])
    others = [each for each in every if each[1] != best[1]]
    radius = float(np.hypot(*(result.design.xy - result.design.xy.mean(axis=0)).T).max())
    clear = _UNLIKE_MM * radius / 100
    if all(o[0] > max(3 * best[0], clear) for o in others):
        return result if best[1] == result.attitude else _renamed(result, best[1], best[2])
    # Nothing distinguishes them: upright and not mirrored, if that is one of them.
    alike = [each for each in every if each[0] <= max(3 * best[0], clear)]
    rank = {attitude: k for k, attitude in enumerate(attitudes(None, None))}
    taken = min(alike, key=lambda each: rank[each[1]])
    names = ", ".join(str(each[1]) for each in alike if each[1] != taken[1])
    text = (
        f"the marks fit in {len(alike)} orientations: taken as {taken[1]}, but also {names}; "
        "give --rotation and --mirrored or --not-mirrored"
    )
    settled = result if taken[1] == result.attitude else _renamed(result, taken[1], taken[2])
    return replace(settled, notes=(*settled.notes, Remark(text, Code.AMBIGUOUS)))


def _exchanged(result: FiducialResult, attitude: Attitude) -> Rows | None:
    """For each mark the measured one that it is in another attitude; None if the marks do not fit."""
    design = result.design
    change = np.linalg.inv(result.attitude.matrix) @ attitude.matrix
    middle = design.xy.mean(axis=0)
    moved = (design.xy - middle) @ change.T
    away = np.hypot(*(moved[:, None] - (design.xy - middle)[None]).transpose(2, 0, 1))
    order = away.argmin(axis=1)
    extent = float(np.ptp(design.xy))
    if len(set(order.tolist())) < len(order) or away.min(axis=1).max() > 0.01 * extent:
        return None
    return np.asarray(order, dtype=np.intp)


def _likelihoods(scan: Scan, result: FiducialResult, fits: dict[Attitude, Rows]) -> dict[Attitude, float]:
    """Logarithms of the likelihoods of attitudes by the images of the marks; equal where these are alike."""
    design = result.design.reversed() if result.negative else result.design
    own = _linear_of(design, result.predicted, result.px_per_mm * result.attitude.matrix)
    seen: dict[int, list[tuple[Any, tuple[float, float]]]] = {}

    def fit(k: int, at: int, linear: Array) -> tuple[float, float]:
        """Fit of the image of a mark at the place of one; what shows the same figure fits the same."""
        mark = design.marks[design.points[k].mark]
        fine = 8.0 / reach_of(mark) if mark.learnt is None else mark.learnt.px_per_mm
        image = formed_mark(design, k, fine / result.px_per_mm * linear)
        noise = 0.0 if mark.learnt is None else mark.learnt.noise / 1000
        for other, found in seen.setdefault(at, []):
            if other.shape == image.shape and same_figure(image, other, noise):
                return found
        fitted = fit_of(scan, design, k, linear, result.xy[at], float(result.psf_px[at]))
        seen[at].append((image, fitted))
        return fitted

    found = {}
    # The own attitude first: others that show the same figures fit as it does.
    for attitude in sorted(fits, key=lambda each: each != result.attitude):
        linear = own @ np.linalg.inv(result.attitude.matrix) @ attitude.matrix
        rows = enumerate(fits[attitude].tolist())
        found[attitude] = {at: fit(k, at, linear) for k, at in rows if result.ok[at]}
    total = dict.fromkeys(fits, 0.0)
    for at in np.flatnonzero(result.ok).tolist():
        count = min(each[at] for each in found.values())[1]  # as the best image leaves them
        for attitude, each in found.items():
            total[attitude] -= count / 2 * float(np.log(max(each[at][0], 1e-12)))
    return total


def _renamed(result: FiducialResult, attitude: Attitude, order: Rows) -> FiducialResult:
    """The result with its marks named as in another attitude."""
    renamed = replace(
        result,
        attitude=attitude,
        xy=result.xy[order],
        cov=result.cov[order],
        common=result.common[order],
        ok=result.ok[order],
        why=tuple(result.why[i] for i in order),
        likeness=result.likeness[order],
        psf_px=result.psf_px[order],
    )
    film = _Film.of(result, attitude)
    fitted = _fitted(result.design, film, renamed, renamed.ok, result.kind)
    if isinstance(fitted, Failure):
        return result
    return replace(
        renamed,
        fit=fitted.fit,
        shared=_shared(result.design, film, renamed, fitted, result.kind),
        residuals=_spread(fitted.residuals, renamed.ok),
        predicted=film.pixels(fitted.model, result.design),
    )


def _misfit(result: FiducialResult, attitude: Attitude, order: Rows) -> float:
    """Rms of the residuals (mm) of an affine transformation in another attitude, of a similarity of three."""
    ok = result.ok[order]
    uv = _Film.of(result, attitude).coordinates(result.xy[order][ok])
    target = result.design.xy[ok]
    if ok.sum() > 3:
        a = np.column_stack([uv, np.ones(len(uv))])
        left = a @ np.linalg.lstsq(a, target, rcond=None)[0] - target
        return float(np.sqrt((left**2).sum() / (2 * len(uv) - 6)))
    z, w = (v[:, 0] + 1j * v[:, 1] for v in (uv - uv.mean(axis=0), target - target.mean(axis=0)))
    return float(np.sqrt((np.abs(z * ((z.conj() @ w) / (z.conj() @ z)) - w) ** 2).sum() / 2))


def _remarks(result: FiducialResult) -> tuple[Remark, ...]:
    """Marks that are missing, and residuals that film does not explain."""
    notes = []
    lost = [name for name, ok in zip(result.design.ids, result.ok, strict=True) if not ok]
    if lost:
        notes.append(Remark(f"not measured: {', '.join(lost)}", Code.NOT_FOUND))
    sigma = result.sigma_mm
    if sigma is None:
        text = f"no redundancy: {int(result.ok.sum())} marks and a transformation of the kind {result.kind}"
        notes.append(Remark(text, Code.NO_REDUNDANCY))
    elif max(sigma) > 0.05:
        text = f"residuals of {1000 * max(sigma):.0f} µm are large for film; check the calibrated coordinates"
        notes.append(Remark(text, Code.INCONSISTENT))
    return tuple(notes)
