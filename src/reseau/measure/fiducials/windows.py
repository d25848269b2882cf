"""Least-squares matching of single fiducial marks in windows of a scan, with correlated noise of the film."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask
from ...io import FiducialDesign, FiducialMark
from ...io.scans import Scan
from ...optics.formation import PixelResponse
from ..matching import Matches, match
from ..matching.patches import MatchOptions
from ..matching.shapes import Window
from .forms import contours_of, margin_of, outlined, reach_of, shape_of, thicknesses
from .learnt import OWN_PSF
from .search import formed_mark, same_figure, turned

_HALF = 48
"""Half side of a window in pixels after reduction, to which larger marks are reduced."""
_WIDTHS = (1.2, 0.6, 2.5)
"""Widths of the point-spread function with which the matching starts, in pixels; others if one fails."""
_GOOD = 0.9
"""Correlation of a match from which other widths need not be tried."""
_SIZE, _TURN = 0.03, 0.012
"""Standard deviations of the size (relative) and rotation (rad) of a mark."""
_SPREAD_MM, _SPREAD, _SPREAD_PX = 0.008, 0.15, 0.12
"""Standard deviation of the displacement of edges: in mm, in units of the thinnest line, and in pixels of the
scan, by a curved response of film and scanner; the tip of a notch moves by several times that."""
_AROUND = 5
"""Pixels around the expected position in which a mark is tracked from level to level."""
_GREYS, _FEW = 8, 20.0
"""Classes of grey values whose noise is estimated apart, and pixels by which a class is drawn to the mean."""
_NEAR = 3
"""Distance along an axis up to which correlations on the marks themselves are used."""
_LAGS = 24
"""Largest distance of pixels whose errors count as correlated."""


@dataclass(frozen=True, eq=False)
class MatchedMarks:
    """Matched marks in pixels of the scan, in columns.

    Parameters
    ----------
    xy, cov : ndarray (k, 2), (k, 2, 2)
        Positions and covariances.
    matches : list of Matches
        The match of each mark in its window; one row each.
    reduction : ndarray (k,)
        Reduction of each window.
    common : ndarray (k, 2, 2)
        What the covariances contain of errors of a learnt mark, which all marks of its kind have.
    """

    xy: Array
    cov: Array
    matches: list[Matches]
    reduction: Array
    common: Array


def grey_window(
    scan: Scan, centre: Array, half: int, reduction: int
) -> tuple[NDArray[np.float32], Mask, Array]:
    """Grey values around a place, reduced by averaging.

    Parameters
    ----------
    scan : Scan
        The scan.
    centre : ndarray (2,)
        Its centre, pixels of the scan.
    half : int
        Half its side, pixels after reduction.
    reduction : int
        Pixels of the scan per pixel along either axis.

    Returns
    -------
    grey : ndarray (2·half + 1, 2·half + 1)
        Mean of the channels.
    inside : ndarray of bool
        Pixels within the scan.
    first : ndarray (2,)
        Place in the scan of the first pixel's centre.
    """
    side = (2 * half + 1) * reduction
    left, top = (int(np.rint(c - (side - 1) / 2)) for c in centre)
    x0, x1 = np.clip([left, left + side], 0, scan.width)
    y0, y1 = np.clip([top, top + side], 0, scan.height)
    whole = np.zeros((side, side), np.float32)
    there = np.zeros((side, side), np.float32)
    if x1 > x0 and y1 > y0:
        part = scan.window(int(y0), int(y1), int(x0), int(x1)).astype(np.float32).mean(axis=2)
        whole[y0 - top : y1 - top, x0 - left : x1 - left] = part
        there[y0 - top : y1 - top, x0 - left : x1 - left] = 1.0
    if reduction > 1:
        size = (2 * half + 1, 2 * half + 1)
        whole = np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        there = np.asarray(cv2.resize(there, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    first = np.array([left, top]) + (reduction - 1) / 2
    return whole, there > 0.999, first


def tracked(
    scan: Scan, design: FiducialDesign, k: int, linear: Array, at: Array, error: float
) -> tuple[Array, float]:
    """Position of a mark, from the coarsest to the finest level, and its correlation with the formed mark.

    Parameters
    ----------
    scan, design, k, linear
        The scan, the camera, the mark, and the mapping from camera coordinates to pixels of the scan.
    at : ndarray (2,)
        Expected position, pixels of the scan.
    error : float
        Its error, pixels of the scan.
    """
    finest = _reduction(design, k, linear)
    level = max(finest, int(np.ceil(error / _AROUND)))
    likeness = 0.0
    while True:
        template = formed_mark(design, k, linear / level)
        half = len(template) // 2 + _AROUND
        grey, inside, first = grey_window(scan, at, half, level)
        if inside.mean() < 0.5 or np.ptp(grey) == 0:
            return at, 0.0
        r = cv2.matchTemplate(np.where(inside, grey, grey[inside].mean()), template, cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(np.nanargmax(r)), r.shape)
        likeness = float(r[row, column])
        at = first + level * (np.array([column, row], dtype=np.float64) + len(template) // 2)
        if level == finest:
            return at, likeness
        level = max(finest, level // 2)


def _reduction(design: FiducialDesign, k: int, linear: Array) -> int:
    """Reduction of the window of a mark for matching."""
    mark = design.marks[design.points[k].mark]
    scale = np.sqrt(abs(np.linalg.det(linear)))
    return max(1, int(np.rint((reach_of(mark) + margin_of(mark)) * scale / _HALF)))


def match_marks(
    scan: Scan, design: FiducialDesign, rows: list[int], linear: Array, at: Array
) -> MatchedMarks:
    """Match marks with their formed images.

    Parameters
    ----------
    scan : Scan
        The scan.
    design : FiducialDesign
        The camera.
    rows : list of int
        Indices of the marks.
    linear : ndarray (2, 2)
        From camera coordinates to pixels of the scan.
    at : ndarray (k, 2)
        Approximate positions, pixels of the scan.
    """
    xy, cov = np.full((len(rows), 2), np.nan), np.full((len(rows), 2, 2), np.nan)
    found, first, formed = [], [], []
    reduction = np.array([_reduction(design, k, linear) for k in rows], dtype=np.intp)
    for i, k in enumerate(rows):
        level = int(reduction[i])
        matched, corner, grey = _matched(scan, design, k, linear / level, at[i], level)
        first.append(corner)
        formed.append(grey + matched.residuals[0])
        found.append(_odd(matched, formed_mark(design, k, linear / level)))
    spread = _spread_by_grey(found, formed)
    spreads = [spread(grey) for grey in formed]
    on_marks = _on_marks(found, spreads)
    for i, matched in enumerate(found):
        xy[i] = first[i] + reduction[i] * matched.xy[0]
        cov[i] = reduction[i] ** 2 * _correlated(matched, spreads[i], on_marks)
    common = np.zeros_like(cov)
    for i, (k, matched) in enumerate(zip(rows, found, strict=True)):
        mark = design.marks[design.points[k].mark]
        if (learnt := mark.learnt) is not None:
            own, ratio = moves_of(design, k, linear)
            # Noise of the example in the residuals, by their scales and what reductions average.
            depth = matched.contrast[0] * (1.0 if mark.polarity == "bright" else matched.level[0])
            grain = learnt.noise / 1000 * abs(float(depth)) * min(1.0, 1 / (ratio * reduction[i]))
            share = min(1.0, (grain / max(float(matched.noise[0]), 1e-9)) ** 2)
            sxx, syy, sxy = learnt.covariance
            place = own @ np.array([[sxx, sxy], [sxy, syy]]) @ own.T
            common[i], cov[i] = share * cov[i] + place, cov[i] + place
    return MatchedMarks(xy, cov, found, reduction.astype(np.float64), common)


def _odd(found: Matches, image: NDArray[np.float32]) -> Matches:
    """The match of a mark with this image; with half a turn that shows the same, what only one side leaves.

    How the mark of a camera differs from its drawing is alike on both sides, and does not displace it.
    """
    if not same_figure(image, image[::-1, ::-1], 0.0):
        return found
    residuals = found.residuals[0]
    y, x = (
        np.rint(2 * at - np.arange(n)).astype(np.intp)
        for at, n in zip(found.xy[0, ::-1], residuals.shape, strict=True)
    )
    inside = np.logical_and.outer((y >= 0) & (y < len(y)), (x >= 0) & (x < len(x)))
    across = residuals[np.ix_(np.clip(y, 0, len(y) - 1), np.clip(x, 0, len(x) - 1))]
    across = np.where(inside, across, np.nan)
    return replace(found, residuals=((residuals - across) / np.sqrt(2))[None])


def moves_of(design: FiducialDesign, k: int, linear: Array) -> tuple[Array, float]:
    """From displacements of the point in the image of a learnt mark to those in a scan, and their scale."""
    learnt = design.marks[design.points[k].mark].learnt
    assert learnt is not None
    own = linear @ turned(design.points[k].turn_deg) @ np.linalg.inv(np.array(learnt.linear))
    return own, float(1 / np.sqrt(abs(np.linalg.det(own))))


def fit_of(
    scan: Scan, design: FiducialDesign, k: int, linear: Array, at: Array, psf_px: float
) -> tuple[float, float]:
    """Variance of the grey values around a mark about its image at a place, and how many independent ones.

    Parameters
    ----------
    scan, design, k, linear
        As of :func:`tracked`.
    at : ndarray (2,)
        Place of the mark, pixels of the scan.
    psf_px : float
        Width of the point-spread function, pixels of the scan.
    """
    level, point = _reduction(design, k, linear), design.points[k]
    mark, scale = design.marks[point.mark], np.sqrt(abs(np.linalg.det(linear))) / level
    half = int(np.ceil((reach_of(mark) + margin_of(mark)) * scale))
    grey, inside, first = grey_window(scan, at, half, level)
    shape = shape_of(mark, linear / level @ turned(point.turn_deg), 0.5, np.ones(3))
    along = np.arange(2 * half + 1.0)[None]
    window, form = Window(along, along, PixelResponse()), np.zeros((1, shape.parameters))
    share = shape.image(((at - first) / level)[None], np.array([psf_px / level]), form, np.array([0]), window)
    y, x = np.mgrid[-1 : 1 : grey.shape[0] * 1j, -1 : 1 : grey.shape[1] * 1j]
    columns = np.stack([np.ones_like(x), x, y, share[0]], axis=-1)[inside]
    left = np.zeros(grey.shape)
    left[inside] = grey[inside] - columns @ np.linalg.lstsq(columns, grey[inside], rcond=None)[0]
    variance = float((left**2).mean())
    near = float((left[1:] * left[:-1]).mean() + (left[:, 1:] * left[:, :-1]).mean()) / 2
    a = float(np.clip(near / max(variance, 1e-12), 0.0, 0.95))
    return variance, left.size * ((1 - a) / (1 + a)) ** 2


def _spread_by_grey(found: list[Matches], formed: list[Array]) -> Callable[[Array], Array]:
    """Standard deviation of residuals as a function of the grey value that was formed.

    Grain depends on the density of the film: a small mark is noisier, or less noisy, than what is around it,
    and the adjustment takes a large part of its few residuals. All marks of a scan show it together.
    """
    columns = []
    for matched, grey in zip(found, formed, strict=True):
        used = np.isfinite(matched.residuals[0])
        if matched.converged[0] and used.any():
            v, free = matched.residuals[0][used], 1 - np.clip(matched.leverage[0][used], 0.0, 0.95)
            columns.append(np.stack([grey[used], v * v, free]))
    if not columns:
        return np.zeros_like
    grey, square, free = np.concatenate(columns, axis=1)
    low, high = np.quantile(grey, [0.001, 0.999])
    ends = np.linspace(low, max(high, low + 1e-6), _GREYS + 1)
    kind = np.clip(np.digitize(grey, ends) - 1, 0, _GREYS - 1)
    total, weight = (np.bincount(kind, values, _GREYS) for values in (square, free))
    mean = square.sum() / free.sum()
    # Few pixels of a class are drawn to the mean of all.
    sigma = np.sqrt((total + _FEW * mean) / (weight + _FEW))
    middle = (ends[1:] + ends[:-1]) / 2
    return lambda values: np.asarray(np.interp(np.nan_to_num(values, nan=low), middle, sigma))


def _matched(
    scan: Scan, design: FiducialDesign, k: int, linear: Array, at: Array, level: int
) -> tuple[Matches, Array, NDArray[np.float32]]:
    """The best of several matches of one mark, the place of its window's first pixel, and its grey values."""
    point = design.points[k]
    mark = design.marks[point.mark]
    scale = float(np.sqrt(abs(np.linalg.det(linear))))
    half = int(np.ceil((reach_of(mark) + margin_of(mark)) * scale)) + 2
    grey, inside, first = grey_window(scan, at, half, level)
    thinnest = thicknesses(mark)[0]
    spread = max(_SPREAD_MM, _SPREAD * thinnest if thinnest < 0.5 else 0.0) * scale
    spread = float(np.hypot(spread, _SPREAD_PX / level))
    axes = linear @ turned(point.turn_deg)
    shape = shape_of(mark, axes, 0.5, np.array([_SIZE, _TURN, spread]))
    noise = max(quiet(grey, inside), scan.full_scale / 255 * 0.3 / level)
    start = np.array([[half, half]], dtype=np.float64) + (at - first) / level - half
    if any(part.use == "ignore" for part in mark.parts):
        inside = inside & ~_ignored(mark, axes, start, half)
    options = MatchOptions(
        half_px=half,
        psf_log_sigma=0.5,
        polarity=mark.polarity,
        start_px=1.0,
        influence=True,
        background=1,
        within_px=np.inf if mark.learnt is None else reach_of(mark) * scale - 2.0,
    )
    best: Matches | None = None
    for psf in _WIDTHS if mark.learnt is None else (OWN_PSF, 2 * OWN_PSF):
        found = match(
            grey,
            inside,
            shape,
            start,
            replace(options, psf_px=psf),
            noise=noise,
            form_sigma=np.ones(shape.parameters),
        )
        if best is None or _better(found, best):
            best = found
        if best.converged[0] and best.correlation[0] > _GOOD:
            break
    assert best is not None
    return best, first, grey


def _ignored(mark: FiducialMark, axes: Array, at: Array, half: int) -> Mask:
    """Pixels of a window that what is ignored beside a mark may reach."""
    shape = outlined([contours_of(mark, reach_of(mark), True)], axes[None], 0.5, np.ones(3))
    along = np.arange(2 * half + 1.0)[None]
    share = shape.image(
        at, np.ones(1), np.zeros((1, 3)), np.array([0]), Window(along, along, PixelResponse())
    )
    return np.asarray(share[0] > 1e-3)


def _better(one: Matches, other: Matches) -> bool:
    """Whether a match is better than another: it converged, and leaves less."""
    if one.converged[0] != other.converged[0]:
        return bool(one.converged[0])
    return bool(one.noise[0] * (1 + one.rejected[0]) < 0.999 * other.noise[0] * (1 + other.rejected[0]))


def quiet(grey: NDArray[np.float32], inside: Mask) -> float:
    """Standard deviation of independent noise, from second differences."""
    bend = grey[1:-1, 1:-1] - 0.25 * (grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:])
    used = bend[inside[1:-1, 1:-1]]
    return float(1.4826 * np.median(np.abs(used)) / np.sqrt(1.25)) if used.size else 0.0


def _correlated(found: Matches, by_grey: Array, on_marks: Array) -> Array:
    """Covariance (2, 2) of a position with the variances and correlations that the residuals show.

    With the influence L of each pixel, the local standard deviation s and the autocorrelation ρ of the
    residuals, the covariance is Σ Σ (L s)(p) ρ(p - q) (L s)(q). :mod:`reseau.measure.matching.correlation`
    needs many marks. Here a window has thousands of pixels beside its mark; `on_marks` are the correlations
    of neighbours on the marks of the scan, where grain may be coarser than the noise around them.
    """
    cov = np.asarray(found.cov[0])
    used = np.isfinite(found.residuals[0])
    if not found.converged[0] or used.sum() < 100 or not np.isfinite(cov).all():
        return cov
    unit, local = _unit(found, by_grey)
    auto, pairs = _pair_sums(unit, used.astype(np.float64))
    auto /= np.maximum(pairs, 1.0)
    auto /= auto[0, 0]
    size = auto.shape
    lag = np.hypot(*np.meshgrid(*(np.minimum(np.arange(n), n - np.arange(n)) for n in size), indexing="ij"))
    auto = np.where(lag <= _LAGS, auto * np.cos(np.pi / 2 * np.minimum(lag / _LAGS, 1.0)) ** 2, 0.0)
    reach = np.arange(-_NEAR, _NEAR + 1)
    near = np.ix_(reach, reach)
    auto[near] = np.maximum(auto[near], on_marks)
    gain = np.where(used, found.influence[0] * local, 0.0)
    kernel = np.fft.rfft2(auto)
    spread = np.fft.irfft2(np.fft.rfft2(gain, size) * kernel.real, size)[:, : used.shape[0], : used.shape[1]]
    uneven = np.einsum("irc,jrc->ij", gain, spread)
    uneven = (uneven + uneven.T) / 2
    # What the prior knowledge of size and spread leaves is in the covariance of independent errors.
    even = np.einsum("irc,jrc->ij", found.influence[0], found.influence[0]) * float(found.noise[0]) ** 2
    value, vector = np.linalg.eigh(cov + uneven - even)
    least = np.linalg.eigvalsh(cov)[0]
    return np.asarray((vector * np.maximum(value, least)) @ vector.T)


def _unit(found: Matches, by_grey: Array) -> tuple[Array, Array]:
    """Residuals (rows, columns) in units of their local standard deviations, and these."""
    residuals = found.residuals[0]
    used = np.isfinite(residuals)
    v = np.where(used, residuals, 0.0)
    weight = scipy.ndimage.gaussian_filter(used.astype(np.float64), 4.0)
    local = np.sqrt(scipy.ndimage.gaussian_filter(v * v, 4.0) / np.maximum(weight, 1e-3))
    rms = float(np.sqrt((v * v).sum() / max(int(used.sum()), 1)))
    local = np.maximum(np.maximum(local, by_grey), max(0.3 * rms, 1e-9))
    return v / local, local


def _pair_sums(values: Array, weight: Array) -> tuple[Array, Array]:
    """Sums of products of weighted values, and of weights, for each displacement of two windows."""
    size = [2 * n for n in values.shape]
    power = np.abs(np.fft.rfft2(values * weight, size)) ** 2
    pairs = np.abs(np.fft.rfft2(weight, size)) ** 2
    return np.fft.irfft2(power, size), np.fft.irfft2(pairs, size)


def _on_marks(found: list[Matches], spreads: list[Array]) -> Array:
    """Correlations (2r + 1, 2r + 1) of residuals near each other where they influence positions.

    What the adjustment takes from residuals lowers their correlations by the leverage of these pixels.
    """
    reach = np.arange(-_NEAR, _NEAR + 1)
    near = np.ix_(reach, reach)
    sums, pairs = np.zeros((2, len(reach), len(reach)))
    taken, weights = 0.0, 0.0
    for matched, by_grey in zip(found, spreads, strict=True):
        used = np.isfinite(matched.residuals[0])
        activity = np.sqrt((matched.influence[0] ** 2).sum(axis=0)) * used
        if not matched.converged[0] or not activity.max() > 0:
            continue
        activity = activity / activity.max()
        unit, _ = _unit(matched, by_grey)
        own, count = _pair_sums(unit, activity)
        sums, pairs = sums + own[near], pairs + count[near]
        taken += float((activity**2 * np.clip(matched.leverage[0], 0, 1)).sum())
        weights += float((activity**2).sum())
    if not weights > 0:
        return np.full((len(reach), len(reach)), -1.0)
    r = sums / np.maximum(pairs, 1e-9)
    share = taken / weights
    r = r / max(r[_NEAR, _NEAR], 1e-9) + share * np.exp(-np.hypot(*np.meshgrid(reach, reach)) / 2)
    return np.asarray(np.minimum(r, 1.0))
