"""Windows of a frame around marks, and the images formed in them with their derivatives.

A patch has these parameters, in this order: position (two), logarithm of the width of the point-spread
function, contrast, coefficients of the background, slopes of the contrast (optional), parameters of the form.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...optics.formation import PixelResponse
from .noise import medians, relative_weights
from .shapes import Shape, Window

X, Y, WIDTH, CONTRAST, LEVEL = range(5)

SHARPEST = 0.5
"""Share of the expected width below which a point-spread function cannot be distinguished from none."""
_FORM_ERROR = 0.2
"""Tolerated difference between a mark and its formed image, as a share of the amplitude."""


@dataclass(frozen=True)
class MatchOptions:
    """Options of the matching.

    Parameters
    ----------
    half_px : int or (int, int)
        Half side of the square window around a mark, or half its width and height.
    psf_px : float or ndarray (k,)
        Expected width (one sigma) of the point-spread function, for all marks or for each.
    psf_log_sigma : float
        Uncertainty of that width: standard deviation of its logarithm.
    contrast : float or ndarray (k,), optional
        Expected contrast. By default 0.5 for a dark mark, and the brightest pixel for a bright one.
    contrast_sigma : float
        Standard deviation of the expected contrast; infinite if nothing is known.
    contrast_slope : float, optional
        Standard deviation of the change of contrast from the centre of the window to its edge, along x and y.
        It models light reflected in the mark, which would otherwise shift it. By default the contrast is
        constant.
    response : PixelResponse
        Response of a pixel.
    polarity : {"dark", "bright"}
        A dark mark attenuates the light that falls on it by a share, so its image is proportional to the
        background; a bright mark adds light to it.
    rejection : float
        Pixels whose residual exceeds this many robust standard deviations of their patch are rejected: bit
        errors, dust, parts of a scene.
    row_jitter_px : float
        Standard deviation of the shift of single rows along x. The stochastic model treats it as an error
        common to a row and proportional to the slope of the image.
    background : int
        Degree of the polynomial of the background: 1, or 2 in front of a scene.
    start_px : float
        Uncertainty of the approximate positions, pixels.
    held : (float, float), optional
        Standard deviations of x and y about the approximate positions, if these are known; by default half
        the half side of the window.
    settled : float
        Iterations end when corrections fall below this share of their standard deviation. Images formed in
        single precision are not smooth enough for values below 0.05.
    variance : (float, float), optional
        Coefficients of the variance a + b·g of a grey value g. Only ratios matter; see
        :func:`reseau.measure.matching.grey_variance`. By default all grey values have the same variance.
    influence : bool
        Whether the influence of every pixel is wanted; see :func:`reseau.measure.matching.with_alike_errors`.
    within_px : float
        Pixels farther from the approximate position are not used, for instance where the arms of a crossing
        end within the window.

    Examples
    --------
    >>> MatchOptions(half_px=9, psf_px=1.2).half
    (9, 9)
    """

    half_px: int | tuple[int, int] = 6
    psf_px: float | Array = 0.8
    psf_log_sigma: float = 0.5
    contrast: float | Array | None = None
    contrast_sigma: float = np.inf
    contrast_slope: float | None = None
    response: PixelResponse = field(default_factory=PixelResponse)
    polarity: Literal["dark", "bright"] = "dark"
    rejection: float = 4.5
    row_jitter_px: float = 0.0
    background: int = 1
    start_px: float = 1.0
    held: tuple[float, float] | None = None
    settled: float = 0.01
    variance: tuple[float, float] | None = None
    influence: bool = False
    within_px: float = np.inf

    @property
    def half(self) -> tuple[int, int]:
        """Half the width and half the height of the window."""
        return (self.half_px, self.half_px) if isinstance(self.half_px, int) else self.half_px


def windows(values: NDArray[Any], centre: Rows, half: tuple[int, int]) -> NDArray[Any]:
    """Values (k, r, c) of windows around pixels `centre` (k, 2); beyond the frame those of its border."""
    (h, w), (right, down) = values.shape, half
    rows = np.clip(centre[:, 1:] + np.arange(-down, down + 1), 0, h - 1)
    columns = np.clip(centre[:, :1] + np.arange(-right, right + 1), 0, w - 1)
    return np.asarray(values[rows[:, :, None], columns[:, None]])


def add_windows(total: NDArray[Any], images: NDArray[Any], first: Rows) -> None:
    """Add images (k, r, c) to a frame (h, w), each from column and row `first` (k, 2) on."""
    (h, w), (_, high, wide) = total.shape, images.shape
    for image, (left, top) in zip(images, first.tolist(), strict=True):
        right, down, up, back = min(w - left, wide), min(h - top, high), max(0, -top), max(0, -left)
        if up < down and back < right:
            total[top + up : top + down, left + back : left + right] += image[up:down, back:right]


def filtered(images: NDArray[Any], kernel: NDArray[Any]) -> Array:
    """Images (m, r, c) weighted by a kernel (2 p + 1, 2 p + 1), without their borders of p pixels."""
    (m, high, wide), reach = images.shape, len(kernel) // 2
    # One image below the other: what one takes from the next lies in its border.
    found = cv2.filter2D(images.reshape(m * high, wide), cv2.CV_32F, kernel).reshape(images.shape)
    return np.ascontiguousarray(found[:, reach : high - reach, reach : wide - reach])


class Patches:
    """Windows of a frame, and the images formed in them."""

    def __init__(
        self,
        pixels: NDArray[Any],
        valid: Mask,
        shape: Shape,
        xy: Array,
        options: MatchOptions,
        claims: tuple[NDArray[Any], Rows] | None = None,
        others: NDArray[Any] | None = None,
        region: Mask | None = None,
    ) -> None:
        self.form, self.xy, self.options = shape, xy, options
        self.forms = shape.parameters
        self.psf = np.broadcast_to(np.asarray(options.psf_px, dtype=np.float64), (len(xy),))
        (right, down) = (np.arange(-half, half + 1) for half in options.half)
        u, v = right[None, :] / right[-1], down[:, None] / down[-1]
        powers = [(i, j) for i in range(options.background + 1) for j in range(options.background + 1 - i)]
        # Monomials (n, b) of the background over the window.
        self.monomials = np.stack([(u**i * v**j).ravel() for i, j in powers], axis=1)
        self.ground = slice(LEVEL, LEVEL + len(powers))
        # Monomials (2, rows, columns) of the contrast, where it varies across a mark.
        uneven = options.contrast_slope is not None
        self.across = np.stack(np.broadcast_arrays(u, v)) if uneven else np.zeros((0, len(down), len(right)))
        self.form_at = self.ground.stop + len(self.across)
        self.centre = np.rint(xy).astype(np.intp)
        columns, rows = self.centre[:, :1] + right, self.centre[:, 1:] + down
        self.window = Window(columns.astype(float), rows.astype(float), options.response, region)
        k = len(xy)
        self.shape = (k, len(down), len(right))
        self.grey = windows(pixels, self.centre, options.half).reshape(k, -1).astype(np.float64)
        inside = ((rows >= 0) & (rows < len(pixels)))[:, :, None] & (
            (columns >= 0) & (columns < pixels.shape[1])
        )[:, None]
        self.weights = (windows(valid, self.centre, options.half) & inside).reshape(k, -1).astype(np.float64)
        if others is not None:
            self.grey -= others.reshape(k, -1)
        self.near: Mask = np.ones(self.grey.shape, dtype=bool)
        if options.within_px < np.inf:
            x_off, y_off = columns - xy[:, :1], rows - xy[:, 1:]
            distance = np.hypot(x_off[:, None, :], y_off[:, :, None])
            self.near = (distance <= options.within_px).reshape(k, -1)
        if region is not None:
            self.near &= region.reshape(k, -1)
        if region is not None or options.within_px < np.inf:
            self.weights *= self.near
        if claims is not None:
            owner, mine = claims
            h, w = pixels.shape
            owners = owner[np.clip(rows, 0, h - 1)[:, :, None], np.clip(columns, 0, w - 1)[:, None, :]]
            self.weights *= ((owners < 0) | (owners == mine[:, None, None])).reshape(k, -1)
        self.relative_weights: Array = np.broadcast_to(1.0, self.grey.shape)
        self.whitener: tuple[Array, Array] | None = None
        self._formed: tuple[Array, Rows, Array, Array] | None = None
        self.first: tuple[Array, Array] | None = None  # images and derivatives where `begin` starts
        self.shares = np.empty(self.shape)
        self.single = False
        """Whether images are formed in single precision; known after `begin` or `start`."""
        self.influences: tuple[Array, Array] | None = None  # of the adjustment, if wanted

    def begin(self, light: tuple[Array, Array] | None) -> Array:
        """Approximate values (k, u) of marks at approximate positions.

        `light` is their contrast (k,) and background (k, b), if known; by default both are those that fit the
        grey values best with images of the expected width.
        """
        x = np.zeros((len(self.xy), self.form_at + self.forms))
        x[:, WIDTH] = self._expected_width
        self.first = self.slopes(x, np.arange(len(x)))
        self.single = self.first[0].dtype == np.float32
        if light is None:
            x[:, LEVEL], depth = self._levels(self.first[0].reshape(len(x), -1))
            dark = self.options.polarity == "dark"
            x[:, CONTRAST] = -depth / np.where(x[:, LEVEL] == 0, 1.0, x[:, LEVEL]) if dark else depth
        else:
            x[:, CONTRAST], x[:, self.ground] = light
        if self.options.variance is not None:
            grey = self._grey(x, self.first[0]).reshape(len(x), -1)
            self.relative_weights = relative_weights(grey, self.options.variance, self.weights > 0)
        return x

    @property
    def _expected_width(self) -> Array:
        """Value (k,) of the width with which :meth:`width` is the expected one."""
        return np.asarray(np.log(self.psf * np.sqrt(1 - SHARPEST**2)))

    @cached_property
    def terms(self) -> tuple[Array, Array, int]:
        """Monomials (b, n) of the background, those (0 or 2, n) of the contrast, and number of columns."""
        across = self.across.reshape(len(self.across), len(self.monomials))
        return self.monomials.T.astype(np.float32, order="C"), across.astype(np.float32), self.shape[2]

    def _levels(self, share: Array) -> tuple[Array, Array]:
        """Grey values (k,) of the background, and what a mark adds, by regression on its share (k, n)."""
        count = np.maximum(self.weights.sum(axis=1), 1.0)
        part, grey = (np.einsum("kn,kn->k", self.weights, v) / count for v in (share, self.grey))
        square = np.einsum("kn,kn,kn->k", self.weights, share, share) / count - part**2
        product = np.einsum("kn,kn,kn->k", self.weights, share, self.grey) / count - part * grey
        depth = product / np.maximum(square, 1e-12)
        return grey - depth * part, depth

    def correlation(self, x: Array, at: Rows) -> Array:
        """Correlation (m,) of grey values with images of the marks `at` as formed last at `x` (k, u)."""
        off = self.grey[at] - self.background(x[at]).reshape(len(at), -1)
        mark = (self._grey(x[at], self.shares[at]) - self.background(x[at])).reshape(len(at), -1)
        used = self.weights[at] > 0
        parts = [np.where(used, v, 0.0) for v in (off, mark)]
        count = np.maximum(used.sum(axis=1, keepdims=True), 1)
        parts = [np.where(used, v - v.sum(axis=1, keepdims=True) / count, 0.0) for v in parts]
        both, one, two = (np.einsum("kn,kn->k", parts[i], parts[j]) for i, j in ((0, 1), (0, 0), (1, 1)))
        with np.errstate(all="ignore"):
            return np.asarray(np.nan_to_num(both / np.sqrt(one * two)))

    def _grey(self, x: Array, share: Array) -> Array:
        """Grey values (k, rows, columns) of marks that take a share of each pixel."""
        plane, part = self.background(x), self.contrast(x) * share
        return np.asarray(plane * (1 - part) if self.options.polarity == "dark" else plane + part)

    def _weigh(self, x: Array) -> None:
        """Weights of the pixels by the grey values that are formed."""
        if self.options.variance is not None:
            grey, _ = self.form_image(x, np.arange(len(x)))
            self.relative_weights = relative_weights(grey, self.options.variance)

    def start(self, noise: float) -> Array:
        """Approximate values; rejects pixels of the background that belong to other objects.

        The background is fitted robustly to the surroundings of the mark, with Tukey's weights and a limit
        that decreases from step to step.
        """
        x = np.zeros((len(self.xy), self.form_at + self.forms))
        x[:, WIDTH] = np.log(np.hypot(self.psf, 0.7 * self.options.start_px))
        share = self.share(x)
        self.single = share.dtype == np.float32
        x[:, WIDTH] = self._expected_width
        around = self.weights * (share.reshape(len(x), -1) < 0.02)
        around[:, 0] = np.where(around.any(axis=1), around[:, 0], 1.0)  # a median needs at least one value
        there = around > 0
        design = self.monomials
        fitted = np.zeros((len(x), design.shape[1]))
        fitted[:, :1] = medians(self.grey, there)
        products = (design[:, :, None] * design[:, None]).reshape(len(design), -1)
        far = np.zeros_like(around)
        for factor in (6.0, 5.0, 4.0, 4.0, 4.0):
            off = np.abs(self.grey - fitted @ design.T)
            scale = np.maximum(1.4826 * medians(off, there), noise)
            far = np.where(there, off, 0.0) / (factor * scale)
            w = around * np.clip(1 - far**2, 0, None) ** 2
            normal = (w @ products).reshape(len(x), *2 * design.shape[1:]) + 1e-6 * np.eye(design.shape[1])
            fitted = np.linalg.solve(normal, ((w * self.grey) @ design + 1e-6 * fitted)[..., None])[..., 0]
        self.weights = np.where(far > 1.5, 0.0, self.weights)
        x[:, self.ground] = fitted
        if self.options.contrast is not None:
            x[:, CONTRAST] = self.options.contrast
        elif self.options.polarity == "dark":
            x[:, CONTRAST] = 0.5
        else:
            top = np.where(self.weights > 0, self.grey - fitted @ design.T, 0.0)
            x[:, CONTRAST] = np.maximum(top.max(axis=1), noise)
        self._weigh(x)
        return x

    def width(self, x: Array, at: Rows) -> Array:
        """Width of the point-spread function (m,) from its logarithm, with a lower bound."""
        return np.hypot(SHARPEST * self.psf[at], np.exp(x[:, WIDTH]))

    def change(self, before: Array, x: Array, at: Rows) -> Array:
        """Relative change (m,) of the images of the marks `at` from `before` to `x` (m, u)."""
        width, off = self.width(x, at), np.abs(x - before)
        parts = [
            off[:, X] / width,
            off[:, Y] / width,
            off[:, WIDTH],
            off[:, CONTRAST] / np.maximum(np.abs(x[:, CONTRAST]), np.finfo(float).tiny),
        ]
        return np.asarray(np.max([*parts, *off[:, self.form_at :].T], axis=0))

    def image(self, x: Array, at: Rows) -> Array:
        """Images (m, rows, columns) of the marks `at` at `x` (m, u)."""
        return self.form.image(*self._place(x, at))

    def slopes(self, x: Array, at: Rows) -> tuple[Array, Array]:
        """Images and their derivatives (m, 3 + p, rows, columns), as :meth:`image`."""
        return self.form.derivatives(*self._place(x, at))

    def _place(self, x: Array, at: Rows) -> tuple[Array, Array, Array, Rows, Window]:
        window = self.window if len(at) == len(self.xy) else self.window.select(at)
        return self.xy[at] + x[:, :2], self.width(x, at), x[:, self.form_at :], at, window

    def keep(self, rows: Rows, on_position: Array, leverage: Array) -> None:
        """Keep influences (m, 2, n) and leverages (m, n) of the marks `rows`."""
        if self.influences is None:
            k, high, wide = self.shape
            self.influences = (
                np.zeros((k, 2, high, wide), np.float32),
                np.zeros((k, high, wide), np.float32),
            )
        self.influences[0][rows] = on_position.reshape(len(rows), 2, *self.shape[1:])
        self.influences[1][rows] = leverage.reshape(len(rows), *self.shape[1:])

    def form_image(self, x: Array, at: Rows) -> tuple[Array, Array]:
        """Grey values (m, n) and their derivatives (m, n, u) for the patches `at`."""
        grey, jacobian = self._form(x, at)
        return (grey, jacobian) if self.whitener is None else self._whitened(grey, jacobian, at)

    def _form(self, x: Array, at: Rows) -> tuple[Array, Array]:
        """As :meth:`form_image`, not whitened; the last result is cached."""
        if self._formed is not None:
            before, rows, grey, jacobian = self._formed
            if np.array_equal(rows, at) and np.array_equal(before, x):
                return grey, jacobian
        width = self.width(x, at)
        share, d_share = self.form.derivatives(
            self.xy[at] + x[:, :2], width, x[:, self.form_at :], at, self.window.select(at)
        )
        plane, contrast = (
            field.astype(share.dtype, copy=False) for field in (self.background(x), self.contrast(x))
        )
        if self.options.polarity == "dark":
            rest = 1 - contrast * share
            grey, by_share, by_contrast = plane * rest, -plane * contrast, -plane * share
        else:
            rest = np.ones_like(share)
            grey, by_share, by_contrast = plane + contrast * share, contrast, share
        # One row of memory for each parameter; returned with the parameters as the last axis.
        rows = np.empty((len(x), x.shape[1], *share.shape[1:]), dtype=share.dtype)
        np.multiply(by_share, d_share[:, 0], out=rows[:, X])
        np.multiply(by_share, d_share[:, 1], out=rows[:, Y])
        by_width = by_share * (np.exp(2 * x[:, WIDTH]) / width)[:, None, None].astype(share.dtype)
        np.multiply(by_width, d_share[:, 2], out=rows[:, WIDTH])
        rows[:, CONTRAST] = by_contrast
        for k, slope in enumerate(self.across.astype(share.dtype)):
            np.multiply(by_contrast, slope, out=rows[:, self.ground.stop + k])
        for k in range(self.forms):
            np.multiply(by_share, d_share[:, 3 + k], out=rows[:, self.form_at + k])
        flat = rows.reshape(len(x), x.shape[1], -1)
        ground = self.monomials.T.astype(share.dtype, copy=False)
        np.multiply(rest.reshape(len(x), 1, -1), ground, out=flat[:, self.ground])
        grey, jacobian = grey.reshape(len(x), -1), np.swapaxes(flat, 1, 2)
        self.shares[at], self._formed = share, (x.copy(), at.copy(), grey, jacobian)
        return grey, jacobian

    def form_values(self, x: Array, at: Rows) -> Array:
        """Grey values (m, n) without derivatives, as in :meth:`form_image`."""
        share = self.form.image(
            self.xy[at] + x[:, :2], self.width(x, at), x[:, self.form_at :], at, self.window.select(at)
        )
        self.shares[at] = share
        grey: Array = self._grey(x, share).reshape(len(x), -1)
        if self.whitener is None:
            return grey
        slope, weighted = (field[at] for field in self.whitener)
        off = (grey - self.grey[at]).reshape(slope.shape)
        whitened: Array = off - slope * (weighted * off).sum(axis=2, keepdims=True)
        return np.asarray(self.grey[at] + whitened.reshape(grey.shape))

    def background(self, x: Array) -> Array:
        """Grey values of the background in the window, (k, rows, columns)."""
        grey: Array = (x[:, self.ground] @ self.monomials.T).reshape(len(x), *self.shape[1:])
        return grey

    def contrast(self, x: Array) -> Array:
        """Contrast (k, 1, 1), or (k, rows, columns) if it has slopes."""
        even = x[:, CONTRAST, None, None]
        return (
            even + np.tensordot(x[:, self.ground.stop : self.form_at], self.across, 1)
            if len(self.across)
            else even
        )

    def share(self, x: Array) -> Array:
        """Share of each pixel covered by the marks, all patches, (k, rows, columns)."""
        every = np.arange(len(x))
        return self.form.image(
            self.xy + x[:, :2], self.width(x, every), x[:, self.form_at :], every, self.window
        )

    def residuals(self, x: Array) -> tuple[Array, Array]:
        """Formed minus observed grey values of all pixels, used or not, and the part that is tolerated.

        No mark is exactly a square or a disk, and no point-spread function exactly Gaussian. In marks of high
        contrast this exceeds the noise; the tolerance attributes it to the model of the mark.

        Returns
        -------
        residuals, tolerated : ndarray (k, n)
        """
        share = self.share(x).reshape(len(x), -1)
        plane, contrast = self.background(x).reshape(len(x), -1), self.contrast(x).reshape(len(x), -1)
        if self.options.polarity == "dark":
            formed = plane * (1 - contrast * share)
        else:
            formed = plane + contrast * share
        return formed - self.grey, self.tolerated(x, share)

    def tolerated(self, x: Array, share: Array) -> Array:
        """Part (m, n) of residuals at `x` (m, u) that is tolerated where `share` (m, n) is covered."""
        amplitude = np.abs(self.contrast(x).reshape(len(x), -1))
        if self.options.polarity == "dark":
            amplitude = amplitude * np.abs(x[:, LEVEL, None])
        return np.asarray(_FORM_ERROR * amplitude * (share > 0.02))

    def influence(self, x: Array, cofactor: Array, used: Mask, scale: Array, at: Rows) -> tuple[Array, Array]:
        """Influence of each pixel on the position (m, 2, rows, columns), and leverage (m, rows, columns).

        With derivatives A, weights W and cofactor Q they are the first rows of Q Aᵀ W, and the diagonal of
        A Q Aᵀ W.
        """
        _, jacobian = self.form_image(x, at)
        weights = self.weights[at] * self.relative_weights[at] * used / scale[:, None] ** 2
        gain = np.nan_to_num(jacobian @ cofactor.astype(jacobian.dtype)) * weights[..., None]
        leverage = (gain * jacobian).sum(axis=2)
        on_position = np.moveaxis(gain[..., :2], 2, 1).copy()  # a view would keep all of `gain`
        size = self.shape[1:]
        return on_position.reshape(len(x), 2, *size), leverage.reshape(len(x), *size)

    def whiten(self, x: Array, sigma: Array, jitter: float) -> None:
        """Include a common error of each row, jitter × slope along x, in the stochastic model.

        The covariance of a row is σ²(W⁻¹ + q² g gᵀ), with the slope g of the formed image, q = jitter/σ, and
        the weights W of the pixels. The matrix I − g gᵀW (1 − (1 + q² gᵀWg)^(−1/2))/gᵀWg makes the residuals
        of a row independent, with weights W.
        """
        _, jacobian = self._form(x, np.arange(len(self.xy)))
        slope = jacobian[..., X].reshape(self.shape) * self.weights.reshape(self.shape).astype(jacobian.dtype)
        length2 = (self.relative_weights.reshape(self.shape) * slope**2).sum(axis=2, keepdims=True)
        q2 = (jitter / np.maximum(sigma, 1e-12))[:, :, None] ** 2
        factor = (1 - 1 / np.sqrt(1 + q2 * length2)) / np.maximum(length2, 1e-300)
        self.whitener = (
            slope,
            (slope * factor * self.relative_weights.reshape(self.shape)).astype(slope.dtype),
        )

    def _whitened(self, grey: Array, jacobian: Array, at: Rows) -> tuple[Array, Array]:
        assert self.whitener is not None
        slope, weighted = (field[at] for field in self.whitener)
        m, rows, columns = slope.shape
        v = (grey - self.grey[at]).reshape(slope.shape)
        v = v - slope * (weighted * v).sum(axis=2, keepdims=True)
        # Contiguous for each derivative, as it was formed.
        j = np.swapaxes(jacobian, 1, 2).reshape(m, -1, rows, columns)
        j -= slope[:, None] * np.einsum("mrc,murc->mur", weighted, j)[..., None]
        self._formed = None  # `j` has overwritten the cached derivatives
        return self.grey[at] + v.reshape(m, -1), np.swapaxes(j.reshape(m, -1, rows * columns), 1, 2)
