r"""The image of a point reflector in an ultrasonic section: an arc, in one of several forms.

A point at range d reflects every beam that grazes it; the echo is later and weaker for more oblique beams. If
the echo is late by :math:`v` at the distance :math:`u` along the scan, with the profile P along it and a
pulse of Gaussian profile of width b,

.. math:: I = P(u) \exp\Bigl(-\frac{(v - h(u))^2}{2b(u)^2}\Bigr), \qquad
          h(u) = \frac{\sqrt{1 + \kappa^2 u^2} - 1}{\kappa} ,

since ranges :math:`\sqrt{d^2 + u^2}` lie on a hyperbola of curvature :math:`\kappa = 1/d` at its vertex. In
an image all this is rotated by the tilt. The spot of a display, the lens and the pixel widen both profiles;
the widths here are those in the image. A pixel integrates: a Gaussian of width s convolved with the pixel is
one of :math:`\sqrt{s^2 + 1/12}` within 1e-3 of its height, for s above 0.6 px.

The profile along is that of a beam, of an even line, or anything between: a line of the half length w with
Gaussian ends of width s, of the rms width :math:`a = \sqrt{s^2 + w^2/3}` and the flatness
:math:`f = w^2/3a^2`; f = 0 is a Gaussian, f near 1 an even line with soft ends. Its brightness may fade
towards one end (g) or taper towards both (c), its width may change towards both ends (d), and the film or
tube may saturate (q). With t = u/a,

.. math:: P = \frac{\Phi(\frac{u+w}s) - \Phi(\frac{u-w}s)}{2\Phi(\frac ws) - 1}\, e^{gt + ct^2}, \qquad
          b(u) = b\, e^{dt^2}, \qquad I' = \frac{1 - e^{-qI}}{1 - e^{-q}} .

The position is the middle between the two ends, whatever the brightness does between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import scipy

from ..core.compiled import compiled
from ..core.data import Array, Rows

_LEAST_FLATNESS = 1e-6
"""Flatness below which a profile is formed as one of this flatness: Gaussian within 1e-6 of its height."""
_LINEAR = 1e-8
"""Saturation below which a response is formed as one of this saturation."""
_MOST_EXPONENT = 50.0
"""Bound of exponents, for parameters that an iteration tries and refuses."""


_DARK = 9.0
"""Widths beyond which a Gaussian is 0 as far as digits go: 3e-18."""
_HALF_ROOT, _DENSITY = math.sqrt(0.5), 1 / math.sqrt(2 * math.pi)


@dataclass(frozen=True, eq=False)
class Arcs:
    """Arcs in columns; image coordinates (x right, y down), the origin at the centre of each.

    Parameters
    ----------
    along, across : ndarray (k,)
        Widths (one sigma) a along the line and b across it, pixels.
    curvature : ndarray (k,)
        Curvature κ at the centre, 1/px; positive if the ends of a horizontal arc lie below its centre.
    tilt : ndarray (k,)
        Angle from the x axis towards the y axis (rad).
    flatness : ndarray (k,), optional
        Flatness f of the profile, from 0 (Gaussian) to below 1 (even line). By default 0, as all that follow.
    fading, tapering, thickening : ndarray (k,), optional
        Logarithmic changes of the brightness along the line, g and c, and of the width across, d.
    saturation : ndarray (k,), optional
        Saturation q of the response, 0 if it is linear.

    Examples
    --------
    >>> one = Arcs(*np.array([[8.0], [2.0], [0.02], [0.0]]))
    >>> image = one.image(np.zeros((1, 2)), np.arange(-9.0, 10)[None], np.arange(-9.0, 10)[None])
    >>> image.shape, float(image[0, 9, 9])
    ((1, 19, 19), 1.0)

    An even line, 40 px long, with ends as soft as its width:

    >>> line = Arcs.lines(np.array([40.0]), np.array([1.8]), np.array([0.01]), np.array([0.0]))
    >>> image = line.image(np.zeros((1, 2)), np.array([[0.0, 10.0, 20.0]]), np.array([[0.0, 0.5, 2.0]]))
    >>> np.diagonal(image[0]).round(2).tolist()
    [1.0, 1.0, 0.5]
    """

    along: Array
    across: Array
    curvature: Array
    tilt: Array
    flatness: Array | None = None
    fading: Array | None = None
    tapering: Array | None = None
    thickening: Array | None = None
    saturation: Array | None = None

    @classmethod
    def lines(
        cls, length: Array, across: Array, curvature: Array, tilt: Array, softness: Array | None = None
    ) -> Arcs:
        """Even lines of a length (k,) between the points of half brightness, with soft ends.

        Parameters
        ----------
        length, across, curvature, tilt : ndarray (k,)
            Length and width (px), curvature and tilt of each line.
        softness : ndarray (k,), optional
            Width (one sigma) of the ends; by default the width across.
        """
        soft = across if softness is None else softness
        long = length**2 / 12
        return cls(np.sqrt(long + soft**2), across, curvature, tilt, long / (long + soft**2))

    def __len__(self) -> int:
        return len(self.along)

    def select(self, rows: Rows) -> Arcs:
        """A subset of the arcs."""
        columns: list[Any] = [getattr(self, column.name) for column in fields(self)]
        parts: list[Any] = [None if values is None else values[rows] for values in columns]
        return Arcs(*parts)

    def image(self, xy: Array, columns: Array, rows: Array) -> Array:
        """Brightness of the pixels of windows, 1 at the centre of the line.

        Parameters
        ----------
        xy : ndarray (k, 2)
            Centres of the lines, pixels.
        columns, rows : ndarray (k, c), (k, r)
            Pixel coordinates of the windows.

        Returns
        -------
        ndarray (k, r, c)
        """
        # Coordinates along and across the tangent of each arc, (k, r, c).
        c, s = np.cos(self._of("tilt")), np.sin(self._of("tilt"))
        x, y = (columns - xy[:, :1])[:, None, :], (rows - xy[:, 1:])[:, :, None]
        u, v = c * x + s * y, c * y - s * x
        k, a = self._of("curvature"), self._of("along")
        late = v - k * u * u / (1 + np.sqrt(1 + (k * u) ** 2))
        t = u / a
        late /= self._of("across") * _exponential(self._of("thickening") * t * t)
        inner = self._of("fading") * t + self._of("tapering") * t * t
        pulse = np.exp(-0.5 * late * late) * _exponential(inner)
        f = np.clip(self._of("flatness"), _LEAST_FLATNESS, 1 - _LEAST_FLATNESS)
        w, soft = a * np.sqrt(3 * f), a * np.sqrt(1 - f)
        if self.flatness is not None and self.flatness.any():
            # Symmetric in u; differences of the lower tails lose no digits.
            far = np.abs(u) / soft
            line = (scipy.special.ndtr(w / soft - far) - scipy.special.ndtr(-w / soft - far)) / (
                2 * scipy.special.ndtr(w / soft) - 1
            )
        else:
            line = np.exp(-0.5 * t * t)
        image: Array = line * pulse
        if self.saturation is not None and self.saturation.any():
            q = self._of("saturation")
            q = np.where(np.abs(q) < _LINEAR, _LINEAR, q)
            image = np.expm1(-q * image) / np.expm1(-q)
        return image

    def derivatives(self, xy: Array, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Brightness, and its derivatives with respect to position, widths and form.

        Returns
        -------
        image : ndarray (k, r, c)
        derivatives : ndarray (k, 11, r, c)
            With respect to x, y, `across`, the logarithm of `along`, `curvature`, `tilt`, the logit
            ln(f/(1 − f)) of `flatness`, `fading`, `tapering`, `thickening` and `saturation`.
        """
        image = np.empty((len(self), rows.shape[1], columns.shape[1]))
        parts = np.empty((len(self), 11, *image.shape[1:]))
        values = [self._of(f.name)[:, 0, 0] for f in fields(self)]
        # A Gaussian is formed as one, if all are.
        even = self.flatness is not None and bool(self.flatness.any())
        _differentiated(
            np.stack(values, axis=1),
            even,
            np.asarray(xy, dtype=np.float64),
            np.ascontiguousarray(columns, dtype=np.float64),
            np.ascontiguousarray(rows, dtype=np.float64),
            image,
            parts,
        )
        return image, parts

    def _of(self, name: str) -> Array:
        """A column as (k, 1, 1); zeros where it was not given."""
        values = getattr(self, name)
        return np.zeros((len(self), 1, 1)) if values is None else values[:, None, None]


def _exponential(exponent: Array) -> Array:
    return np.exp(np.clip(exponent, -_MOST_EXPONENT, _MOST_EXPONENT))


@compiled
def _tail(z: float) -> float:
    """Normal distribution."""
    return 0.5 * math.erfc(-z * _HALF_ROOT)


@compiled
def _bell(z: float) -> float:
    """Density of the normal distribution."""
    return math.exp(-0.5 * z * z) * _DENSITY


@compiled
def _differentiated(
    arcs: Array, even: bool, xy: Array, columns: Array, rows: Array, image: Array, parts: Array
) -> None:
    """Images and derivatives, pixel by pixel, of `arcs` with columns in the order of :class:`Arcs`."""
    for n in range(len(arcs)):
        a, b0, k, tilt = arcs[n, 0], arcs[n, 1], arcs[n, 2], arcs[n, 3]
        fading, tapering, thickening, saturation = arcs[n, 5], arcs[n, 6], arcs[n, 7], arcs[n, 8]
        f = min(max(arcs[n, 4], _LEAST_FLATNESS), 1 - _LEAST_FLATNESS)
        c, s = math.cos(tilt), math.sin(tilt)
        w, soft = a * math.sqrt(3 * f), a * math.sqrt(1 - f)
        whole, middle = 2 * _tail(w / soft) - 1, 2 * _bell(w / soft) / soft
        fades, saturates = fading != 0 or tapering != 0, saturation != 0
        q = saturation if abs(saturation) >= _LINEAR else _LINEAR
        scale = -math.expm1(-q)
        for i in range(rows.shape[1]):
            y = rows[n, i] - xy[n, 1]
            for j in range(columns.shape[1]):
                x = columns[n, j] - xy[n, 0]
                u, v = c * x + s * y, c * y - s * x
                root = math.sqrt(1 + (k * u) ** 2)
                late = v - k * u * u / (1 + root)
                t = u / a
                b = b0
                if thickening != 0:
                    b *= math.exp(min(max(thickening * t * t, -_MOST_EXPONENT), _MOST_EXPONENT))
                late_b = late / b
                if abs(late_b) > _DARK or (even and abs(u) > w + _DARK * soft):
                    image[n, i, j] = 0.0
                    parts[n, :, i, j] = 0.0
                    continue
                pulse = math.exp(-0.5 * late_b * late_b)
                if fades:
                    inner = fading * t + tapering * t * t
                    pulse *= math.exp(min(max(inner, -_MOST_EXPONENT), _MOST_EXPONENT))
                if even:
                    far = abs(u) / soft
                    linear = (_tail(w / soft - far) - _tail(-w / soft - far)) / whole * pulse
                    ahead, behind = _bell((u + w) / soft) / soft, _bell((u - w) / soft) / soft
                    by_u = (ahead - behind) / whole * pulse
                    by_w = ((ahead + behind) * pulse - linear * middle) / whole
                    by_soft = ((u - w) * behind - (u + w) * ahead) * pulse + linear * middle * w
                    by_soft /= soft * whole
                    by_along = w * by_w + soft * by_soft
                    by_flatness = 0.5 * (by_w * w * (1 - f) - by_soft * soft * f)
                else:
                    linear = math.exp(-0.5 * t * t) * pulse
                    by_u = -linear * t / a
                    by_along = linear * t * t
                    by_flatness = 0.0  # of first order in f
                by_v = -linear * late_b / b
                by_thick = -by_v * late  # with respect to the logarithm of b
                by_u -= by_v * k * u / root
                by_t = linear * (fading + 2 * tapering * t) + 2 * thickening * t * by_thick
                by_u += by_t / a
                by_along -= t * by_t
                image[n, i, j] = linear
                part = parts[n, :, i, j]
                part[0] = s * by_v - c * by_u
                part[1] = -s * by_u - c * by_v
                part[2] = by_thick / b0
                part[3] = by_along
                part[4] = -by_v * u * u / (root * (1 + root))
                part[5] = by_u * v - by_v * u
                part[6] = by_flatness
                part[7] = linear * t
                part[8] = part[7] * t
                part[9] = by_thick * t * t
                part[10] = 0.5 * linear * (1 - linear)
                if saturates:
                    left = math.exp(-q * linear)
                    seen = -math.expm1(-q * linear) / scale
                    image[n, i, j] = seen
                    for p in range(10):
                        part[p] *= q * left / scale
                    part[10] = (linear * left - seen * (1 - scale)) / scale
