r"""The image of a point reflector in an ultrasonic section: an arc that is brightest at its centre.

A point at range d reflects every beam that grazes it; the echo is later and weaker for more oblique beams. If
the echo is late by :math:`v` at the distance :math:`u` along the scan, with a beam and a pulse of Gaussian
profiles of widths a and b,

.. math:: I = \exp\Bigl(-\frac{u^2}{2a^2} - \frac{(v - h(u))^2}{2b^2}\Bigr), \qquad
          h(u) = \frac{\sqrt{1 + \kappa^2 u^2} - 1}{\kappa} ,

since ranges :math:`\sqrt{d^2 + u^2}` lie on a hyperbola of curvature :math:`\kappa = 1/d` at its vertex. In
an image all this is rotated by the tilt. The spot of a display, the lens and the pixel widen both profiles;
the widths here are those in the image. A pixel integrates: a Gaussian of width s convolved with the pixel is
one of :math:`\sqrt{s^2 + 1/12}` within 1e-3 of its height, for s above 0.6 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.data import Array, Rows

__all__ = ["Arcs"]


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

    Examples
    --------
    >>> one = Arcs(*np.array([[8.0], [2.0], [0.02], [0.0]]))
    >>> image = one.image(np.zeros((1, 2)), np.arange(-9.0, 10)[None], np.arange(-9.0, 10)[None])
    >>> image.shape, float(image[0, 9, 9])
    ((1, 19, 19), 1.0)
    """

    along: Array
    across: Array
    curvature: Array
    tilt: Array

    def __len__(self) -> int:
        return len(self.along)

    def select(self, rows: Rows) -> Arcs:
        """A subset of the arcs."""
        return Arcs(self.along[rows], self.across[rows], self.curvature[rows], self.tilt[rows])

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
        u, v = self._own(xy, columns, rows)
        root = np.sqrt(1 + (self._k * u) ** 2)
        late = v - self._k * u * u / (1 + root)
        image: Array = np.exp(-0.5 * ((u / self._a) ** 2 + (late / self._b) ** 2))
        return image

    def derivatives(self, xy: Array, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Brightness, and its derivatives with respect to position, widths and form.

        Returns
        -------
        image : ndarray (k, r, c)
        derivatives : ndarray (k, 6, r, c)
            With respect to x, y, `across`, the logarithm of `along`, `curvature` and `tilt`.
        """
        u, v = self._own(xy, columns, rows)
        k, a, b = self._k, self._a, self._b
        root = np.sqrt(1 + (k * u) ** 2)
        late = v - k * u * u / (1 + root)
        image = np.exp(-0.5 * ((u / a) ** 2 + (late / b) ** 2))
        # Derivatives of the exponent with respect to v, and to u along and across.
        by_v = -image * late / b**2
        by_u = -image * u / a**2 - by_v * k * u / root
        c, s = np.cos(self.tilt)[:, None, None], np.sin(self.tilt)[:, None, None]
        parts = np.empty((len(u), 6, *u.shape[1:]))
        parts[:, 0] = s * by_v - c * by_u
        parts[:, 1] = -s * by_u - c * by_v
        parts[:, 2] = -by_v * late / b
        parts[:, 3] = image * (u / a) ** 2
        parts[:, 4] = -by_v * u * u / (root * (1 + root))
        parts[:, 5] = by_u * v - by_v * u
        return image, parts

    def _own(self, xy: Array, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Coordinates along and across the tangent of each arc, (k, r, c)."""
        c, s = np.cos(self.tilt)[:, None, None], np.sin(self.tilt)[:, None, None]
        x, y = (columns - xy[:, :1])[:, None, :], (rows - xy[:, 1:])[:, :, None]
        return c * x + s * y, c * y - s * x

    @property
    def _a(self) -> Array:
        return self.along[:, None, None]

    @property
    def _b(self) -> Array:
        return self.across[:, None, None]

    @property
    def _k(self) -> Array:
        return self.curvature[:, None, None]
