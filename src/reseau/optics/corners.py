r"""Exact images of corners: where two edges cross, as the squares of a chessboard do, or three.

Two straight edges with the signed distances :math:`d_1, d_2` of a pixel, positive on the dark side of each,
divide the plane into four sectors. Blurred by a Gaussian of the width s, the light that a pixel receives from
the sector where both are positive is the probability that two normal variables of the correlation
:math:`\rho = n_1 \cdot n_2`, the cosine between the normals, are below :math:`a = d_1/s` and
:math:`b = d_2/s` (Genz 2004, eq. 3),

.. math:: \Phi_2(a, b; \rho) = \Phi(a)\Phi(b) + \int_0^\rho \varphi_2(a, b; r)\,dr , \qquad
   \frac{\partial \Phi_2}{\partial a} = \varphi(a)\,\Phi\Big(\frac{b - \rho a}{\sqrt{1 - \rho^2}}\Big) .

A corner of a chessboard is this sector and the opposite one, a corner of a tag this sector alone. The square
aperture of a pixel adds its variance, 1/12 px², to that of the Gaussian, and its fourth cumulant, −1/120 px⁴,
by the fourth derivatives of the image (Edgeworth's series). Edges may be bent: the distances then are those
from parabolas, :math:`d = n \cdot q - \tfrac12 c\,(t \cdot q)^2`.

Where three edges cross, as the triangles of a deltille do, six sectors are dark and bright in turn. With
normals of which a positive combination is zero, two of the three distances are positive in each dark sector,
and one in each bright one. The dark sectors therefore are the sum of three half planes less the plane, and
so is their image, whatever the blur:

.. math:: \Phi(d_1/s) + \Phi(d_2/s) + \Phi(d_3/s) - 1 .

Sources: A. Genz, Numerical computation of rectangular bivariate and trivariate normal and t probabilities,
Statistics and Computing 14 (2004); Z. Drezner, G. O. Wesolowsky, On the computation of the bivariate normal
integral, J. Statist. Comput. Simul. 35 (1990).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.data import Array, Mask, Rows
from ..core.threads import one_thread
from .compiled_corners import formed, six_formed


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners in an image, in columns: two or three edges each, and the sectors that are dark.

    Parameters
    ----------
    normal : ndarray (k, e, 2)
        Unit normals of the e edges, in rows: of two towards the dark sector, of three so that two of them
        point towards each dark sector.
    bend : ndarray (k, e)
        Curvature of each edge, 1/px, positive if it bends towards its normal.
    opposite : ndarray of bool (k,)
        Whether the sector opposite to the dark one of two edges is dark, too, as on a chessboard.

    Examples
    --------
    >>> corners = Corners(np.eye(2)[None], np.zeros((1, 2)), np.array([True]))
    >>> len(corners)
    1
    """

    normal: Array
    bend: Array
    opposite: Mask

    def __len__(self) -> int:
        return len(self.normal)

    def select(self, at: Mask | Rows) -> Corners:
        """Corners selected by indices or a mask."""
        return Corners(self.normal[at], self.bend[at], self.opposite[at])


def corner_images(
    corners: Corners,
    xy: Array,
    sigma: Array,
    form: Array,
    columns: Array,
    rows: Array,
    *,
    fill: float = 1.0,
    derivatives: bool = True,
    needed: Mask | None = None,
) -> Array:
    """Form images of corners, and their derivatives.

    Parameters
    ----------
    corners : Corners
        The k corners.
    xy : ndarray (k, 2)
        Their positions in pixels.
    sigma : ndarray (k,)
        Widths of the point-spread function in pixels.
    form : ndarray (k, e or 2 e)
        Rotation of each edge in radians, x into y; in twice as many columns also what is added to their
        curvatures, 1/px.
    columns, rows : ndarray (k, c), (k, r)
        Pixel coordinates.
    fill : float
        Light-sensitive share of the pitch.
    derivatives : bool
        Whether to form the derivatives, too.
    needed : ndarray of bool (k, r, c), optional
        Pixels that are formed; the others become 0. By default all.

    Returns
    -------
    ndarray (k, 4 + e or 4 + 2 e, r, c), float32
        Share of each pixel's light from the dark sectors; its derivatives by x, y, `sigma` and `form`.

    Examples
    --------
    At the corner itself half of the light comes from the dark sectors of a chessboard, whatever the blur:

    >>> corners = Corners(np.eye(2)[None], np.zeros((1, 2)), np.array([True]))
    >>> nine = np.arange(9.0)[None]
    >>> image = corner_images(corners, np.full((1, 2), 4.0), np.ones(1), np.zeros((1, 2)), nine, nine)
    >>> image.shape, float(image[0, 0, 4, 4]), float(image[0, 0, 8, 8].round(3))
    ((1, 6, 9, 9), 0.5, 1.0)

    The same with three edges:

    >>> angle = np.pi / 6 + 2 * np.pi / 3 * np.arange(3)
    >>> normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)[None]
    >>> corners = Corners(normal, np.zeros((1, 3)), np.array([True]))
    >>> sharp = np.full(1, 0.5)
    >>> image = corner_images(corners, np.full((1, 2), 4.0), sharp, np.zeros((1, 3)), nine, nine)
    >>> float(image[0, 0, 4, 4]), float(image[0, 0, 8, 4].round(2)), float(image[0, 0, 0, 4].round(2))
    (0.5, 1.0, 0.0)
    """
    parts = 4 + form.shape[1] if derivatives else 1
    images = np.empty((len(corners), parts, rows.shape[1], columns.shape[1]), np.float32)
    wanted = np.zeros((0, 1, 1), dtype=bool) if needed is None else np.ascontiguousarray(needed)
    xy, sigma, form = (np.ascontiguousarray(each) for each in (xy, sigma, form))
    pixels = np.ascontiguousarray(columns), np.ascontiguousarray(rows), fill, wanted, images
    with one_thread():
        if corners.normal.shape[1] == 3:
            six_formed(corners.normal, corners.bend, xy, sigma, form, *pixels)
        else:
            formed(corners.normal, corners.bend, corners.opposite, xy, sigma, form, *pixels)
    return np.asarray(images)
