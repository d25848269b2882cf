"""Calibration of a sensor from a series of frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import scipy

from ..calibration.document import Calibration, Covariance, Quantity, SensorModel
from ..calibration.sensor import Fields, SensorCorrection
from ..core.data import Array, Frame, Mask
from ..core.errors import EstimationError
from ..core.failure import Failure
from ..core.threads import one_thread
from .edge import EdgeSpread, measure_edge
from .series import Image32, Level, SensorSeries, saturation
from .transfer import ROUNDING, Linearity, PhotonTransfer, curve_of, fit_linearity, fit_transfer

_FULL = 0.97
"""Share of the saturation signal above which an edge is clipped."""


@dataclass(frozen=True, eq=False)
class SensorResult:
    """Calibration of a sensor; truthy.

    Parameters
    ----------
    fields : Fields
        Properties of each pixel.
    transfer : PhotonTransfer
        Gain, noise, full-well capacity.
    linearity : Linearity or Failure
        Response to light; a failure with too few exposures, and then treated as linear.
    full_scale : float
        Full scale of the frames.
    exposure_us : float
        Longest unsaturated exposure time.
    edge : EdgeSpread or Failure, optional
        Sharpness; a failure if no edge could be measured.
    scatter : (float, float)
        Variances of bias and response of a pixel that come from the noise of the frames.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> def level(exposure_us):
    ...     light = rng.poisson(2.0 * exposure_us, (8, 16, 16)) / 10
    ...     return Level.of(exposure_us, np.rint(20 + light + rng.normal(0, 2, light.shape)))
    >>> bright = tuple(level(exposure_us) for exposure_us in (100.0, 200.0, 300.0, 400.0, 500.0))
    >>> result = calibrate_sensor(SensorSeries((level(0.0),), bright, full_scale=255.0))
    >>> gain = result.quantities()["gain"]
    >>> round(gain.value, 1), round(gain.sigma, 1), gain.unit
    (10.5, 0.4, 'e-/DN')
    >>> result.exposure_us, result.validity()["size"]
    (500.0, [16, 16])
    """

    fields: Fields
    transfer: PhotonTransfer
    linearity: Linearity | Failure
    full_scale: float
    exposure_us: float
    edge: EdgeSpread | Failure | None = None
    scatter: tuple[float, float] = (0.0, 0.0)

    @property
    def dsnu(self) -> float:
        """Standard deviation of the bias over the good pixels (grey values), without the noise of frames."""
        return self._between_pixels(self.fields.bias, self.scatter[0])

    @property
    def prnu(self) -> float:
        """The same for the response, including uneven light."""
        return self._between_pixels(self.fields.response, self.scatter[1])

    def _between_pixels(self, field: Image32, noise: float) -> float:
        variance = float(field[~self.fields.defects].var(dtype=np.float64)) - noise
        return float(np.sqrt(max(variance, 0.0)))

    @property
    def correction(self) -> SensorCorrection:
        """The correction of frames."""
        b2, b3 = 0.0, 0.0
        if isinstance(self.linearity, Linearity):
            b2, b3 = self.linearity.fit["b2"], self.linearity.fit["b3"]
        return SensorCorrection(self.fields, b2, b3, self.full_scale, self.exposure_us)

    def quantities(self) -> dict[str, Quantity]:
        """Estimated quantities by name."""
        fit = self.transfer.fit
        found = {
            "gain": Quantity(value=fit["gain"], sigma=fit.sigma_of("gain"), unit="e-/DN"),
            "read_noise": Quantity(value=abs(fit["read_noise"]), sigma=fit.sigma_of("read_noise"), unit="DN"),
        }
        if (well := self.transfer.full_well) is not None:
            found["full_well"] = Quantity(value=well[0], sigma=well[1], unit="e-")
        if isinstance(self.linearity, Linearity):
            for name in ("b2", "b3"):
                fit = self.linearity.fit
                found[name] = Quantity(value=fit[name], sigma=fit.sigma_of(name), unit="1")
        if isinstance(self.edge, EdgeSpread):
            found |= self.edge.quantities()
        return found

    def variance(self, frame: Frame, exposures: int, exposure_us: float) -> Array:
        """Variance of the grey values of a corrected frame, from the photon transfer.

        Parameters
        ----------
        frame : Frame
            The uncorrected frame, a mean of several exposures.
        exposures : int
            Number of exposures.
        exposure_us : float
            Exposure time of each.

        Notes
        -----
        With s̃ the linearised signal and q its slope, (q²(σ² + 1/12) + s̃/g) / (n r²).
        """
        u = (frame.pixels - self.fields.dark(exposure_us)).astype(np.float64) / self.full_scale
        b2, b3 = self.correction.b2, self.correction.b3
        signal, slope = u * (1 + b2 * u + b3 * u**2) * self.full_scale, 1 + 2 * b2 * u + 3 * b3 * u**2
        fit = self.transfer.fit
        read = slope**2 * (fit["read_noise"] ** 2 + ROUNDING)
        noise: Array = read + np.maximum(signal, 0.0) / fit["gain"]
        return noise / (exposures * self.fields.response.astype(np.float64) ** 2)

    def calibration(self, name: str, provenance: Mapping[str, Any], times: Mapping[str, str]) -> Calibration:
        """The calibration file ``reseau-calibration/1`` of the kind ``sensor``."""
        fit = self.transfer.fit
        names: tuple[str, ...] = ("gain", "read_noise")
        matrix = np.zeros((4, 4))
        matrix[:2, :2] = fit.covariance_of(*names)
        if isinstance(self.linearity, Linearity):
            names += ("b2", "b3")
            matrix[2:, 2:] = self.linearity.fit.covariance_of("b2", "b3")
        size = len(names)
        rows = tuple(tuple(row) for row in matrix[:size, :size].tolist())
        test = fit.global_test()
        tests = [{"name": "photon transfer", "passed": test.passed, "statistic": test.statistic}]
        model = self.correction.to_model()
        if isinstance(self.edge, EdgeSpread):
            tests, model = tests + self.edge.tests(), cast(SensorModel, model | self.edge.to_model())
        return Calibration(
            kind="sensor",
            name=name,
            model=model,
            parameters=self.quantities(),
            covariance=Covariance(names=names, matrix=rows),
            sigma0=fit.sigma0,
            redundancy=fit.redundancy,
            tests=tuple(tests),
            validity=self.validity(),
            provenance=dict(provenance),
            times=dict(times),
        )

    def validity(self) -> dict[str, Any]:
        """Validity of the calibration, and non-uniformity of the sensor."""
        height, width = self.fields.bias.shape
        straight = isinstance(self.linearity, Linearity)
        found = {
            "size": [width, height],
            "full_scale": self.full_scale,
            "exposure_us": self.exposure_us,
            "dsnu": self.dsnu,
            "prnu": self.prnu,
            "defects": int(self.fields.defects.sum()),
            "nonlinearity": self.linearity.worst if isinstance(self.linearity, Linearity) else None,
            "linearity": "fitted" if straight else getattr(self.linearity, "reason", ""),
            "saturated": self.transfer.curve.plateau is not None,
        }
        if self.edge is None:
            return found
        if isinstance(self.edge, Failure):
            return found | {"edge": self.edge.reason}
        return found | self.edge.validity()


def calibrate_sensor(series: SensorSeries) -> SensorResult:
    """Calibrate a sensor.

    Parameters
    ----------
    series : SensorSeries
        Frames in the dark and of even light.

    Raises
    ------
    EstimationError
        When gain and noise cannot be determined.

    Notes
    -----
    Derived in ``docs/mathematics/sensor.md``.

    Examples
    --------
    Frames of a sensor with a gain of 10 electrons per grey value and a read noise of 2 grey values:

    >>> rng = np.random.default_rng(1)
    >>> def level(exposure_us):
    ...     light = rng.poisson(2.0 * exposure_us, (8, 16, 16)) / 10
    ...     return Level.of(exposure_us, np.rint(20 + light + rng.normal(0, 2, light.shape)))
    >>> bright = tuple(level(exposure_us) for exposure_us in (100.0, 200.0, 300.0, 400.0, 500.0))
    >>> fit = calibrate_sensor(SensorSeries((level(0.0),), bright, full_scale=255.0)).transfer.fit
    >>> bool(abs(fit["gain"] - 10) < 3 * fit.sigma_of("gain")), round(fit["read_noise"], 1)
    (True, 2.0)
    """
    fields = estimate_fields(series)
    curve = curve_of(series, fields)
    linearity = fit_linearity(curve, series.full_scale)
    transfer = fit_transfer(curve, linearity if isinstance(linearity, Linearity) else None)
    if isinstance(transfer, Failure):
        raise EstimationError(transfer.reason, where="photon transfer")
    brightest = curve.exposure_us[curve.bright & curve.usable].max()
    scatter = scatter_of(series, fields)
    return SensorResult(fields, transfer, linearity, series.full_scale, float(brightest), scatter=scatter)


def with_edge(
    result: SensorResult, edge: Level, region: tuple[int, int, int, int] | None = None
) -> SensorResult:
    """The calibration with the sharpness of an edge, measured in corrected frames.

    Parameters
    ----------
    result : SensorResult
        Calibration of the same sensor.
    edge : Level
        Frames of a slanted edge.
    region : (left, top, width, height), optional
        Region that contains nothing else; by default the whole frame.

    Returns
    -------
    SensorResult
        The calibration with the edge.

    Examples
    --------
    >>> from scipy.special import ndtr
    >>> rng = np.random.default_rng(1)
    >>> def level(exposure_us, share=np.ones((24, 24))):
    ...     light = rng.poisson(2.0 * exposure_us * share, (8, 24, 24)) / 10
    ...     return Level.of(exposure_us, np.rint(20 + light + rng.normal(0, 2, light.shape)))
    >>> bright = tuple(level(exposure_us) for exposure_us in (100.0, 200.0, 300.0, 400.0))
    >>> result = calibrate_sensor(SensorSeries((level(0.0),), bright, full_scale=255.0))
    >>> y, x = np.mgrid[-12:12, -12:12]
    >>> found = with_edge(result, level(400.0, 0.2 + 0.8 * ndtr((x - 0.1 * y) / 0.9)))
    >>> bool(abs(found.edge.fit["psf"] - 0.9) < 0.1)
    True
    """
    frame = Frame(edge.mean, result.full_scale, "edge")
    corrected = result.correction.correct(frame, edge.exposure_us)
    if (well := result.transfer.saturation) is not None:
        corrected = replace(corrected, full_scale=min(corrected.full_scale, _FULL * well))
    variance = result.variance(frame, edge.count, edge.exposure_us)
    return replace(result, edge=measure_edge(corrected, region, variance, ~result.fields.defects))


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
