"""Linearity of the response to light, and noise: the photon transfer curve.

Sources: Janesick, *Photon Transfer*; EMVA Standard 1288, release 4.0. The variance of a grey value is the sum
of the variance of the electrons (the signal over the gain in electrons per grey value), of the read noise,
and of rounding to integers (1/12).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..adjust import Adjustment, GaussMarkov, Options, Parameters, adjust
from ..adjust.problem import GaussHelmert
from ..calibration.sensor import Fields
from ..core.data import Array, Mask
from ..core.failure import Code, Failure
from .series import SensorSeries, saturation

ROUNDING = 1 / 12
_COARSE = 1.5
"""Least variance, relative to that of rounding, at which rounding is independent of the signal."""
_LINEAR = 0.7
"""Largest signal of the levels used, as a share of saturation (EMVA 1288)."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Means over the good pixels for each level; dark ones first.

    Parameters
    ----------
    exposure_us, signal, variance : ndarray (m,)
        Exposure time, grey value above the dark one, variance of a pixel from frame to frame.
    signal_sigma, variance_sigma : ndarray (m,)
        Their standard deviations.
    bright : ndarray (m,) of bool
        Which levels are bright.
    usable : ndarray (m,) of bool
        Which levels are far enough below saturation.
    plateau : float or None
        Signal at saturation; None if no level is saturated.
    light : ndarray (m,), optional
        Amount of light in any unit, if not the exposure time alone varies.
    dark : ndarray (m,) or float
        Grey value of the dark current.
    """

    exposure_us: Array
    signal: Array
    variance: Array
    signal_sigma: Array
    variance_sigma: Array
    bright: Mask
    usable: Mask
    plateau: float | None
    light: Array | None = None
    dark: Array | float = 0.0

    @property
    def amount(self) -> Array:
        """The light (m,), in its own unit or by the exposure times."""
        return self.exposure_us if self.light is None else self.light


def curve_of(series: SensorSeries, fields: Fields) -> Curve:
    """The photon transfer curve of a series."""
    good = ~fields.defects
    levels = [*series.dark, *series.bright]
    bright = np.array([False] * len(series.dark) + [True] * len(series.bright))
    times = np.array([level.exposure_us for level in levels])
    signal = np.array(
        [
            float((level.mean - fields.dark(level.exposure_us))[good].mean(dtype=np.float64)) if lit else 0.0
            for level, lit in zip(levels, bright, strict=True)
        ]
    )
    variance = np.array([float(level.variance[good].mean(dtype=np.float64)) for level in levels])
    frames = np.array([level.count for level in levels])
    freedom = (frames - 1) * int(good.sum())
    # The minimum variance is that of rounding, as in saturation or below one grey value.
    safe = np.maximum(variance, ROUNDING)
    plateau, most = saturation(signal[bright], variance[bright])
    light = None
    if series.bright[0].light is not None:
        light = np.array([level.amount if lit else 0.0 for level, lit in zip(levels, bright, strict=True)])
    usable = ~bright | (signal <= _LINEAR * most)
    return Curve(
        times,
        signal,
        variance,
        np.sqrt(safe / (frames * good.sum())),
        safe * np.sqrt(2 / freedom),
        bright,
        usable,
        plateau,
        light,
        np.maximum(float(fields.dark_current[good].mean(dtype=np.float64)), 0.0) * times,
    )


@dataclass(frozen=True, eq=False)
class Linearity:
    """Deviation of the response from a straight line.

    Parameters
    ----------
    fit : Adjustment
        Adjustment of `slope` (grey values per microsecond, relative to that of a line), `b2` and `b3`:
        signal·(1 + b2·u + b3·u²) = slope·exposure, with u the signal over full scale.
    full_scale : float
        Full scale used for u.
    worst : float
        Largest deviation of a level from the straight line, relative to its signal.

    Examples
    --------
    >>> signal, times = np.array([20.0, 40.0, 60.0, 80.0]), np.array([100.0, 200.0, 300.0, 400.0])
    >>> sigma, bright = np.full(4, 0.05), np.ones(4, dtype=bool)
    >>> curve = Curve(times, signal, signal / 10 + 4, sigma, np.full(4, 0.1), bright, bright, None)
    >>> found = fit_linearity(curve, 255.0)
    >>> found.worst < 1e-6, found.straight(np.array([50.0]))[0].round(6)
    (True, array([50.]))
    """

    fit: Adjustment
    full_scale: float
    worst: float

    def straight(self, signal: Array) -> tuple[Array, Array]:
        """Linearised signals, and the derivative of the linearisation there."""
        u, b2, b3 = signal / self.full_scale, self.fit["b2"], self.fit["b3"]
        return signal * (1 + b2 * u + b3 * u**2), 1 + 2 * b2 * u + 3 * b3 * u**2


def fit_linearity(curve: Curve, full_scale: float) -> Linearity | Failure:
    """Fit the linearity to the bright levels below saturation; exposure times are treated as error-free.

    Parameters
    ----------
    curve : Curve
        Means of the levels.
    full_scale : float
        Grey value at which the converter saturates.

    Returns
    -------
    Linearity or Failure
        A failure with fewer than four levels.

    Examples
    --------
    >>> times = np.array([100.0, 200.0, 300.0, 400.0, 500.0])
    >>> light = 0.2 * times
    >>> signal, bright = light * (1 - 0.1 * light / 255), np.ones(5, dtype=bool)
    >>> curve = Curve(times, signal, light / 10 + 4, np.full(5, 0.05), np.full(5, 0.1), bright, bright, None)
    >>> found = fit_linearity(curve, 255.0)
    >>> round(found.fit["b2"], 2), found.straight(signal)[0].round(1)
    (0.1, array([ 20.,  40.,  60.,  80., 100.]))
    """
    use = curve.bright & curve.usable & (curve.amount > 0)
    signal, times = curve.signal[use][:, None], curve.amount[use][:, None]
    if len(signal) < 4:
        return Failure(
            "fewer than four bright levels below saturation: take more exposures", Code.TOO_FEW_LEVELS
        )
    scale = float((signal * times).sum() / (times**2).sum())

    def conditions(observed: Array, x: Array) -> Array:
        u = observed / full_scale
        left: Array = observed * (1 + x[1] * u + x[2] * u**2) - x[0] * scale * times
        return left

    def jacobians(observed: Array, x: Array) -> tuple[Array, Array]:
        u = observed / full_scale
        by_parameters = np.stack([-scale * times, observed * u, observed * u**2], axis=-1)
        by_signal = 1 + 2 * x[1] * u + 3 * x[2] * u**2
        return by_parameters, by_signal[..., None]

    parameters = Parameters(["slope", "b2", "b3"], [1.0, 0.0, 0.0])
    problem = GaussHelmert(conditions, signal, curve.signal_sigma[use][:, None], parameters, jacobians)
    found = adjust(problem)
    if isinstance(found, Failure):
        return found
    straight = found["slope"] * scale * times
    worst = float(np.abs(signal / straight - 1).max())
    return Linearity(found, full_scale, worst)


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """Gain and noise of a sensor.

    Parameters
    ----------
    fit : Adjustment
        Adjustment of `gain` (electrons per grey value) and `read_noise` (grey values).
    curve : Curve
        The curve it was fitted to.
    saturation : float or None
        Linearised signal at saturation; None if no level is saturated.

    Examples
    --------
    >>> signal, bright = np.array([0.0, 50.0, 100.0, 150.0]), np.array([False, True, True, True])
    >>> sigma, variance = np.full(4, 0.05), 2.0**2 + 1 / 12 + signal / 10
    >>> usable = np.ones(4, dtype=bool)
    >>> curve = Curve(2 * signal, signal, variance, sigma, np.full(4, 0.1), bright, usable, 235.0)
    >>> well, well_sigma = fit_transfer(curve).full_well
    >>> round(well), round(well_sigma)
    (2350, 21)
    """

    fit: Adjustment
    curve: Curve
    saturation: float | None

    @property
    def full_well(self) -> tuple[float, float] | None:
        """Full-well capacity in electrons, and its sigma; None if no level is saturated."""
        if self.saturation is None:
            return None
        return self.saturation * self.fit["gain"], self.saturation * self.fit.sigma_of("gain")


def fit_transfer(curve: Curve, linearity: Linearity | None = None) -> PhotonTransfer | Failure:
    """Fit the photon transfer curve: σ² = σ_read² + 1/12 + (signal + dark current)/gain.

    For a non-linear response the signal is linearised, and its part of the variance is divided by the square
    of the slope. The uncertainty of the signal is propagated to the variance.

    Parameters
    ----------
    curve : Curve
        Means of the levels.
    linearity : Linearity, optional
        Response; by default it is linear.

    Returns
    -------
    PhotonTransfer or Failure
        A failure with too few levels, or if the variance does not increase with the light.

    Examples
    --------
    >>> signal, bright = np.array([0.0, 50.0, 100.0, 150.0]), np.array([False, True, True, True])
    >>> sigma, variance = np.full(4, 0.05), 2.0**2 + 1 / 12 + signal / 10
    >>> usable = np.ones(4, dtype=bool)
    >>> curve = Curve(2 * signal, signal, variance, sigma, np.full(4, 0.1), bright, usable, None)
    >>> found = fit_transfer(curve)
    >>> round(found.fit["gain"], 3), round(found.fit["read_noise"], 3), found.full_well
    (10.0, 2.0, None)
    """
    use = curve.usable
    signal, variance = curve.signal[use], curve.variance[use]
    dark = np.broadcast_to(curve.dark, use.shape)[use]
    top, saturation = np.array([curve.plateau or 0.0]), curve.plateau
    if linearity is not None:
        signal, bend = linearity.straight(signal)
        signal = signal / bend**2
        saturation = None if curve.plateau is None else float(linearity.straight(top)[0][0])
    if (curve.bright & use).sum() < 2 or not np.ptp(signal) > 0:
        return Failure(
            "fewer than two bright levels below saturation: take shorter exposures", Code.TOO_FEW_LEVELS
        )
    signal = signal + dark  # electrons of the dark current scatter as those of light do
    slope, floor = np.polyfit(signal, variance, 1, w=1 / curve.variance_sigma[use])
    if not slope > 0:
        return Failure(
            "the variance does not increase with the light: check that it is even and no gamma curve is set",
            Code.INCONSISTENT,
        )
    least = float(variance.min())
    if least < _COARSE * ROUNDING:
        return Failure(
            f"the noise in the dark, {np.sqrt(max(least, 0.0)):.2g} grey values, is lost in rounding: use a "
            "higher gain or more bits",
            Code.INCONSISTENT,
        )
    sigma = np.hypot(curve.variance_sigma[use], slope * curve.signal_sigma[use] * curve.bright[use])

    def computed(x: Array) -> Array:
        expected: Array = x[1] ** 2 + ROUNDING + signal / x[0]
        return expected

    def jacobian(x: Array) -> Array:
        return np.stack([-signal / x[0] ** 2, np.full_like(signal, 2 * x[1])], axis=1)

    start = [1 / slope, np.sqrt(max(floor - ROUNDING, 1e-4))]
    parameters = Parameters(["gain", "read_noise"], start)
    found = adjust(GaussMarkov(computed, variance, sigma, parameters, jacobian), Options(scale="a-priori"))
    return found if isinstance(found, Failure) else PhotonTransfer(found, curve, saturation)
