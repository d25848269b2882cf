"""Whether formed images are those of the photograph, beside noise that grows with the light.

Two explanations of the residuals are compared: they are as large in the images of the targets as beside
them, in units of the noise of each grey value, or they are larger there, for lens, focus or aperture are
others. The noise follows from differences of adjacent residuals, which the misfit of a blurred image, itself
smooth, hardly changes; the misfit shows in means over blocks, in which the noise is small. Noise that
neighbours have in common is in the means beside the targets, too.

What blurs beside the rays can take a part of their blur: then it is another from target to target. That all
have one width competes with a width of each (Schwarz 1978).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask
from ..matching.noise import LEAST, adjusted_grey, linear_variance

_BLOCK = 3
"""Side of the blocks, pixels: less than the parts of a blurred image that differ alike."""
_BESIDE = 0.02
"""Part of the contrast below which a block is beside the target."""
_ON, _AROUND = 4, 3
"""Parameters of a match that follow from the target (place, width, contrast), and from the background."""


@dataclass(frozen=True)
class Likeness:
    """What the residuals of all targets of a frame say.

    Parameters
    ----------
    misfit : float
        Root mean square of block means in the images over that beside them; NaN where there are too few.
    unlike : bool
        Whether the images are not those of the photograph.
    """

    misfit: float
    unlike: bool


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of targets of similar size.

    Parameters
    ----------
    adjusted : ndarray (k, r, c)
        Adjusted grey values, NaN where a pixel was not used.
    off : ndarray (k, r, c)
        Adjusted minus observed.

    Examples
    --------
    A disk that is darker by 2 in the photograph than around it by the formed image:

    >>> rng = np.random.default_rng(0)
    >>> x, y = np.meshgrid(np.arange(-20.0, 21), np.arange(-20.0, 21))
    >>> adjusted = 200 - 100 * np.exp(-0.01 * (x**2 + y**2)**1.5)[None].repeat(8, axis=0)
    >>> noise = rng.normal(0.0, np.sqrt(adjusted / 20))
    >>> Residuals(adjusted, noise).likeness([Residuals(adjusted, noise)]).unlike
    False
    >>> wrong = Residuals(adjusted, noise + 2 * np.cos(x / 2) * (np.hypot(x, y) < 8))
    >>> wrong.likeness([wrong]).unlike
    True
    """

    adjusted: Array
    off: Array

    @classmethod
    def of(cls, pixels: NDArray[np.float32], start: Array, off: Array) -> Residuals:
        """Residuals (k, r, c) of windows around pixels (k, 2) of a frame."""
        return cls(adjusted_grey(pixels, start, off), off)

    def variance(self) -> tuple[float, float] | None:
        """Variance a + b·g of a grey value g by differences of residuals; None if it does not grow with g."""
        return linear_variance(*self._differences())

    def _differences(self) -> tuple[Array, Array]:
        """Grey values, and squares of second differences along both axes with the variance of one pixel."""
        bent = np.diff(np.diff(self.off, 2, axis=1), 2, axis=2)[:, ::2, ::2] / 6
        grey = self.adjusted[:, 1:-1:2, 1:-1:2]
        there = np.isfinite(bent) & np.isfinite(grey)
        return grey[there], bent[there] ** 2

    def _blocks(self, variance: tuple[float, float], mean: float) -> tuple[Array, Mask]:
        """Squares of mean residuals of blocks, over their variance, and whether blocks are on a target."""
        k, r, c = self.off.shape
        rows, columns = r // _BLOCK * _BLOCK, c // _BLOCK * _BLOCK
        grey = self.adjusted
        unit = self.off / np.sqrt(np.maximum(variance[0] + variance[1] * grey, LEAST * mean))
        # Around a target there is the background alone, a plane.
        y, x = np.meshgrid(np.linspace(-1, 1, r), np.linspace(-1, 1, c), indexing="ij")
        plane = np.stack([np.ones_like(x), x, y], axis=-1)
        edge = np.maximum(np.abs(x), np.abs(y)) > 1 - 1e-9
        on = np.zeros(grey.shape)
        for each, values in enumerate(grey):
            used = edge & np.isfinite(values)
            flat = plane @ np.linalg.lstsq(plane[used], values[used], rcond=None)[0]
            on[each] = np.abs(values - flat)
        on /= np.nanmax(on, axis=(1, 2), keepdims=True)

        def blocks(values: Array) -> Array:
            parts = values[:, :rows, :columns].reshape(k, rows // _BLOCK, _BLOCK, columns // _BLOCK, _BLOCK)
            return np.asarray(parts.mean(axis=(2, 4)))

        square, within = (_BLOCK * blocks(unit)) ** 2, blocks(on)
        there = np.isfinite(square) & np.isfinite(within)
        targets: Mask = within[there] > _BESIDE
        return square[there], targets

    @staticmethod
    def likeness(parts: list[Residuals]) -> Likeness:
        """Compare both explanations of the residuals of all targets of a frame."""
        count = sum(len(part.off) for part in parts)
        grey, squares = (
            np.concatenate(each) for each in zip(*(part._differences() for part in parts), strict=True)
        )
        mean = float(squares.mean()) if len(squares) else 0.0
        variance = linear_variance(grey, squares) or (mean, 0.0)
        if not mean > 0:
            return Likeness(float("nan"), False)
        square, on = (
            np.concatenate(each)
            for each in zip(*(part._blocks(variance, mean) for part in parts), strict=True)
        )
        free = np.array([on.sum() - _ON * count, (~on).sum() - _AROUND * count])
        if (free < _BLOCK).any():
            return Likeness(float("nan"), False)
        sums = np.array([square[on].sum(), square[~on].sum()])
        each, both = sums / free, sums.sum() / free.sum()
        # Twice the gain in likelihood by one more variance, over what such a gain is worth (Schwarz).
        gain = float(free @ np.log(both / each))
        return Likeness(
            float(np.sqrt(each[0] / each[1])), bool(each[0] > each[1] and gain > np.log(free.sum()))
        )


def widths_differ(psf_px: Array, log_sigma: Array, pixels: int) -> bool:
    """Whether what blurs beside the rays (n,) has another width at each target, rather than one at all."""
    log, weight = np.log(psf_px), log_sigma**-2.0
    off = log - (weight @ log) / weight.sum()
    return bool(weight @ off**2 > (len(log) - 1) * np.log(pixels))
