"""Fields over the pixels of a sensor: bias, dark current, response, and defective pixels."""

from __future__ import annotations

import numpy as np
import scipy

from ..calibration.sensor import Fields
from ..core.data import Mask
from ..core.threads import one_thread
from .series import Image32, Level, SensorSeries, saturation

_FALSE_ALARMS = 0.5
"""Expected number of good pixels classified as defective, over a whole sensor."""
_TESTS = 4
_BRIGHTEST = 0.8
"""Largest signal, as a share of saturation or of full scale, of levels used for the response."""
_MAD = 1.4826


def estimate_fields(series: SensorSeries) -> Fields:
    """Estimate bias and dark current from each pixel's dark levels, the response from its bright ones.

    Straight lines are fitted by least squares in closed form, weighted by the numbers of frames. A pixel is
    defective if it differs from the others in bias, dark current, response (robust normal test) or scatter
    (χ² test); the level gives half a false alarm on the whole sensor.

    Parameters
    ----------
    series : SensorSeries
        Frames in the dark and of even light.

    Returns
    -------
    Fields
        The properties of each pixel.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> def level(exposure_us):
    ...     frames = 20 + 0.2 * exposure_us + rng.normal(0, 2, (8, 16, 16))
    ...     frames[:, 3, 5] += 50.0  # a hot pixel
    ...     return Level.of(exposure_us, frames)
    >>> bright = tuple(level(exposure_us) for exposure_us in (100.0, 200.0, 300.0))
    >>> fields = estimate_fields(SensorSeries((level(0.0),), bright, full_scale=255.0))
    >>> bool(fields.defects[3, 5]), round(float(fields.bias.mean()))
    (True, 20)
    """
    bias, current = _dark_lines(series.dark)
    bright = _unsaturated(series, float(bias.mean()))
    signal = np.zeros(series.shape)
    for level in bright:
        signal += level.count * (level.mean - bias - current * level.exposure_us)
    usual = float(np.median(signal))
    response = signal / usual if usual > 0 else np.ones(series.shape)
    defects = _outliers(bias) | _outliers(_unshaded(response)) | _noisy(series)
    if np.ptp([level.exposure_us for level in series.dark]) > 0:
        defects |= _outliers(current)
    good = ~defects
    response = np.where(good, response / response[good].mean(), 1.0)
    return Fields(bias.astype(np.float32), current.astype(np.float32), response.astype(np.float32), defects)


def scatter_of(series: SensorSeries, fields: Fields) -> tuple[float, float]:
    """Variances of bias and response of a good pixel that come from the noise of the frames.

    Parameters
    ----------
    series : SensorSeries
        The frames.
    fields : Fields
        What was estimated from them.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> def level(exposure_us):
    ...     return Level.of(exposure_us, 20 + 0.2 * exposure_us + rng.normal(0, 2, (8, 32, 32)))
    >>> bright = tuple(level(exposure_us) for exposure_us in (100.0, 200.0, 300.0))
    >>> series = SensorSeries((level(0.0),), bright, full_scale=255.0)
    >>> round(scatter_of(series, estimate_fields(series))[0], 1)  # 2² / 8
    0.5
    """
    good = ~fields.defects
    weights = np.array([level.count for level in series.dark], dtype=np.float64)
    times = np.array([level.exposure_us for level in series.dark])
    noise = np.array([level.variance[good].mean(dtype=np.float64) for level in series.dark])
    middle = float(weights @ times / weights.sum())
    spread = float(weights @ (times - middle) ** 2)
    # The bias is a weighted sum of the dark means.
    share = weights / weights.sum() - (middle * weights * (times - middle) / spread if spread > 0 else 0.0)
    bias = float((share**2 / weights) @ noise)
    light, total, frames = 0.0, 0.0, 0.0
    for level in _unsaturated(series, float(fields.bias[good].mean())):
        signal = float((level.mean - fields.dark(level.exposure_us))[good].mean(dtype=np.float64))
        light += level.count * signal
        total += level.count * float(level.variance[good].mean(dtype=np.float64))
        frames += level.count
    return bias, (total + frames**2 * bias) / light**2 if light > 0 else 0.0


def _unsaturated(series: SensorSeries, dark: float) -> list[Level]:
    """Bright levels below saturation, wherever it is: files with 16 bits hold grey values of 12."""
    signal = np.array([level.mean.mean(dtype=np.float64) - dark for level in series.bright])
    variance = np.array([level.variance.mean(dtype=np.float64) for level in series.bright])
    plateau = saturation(signal, variance)[0]
    most = series.full_scale - dark if plateau is None else min(plateau, series.full_scale - dark)
    found = [level for level, s in zip(series.bright, signal, strict=True) if s < _BRIGHTEST * most]
    return found or [series.bright[0]]


def _dark_lines(levels: tuple[Level, ...]) -> tuple[Image32, Image32]:
    weights = np.array([level.count for level in levels], dtype=np.float64)
    times = np.array([level.exposure_us for level in levels])
    middle = float((weights * times).sum() / weights.sum())
    mean = sum(w * level.mean.astype(np.float64) for w, level in zip(weights, levels, strict=True))
    mean = mean / weights.sum()
    spread = float((weights * (times - middle) ** 2).sum())
    slope = np.zeros_like(mean)
    if spread > 0:
        for w, t, level in zip(weights, times, levels, strict=True):
            slope += w * (t - middle) * level.mean / spread
    return (mean - slope * middle).astype(np.float32), slope.astype(np.float32)


def _unshaded(response: np.ndarray) -> np.ndarray:
    """The response without slow changes: falloff of light is no defect."""
    across, down = (np.vander(np.linspace(-1, 1, n), 4, increasing=True) for n in response.shape[::-1])
    flat = response.ravel()
    usual = np.abs(flat - np.median(flat)) < 10 * _MAD * np.median(np.abs(flat - np.median(flat))) + 1e-12
    chosen = np.flatnonzero(usual)[:: max(1, flat.size // 20000)]
    row, column = np.divmod(chosen, response.shape[1])
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    terms = np.stack([across[column, i] * down[row, j] for i, j in powers], axis=-1)
    surface = np.zeros((4, 4))
    with one_thread():  # makes sums independent of the number of processors
        surface[tuple(np.transpose(powers))] = np.linalg.lstsq(terms, flat[chosen], rcond=None)[0]
        rest: np.ndarray = response - down @ surface.T @ across.T
    return rest


def _outliers(values: np.ndarray) -> Mask:
    middle = np.median(values)
    scale = _MAD * np.median(np.abs(values - middle))
    limit = -scipy.special.ndtri(_FALSE_ALARMS / _TESTS / values.size / 2)
    found: Mask = np.abs(values - middle) > limit * max(scale, 1e-12)
    return found if scale > 0 else np.zeros(values.shape, dtype=bool)


def _noisy(series: SensorSeries) -> Mask:
    """Mask of pixels that scatter in the dark more than χ² allows."""
    dof = sum(level.count - 1 for level in series.dark)
    pooled = np.zeros(series.shape)
    for level in series.dark:
        pooled += (level.count - 1) / dof * level.variance
    usual = float(np.median(pooled)) / (scipy.special.chdtri(dof, 0.5) / dof)
    limit = scipy.special.chdtri(dof, _FALSE_ALARMS / _TESTS / pooled.size) / dof
    noisy: Mask = pooled > limit * max(usual, 1 / 12)
    return noisy
