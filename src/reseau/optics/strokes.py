r"""Bent strokes that fade towards their ends: the image of a point reflector in a scanned sector.

A point at distance answers to every beam that grazes it, later the more obliquely it is hit, and weaker. On
the screen that is a short arc, brightest in its middle. Here it is an outline around the middle line
:math:`v = \tfrac12\kappa u^2`, :math:`|u| \le L/2`, turned by the tilt. What is thinner than the point-spread
function is darker, so that an outline that tapers is an echo that fades:

.. math:: u = \tfrac L2\cos\vartheta, \qquad
          v = \tfrac12\kappa u^2 + \tfrac w2\sin\vartheta\,(1 - \beta + \beta\sin^2\vartheta) ,

with the taper :math:`\beta` from 0, an ellipse, to 1, a lens whose ends are cusps. The curve is analytic in
:math:`\vartheta`, hence the trapezoidal rule on it spectrally exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..data import Array
from .formation import Outline

__all__ = ["Strokes"]


@dataclass(frozen=True, eq=False)
class Strokes:
    """Bent strokes, in columns; image coordinates (x right, y down), the origin at the middle of each.

    Parameters
    ----------
    length : ndarray (k,)
        Length L along the chord, pixels.
    thickness : ndarray (k,)
        Width w of the outline in the middle, across the chord, pixels.
    curvature : ndarray (k,)
        Curvature κ in the middle, 1/px; above zero the ends of a level stroke lie below its middle.
    tilt : ndarray (k,)
        Angle from the x axis towards the y axis (rad).
    taper : float
        How the stroke narrows: 0 an ellipse, 1 a lens with cusps.

    Examples
    --------
    >>> one = Strokes(*np.array([[20.0], [3.0], [0.01], [0.0]]))
    >>> outline = one.outline(0.7)
    >>> bool(abs(outline.xy[0, :, 0].max() - 10.0) < 0.01)  # its tips lie half its length from the middle
    True
    """

    length: Array
    thickness: Array
    curvature: Array
    tilt: Array
    taper: float = 0.7

    def __len__(self) -> int:
        return len(self.length)

    def nodes(self, spacing: float) -> int:
        """Nodes on an outline, at most `spacing` apart along the longest stroke."""
        return max(24, 2 * int(np.ceil(np.pi * float(np.max(self.length, initial=0.0)) / (2 * spacing))))

    def outline(self, spacing: float, nodes: int | None = None) -> Outline:
        """Outlines (k, j, 2).

        Parameters
        ----------
        spacing : float
            Largest distance of two nodes in pixels; one width of the point-spread function is exact to 1e-8.
        nodes : int, optional
            Their number, where it is given.
        """
        u, v, half, angle = self._curve(spacing, nodes)
        sine, cosine = np.sin(angle), np.cos(angle)
        rim = cosine * (1 - self.taper + 3 * self.taper * sine**2)  # derivative of the half width's profile
        step = 2 * np.pi / len(angle)
        du = -0.5 * self.length[:, None] * sine
        dv = self.curvature[:, None] * u * du + 0.5 * self.thickness[:, None] * rim
        return Outline(self._turned(u, v + half), step * self._turned(du, dv))

    def motions(self, spacing: float, nodes: int | None = None) -> Array:
        """Velocities of the nodes, (k, 4, j, 2).

        With respect to the logarithm of the length, that of the thickness, the curvature (px) and the tilt
        (rad).
        """
        u, v, half, _ = self._curve(spacing, nodes)
        none = np.zeros_like(u)
        turned = self._turned(u, v + half)
        return np.stack(
            [
                self._turned(u, 2 * v),
                self._turned(none, half),
                self._turned(none, 0.5 * u * u),
                np.stack([-turned[..., 1], turned[..., 0]], axis=-1),
            ],
            axis=1,
        )

    def _curve(self, spacing: float, nodes: int | None) -> tuple[Array, Array, Array, Array]:
        """Along the chord, across it to the middle line, and from there to the outline; the parameter."""
        count = self.nodes(spacing) if nodes is None else nodes
        angle = 2 * np.pi * (np.arange(count) + 0.5) / count
        sine = np.sin(angle)
        u = 0.5 * self.length[:, None] * np.cos(angle)
        half = 0.5 * self.thickness[:, None] * sine * (1 - self.taper + self.taper * sine**2)
        return u, 0.5 * self.curvature[:, None] * u * u, half, angle

    def _turned(self, u: Array, v: Array) -> Array:
        """Vectors turned by the tilt, (k, j, 2)."""
        c, s = np.cos(self.tilt)[:, None], np.sin(self.tilt)[:, None]
        return np.stack([c * u - s * v, s * u + c * v], axis=-1)
