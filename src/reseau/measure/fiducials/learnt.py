"""Marks whose model is their image in a scan: moved, turned, scaled and blurred as the formed ones are.

The image is filtered in the frequency domain and interpolated by cubic splines. Its own width is that of the
scan from which it was learnt; a sharper scan asks for a negative variance, which the matching bounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Rows
from ...io import LearntMark
from ..matching.shapes import Window

OWN_PSF = 0.6
"""Width of the point-spread function that stands for that of the image itself, pixels."""
_ROOM = 8
"""Pixels over which an image fades before it is filtered."""


@dataclass(frozen=True, eq=False)
class LearntShape:
    """The image of one learnt mark in another scan; see :class:`reseau.measure.matching.Shape`.

    Parameters
    ----------
    learnt : LearntMark
        The image.
    axes : ndarray (2, 2)
        From the plane of the mark to pixels of the scan.
    step : ndarray (2,)
        Units of the parameters of the form: relative change of the size, and rotation in radians.

    Examples
    --------
    >>> u, v = np.meshgrid(np.arange(21) - 10, np.arange(21) - 10)
    >>> rows = np.rint(1000 * np.exp(-(u**2 + v**2) / 8)).astype(int).tolist()
    >>> learnt = LearntMark(values=tuple(map(tuple, rows)), at=(10.0, 10.0), covariance=(0.0, 0.0, 0.0),
    ...     linear=((10.0, 0.0), (0.0, -10.0)), reach=10.0, noise=0.0, source="")
    >>> shape = LearntShape(learnt, np.array([[20.0, 0.0], [0.0, -20.0]]), np.ones(2))
    >>> from reseau.optics.formation import PixelResponse
    >>> window = Window(np.arange(9.0)[None], np.arange(9.0)[None], PixelResponse())
    >>> one = np.array([[4.5, 4.0]]), np.array([OWN_PSF]), np.zeros((1, 2)), np.array([0])
    >>> shape.image(*one, window)[0, 4, 3:7].round(2)  # twice as wide
    array([0.93, 0.99, 0.99, 0.93])
    """

    learnt: LearntMark
    axes: Array
    step: Array

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return len(self.step)

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.Shape`."""
        return self._formed(xy, width, form, at, window, 1)[:, 0]

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.Shape`."""
        parts = self._formed(xy, width, form, at, window, 6)
        return parts[:, 0], parts[:, 1:]

    def _formed(self, xy: Array, width: Array, form: Array, at: Rows, window: Window, parts: int) -> Array:
        """The image and its derivatives (m, parts, r, c) by x, y, width, size and rotation."""
        high, wide = window.rows.shape[1], window.columns.shape[1]
        found = np.zeros((len(at), parts, high, wide))
        for i in range(len(at)):
            if not (np.isfinite(xy[i]).all() and np.isfinite(form[i]).all() and np.isfinite(width[i])):
                found[i] = np.nan
                continue
            offset = np.stack(np.meshgrid(window.columns[i] - xy[i, 0], window.rows[i] - xy[i, 1]))
            found[i] = self._one(offset, float(width[i]), form[i] * self.step, parts)
        return found

    def _one(self, offset: Array, width: float, form: Array, parts: int) -> Array:
        own, back = np.array(self.learnt.linear), np.linalg.inv(self.axes)
        c, s = np.cos(form[1]), np.sin(form[1])
        turn, turned = np.array([[c, s], [-s, c]]), np.array([[-s, c], [-c, -s]])
        matrix = own @ turn @ back / (1 + form[0])
        away = np.einsum("ij,jrc->irc", matrix, offset)
        places = away[::-1] + np.array(self.learnt.at)[::-1, None, None] + _ROOM
        ratio2 = abs(float(np.linalg.det(matrix)))
        variance = ratio2 * (width**2 - OWN_PSF**2) + max(ratio2 - 1, 0.0) / 12  # coarser pixels are larger
        value, *slopes = (
            scipy.ndimage.map_coordinates(field, places, order=3, mode="constant")
            for field in self._filtered(variance, 1 if parts == 1 else 4)
        )
        if parts == 1:
            return np.asarray(value[None])
        slope = np.stack(slopes[:2])
        by_xy = -np.einsum("ij,irc->jrc", matrix, slope)
        by_width = ratio2 * width * slopes[2]
        by_size = -(slope * away).sum(axis=0) * self.step[0] / (1 + form[0])
        swept = np.einsum("ij,jrc->irc", own @ turned @ back / (1 + form[0]), offset)
        by_turn = (slope * swept).sum(axis=0) * self.step[1]
        return np.stack([value, *by_xy, by_width, by_size, by_turn])

    @cached_property
    def _spectrum(self) -> tuple[NDArray[Any], tuple[int, int]]:
        """Spectrum of the image, which fades around its border, and the size of that."""
        values = np.pad(np.array(self.learnt.values, dtype=np.float64) / 1000, _ROOM, mode="linear_ramp")
        return np.fft.rfft2(values), (len(values), values.shape[1])

    def _filtered(self, variance: float, fields: int) -> list[Array]:
        """The image blurred by a variance (px²), its derivatives in x and y, and its Laplacian."""
        whole, (high, wide) = self._spectrum
        ky, kx = 2 * np.pi * np.fft.fftfreq(high)[:, None], 2 * np.pi * np.fft.rfftfreq(wide)
        square = kx**2 + ky**2
        spectrum = whole * np.exp(-variance * square / 2)
        each = [spectrum, 1j * kx * spectrum, 1j * ky * spectrum, -square * spectrum]
        return [np.fft.irfft2(one, (high, wide)) for one in each[:fields]]


def thickness_of(learnt: LearntMark) -> float:
    """Width of the lines of a learnt mark, mm: four times its area over its circumference."""
    blurred = scipy.ndimage.gaussian_filter(np.array(learnt.values, dtype=np.float64) / 1000, 1.0)
    slope = np.hypot(*np.gradient(blurred)).sum()
    return float(4 * np.abs(blurred).sum() / max(slope, 1e-9) / learnt.px_per_mm)
