"""Checks before an acquisition: exposure, focus, vibration, drift."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import scipy

from ..core.data import Array, Frame
from ..core.errors import UsageError
from ..core.numbers import or_null

_PIXEL = math.sqrt(1 / 12)
_REACHES = (6, 12, 24)
_SMOOTH = 1.5
_SLOPE = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12


@dataclass(frozen=True)
class Limits:
    """Limits of the checks.

    Parameters
    ----------
    saturated : float
        Largest share of pixels at full scale.
    darkest : float
        The brightest thousandth of the pixels must reach this share of full scale.
    edge_px : float
        Largest width (one sigma, px) of the sharpest edges.
    vibration_px : float
        Largest rms shift from frame to frame (px).
    drift_px, drift_level : float
        Largest shift (px) and relative change of brightness from the first frame to the last.

    Examples
    --------
    >>> Limits(edge_px=3.0).saturated
    0.01
    """

    saturated: float = 0.01
    darkest: float = 0.15
    edge_px: float = 2.5
    vibration_px: float = 0.05
    drift_px: float = 0.1
    drift_level: float = 0.02


@dataclass(frozen=True)
class Readiness:
    """Result of the checks on frames of a static scene; truthy if no limit is exceeded.

    Parameters
    ----------
    saturated, bright : float
        Share of saturated pixels; grey value exceeded by a thousandth of the pixels, relative to full scale.
    edge_px : float
        Width (one sigma, px) of the sharpest edges: of a step edge, point-spread function and pixel.
    vibration_px, vibration_sigma_px : float
        Rms shift from frame to frame (px), and its standard deviation due to noise alone.
    drift_px, drift_level : float
        Shift (px) and relative change of brightness from the first frame to the last.
    faults : tuple of str
        Exceeded limits, each with a remedy.

    Examples
    --------
    >>> bool(Readiness(0.0, 0.8, 1.1, 0.01, 0.01, 0.0, 0.0, faults=("no edges found: focus",)))
    False
    """

    saturated: float
    bright: float
    edge_px: float
    vibration_px: float
    vibration_sigma_px: float
    drift_px: float
    drift_level: float
    faults: tuple[str, ...]

    def __bool__(self) -> bool:
        return not self.faults

    def to_dict(self) -> dict[str, object]:
        """Return JSON values; None for a value that could not be determined."""
        found = {key: value for key, value in asdict(self).items() if key != "faults"}
        return {k: or_null(v) for k, v in found.items()} | {"faults": list(self.faults)}


def exposure_fault(frame: Frame, limits: Limits | None = None) -> str:
    """Return what is wrong with the exposure of a frame; empty if nothing is.

    Examples
    --------
    >>> exposure_fault(Frame(np.full((40, 50), 255, np.uint8), 255.0))
    '100 % of the pixels are saturated: expose less'
    """
    limits = limits or Limits()
    saturated, bright = exposure_of(frame)
    if saturated > limits.saturated:
        return f"{_percent(saturated)} of the pixels are saturated: expose less"
    if bright < limits.darkest:
        return f"brightest pixels reach only {_percent(bright)} of full scale: expose more"
    return ""


def _percent(share: float) -> str:
    return f"{float(f'{100 * share:.2g}'):g} %"


def exposure_of(frame: Frame) -> tuple[float, float]:
    """Return the share of saturated pixels, and the grey value that a thousandth exceeds, of full scale.

    Examples
    --------
    >>> exposure_of(Frame(np.full((40, 50), 51, np.uint8), 255.0))
    (0.0, 0.2)
    """
    pixels = frame.pixels
    bright = np.partition(pixels.ravel(), -1 - pixels.size // 1000)[-1 - pixels.size // 1000]
    return float(np.mean(pixels >= frame.full_scale)), float(bright) / frame.full_scale


def grey_counts(frame: Frame, bins: int = 64) -> list[int]:
    """Return how many pixels have each grey value; the last number is that of saturated ones.

    Of a large frame each second, third, … row and column are counted.

    Parameters
    ----------
    frame : Frame
        The frame.
    bins : int
        Number of intervals below full scale.

    Examples
    --------
    >>> grey_counts(Frame(np.array([[0, 10, 200, 255], [0, 0, 130, 255]], np.uint8), 255.0), 2)
    [4, 2, 2]
    """
    every = max(1, math.isqrt(frame.pixels.size // 250_000))
    grey = frame.pixels[::every, ::every].ravel() / frame.full_scale
    at = np.where(grey >= 1.0, bins, np.clip(grey, 0.0, None) * bins).astype(np.intp)
    return [int(each) for each in np.bincount(at, minlength=bins + 1)]


def edge_sigma(frame: Frame) -> float:
    """Return the width (one sigma, px) of the sharpest edges of a frame; infinite if there are no edges.

    Notes
    -----
    Of a step of height h, blurred by a Gaussian of σ, the pixels before and after its middle differ by
    (2 Φ(1 px / σ) − 1) h. The median over the steepest places is inverted; a place is chosen by its
    neighbours along the edge, so that noise is not taken for a slope. σ includes the width of a pixel,
    1/√12 = 0.29 px, and nothing smaller is returned.

    Examples
    --------
    >>> from scipy.special import ndtr
    >>> edge = 200 * ndtr((np.arange(60.0) - 30) / 2) * np.ones((60, 1))
    >>> round(edge_sigma(Frame(edge, 255.0)), 1)
    2.0
    """
    grey = frame.pixels.astype(np.float64)
    # Along rows, then along columns: the steepest places and the levels on both sides of them.
    quantum = 1.0 if np.issubdtype(frame.pixels.dtype, np.integer) else 0.0
    sigma = 0.0
    for reach in _REACHES:
        share = max(_steepest(grey, reach, quantum), _steepest(grey.T, reach, quantum))
        if share > 0.0:
            # Too short a reach and a second edge within it both make the height too small, and so the width.
            sigma = max(sigma, 1.0 / float(scipy.special.ndtri(0.5 + 0.5 * min(share, 0.9999))), _PIXEL)
        if sigma <= reach / 4:
            break
    return sigma or float("inf")


def _steepest(grey: Array, reach: int, quantum: float) -> float:
    """Share of an edge's height that lies between the pixels on its two sides; 0 if there are no edges."""
    if grey.shape[1] < 2 * reach + 3 or grey.shape[0] < 3:
        return 0.0
    slope = np.abs(grey[:, 2:] - grey[:, :-2])[:, reach:-reach]
    beside = slope[2:] + slope[:-2]
    count = min(max(100, beside.size // 1000), beside.size)
    at = np.argpartition(beside, -count, axis=None)[-count:]
    row, column = np.unravel_index(at, beside.shape)
    row, centre = row + 1, column + reach + 1
    around = grey[row[:, None], centre[:, None] + np.arange(-reach, reach + 1)]
    height = np.abs(around[:, -2:].mean(axis=1) - around[:, :2].mean(axis=1))
    noise = 1.4826 * np.median(np.abs(np.diff(grey, axis=1))) / np.sqrt(2)
    real = height > 10 * max(noise, quantum * _PIXEL)
    if not real.any():
        return 0.0
    return float(np.median(slope[row, column][real] / height[real]))


def shift_between(first: Frame, second: Frame) -> tuple[Array, Array]:
    """Return the shift of the second frame against the first, to the right and down, of the same scene.

    Returns
    -------
    ndarray (2,), ndarray (2,)
        Shift and its standard deviations (px) from all pixels together; for shifts below a pixel.

    Raises
    ------
    UsageError
        If the frames differ in size.

    Notes
    -----
    Least-squares matching of whole frames (Förstner 1982): g₂ = a g₁ + b − ∇g·d. The gradient of the mean of
    both makes the linearisation accurate to the second order. Both frames are smoothed first, because finite
    differences underestimate steep slopes. The covariance is therefore N⁻¹ (SA)ᵀ(SA) N⁻¹ times the variance
    of the noise before smoothing, which is that of the residuals times 4πs².

    Examples
    --------
    >>> y, x = np.mgrid[:40, :40] / 5.0
    >>> scene = lambda d: Frame(100 + 50 * np.sin(x - d / 5) * np.cos(y), 255.0)
    >>> shift, sigma = shift_between(scene(0.0), scene(0.2))
    >>> shift.round(2).tolist()
    [0.21, 0.0]
    """
    if first.pixels.shape != second.pixels.shape:
        raise UsageError("differs in size from the first frame", where=second.name)
    one, two = (scipy.ndimage.gaussian_filter(f.pixels.astype(np.float64), _SMOOTH) for f in (first, second))
    both = 0.5 * (one + two)
    right, down = (scipy.ndimage.correlate1d(both, _SLOPE, axis) for axis in (1, 0))
    columns = [-right, -down, one, np.ones_like(one)]
    design = np.column_stack([column.ravel() for column in columns])
    try:
        inverse = np.linalg.inv(design.T @ design)
    except np.linalg.LinAlgError:
        return np.full(2, np.nan), np.full(2, np.inf)
    estimate = inverse @ (design.T @ two.ravel())
    rest = two.ravel() - design @ estimate
    variance = 4 * np.pi * _SMOOTH**2 * float(rest @ rest) / max(rest.size - 4, 1)
    again = [scipy.ndimage.gaussian_filter(column, _SMOOTH) for column in columns]
    seen = np.column_stack([column.ravel() for column in again]) @ inverse
    return estimate[:2], np.sqrt(variance * np.diagonal(seen.T @ seen)[:2])


def readiness(frames: Sequence[Frame], limits: Limits | None = None) -> Readiness:
    """Check a series of at least two frames of a static scene.

    Parameters
    ----------
    frames : sequence of Frame
        In the order in which they were taken.
    limits : Limits, optional
        Limits of the checks.

    Raises
    ------
    UsageError
        If there are fewer frames, or they differ in size.

    Examples
    --------
    >>> flat = Frame(np.full((40, 40), 90, np.uint8), 255.0)
    >>> readiness([flat, flat]).faults
    ('no edges found: focus, or point the camera at a target',)
    """
    if len(frames) < 2:
        raise UsageError("at least two frames are needed", where="checks")
    limits = limits or Limits()
    saturated, bright = exposure_of(frames[0])
    edge = edge_sigma(frames[0])
    steps = [shift_between(one, two) for one, two in itertools.pairwise(frames)]
    moved = np.array([step for step, _ in steps])
    noise = np.array([sigma for _, sigma in steps])
    vibration = float(np.sqrt(np.mean(moved**2)))
    sigma = float(np.sqrt(np.mean(noise**2)))
    drift, drift_sigma = shift_between(frames[0], frames[-1])
    means = [float(frame.pixels.mean()) for frame in (frames[0], frames[-1])]
    level = means[1] / means[0] - 1 if means[0] else 0.0
    faults = [exposure_fault(frames[0], limits)]
    if math.isinf(edge):
        faults.append("no edges found: focus, or point the camera at a target")
    elif edge > limits.edge_px:
        faults.append(f"the sharpest edges are {edge:.1f} px wide: focus")
    if vibration > limits.vibration_px + 3 * sigma:  # both are NaN if nothing in the scene shows a shift
        faults.append(f"vibration of {vibration:.2g} px from frame to frame: find its source")
    if np.hypot(*drift) > limits.drift_px + 3 * float(np.hypot(*drift_sigma)):
        faults.append(f"drift of {np.hypot(*drift):.2g} px: let the camera warm up")
    if abs(level) > limits.drift_level:
        faults.append(f"brightness drift of {_percent(level)}: let the camera warm up")
    return Readiness(
        saturated,
        bright,
        edge,
        vibration,
        sigma,
        float(np.hypot(*drift)),
        level,
        tuple(fault for fault in faults if fault),
    )
