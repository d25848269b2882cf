"""Least-squares matching: patches of a frame are adjusted to formed images of marks.

For each mark the position, the width of the point-spread function, the contrast, the background and, if
wanted, the form are estimated together; all marks of a frame make one batch of least-squares problems
(:func:`reseau.adjust.adjust_batch`). Kinds of marks differ only in the outline that is formed.

A patch has these parameters, in this order: position (two), logarithm of the width of the point-spread
function, contrast, coefficients of the background, slopes of the contrast (optional), parameters of the form.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...adjust import BatchAdjustment, BatchOptions, BatchReason, adjust_batch
from ...core.data import Array, Mask, Rows
from ...core.threads import one_thread
from ...optics.formation import Outline, PixelResponse
from .noise import medians, relative_weights
from .shapes import GrownOutline, Shape, ShapeSubset, Window

__all__ = [
    "CONTRAST",
    "LEVEL",
    "SIZE",
    "WIDTH",
    "MatchOptions",
    "Matches",
    "Patches",
    "Shape",
    "X",
    "Y",
    "match",
]

X, Y, WIDTH, CONTRAST, LEVEL = range(5)

_FORM_ERROR = 0.2
"""Tolerated difference between a mark and its formed image, as a share of the amplitude."""

_SHARPEST = 0.5
"""Share of the expected width below which a point-spread function cannot be distinguished from none."""


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
        others: Array | None = None,
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
        self.window = Window(columns.astype(float), rows.astype(float), options.response)
        h, w = pixels.shape
        c, r = np.clip(columns, 0, w - 1)[:, None, :], np.clip(rows, 0, h - 1)[:, :, None]
        inside = ((rows >= 0) & (rows < h))[:, :, None] & ((columns >= 0) & (columns < w))[:, None, :]
        k = len(xy)
        self.shape = (k, len(down), len(right))
        self.grey = pixels[r, c].astype(np.float64).reshape(k, -1)
        if others is not None:
            self.grey -= others.reshape(k, -1)
        near = np.ones(self.shape, dtype=bool)
        if options.within_px < np.inf:
            x_off, y_off = columns - xy[:, :1], rows - xy[:, 1:]
            near = np.hypot(x_off[:, None, :], y_off[:, :, None]) <= options.within_px
        self.near = near.reshape(k, -1)
        usable = inside & valid[r, c] & near
        if claims is not None:
            owner, mine = claims
            usable &= (owner[r, c] < 0) | (owner[r, c] == mine[:, None, None])
        self.weights = usable.reshape(k, -1).astype(np.float64)
        self.relative_weights = np.ones(self.grey.shape)
        self.whitener: tuple[Array, Array] | None = None
        self._formed: tuple[Array, Rows, Array, Array] | None = None
        self.shares = np.zeros(self.shape)

    def begin(self, contrast: Array, ground: Array) -> Array:
        """Approximate values (k, u) of marks whose contrast (k,) and background (k, b) are known."""
        x = np.zeros((len(self.xy), self.form_at + self.forms))
        # Start with the expected width; see `width`.
        x[:, WIDTH] = np.log(self.psf * np.sqrt(1 - _SHARPEST**2))
        x[:, CONTRAST], x[:, self.ground] = contrast, ground
        return x

    def start(self, noise: float) -> Array:
        """Approximate values; rejects pixels of the background that belong to other objects.

        The background is fitted robustly to the surroundings of the mark, with Tukey's weights and a limit
        that decreases from step to step.
        """
        x = np.zeros((len(self.xy), self.form_at + self.forms))
        x[:, WIDTH] = np.log(np.hypot(self.psf, 0.7 * self.options.start_px))
        share = self.share(x)
        x[:, WIDTH] = np.log(self.psf)
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
        if self.options.variance is not None:
            grey, _ = self.form_image(x, np.arange(len(x)))
            self.relative_weights = relative_weights(grey, self.options.variance)
        return x

    def width(self, x: Array, at: Rows) -> Array:
        """Width of the point-spread function (m,) from its logarithm, with a lower bound."""
        width: Array = np.hypot(_SHARPEST * self.psf[at], np.exp(x[:, WIDTH]))
        return width

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
        plane, part = self.background(x), self.contrast(x) * share
        formed = plane * (1 - part) if self.options.polarity == "dark" else plane + part
        grey: Array = formed.reshape(len(x), -1)
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
        amplitude = np.abs(contrast)
        if self.options.polarity == "dark":
            formed = plane * (1 - contrast * share)
            amplitude = amplitude * np.abs(x[:, LEVEL, None])
        else:
            formed = plane + contrast * share
        return formed - self.grey, _FORM_ERROR * amplitude * (share > 0.02)

    def influence(self, x: Array, cofactor: Array, used: Mask, scale: Array) -> tuple[Array, Array]:
        """Influence of each pixel on the position (k, 2, rows, columns), and leverage (k, rows, columns).

        With derivatives A, weights W and cofactor Q they are the first rows of Q Aᵀ W, and the diagonal of
        A Q Aᵀ W.
        """
        _, jacobian = self.form_image(x, np.arange(len(x)))
        weights = self.weights * self.relative_weights * used / scale[:, None] ** 2
        gain = np.nan_to_num(jacobian @ cofactor.astype(jacobian.dtype)) * weights[..., None]
        leverage = (gain * jacobian).sum(axis=2)
        on_position = np.moveaxis(gain[..., :2], 2, 1).copy()  # a view would keep all of `gain`
        return on_position.reshape(len(x), 2, *self.shape[1:]), leverage.reshape(self.shape)

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


Columns = TypeVar("Columns", "Matches", BatchAdjustment)

_PLAIN = 1.25
"""Multiple of the rejection limit from which blunders are searched for when good start values are known."""

_FIRST, _MOST = 10, 50
"""Iterations before the search for blunders, and maximum."""

SIZE = np.eye(2)[None]
"""Generator of the form for a mark of unknown size: a change of scale."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Results of matching, in columns over the k marks.

    Parameters
    ----------
    xy : ndarray (k, 2)
        Positions in pixels.
    cov : ndarray (k, 2, 2)
        Covariances of the positions, from the residuals of each patch.
    psf_px : ndarray (k,)
        Widths of the point-spread function.
    contrast : ndarray (k,)
        Share of the light that a dark mark attenuates; grey values that a bright mark adds.
    level : ndarray (k,)
        Grey value of the background at the mark.
    t : ndarray (k,)
        Contrast over its standard deviation, for given width and form.
    form : ndarray (k, m)
        Parameters of the form.
    noise : ndarray (k,)
        Standard deviation of the residuals, grey values.
    correlation : ndarray (k,)
        Correlation of the patch with the formed image after subtraction of the background.
    seen : ndarray (k,)
        Share of the mark on valid pixels.
    rejected : ndarray (k,)
        Share of the mark on pixels rejected as blunders.
    converged : ndarray of bool (k,)
        Whether the adjustment converged.
    residuals : ndarray (k, rows, columns)
        Adjusted minus observed, NaN where a pixel was not used.
    form_sigma : ndarray (k, m)
        Standard deviations of `form`.
    influence : ndarray (k, 2, rows, columns)
        Change of the position with the grey value of each pixel; (k, 2, 0, 0) if it was not wanted.
    leverage : ndarray (k, rows, columns)
        Share of the error of each pixel that the adjustment takes from its residual; empty as `influence`.

    Examples
    --------
    >>> one, none = np.ones(2), np.zeros((2, 0))
    >>> xy, cov = np.array([[10.3, 9.6], [40.1, 9.8]]), np.tile(1e-4 * np.eye(2), (2, 1, 1))
    >>> seen = np.array([1.0, 0.4])
    >>> marks = Matches(xy, cov, one, 0.6 * one, 200 * one, 300 * one, none, one, one, seen, 0 * one,
    ...                 one > 0, np.zeros((2, 17, 17)), none, np.zeros((2, 2, 17, 17)), np.zeros((2, 17, 17)))
    >>> len(marks.select(marks.seen > 0.5))
    1
    """

    xy: Array
    cov: Array
    psf_px: Array
    contrast: Array
    level: Array
    t: Array
    form: Array
    noise: Array
    correlation: Array
    seen: Array
    rejected: Array
    converged: Mask
    residuals: Array
    form_sigma: Array
    influence: Array
    leverage: Array

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, keep: Mask) -> Matches:
        """Matches selected by a mask (k,)."""
        return Matches(**{column.name: getattr(self, column.name)[keep] for column in fields(self)})

    def replaced(self, rows: Rows, others: Matches) -> Matches:
        """These matches with `rows` replaced by others from windows of the same size."""
        return _with_rows(self, rows, others)


def _with_rows(whole: Columns, rows: Rows, part: Columns) -> Columns:
    """A dataclass of columns with some rows replaced by those of another."""
    columns = {}
    for column in fields(whole):
        columns[column.name] = getattr(whole, column.name).copy()
        columns[column.name][rows] = getattr(part, column.name)
    return replace(whole, **columns)


def match(
    pixels: NDArray[Any],
    valid: Mask,
    outline: Outline | Shape,
    xy: Array,
    options: MatchOptions,
    *,
    noise: float,
    form: Array | None = None,
    form_sigma: Array | None = None,
    claims: tuple[NDArray[Any], Rows] | None = None,
    others: Array | None = None,
    light: tuple[Array, Array] | None = None,
    searching: bool = True,
) -> Matches:
    """Match every patch with the formed image of its mark.

    Parameters
    ----------
    pixels : ndarray (h, w)
        Grey values.
    valid : ndarray (h, w) of bool
        Pixels that may be used.
    outline : Outline or Shape
        Outlines (k, j, 2) in pixels around the point to be measured, or a shape of k marks with its own
        parameters.
    xy : ndarray (k, 2)
        Approximate positions, good to about the radius of a mark.
    options : MatchOptions
        Options of the matching.
    noise : float
        Approximate standard deviation of the grey values; used for the weights of prior knowledge only.
    form : ndarray (m, 2, 2) or (k, m, 2, 2), optional
        Generators F_i of the form of an outline, which is multiplied by 1 + Σ p_i F_i.
    form_sigma : ndarray (m,), optional
        Prior standard deviations of the p_i around 0.
    claims : tuple, optional
        Owner of each pixel, (h, w) of int, negative for none; and the owner number (k,) of each mark. Pixels
        owned by another mark are not used.
    others : ndarray (k, rows, columns), optional
        Light of other marks in each window, subtracted first.
    light : tuple, optional
        Contrast (k,) and coefficients of the background (k, b), if these, the positions and the width are
        known approximately. Then only patches with large residuals are searched for blunders.
    searching : bool
        Whether to search those patches; if not, they count as not converged.

    Returns
    -------
    Matches
        All k marks; a failed match has `converged` False or a small `t`.

    Examples
    --------
    Form the image of a dark disk of radius 3 px at (10.3, 9.6) and measure its centre:

    >>> import numpy as np
    >>> from reseau.optics.formation import Outline, PixelResponse, coverage
    >>> disk = Outline.circle(3.0, 0.5)
    >>> x, y = np.arange(21.0)[None], np.arange(21.0)[None]
    >>> placed = Outline(disk.xy[None] + [10.3, 9.6], disk.dxy[None])
    >>> share = coverage(placed, x, y, np.ones(1), PixelResponse())[0]
    >>> grey = 200 * (1 - 0.6 * share)
    >>> options = MatchOptions(half_px=8, psf_px=1.0)
    >>> outline = Outline(disk.xy[None], disk.dxy[None])
    >>> found = match(grey, grey > 0, outline, np.array([[10.0, 10.0]]), options, noise=0.5)
    >>> found.xy.round(2)
    array([[10.3,  9.6]])
    """
    if isinstance(outline, Outline):
        outline = GrownOutline(outline, np.zeros((0, 2, 2)) if form is None else form)
    patch = Patches(pixels, valid, outline, xy, options, claims, others)
    free = np.full(patch.form_at + patch.forms, np.inf)
    free[[X, Y]], free[WIDTH] = options.held or np.array(options.half) / 2, options.psf_log_sigma
    free[CONTRAST] = options.contrast_sigma
    free[patch.ground.stop : patch.form_at] = options.contrast_slope or np.inf
    if form_sigma is not None:
        free[patch.form_at :] = form_sigma
    if light is None:
        return _searched(patch, free, noise)
    quick, amiss = _continued(patch, patch.begin(*light), free, noise)
    quick.converged[amiss] = False
    if not len(amiss) or not searching:
        return quick
    few = Patches(
        pixels,
        valid,
        ShapeSubset(outline, amiss),
        xy[amiss],
        replace(options, psf_px=patch.psf[amiss]),
        None if claims is None else (claims[0], claims[1][amiss]),
        None if others is None else others[amiss],
    )
    return quick.replaced(amiss, _searched(few, free, noise))


def _searched(patch: Patches, free: Array, noise: float) -> Matches:
    """Matches from approximate positions alone; pixels with blunders are rejected."""
    options = patch.options
    start = patch.start(noise)

    def adjust(rows: Rows, start_at: Array, most: int = _MOST) -> BatchAdjustment:
        return adjust_batch(
            lambda x, at: patch.form_image(x, rows[at]),
            start_at[rows],
            patch.grey[rows],
            weights=used[rows] * patch.relative_weights[rows] / scale[rows] ** 2,
            prior=(start[rows], free),
            options=BatchOptions(share=options.settled, max_iterations=most),
        )

    every = np.arange(len(patch.xy))
    used, scale = patch.weights, np.full((len(patch.xy), 1), noise)
    # Before blunders are rejected, full convergence is not needed.
    found = adjust(every, start, _FIRST)
    for most in (_FIRST, _MOST):
        # Large residuals are blunders only around a mark that was found; before, they may be the mark itself.
        residuals, tolerated = patch.residuals(found.estimates)
        limit = options.rejection * np.maximum(_robust_sigma(residuals, used), noise) + tolerated
        kept = patch.weights * (np.abs(residuals) < limit)
        # Model errors caused by a scene count as noise; otherwise prior knowledge would have no weight there.
        rougher = np.maximum(noise, _rms(residuals, kept, start.shape[1]))
        renewed = (kept != used).any(axis=1) | (rougher > 1.2 * scale)[:, 0]
        renewed |= found.reasons == BatchReason.MAX_ITERATIONS
        changed = np.flatnonzero(renewed)
        if not len(changed):
            break
        used, scale = kept, np.where(np.isin(every, changed)[:, None], rougher, scale)
        found = _with_rows(found, changed, adjust(changed, found.estimates, most))
    for _ in range(2 if options.row_jitter_px > 0 else 0):
        # The residuals contain the jitter in the first round; whitened residuals contain the noise alone.
        patch.whiten(found.estimates, _rms(found.residuals, used, start.shape[1]), options.row_jitter_px)
        found = adjust(every, found.estimates)
    return _columns(patch, found, used > 0, scale[:, 0])


def _continued(patch: Patches, start: Array, free: Array, noise: float) -> tuple[Matches, Rows]:
    """Matches from good start values, and the rows with blunders or without convergence."""
    weights = patch.weights * patch.relative_weights / noise**2
    options = BatchOptions(share=patch.options.settled, max_iterations=_FIRST, damping=1e-5)
    found, rows = _compiled(patch, start, free, noise, weights, options)
    if found is None or len(rows):
        formed = patch.shares.copy()
        if patch.options.row_jitter_px > 0:
            patch.whiten(start, np.full((len(start), 1), noise), patch.options.row_jitter_px)
        general = adjust_batch(
            lambda x, at: patch.form_image(x, rows[at]),
            start[rows],
            patch.grey[rows],
            weights=weights[rows],
            prior=(start[rows], free),
            values=lambda x, at: patch.form_values(x, rows[at]),
            options=options,
        )
        found = general if found is None else _with_rows(found, rows, general)
        formed[rows] = patch.shares[rows]
        patch.shares = formed
    used = patch.weights > 0
    worst = np.where(used, np.abs(found.residuals), 0.0).max(axis=1)
    rms = found.sigma0 * noise
    amiss = (
        ~found.converged
        | ~(worst < _PLAIN * patch.options.rejection * np.maximum(rms, noise))
        | ~(rms < 2 * noise)
    )
    return _columns(patch, found, used, np.full(len(start), noise), patch.shares), np.flatnonzero(amiss)


def _compiled(
    patch: Patches, start: Array, free: Array, noise: float, weights: Array, options: BatchOptions
) -> tuple[BatchAdjustment | None, Rows]:
    """The adjustment of :func:`_continued` by compiled code, and the rows left to the general one."""
    every, shape = np.arange(len(start)), patch.form
    share, slopes = shape.derivatives(
        patch.xy + start[:, :2], patch.width(start, every), start[:, patch.form_at :], every, patch.window
    )
    if share.dtype != np.float32:
        return None, every
    from .compiled import ACTIVE, DONE, advanced, linearised  # takes half a second to import

    (k, n), u = patch.grey.shape, start.shape[1]
    jitter, dark = patch.options.row_jitter_px, patch.options.polarity == "dark"
    window = patch.monomials.T.copy(), patch.across.reshape(len(patch.across), n), patch.shape[2]
    prior = 1 / free**2
    residuals, normal, cofactor = np.zeros((k, n)), np.zeros((k, u, u)), np.full((k, u, u), np.nan)
    common = np.zeros((2, k if jitter > 0 else 0, n), np.float32)
    kept = np.empty((k, u, n), np.float32)
    work = residuals, kept, normal, np.zeros((k, u)), cofactor, common[0], common[1]
    x, trial, iteration, state = start.copy(), start.copy(), np.zeros((k, 4)), np.zeros(k, np.int64)
    iteration[:, 1] = options.damping
    with one_thread():
        linearised(
            share.reshape(k, -1),
            slopes.reshape(k, -1, n),
            patch.grey,
            weights,
            window,
            (dark, noise**2, (jitter / noise) ** 2),
            _SHARPEST * patch.psf,
            prior,
            options.share,
            *(x, work, trial, iteration, state),
        )
        patch.shares = share.copy()
        rounds = np.zeros(k, np.int64)
        for _ in range(options.max_iterations - 1):
            rows = np.flatnonzero(state == ACTIVE)
            if not len(rows):
                break
            width, form = patch.width(trial[rows], rows), trial[rows, patch.form_at :]
            tried = shape.image(
                patch.xy[rows] + trial[rows, :2], width, form, rows, patch.window.select(rows)
            )
            patch.shares[rows] = tried
            rounds[rows] += 1
            advanced(
                rows,
                tried.reshape(len(rows), n),
                patch.grey,
                weights,
                window,
                dark,
                start,
                prior,
                options.share,
                *(x, work, trial, iteration, state),
            )
    redundancy = (patch.weights > 0).sum(axis=1) + np.count_nonzero(prior) - u
    left = state != DONE
    found = BatchAdjustment(
        estimates=x,
        cofactor=cofactor,
        residuals=residuals,
        sigma0=np.sqrt(iteration[:, 0] / np.maximum(redundancy, 1)),
        redundancy=redundancy,
        converged=~left,
        iterations=rounds,
        reasons=np.where(left, BatchReason.MAX_ITERATIONS, BatchReason.CONVERGED).astype(np.int64),
        factors=np.ones((k, n)),
    )
    return found, np.flatnonzero(left)


def _robust_sigma(residuals: Array, used: Array) -> Array:
    """1.4826 × the median of the absolute residuals in use, (k, 1); at least half their rms."""
    sigma = 1.4826 * medians(np.abs(residuals), used > 0)
    # In an image of few grey levels half of the residuals may be 0.
    return np.maximum(sigma, 0.5 * _rms(residuals, used, 0))


def _rms(residuals: Array, used: Array, parameters: int) -> Array:
    """Root mean square of the residuals in use, (k, 1)."""
    squares = np.where(used > 0, np.nan_to_num(residuals) ** 2, 0.0).sum(axis=1, keepdims=True)
    rms: Array = np.sqrt(squares / np.maximum((used > 0).sum(axis=1, keepdims=True) - parameters, 1))
    return rms


def _columns(
    patch: Patches, found: BatchAdjustment, used: Mask, scale: Array, share: Array | None = None
) -> Matches:
    """Columns of results from the adjusted batch; `share` as formed last, if it is known."""
    x, k = found.estimates, len(patch.xy)
    flat = (patch.share(x) if share is None else share).reshape(k, -1)
    sight = np.maximum((flat * patch.near).sum(axis=1), 1e-12)
    plane = patch.background(x).reshape(k, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cov = found.covariance
        expected = -plane * flat if patch.options.polarity == "dark" else flat
        correlation = _correlation(patch.grey - plane, expected, used)
        t = correlation * np.sqrt(np.maximum(used.sum(axis=1) - patch.form_at, 1) / (1 - correlation**2))
    influence, leverage = np.zeros((k, 2, 0, 0)), np.zeros((k, 0, 0))
    if patch.options.influence:
        influence, leverage = patch.influence(x, found.cofactor, used, scale)
    return Matches(
        xy=patch.xy + x[:, :2],
        cov=cov[:, :2, :2],
        psf_px=patch.width(x, np.arange(k)),
        contrast=x[:, CONTRAST],
        level=x[:, LEVEL],
        t=np.nan_to_num(t),
        form=x[:, patch.form_at :],
        noise=found.sigma0 * scale,
        correlation=np.nan_to_num(correlation),
        seen=(flat * patch.weights).sum(axis=1) / sight,
        rejected=(flat * (patch.weights - used)).sum(axis=1) / sight,
        converged=found.converged & np.isfinite(cov[:, :2, :2]).all(axis=(1, 2)),
        residuals=np.where(used, found.residuals, np.nan).reshape(patch.shape),
        form_sigma=np.sqrt(np.diagonal(cov, axis1=1, axis2=2)[:, patch.form_at :]),
        influence=influence,
        leverage=leverage,
    )


def _correlation(a: Array, b: Array, used: Mask) -> Array:
    """Correlation of the rows of two arrays over the entries in use, (k,)."""
    n, w = used.sum(axis=1), used.astype(np.float64)
    a, b = np.where(used, a, 0.0), np.where(used, b, 0.0)
    a -= w * (a.sum(axis=1) / n)[:, None]
    b -= w * (b.sum(axis=1) / n)[:, None]
    ab, aa, bb = (np.einsum("kn,kn->k", x, y) for x, y in ((a, b), (a, a), (b, b)))
    return np.asarray(ab / np.sqrt(aa * bb))
