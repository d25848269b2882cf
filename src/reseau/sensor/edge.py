"""Sharpness from a slanted edge (ISO 12233): modulation transfer without assumptions, and a Gaussian model.

A straight edge between dark and bright, slanted by a few degrees, is sampled at all distances from the centre
of a pixel. It is described twice: see :mod:`reseau.sensor.gaussian_edge` and :mod:`reseau.sensor.free_curve`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from ..adjust import Adjustment
from ..adjust.fitted import compare
from ..adjust.significance import CoefficientTest, NestedTest
from ..calibration.document import Quantity
from ..core.data import Array, Frame, Mask
from ..core.failure import Code, Failure
from ..core.threads import one_thread
from .free_curve import FREQUENCIES, FreeCurve, fit_free
from .gaussian_edge import EdgePixels, approximate_edge, fit_gaussian

_REACH_PX, _REACH_PSF = 8.0, 4.0
"""Distance from the edge up to which pixels are used for the Gaussian: the larger of pixels and widths."""
_FREE_REACH_PX, _FREE_REACH_PSF = 32.0, 12.0
"""The same for the free curve."""
LEAST_SLANT, MOST_SLANT = 0.02, 0.6
"""Limits of the slant in radians; below, all pixels along the edge have nearly the same distance."""
_LEAST_CONTRAST, _BESIDE_PX = 5.0, 2.0
"""Minimum contrast of an edge over the noise of a pixel; distance from the edge of its two flat sides."""
ALPHA = 0.01
"""Level of significance of the tests."""
_SATURATED = 0.005
"""Largest share of saturated pixels in the region."""


@dataclass(frozen=True, eq=False)
class EdgeSpread:
    """Sharpness of an edge.

    Parameters
    ----------
    fit : Adjustment
        Adjustment of `offset` (px), `slope` and `bow` of the edge (zero for a straight edge), `dark` and
        `bright` beside it, and `psf` (px, one sigma; fixed if the edge shows no width).
    free : FreeCurve or Failure
        Modulation transfer without the assumption of a Gaussian; a failure if there are too few pixels.
    gaussian : NestedTest or None
        Test of whether more than the Gaussian is needed; significant if it does not describe the edge.
    bent : CoefficientTest or None
        Test of whether the edge is curved.

    Examples
    --------
    >>> from scipy.special import ndtr
    >>> y, x = np.mgrid[-12:12, -12:12]
    >>> pixels = EdgePixels.of(40 + 150 * ndtr((x - 0.1 * y) / 0.9), np.ones((24, 24), dtype=bool))
    >>> fit = fit_gaussian(pixels, np.array([12.0, 0.1, 0.0, 40.0, 190.0, 0.8]), np.inf)
    >>> edge = EdgeSpread(fit.required(), Failure("not measured", Code.TOO_SMALL))
    >>> round(edge.fit["psf"], 2), round(float(np.rad2deg(edge.angle)), 1), round(edge.mtf50[0], 2)
    (0.85, 5.7, 0.21)
    """

    fit: Adjustment
    free: FreeCurve | Failure
    gaussian: NestedTest | None = None
    bent: CoefficientTest | None = None

    @property
    def angle(self) -> float:
        """Angle of the edge from its axis (rad)."""
        return float(np.arctan(self.fit["slope"]))

    def mtf(self, frequency: Array | float, psf: float | None = None) -> Array:
        """Modulation transfer of the Gaussian at frequencies in cycles per pixel, along the normal of the
        edge; includes the square of the pixel.
        """
        f = np.asarray(frequency, dtype=np.float64)
        width = self.fit["psf"] if psf is None else psf
        blur = np.exp(-2 * (np.pi * width * f) ** 2)
        transfer: Array = blur * np.abs(np.sinc(f * np.cos(self.angle)) * np.sinc(f * np.sin(self.angle)))
        return transfer

    @property
    def mtf50(self) -> tuple[float, float]:
        """Frequency at which the modulation of the Gaussian is 0.5 (cycles per pixel), and its sigma."""

        def half(psf: float) -> float:
            return float(scipy.optimize.brentq(lambda f: float(self.mtf(f, psf)) - 0.5, 1e-6, 0.99))

        psf, step = abs(self.fit["psf"]), 1e-4
        slope = (half(psf + step) - half(max(psf - step, 0.0))) / (step + min(step, psf))
        return half(psf), abs(slope) * self.fit.sigma_of("psf")

    def quantities(self) -> dict[str, Quantity]:
        """Estimated quantities by name: of the Gaussian, and of the free curve."""
        half, sigma = self.mtf50
        found = {
            "psf": Quantity(value=abs(self.fit["psf"]), sigma=self.fit.sigma_of("psf"), unit="px"),
            "mtf50": Quantity(value=half, sigma=sigma, unit="1/px"),
        }
        if isinstance(self.free, FreeCurve):
            if (free := self.free.mtf50) is not None:
                found["mtf50_free"] = Quantity(value=free[0], sigma=free[1], unit="1/px")
            value, sigma = self.free.nyquist
            found["mtf_nyquist_free"] = Quantity(value=value, sigma=sigma, unit="1")
        return found

    def to_model(self) -> dict[str, Any]:
        """Curves for a calibration file: the free curve in columns, and that of the Gaussian."""
        if isinstance(self.free, Failure):
            return {}
        frequency = FREQUENCIES[: int(np.searchsorted(FREQUENCIES, self.free.limit, side="right"))]
        value, sigma = self.free.mtf(frequency)
        columns = {"frequency": frequency, "mtf": value, "sigma": sigma, "gaussian": self.mtf(frequency)}
        return {"mtf": {name: column.tolist() for name, column in columns.items()}}

    def tests(self) -> list[dict[str, Any]]:
        """Tests for a calibration file: Gaussian edge, straight edge, constant sides."""
        if isinstance(self.free, Failure):
            return []
        found: list[dict[str, Any]] = [
            {"name": name, "passed": not test.significant, "statistic": test.statistic, "p": test.p}
            for name, test in (("Gaussian edge", self.gaussian), ("straight edge", self.bent))
            if test is not None
        ]
        rise, p = self.free.ends()
        return [*found, {"name": "flat beside the edge", "passed": p >= ALPHA, "statistic": rise, "p": p}]

    def validity(self) -> dict[str, Any]:
        """Description for a calibration file: the method and the slant."""
        free = "measured" if self.free else f"no free curve: {getattr(self.free, 'reason', '')}"
        return {"edge": free, "edge_angle_deg": float(np.rad2deg(self.angle))}


def measure_edge(
    frame: Frame,
    region: tuple[int, int, int, int] | None = None,
    variance: Array | None = None,
    good: Mask | None = None,
) -> EdgeSpread | Failure:
    """Measure the edge in a region.

    Parameters
    ----------
    frame : Frame
        A frame with a straight edge, nearly vertical or horizontal; grey values proportional to the light.
    region : (left, top, width, height), optional
        Region that contains nothing else; by default the whole frame.
    variance : ndarray (height, width), optional
        Variance of the grey values, up to a common factor, if the photon transfer is known; by default one
        value for the dark and one for the bright side are estimated from the residuals.
    good : ndarray (height, width) of bool, optional
        Pixels to be used; by default all.

    Returns
    -------
    EdgeSpread or Failure
        A failure if the region has no suitable edge.

    Examples
    --------
    A vertical edge with a slope of 0.1 and a width of 0.9 px:

    >>> import numpy as np
    >>> from scipy.special import ndtr
    >>> x, y = np.meshgrid(np.arange(40.0) - 20, np.arange(40.0) - 20)
    >>> grey = 40 + 150 * ndtr((x - 0.1 * y) / 0.9) + np.random.default_rng(1).normal(0, 1, x.shape)
    >>> found = measure_edge(Frame(grey.astype(np.float32), 255.0))
    >>> round(float(np.rad2deg(found.angle)), 0)
    6.0
    """
    left, top, width, height = region or (0, 0, frame.width, frame.height)
    inside = np.s_[max(top, 0) : top + height, max(left, 0) : left + width]
    pixels = frame.pixels[inside].astype(np.float64)
    if min(pixels.shape) < 16:
        return Failure("the region of the edge is smaller than 16 pixels", Code.TOO_SMALL)
    usable = np.ones(pixels.shape, dtype=bool) if good is None else good[inside]
    if np.mean(pixels[usable] >= frame.full_scale) > _SATURATED:
        return Failure("its bright side is saturated: reduce the exposure", Code.SATURATED)
    noise = None if variance is None else variance[inside]
    across, along = (np.abs(np.diff(pixels, axis=axis)).sum() for axis in (1, 0))
    if along > across:
        pixels, usable = pixels.T, usable.T
        noise = None if noise is None else noise.T
    values = approximate_edge(pixels, usable)
    if values is None:
        return Failure("a row of the region has no edge", Code.NOT_FOUND)
    if not _contrast(pixels, values, usable) > _LEAST_CONTRAST:
        return Failure("there is no edge above the noise in its region", Code.LOW_CONTRAST)
    if not LEAST_SLANT < abs(values[1]) < MOST_SLANT:
        slant = np.rad2deg(np.arctan(values[1]))
        return Failure(f"the edge is slanted by {slant:.1f}°: rotate it to 3° to 20°", Code.SLANT)
    around = EdgePixels.of(pixels, usable)
    if noise is not None:
        around = replace(around, sigma=np.sqrt(noise[usable]))
    with one_thread():
        return _measured(around, values, noise is not None)


def _contrast(pixels: Array, values: Array, usable: Mask) -> float:
    """Difference of the two sides over the noise of a pixel, both robust; 0 if a side is missing."""
    rows = np.arange(len(pixels)) - (len(pixels) - 1) / 2
    aside = np.arange(pixels.shape[1]) - values[0] - values[1] * rows[:, None]
    left, right = pixels[usable & (aside < -_BESIDE_PX)], pixels[usable & (aside > _BESIDE_PX)]
    if not len(left) or not len(right):
        return 0.0
    pairs = usable[1:] & usable[:-1]
    if not pairs.any():
        return 0.0
    noise = 1.4826 * float(np.median(np.abs(np.diff(pixels, axis=0))[pairs])) / np.sqrt(2)
    step = abs(float(np.median(left) - np.median(right)))
    return step / noise if noise > 0 else np.inf if step > 0 else 0.0


def _measured(pixels: EdgePixels, values: Array, known: bool) -> EdgeSpread | Failure:
    """Adjust Gaussian and free curve in turn, with selection of pixels, noise and test of the bow."""
    first = fit_gaussian(pixels, values, _REACH_PX)
    if isinstance(first, Failure):
        return first
    near, far = _reaches(first)
    pixels = pixels.part(np.abs(pixels.distance(*first.values[:3])) < far)
    wide = fit_gaussian(pixels, first.values, np.inf, bow=True)
    if isinstance(wide, Failure):
        return wide
    free = fit_free(pixels, wide.values, bow=True)
    if isinstance(free, Failure):
        fit = fit_gaussian(pixels, first.values, near)
        return fit if isinstance(fit, Failure) else EdgeSpread(fit, free)
    if not known:
        pixels = _weighed(free, pixels)
        free = fit_free(pixels, wide.values, bow=True, start=free)
        if isinstance(free, Failure):
            return free
    bent = free.fit.test_of("bow", alpha=ALPHA)
    wide = fit_gaussian(pixels, first.values, np.inf, bow=bent.significant)
    fit = fit_gaussian(pixels, first.values, near, bow=bent.significant)
    if isinstance(wide, Failure):
        return wide
    if isinstance(fit, Failure):
        return fit
    free = fit_free(pixels, wide.values, bow=bent.significant)
    test = None if isinstance(free, Failure) else compare(wide, free.fit, ALPHA)
    return EdgeSpread(fit, free, test, bent)


def _reaches(fit: Adjustment) -> tuple[float, float]:
    """Distances up to which pixels are used, in the Gaussian and in the free curve."""
    psf = abs(fit["psf"])
    return max(_REACH_PX, _REACH_PSF * psf), max(_FREE_REACH_PX, _FREE_REACH_PSF * psf)


def _weighed(free: FreeCurve, pixels: EdgePixels) -> EdgePixels:
    """The pixels with sigmas from the residuals; the variance is a linear function of the light."""
    dark, bright = free.base[3:5]
    residual = free.fit.residuals**2 * (len(pixels.grey) / free.fit.redundancy)
    share = np.clip((pixels.grey + free.fit.residuals - dark) / (bright - dark), 0.0, 1.0)
    levels = np.full(2, float(residual.mean()))
    for _ in range(2):  # squared residuals scatter in proportion to their mean
        design = np.stack([1 - share, share], axis=1)
        weight = 1 / (design @ levels)
        found = np.linalg.lstsq(design * weight[:, None], residual * weight, rcond=None)[0]
        levels = np.maximum(found, 1e-3 * float(residual.mean()) + 1e-12)
    return replace(pixels, sigma=np.sqrt(levels[0] + (levels[1] - levels[0]) * share))
