"""What a camera has made of the light: a kernel of motion, defocus or sharpening.

It is estimated from marks that have been matched with plain Gaussian images, by what is left in their
windows. A mark has its own position, contrast, background and form; what these can explain is projected out
of each window, and the windows together determine what all have in common. A kernel is even, K(d) = K(−d),
with a sum of 1: an odd one would shift all marks. Its values at whole pixels weight shifted images of the
mark, to which the residuals are linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.data import Array, Mask, Rows
from .matching import Shape
from .matching.patches import filtered
from .matching.shapes import Window

_REACH = 5
"""Half the side of a kernel, pixels."""
_TAP = 0.1
"""Prior standard deviation of a value of a kernel."""
_SHARPER = (1.0, 0.75, 0.5)
"""Shares of the width of the point-spread function that are tried beneath a kernel."""
_FUTILE = 0.95
"""Ratio of mean square residuals above which no kernel is sought beneath a sharper function."""
_SINGULAR = 1e-12
"""Added to the diagonal of correlations, where parts of a basis may be alike."""
_SMALL = 1e-3
"""Values of a kernel below this are set to zero."""
_SHARPENS = -0.01
"""Values of a kernel below which it subtracts light, as sharpening does and motion cannot."""


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
    >>> from reseau.measure.matching.shapes import GrownOutline
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
        every = np.ascontiguousarray(images, dtype=np.float32).reshape(-1, *images.shape[-2:])
        found = filtered(every, self.kernel.astype(np.float32))
        return np.asarray(found.reshape(*images.shape[:-2], *found.shape[1:]), dtype=images.dtype)


def sharpened_from_px(kernel: Array) -> int:
    """Distance up to which sharpening takes light from around a pixel; 0 for motion.

    Sharpening has worked on the grey values of the frame: nearer to its border than this, it has invented
    those beyond.

    Parameters
    ----------
    kernel : ndarray (2 m + 1, 2 m + 1)
        See :func:`estimate_kernel`.

    Examples
    --------
    >>> sharpened_from_px(np.array([[0.0, -0.1, 0.0], [-0.1, 1.4, -0.1], [0.0, -0.1, 0.0]]))
    1
    >>> sharpened_from_px(np.array([[0.0, 0.0, 0.0], [0.3, 0.4, 0.3], [0.0, 0.0, 0.0]]))
    0
    """
    at = np.argwhere(kernel < _SHARPENS) - len(kernel) // 2
    return int(np.abs(at).max(initial=0))


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
        """What each mark explains by itself (k, b, n): position, form, contrast and background."""
        k, rows, columns = share.shape
        u, v = np.linspace(-1, 1, columns)[None, :], np.linspace(-1, 1, rows)[:, None]
        even, m = np.stack([u**i * v**j for i, j in _POWERS]), slopes.shape[1]
        parts = np.empty((k, 3 + m + len(even), rows, columns))
        np.multiply(share[:, None], even[:3], out=parts[:, :3])
        parts[:, 3 : 3 + m], parts[:, 3 + m :] = slopes, even
        return parts.reshape(k, -1, rows * columns)


_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


def unexplained(values: Array, basis: Array, weight: Array) -> Array:
    """What weighted values (k, s, n) contain beside a weighted basis (k, b, n)."""
    left = np.empty(values.shape)
    for mark, (parts, w) in enumerate(zip(basis, weight, strict=True)):
        # One mark at a time: what is formed stays in a cache.
        known = _turned(parts[None] * w)[0]
        normal, scaled = known @ known.T + _SINGULAR * np.eye(len(known)), values[mark] * w
        for _ in range(2):  # what rounding left the first time
            scaled = scaled - np.linalg.solve(normal, known @ scaled.T).T @ known
        left[mark] = scaled
    return left


def _turned(rows: Array) -> Array:
    """A basis (k, b, n) with rows of length 1."""
    length = np.sqrt(np.einsum("kbn,kbn->kb", rows, rows))
    return np.asarray(rows / np.maximum(length, 1e-300)[..., None])


def _reduced(products: Array, last: int) -> Array:
    """Products (k, m, m) of the `last` of parts without what the others explain, summed: (last, last)."""
    first = products.shape[1] - last
    known = products[:, :first, :first] + _SINGULAR * np.eye(first)
    across = products[:, :first, first:]
    left = products[:, first:, first:] - np.swapaxes(across, 1, 2) @ np.linalg.solve(known, across)
    return np.asarray(left.sum(axis=0))


def estimate_kernel(samples: Samples, sharper: tuple[float, ...] = _SHARPER) -> tuple[Array, float, float]:
    """Estimate the kernel between a Gaussian point-spread function and the images of marks.

    Parameters
    ----------
    samples : Samples
        Marks that were matched with images of a Gaussian point-spread function.
    sharper : tuple of float
        Shares of the width of that function that are tried beneath the kernel, 1 first.

    Returns
    -------
    kernel : ndarray (11, 11)
        The kernel.
    share : float
        Share of the width `psf_px` of the Gaussian to which it belongs.
    gain : float
        Mean square of the residuals, per redundancy, with the kernel over that without; 1 where too few
        pixels are left to tell.

    Examples
    --------
    >>> from reseau.measure.matching.shapes import GrownOutline
    >>> from reseau.optics.formation import Outline, PixelResponse
    >>> disk = Outline.circle(4.0, 0.5)
    >>> plain = GrownOutline(Outline(disk.xy[None], disk.dxy[None]), np.zeros((0, 2, 2)))
    >>> window = Window(np.arange(25.0)[None], np.arange(25.0)[None], PixelResponse())
    >>> place = np.array([[12.2, 11.9]]), np.full(1, 0.8), np.zeros((1, 0)), np.array([0]), window
    >>> moved = FilteredShape(plain, np.array([[0, 0, 0], [0.3, 0.4, 0.3], [0, 0, 0]]))
    >>> grey = 200 - 150 * moved.image(*place) + np.random.default_rng(0).normal(0, 0.5, (1, 25, 25))
    >>> one = Samples(plain, *place[:3], np.array([-150.0]), window, grey, grey > 0)
    >>> kernel, share, gain = estimate_kernel(one)
    >>> bool(gain < 0.5), bool(kernel[5, 4] > 2 * kernel[4, 5])
    (True, True)
    """
    offsets = np.array(
        [(i, j) for j in range(_REACH + 1) for i in range(-_REACH, _REACH + 1) if (j, i) > (0, 0)]
    )
    k, high, wide = samples.grey.shape
    used = samples.used.reshape(k, 1, -1).astype(np.float64)
    every, best, plain, tried = np.arange(k), (np.inf, 1.0, np.zeros(len(offsets)), 0.0), np.inf, sharper
    observed = np.where(samples.used, samples.grey, 0.0).reshape(k, 1, -1)
    for share_of_width in tried:
        place = (
            *(samples.xy, share_of_width * samples.psf_px, samples.form, every),
            _widened(samples.window, _REACH),
        )
        share, slopes = samples.shape.derivatives(*place)
        inner = slice(_REACH, _REACH + high), slice(_REACH, _REACH + wide)
        # The width is explained by the kernel.
        middle, own = share[:, *inner], np.delete(slopes[:, :, *inner], 2, axis=1)
        basis = _turned(samples.basis(middle, own)) * used
        if share_of_width == tried[0]:
            # What a mark does not explain: sums of squares of grey values would drown it in rounding errors.
            observed = unexplained(observed, basis, used[:, 0])
            blur = slopes[:, 2:3, *inner].reshape(k, 1, -1) * used
            wider = np.concatenate([basis, blur, observed], axis=1)
            plain = float(_reduced(wider @ np.swapaxes(wider, 1, 2), 1)[0, 0])
        parts = np.empty((basis.shape[1] + 1 + len(offsets), high, wide), np.float32)
        whole = np.empty((k, len(parts), len(parts)))
        flat, twice = parts.reshape(len(parts), -1), 2 * middle
        for mark in every:
            # One mark at a time: what is formed stays in a cache.
            flat[: basis.shape[1]], flat[basis.shape[1]] = basis[mark], observed[mark, 0]
            image, taken = share[mark], parts[basis.shape[1] + 1 :]
            for part, (i, j) in zip(taken, offsets.tolist(), strict=True):
                here = image[_REACH - j : _REACH - j + high, _REACH - i : _REACH - i + wide]
                there = image[_REACH + j : _REACH + j + high, _REACH + i : _REACH + i + wide]
                np.add(here, there, out=part)
            taken -= twice[mark]
            taken *= samples.depth[mark] * samples.used[mark]
            whole[mark] = flat @ flat.T
        left = _reduced(whole, 1 + len(offsets))
        square, across, total, cost = left[1:, 1:], left[1:, 0], float(left[0, 0]), plain
        for _ in range(3):
            # The prior is weighed by what is left with the kernel: noise, not misfit.
            weight_of_prior = cost / max(used.sum(), 1) / _TAP**2
            values = np.linalg.solve(square + weight_of_prior * np.eye(len(offsets)), across)
            cost = float(total - 2 * values @ across + values @ square @ values)
        # A weak observation of a value of the kernel takes a part of one from the redundancy.
        taken_by = float(np.trace(np.linalg.solve(square + weight_of_prior * np.eye(len(offsets)), square)))
        spare = float(used.sum()) - k * basis.shape[1] - taken_by
        if cost < best[0]:
            best = cost, share_of_width, values, spare
        if cost > _FUTILE * plain:
            break
    cost, share_of_width, values, spare = best
    kernel = np.zeros((2 * _REACH + 1,) * 2)
    values = np.where(np.abs(values) < _SMALL, 0.0, values)
    for (i, j), value in zip(offsets.tolist(), values, strict=True):
        kernel[_REACH + j, _REACH + i] = kernel[_REACH - j, _REACH - i] = value
    kernel[_REACH, _REACH] = 1 - kernel.sum()
    before = float(used.sum()) - k * (basis.shape[1] + 1)
    if min(spare, before) < 1:
        return kernel, share_of_width, 1.0
    return kernel, share_of_width, (cost / spare) / max(plain / before, 1e-300)
