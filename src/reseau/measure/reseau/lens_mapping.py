"""The mapping of a plane target through a lens, from few points: a projectivity and radial distortion.

With the ideal image u by the projectivity, in units of half the longer side of the frame about its middle,

.. math:: u_d = u + (u - c)\\,(k_1 r^2 + k_2 r^4) , \\qquad r = |u - c| ,

twelve parameters contain the second derivatives that a free polynomial has only from its third degree on,
with twenty. A centre c that is not the principal point contains decentring distortion to first order (Brown
1971, Photogrammetric Engineering 37, eq. 10). Written out it is a polynomial of the fifth degree.
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array
from ...optics import Chain
from ..testfield.lattice_mapping import of_degree, started, with_coefficients
from .sheet_placement import through

__all__ = ["mapping_through"]

_LENS_SIGMA = np.array([0.3, 0.3, 0.1, 0.1])
"""Usual sizes of k1, k2 and the centre; half the width of a frame has r = 1."""
_ROUGH_PX = 0.005
"""Deviation that does not count in the comparison of mappings: positions were formed with another one."""
_PER_TERM = 2.0
"""Least number of points for each term of a polynomial."""
_STEPS, _SETTLED = 12, 1e-3
"""Most iterations, and change of the sum of squares at which they end."""


def mapping_through(at: Array, xy: Array, sigma: Array, shape: tuple[int, int]) -> Chain:
    """Mapping through precise points: through a lens, or a polynomial where that describes them better.

    The one with the least sum of weighted squares and twice the number of parameters is taken (Akaike 1974).

    Parameters
    ----------
    at, xy : ndarray (n, 2)
        Lattice coordinates and images.
    sigma : ndarray (n,)
        Standard deviations of the images, pixels.
    shape : (int, int)
        Height and width of the frame.
    """
    degree = next(d for d in (5, 4, 3, 2, 1) if _PER_TERM * (d + 1) * (d + 2) <= 2 * len(at) or d == 1)
    free = through(at, xy, shape, degree)
    lens = _through_lens(at, xy, sigma, shape, free)
    if lens is None:
        return free
    weight = 1 / np.hypot(sigma, _ROUGH_PX)[:, None]
    misfit = [float((((m(at) - xy) * weight) ** 2).sum()) for m in (lens, free)]
    better = misfit[0] + 2 * (8 + len(_LENS_SIGMA)) <= misfit[1] + 2 * len(free.second.values)
    return lens if better else free


def _through_lens(at: Array, xy: Array, sigma: Array, shape: tuple[int, int], start: Chain) -> Chain | None:
    """Least-squares mapping with radial distortion; None if there is none."""
    h, w = shape
    middle, half = np.array([w - 1, h - 1]) / 2, max(h, w) / 2
    centre, size = at.mean(axis=0), max(float(np.ptp(at, axis=0).max()) / 2, 1e-9)
    back = np.array([[1 / size, 0, -centre[0] / size], [0, 1 / size, -centre[1] / size], [0, 0, 1]])
    to_unit = np.array([[1 / half, 0, -middle[0] / half], [0, 1 / half, -middle[1] / half], [0, 0, 1]])
    first = to_unit @ np.append(start.first.values, 1.0).reshape(3, 3) @ np.linalg.inv(back)
    source = np.column_stack([(at - centre) / size, np.ones(len(at))])
    seen, weight = (xy - middle) / half, np.repeat(half / np.hypot(sigma, _ROUGH_PX), 2)
    x = np.append((first / first[2, 2]).ravel()[:8], np.zeros(4))
    prior = np.append(np.zeros(8), 1 / _LENS_SIGMA)
    last = np.inf
    for _ in range(_STEPS):
        matrix, (k1, k2), c = np.append(x[:8], 1.0).reshape(3, 3), x[8:10], x[10:]
        p = source @ matrix.T
        u = p[:, :2] / p[:, 2:]
        d = u - c
        r2 = (d**2).sum(axis=1)[:, None]
        bent = r2 * (k1 + k2 * r2)
        # Derivative of the distortion by its argument.
        slope = bent[..., None] * np.eye(2) + (2 * (k1 + 2 * k2 * r2))[..., None] * d[:, :, None] * d[:, None]
        by_u = slope + np.eye(2)
        by_h = np.zeros((len(at), 2, 8))
        by_h[:, 0, :3] = by_h[:, 1, 3:6] = source / p[:, 2:]
        by_h[:, :, 6:] = -u[:, :, None] * (source[:, None, :2] / p[:, 2:, None])
        jacobian = np.concatenate([by_u @ by_h, (d * r2)[..., None], (d * r2**2)[..., None], -slope], axis=2)
        jacobian = jacobian.reshape(-1, 12) * weight[:, None]
        off = (seen - u - d * bent).ravel() * weight
        normal = jacobian.T @ jacobian + np.diag(prior**2)
        try:
            step = np.linalg.solve(normal, jacobian.T @ off - prior**2 * x)
        except np.linalg.LinAlgError:
            return None
        total = float(off @ off + ((prior * x) ** 2).sum())
        if not np.isfinite(total):
            return None
        x = x + step
        if abs(last - total) < _SETTLED:
            break
        last = total
    else:
        return None
    matrix = np.linalg.inv(to_unit) @ np.append(x[:8], 1.0).reshape(3, 3) @ back
    mapping = of_degree(started(matrix, 1, shape), 5)
    return with_coefficients(mapping, half * _expanded(x[8], x[9], x[10:]).T)


def _expanded(k1: float, k2: float, c: Array) -> Array:
    """Coefficients (21, 2) of radial distortion in the monomials 1, u, v, u², u v, v², …"""
    # They are found from values, of which a polynomial of the fifth degree has no residuals.
    side = np.linspace(-1.0, 1.0, 7)
    u = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    terms = np.stack([u[:, 0] ** (n - j) * u[:, 1] ** j for n in range(6) for j in range(n + 1)], axis=1)
    d = u - c
    r2 = (d**2).sum(axis=1)[:, None]
    return np.asarray(np.linalg.lstsq(terms, d * r2 * (k1 + k2 * r2), rcond=None)[0])
