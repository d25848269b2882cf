"""What a camera has made of the light: its tone curve, and a kernel of motion, defocus or sharpening.

Both are estimated from marks that have been matched with plain images, Gaussian and linear in the light, by
what is left in their windows. A mark has its own position, contrast, background and form; what these can
explain is projected out of each window, and the windows together determine what all have in common:

- A tone curve, grey = F (light / F)^(1/γ), makes the edge of a mark steeper on its dark side than on its
  bright side. No blur does that.
- A kernel is even, K(d) = K(−d), with a sum of 1: an odd one would shift all marks. Its values at whole
  pixels weight shifted images of the mark, to which the residuals are linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..core.data import Array, Mask, Rows
from .matching import Shape, Window, displaced

__all__ = ["Exponent", "FilteredShape", "Samples", "estimate_gamma", "estimate_kernel"]

_REACH = 5
"""Half the side of a kernel, pixels."""
_TAP = 0.1
"""Prior standard deviation of a value of a kernel."""
_SHARPER = (1.0, 0.75, 0.5)
"""Shares of the width of the point-spread function that are tried beneath a kernel."""
_FUTILE = 0.95
"""Ratio of mean square residuals above which no kernel is sought beneath a sharper function."""
_SMALL = 1e-3
"""Values of a kernel below this are set to zero."""
_LEAST_GAIN, _STRONG = 0.995, 0.9
"""Ratios of mean square residuals below which a tone curve matters, and is beyond doubt."""
_CERTAIN, _CORRELATED = 6.0, 0.12
"""Least significance of a tone curve; correlation of residuals from which they have another cause."""


@dataclass(frozen=True, eq=False)
class FilteredShape:
    """A shape whose images are convolved with a kernel of whole pixels, itself a shape.

    Parameters
    ----------
    shape : Shape
        The shape.
    kernel : ndarray (2 m + 1, 2 m + 1)
        The kernel; even, with a sum of 1.

    Examples
    --------
    >>> from reseau.measure.matching import GrownOutline
    >>> from reseau.optics.formation import Outline, PixelResponse
    >>> disk = Outline.circle(2.0, 0.5)
    >>> plain = GrownOutline(Outline(disk.xy[None], disk.dxy[None]), np.zeros((0, 2, 2)))
    >>> moved = FilteredShape(plain, np.array([[0, 0, 0], [0.25, 0.5, 0.25], [0, 0, 0]]))
    >>> window = Window(np.arange(11.0)[None], np.arange(11.0)[None], PixelResponse())
    >>> place = np.array([[5.0, 5.0]]), np.ones(1), np.zeros((1, 0)), np.array([0]), window
    >>> sharp, smeared = plain.image(*place)[0], moved.image(*place)[0]
    >>> float(round(smeared[5, 8] / sharp[5, 8], 2)), float(round(smeared.sum() / sharp.sum(), 3))
    (1.36, 1.0)
    """

    shape: Shape
    kernel: Array

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return self.shape.parameters

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.Shape`."""
        return self._filtered(self.shape.image(xy, width, form, at, self._wider(window)))

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.Shape`."""
        share, slopes = self.shape.derivatives(xy, width, form, at, self._wider(window))
        return self._filtered(share), self._filtered(slopes)

    def _wider(self, window: Window) -> Window:
        return _widened(window, len(self.kernel) // 2)

    def _filtered(self, images: Array) -> Array:
        reach, (high, wide) = len(self.kernel) // 2, images.shape[-2:]
        # One image below the other: what a kernel takes from the next is cut off.
        column = np.ascontiguousarray(images, dtype=np.float32).reshape(-1, wide)
        smooth = cv2.filter2D(column, -1, self.kernel).reshape(*images.shape[:-2], high, wide)
        return np.asarray(smooth[..., reach : high - reach, reach : wide - reach], dtype=images.dtype)


def _widened(window: Window, reach: int) -> Window:
    ends = [np.arange(-reach, 0), np.arange(1, reach + 1)]
    axes = [
        np.concatenate([axis[:, :1] + ends[0], axis, axis[:, -1:] + ends[1]], axis=1)
        for axis in (window.columns, window.rows)
    ]
    return Window(axes[0], axes[1], window.response)


@dataclass(frozen=True, eq=False)
class Samples:
    """Marks that have been matched, all in windows of one size.

    Parameters
    ----------
    shape : Shape
        The k marks.
    xy, psf_px, form : ndarray (k, 2), (k,), (k, p)
        Their position, width of the point-spread function, and form.
    depth : ndarray (k,)
        Grey values that a mark adds; negative for dark marks.
    window : Window
        Their windows.
    grey : ndarray (k, r, c)
        Observed grey values.
    used : ndarray of bool (k, r, c)
        Pixels that were used.

    Examples
    --------
    See :func:`estimate_kernel`.
    """

    shape: Shape
    xy: Array
    psf_px: Array
    form: Array
    depth: Array
    window: Window
    grey: Array
    used: Mask

    def basis(self, share: Array, slopes: Array) -> Array:
        """What each mark explains by itself (k, n, b): position, form, contrast and background."""
        k, rows, columns = share.shape
        u, v = np.linspace(-1, 1, columns)[None, :], np.linspace(-1, 1, rows)[:, None]
        even = np.broadcast_to(np.stack([u**i * v**j for i, j in _POWERS]), (k, len(_POWERS), rows, columns))
        parts = [share[:, None] * even[:, :3], slopes, even]
        return np.moveaxis(np.concatenate(parts, axis=1).reshape(k, -1, rows * columns), 1, 2)


_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


def _left(values: Array, basis: Array, weight: Array) -> Array:
    """What is left of weighted values (k, n, s) beside a weighted basis (k, n, b)."""
    q = np.linalg.qr(basis * weight[..., None])[0]
    scaled = values * weight[..., None]
    return np.asarray(scaled - q @ (np.swapaxes(q, 1, 2) @ scaled))


def estimate_kernel(samples: Samples) -> tuple[Array, float, float]:
    """Estimate the kernel between a Gaussian point-spread function and the images of marks.

    Parameters
    ----------
    samples : Samples
        Marks that were matched with images of a Gaussian point-spread function.

    Returns
    -------
    kernel : ndarray (11, 11)
        The kernel.
    sharper : float
        Share of the width `psf_px` of the Gaussian to which it belongs.
    gain : float
        Mean square of the residuals with the kernel over that without.

    Examples
    --------
    >>> from reseau.measure.matching import GrownOutline
    >>> from reseau.optics.formation import Outline, PixelResponse
    >>> disk = Outline.circle(4.0, 0.5)
    >>> plain = GrownOutline(Outline(disk.xy[None], disk.dxy[None]), np.zeros((0, 2, 2)))
    >>> window = Window(np.arange(25.0)[None], np.arange(25.0)[None], PixelResponse())
    >>> place = np.array([[12.2, 11.9]]), np.full(1, 0.8), np.zeros((1, 0)), np.array([0]), window
    >>> moved = FilteredShape(plain, np.array([[0, 0, 0], [0.3, 0.4, 0.3], [0, 0, 0]]))
    >>> grey = 200 - 150 * moved.image(*place) + np.random.default_rng(0).normal(0, 0.5, (1, 25, 25))
    >>> one = Samples(plain, *place[:3], np.array([-150.0]), window, grey, grey > 0)
    >>> kernel, sharper, gain = estimate_kernel(one)
    >>> bool(gain < 0.5), bool(kernel[5, 4] > 2 * kernel[4, 5])
    (True, True)
    """
    offsets = np.array(
        [(i, j) for j in range(_REACH + 1) for i in range(-_REACH, _REACH + 1) if (j, i) > (0, 0)]
    )
    k, high, wide = samples.grey.shape
    weight = samples.used.reshape(k, -1).astype(np.float64)
    observed = np.where(samples.used, samples.grey, 0.0).reshape(k, -1, 1)
    every, best = np.arange(k), (np.inf, 1.0, np.zeros(len(offsets)))
    plain = np.inf
    for sharper in _SHARPER:
        place = samples.xy, sharper * samples.psf_px, samples.form, every, _widened(samples.window, _REACH)
        share, slopes = samples.shape.derivatives(*place)
        inner = slice(_REACH, _REACH + high), slice(_REACH, _REACH + wide)
        # The width is explained by the kernel.
        own = np.delete(slopes, 2, axis=1)[:, :, *inner]
        middle = share[:, *inner].astype(np.float64)

        def shifted(i: int, j: int, image: Array = share) -> Array:
            return image[:, _REACH - j : _REACH - j + high, _REACH - i : _REACH - i + wide]

        moved = (
            np.stack([(shifted(i, j) + shifted(-i, -j)) - 2 * middle for i, j in offsets.tolist()], axis=-1)
            * samples.depth[:, None, None, None]
        )
        basis = samples.basis(middle, own)
        left = _left(np.concatenate([observed, moved.reshape(k, high * wide, -1)], axis=2), basis, weight)
        if sharper == 1.0:
            wider = samples.basis(middle, slopes[:, :, *inner])
            plain = float((_left(observed, wider, weight) ** 2).sum())
        rest, taps = left[..., 0].ravel(), left[..., 1:].reshape(-1, len(offsets))
        square, across, cost = taps.T @ taps, taps.T @ rest, plain
        for _ in range(3):
            # The prior is weighed by what is left with the kernel: noise, not misfit.
            weight_of_prior = cost / max(weight.sum(), 1) / _TAP**2
            values = np.linalg.solve(square + weight_of_prior * np.eye(len(offsets)), across)
            cost = float(((rest - taps @ values) ** 2).sum())
        if cost < best[0]:
            best = cost, sharper, values
        if cost > _FUTILE * plain:
            break
    cost, sharper, values = best
    kernel = np.zeros((2 * _REACH + 1,) * 2)
    values = np.where(np.abs(values) < _SMALL, 0.0, values)
    for (i, j), value in zip(offsets.tolist(), values, strict=True):
        kernel[_REACH + j, _REACH + i] = kernel[_REACH - j, _REACH - i] = value
    kernel[_REACH, _REACH] = 1 - kernel.sum()
    return kernel, sharper, cost / max(plain, 1e-300)


@dataclass(frozen=True)
class Exponent:
    """Exponent of a tone curve, grey = F (light / F)^(1/γ), estimated from the residuals of marks.

    Parameters
    ----------
    gamma : float
        The exponent γ.
    sigma : float
        Its standard deviation, from the scatter of the marks.
    gain : float
        Mean square of the residuals with the exponent over that before.
    correlation : float
        Largest correlation of the residuals of neighbouring pixels that remains.

    Examples
    --------
    >>> Exponent(2.2, 0.04, 0.97, 0.02).certain, Exponent(2.2, 0.04, 0.97, 0.25).certain
    (True, False)
    """

    gamma: float
    sigma: float
    gain: float
    correlation: float

    @property
    def certain(self) -> bool:
        """Whether there is a curve; correlated residuals, as of compression, can look like a weak one."""
        significant = self.gain < _LEAST_GAIN and abs(self.gamma - 1) > _CERTAIN * self.sigma
        return significant and (self.gain < _STRONG or self.correlation < _CORRELATED)


def estimate_gamma(samples: Samples, formed: Array, gamma: float, full_scale: float) -> Exponent:
    """Correct the exponent of a tone curve by the residuals of marks in linearised grey values.

    Parameters
    ----------
    samples : Samples
        Marks that were matched in grey values linearised with `gamma`.
    formed : ndarray (k, r, c)
        Their images as adjusted.
    gamma : float
        The exponent so far; 1 at first.
    full_scale : float
        Grey value at which the sensor saturates.

    Returns
    -------
    Exponent
        The corrected exponent.

    Examples
    --------
    >>> from reseau.measure.matching import GrownOutline
    >>> from reseau.optics.formation import Outline, PixelResponse
    >>> disk = Outline.circle(4.0, 0.5)
    >>> plain = GrownOutline(Outline(disk.xy[None], disk.dxy[None]), np.zeros((0, 2, 2)))
    >>> window = Window(np.arange(25.0)[None], np.arange(25.0)[None], PixelResponse())
    >>> place = np.array([[12.2, 11.9]]), np.full(1, 0.8), np.zeros((1, 0)), np.array([0]), window
    >>> light = 200 - 150 * plain.image(*place)
    >>> grey = 255 * (light / 255) ** (1 / 1.2) + np.random.default_rng(0).normal(0, 0.1, (1, 25, 25))
    >>> one = Samples(plain, *place[:3], np.array([-150.0]), window, grey, grey > 0)
    >>> curve = estimate_gamma(one, grey, 1.0, 255.0)
    >>> bool(abs(curve.gamma - 1.2) < 0.03), bool(curve.gain < 0.9)
    (True, True)
    """
    k = len(samples.xy)
    every = np.arange(k)
    share, slopes = samples.shape.derivatives(samples.xy, samples.psf_px, samples.form, every, samples.window)
    light = np.clip(np.where(samples.used, formed, full_scale) / full_scale, 1e-3, None)
    coded = light ** (1 / gamma)
    # The noise is that of the coded grey values: its slope weights the light.
    weight = np.where(samples.used, light ** (1 / gamma - 1), 0.0).reshape(k, -1)
    change = full_scale * light * np.log(coded)
    both = np.stack([samples.grey, change], axis=-1)
    both = np.where(samples.used[..., None], both, 0.0).reshape(k, -1, 2)
    left = _left(both, samples.basis(share.astype(np.float64), slopes), weight)
    observed, change = left[..., 0], left[..., 1]
    square = float((change**2).sum())
    step = -float((change * observed).sum()) / max(square, 1e-300)
    rest = observed + step * change
    # Residuals of a window may be correlated, those of different windows are not (White's estimator).
    scores = (change * rest).sum(axis=1)
    sigma = np.sqrt(k / max(k - 1, 1) * float((scores**2).sum())) / max(square, 1e-300)
    before, after = float((observed**2).sum()), float((rest**2).sum())
    correlation = _correlation(rest.reshape(samples.grey.shape), samples.used)
    return Exponent(gamma + step, float(sigma), after / max(before, 1e-300), correlation)


def _correlation(rest: Array, used: Mask) -> float:
    """Largest correlation of the residuals (k, r, c) of neighbouring pixels."""
    square = float((rest**2).sum()) / max(float(used.sum()), 1)
    found = []
    for lag in ((0, 1), (1, 0), (1, 1), (1, -1)):
        (a, b), both = displaced(rest, *lag), np.logical_and(*displaced(used, *lag))
        found.append(abs(float((a * b)[both].sum())) / max(float(both.sum()), 1))
    return max(found) / max(square, 1e-300)
