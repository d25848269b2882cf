r"""The mapping of a plane target through a lens, from few points: a projectivity and distortion.

With the ideal image u by the projectivity, in units of half the longer side of the frame about its middle, a
centre c, and the ratio a of the scales along both axes less 1,

.. math:: u_d = u + S^{-1} q(S (u - c)) , \qquad S = \mathrm{diag}(1, 1 + a) , \qquad
   q(d) = d\,(k_1 r^2 + k_2 r^4 + k_3 r^6) +
   \begin{pmatrix} 2 p_1 d_x d_y + p_2 (r^2 + 2 d_x^2) \\ p_1 (r^2 + 2 d_y^2) + 2 p_2 d_x d_y \end{pmatrix}

with r = |d| (Brown 1971, Photogrammetric Engineering 37, eq. 10): sixteen parameters, of which usual sizes
are known, contain the second derivatives that a free polynomial has only from its third degree on, with
twenty. Written out it is a polynomial of the seventh degree. Behind a fisheye u is that by an equidistant
one about the middle of the frame (:class:`reseau.optics.Equidistant`).

Where the rows are read one by one (a rolling shutter) and the plane moves, the projectivity changes with the
row v in which a point is seen: u becomes (u + v (A u + b)) / (1 + v c · u), with eight more parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ...core.data import Array
from ...optics import Equidistant
from ...optics.composition import Chain
from .lattice_mapping import (
    degree_of,
    matrix_of,
    of_degree,
    started,
    strength_of,
    with_coefficients,
)
from .plane_mapping import fisheye_of, polynomial_through
from .polynomial import monomials_of


def projected(source: Array, matrix: Array) -> tuple[Array, Array]:
    """Images of points by a projectivity, and their derivatives by its elements.

    Parameters
    ----------
    source : ndarray (n, 3)
        Points in homogeneous coordinates.
    matrix : ndarray (8,)
        Elements of the projectivity; the ninth is 1.

    Returns
    -------
    u : ndarray (n, 2)
    by_matrix : ndarray (n, 2, 8)
    """
    rows = np.append(matrix, 1.0).reshape(3, 3)
    image = source @ rows.T
    depth = image[:, 2:]
    u, by_matrix = image[:, :2] / depth, np.zeros((len(source), 2, 8))
    by_matrix[:, 0, :3] = by_matrix[:, 1, 3:6] = source / depth
    by_matrix[:, :, 6:] = -u[:, :, None] * by_matrix[:, :1, :2]
    return u, by_matrix


def distorted(u: Array, by_others: Array, x: Array) -> tuple[Array, Array]:
    """Distorted images of points, and their derivatives.

    Parameters
    ----------
    u : ndarray (n, 2)
        Points without distortion.
    by_others : ndarray (n, 2, m)
        Their derivatives by other parameters.
    x : ndarray (8,)
        k1, k2, k3, both coordinates of the centre, the ratio of the scales less 1, p1 and p2.

    Returns
    -------
    images : ndarray (n, 2)
    by_all : ndarray (n, 2, m + 8)
        Derivatives by the other parameters, and by those of the distortion.
    """
    (k1, k2, k3), p, scale = x[:3], x[6:], np.array([1.0, 1.0 + x[5]])
    off = u - x[3:5]
    d = off * scale
    r2 = (d * d).sum(axis=1)[:, None]
    radial, rate = r2 * (k1 + r2 * (k2 + r2 * k3)), 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    outer = d[:, :, None] * d[:, None]
    by_p = 2 * outer[:, :, ::-1]
    by_p[:, 0, 1] = r2[:, 0] + 2 * outer[:, 0, 0]
    by_p[:, 1, 0] = r2[:, 0] + 2 * outer[:, 1, 1]
    by_p[:, 0, 0] = by_p[:, 1, 1] = 2 * outer[:, 0, 1]
    cross = 2 * d @ p
    by_d = rate[:, :, None] * outer
    by_d[:, 0, 0] += radial[:, 0] + 2 * p[0] * d[:, 1] + 6 * p[1] * d[:, 0]
    by_d[:, 1, 1] += radial[:, 0] + 6 * p[0] * d[:, 1] + 2 * p[1] * d[:, 0]
    by_d[:, 0, 1] += cross
    by_d[:, 1, 0] += cross
    q = d * radial + by_p @ p
    by_u = by_d * scale / scale[:, None]
    by_radial = (d / scale)[:, :, None] * r2[:, :, None] ** np.arange(1, 4)
    by_ratio = by_d[:, :, 1] * off[:, 1:] / scale
    by_ratio[:, 1] -= q[:, 1] / scale[1] ** 2
    own = by_others + by_u @ by_others
    return u + q / scale, np.concatenate(
        [own, by_radial, -by_u, by_ratio[:, :, None], by_p / scale[:, None]], axis=2
    )


def moving(u: Array, row: Array, motion: Array) -> tuple[Array, Array, Array]:
    """Images of points of a plane that moves while the rows of an image are read one by one.

    Parameters
    ----------
    u : ndarray (n, 2)
        Images while the middle row is read, without distortion.
    row : ndarray (n,)
        Rows in which the points are seen, from the middle one.
    motion : ndarray (8,)
        Change of the projectivity with the row v: u becomes (u + v (A u + b)) / (1 + v c · u); the elements
        of A, b and c in this order.

    Returns
    -------
    images : ndarray (n, 2)
    by_u : ndarray (n, 2, 2)
        Their derivatives in a row.
    by_motion : ndarray (n, 2, 8)
    """
    a, c, one = motion[:4].reshape(2, 2), motion[6:], np.eye(2)
    depth = (1 + row * (u @ c))[:, None, None]
    moved = (u + row[:, None] * (u @ a.T + motion[4:6])) / depth[..., 0]
    by_motion = np.zeros((len(u), 2, 8))
    by_motion[:, 0, :2] = by_motion[:, 1, 2:4] = u
    by_motion[:, :, 4:6] = one
    by_motion[:, :, 6:] = -moved[:, :, None] * u[:, None]
    by_motion *= row[:, None, None] / depth
    by_u = (one + row[:, None, None] * (a - moved[:, :, None] * c)) / depth
    return moved, by_u, by_motion


UNFIT = 2.0
"""Misfit of the mapping through all marks, in their sigmas, from which it does not tell its derivatives."""

_LENS_SIGMA = np.array([0.3, 0.3, 0.1, 0.1, 0.1, 0.005, 0.003, 0.003])
"""Usual sizes of k1, k2, k3, c, a, p1 and p2; half the width of a frame has r = 1."""
_MOTION_SIGMA = np.full(8, 0.05)
"""Usual changes of a projectivity while half the width of a frame is read."""
_ROWS = 3
"""Iterations by which the rows are found in which points are seen."""
_FISHEYE = 0.25
"""Share of the weighted squares and parameters without a fisheye below which there is one."""
_DEGREE, _USUAL = 7, 5
"""Degree of the polynomial; and of a free one that is tried with any number of points."""
_ROUGH_PX = 0.005
"""Deviation that does not count in the comparison of mappings: positions were formed with another one."""
_PER_TERM = 2.0
"""Least number of points for each term of a polynomial."""
_STEPS, _SETTLED = 24, 1e-3
"""Most iterations, and change of the sum of squares at which they end."""
_SHOWN = 4
"""Redundancy from which misfits tell more about the errors of a mapping than sigmas do."""


@dataclass(frozen=True, eq=False)
class FoundMapping:
    """A mapping with its uncertainty.

    Parameters
    ----------
    mapping : Chain
        The mapping.
    changes : callable
        Changes (m, n, 2) of the images of lattice coordinates (n, 2) by one standard deviation of the mapping
        in each of m independent directions. The covariance of anything that follows from the mapping is the
        sum of the squares of what changes with them.

    Examples
    --------
    >>> from reseau.measure.plane.lattice_mapping import started
    >>> exact = FoundMapping(started(np.eye(3), 1, (480, 640)), lambda at: np.zeros((0, *at.shape)))
    >>> exact.changes(np.zeros((5, 2))).shape
    (0, 5, 2)
    """

    mapping: Chain
    changes: Callable[[Array], Array]


def mapping_through(at: Array, xy: Array, sigma: Array, shape: tuple[int, int]) -> FoundMapping:
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
    weight = 1 / np.hypot(sigma, _ROUGH_PX)

    def criterion(mapping: Chain, parameters: int) -> float:
        return float((((mapping(at) - xy) * weight[:, None]) ** 2).sum()) + 2 * parameters

    known = [d for d in range(1, _DEGREE + 1) if d == 1 or _PER_TERM * (d + 1) * (d + 2) <= 2 * len(at)]

    def best_of(strength: float) -> tuple[float, FoundMapping]:
        # Where no lens of the above kind describes the points: as high a degree as there are points for.
        free = [
            polynomial_through(at, xy, shape, d, strength)
            for d in sorted({min(known[-1], _USUAL), known[-1]})
        ]
        if strength > 0:
            # What little is left towards the margin counts for a robust fit as errors of the points.
            free = [free_through(mapping, at, xy, sigma, degree_of(mapping)) for mapping in free]
        best = min(free, key=lambda mapping: criterion(mapping, len(mapping.second.values)))
        least = criterion(best, len(best.second.values))
        found = FoundMapping(best, _changes(best, at, xy, weight))
        for parameters, moves in (
            (8 + len(_LENS_SIGMA), False),
            (8 + len(_LENS_SIGMA) + len(_MOTION_SIGMA), True),
        ):
            lens = lens_through(at, xy, sigma, shape, free[0], moves=moves)
            if lens is not None and (own := criterion(lens.mapping, parameters)) <= least:
                least, found = own, lens
        return least, found

    least, found = best_of(0.0)
    if least > UNFIT**2 * 2 * len(at) and (strength := fisheye_of(at, xy, shape)) > 0:
        # A board that is not plane is described a little better, too.
        other, behind = best_of(strength)
        found = behind if other < _FISHEYE * least else found
    return found


def free_through(mapping: Chain, at: Array, xy: Array, sigma: Array, degree: int = _DEGREE) -> Chain:
    """The projectivity of a mapping with a polynomial of some degree through points, by least squares.

    Where no lens describes the points (a fisheye), the difference from `mapping` shows what is unknown.

    Parameters
    ----------
    mapping : Chain
        The mapping.
    at, xy, sigma
        See :func:`mapping_through`.
    degree : int
        Of the polynomial.
    """
    free, weight = of_degree(mapping, degree), 1 / np.hypot(sigma, _ROUGH_PX)[:, None]
    monomials, straight = monomials_of(free, at)
    values = np.linalg.lstsq(monomials * weight, (xy - straight) * weight, rcond=1e-10)[0]
    return with_coefficients(free, np.asarray(values.T, dtype=np.float64))


def _changes(free: Chain, at: Array, xy: Array, weight: Array) -> Callable[[Array], Array]:
    """See :class:`FoundMapping`; the coefficients of a polynomial are those of a linear problem."""

    def changed(there: Array) -> Array:
        monomials, _ = monomials_of(free, at)
        _, value, right = np.linalg.svd(monomials * weight[:, None], full_matrices=False)
        known = value > 1e-10 * value[0]
        redundancy = len(at) - int(known.sum())
        square = (((free(at) - xy) * weight[:, None]) ** 2).mean() * len(at) / max(redundancy, 1)
        scale = np.sqrt(square) if 2 * redundancy >= _SHOWN else 1.0
        along = scale * (right[known] / value[known, None]) @ monomials_of(free, there)[0].T
        return np.asarray((along[:, None, :, None] * np.eye(2)[None, :, None]).reshape(-1, len(there), 2))

    return changed


def _seen(source: Array, x: Array, strength: float) -> tuple[Array, Array]:
    """Images (n, 2) of points (n, 3) in homogeneous coordinates, and derivatives (n, 2, p) by parameters."""
    u, by_matrix = projected(source, x[:8])
    if strength > 0:
        u, slope = Equidistant(np.array([strength])).derivatives(u)[:2]
        by_matrix = slope @ by_matrix
    return _through(u, by_matrix, x[8:])


def _through(u: Array, by_others: Array, x: Array) -> tuple[Array, Array]:
    """Images of points as :func:`distorted`, of a plane that moves if parameters of a motion follow."""
    lens, motion = x[: len(_LENS_SIGMA)], x[len(_LENS_SIGMA) :]
    image, by_all = distorted(u, by_others, lens)
    for _ in range(_ROWS if len(motion) else 0):
        moved, by_u, by_motion = moving(u, image[:, 1], motion)
        image, by_all = distorted(moved, np.concatenate([by_u @ by_others, by_motion], axis=2), lens)
    before, own = by_others.shape[2], len(motion)
    # Those of the motion come last.
    return image, np.concatenate(
        [by_all[..., :before], by_all[..., before + own :], by_all[..., before : before + own]], axis=2
    )


def lens_through(
    at: Array, xy: Array, sigma: Array, shape: tuple[int, int], start: Chain, *, moves: bool = False
) -> FoundMapping | None:
    """Least-squares mapping with distortion, see :func:`mapping_through`; None if there is none.

    Parameters
    ----------
    at, xy, sigma, shape
        See :func:`mapping_through`.
    start : Chain
        Whose projectivity the iteration starts from; its fisheye is kept.
    moves : bool
        Whether the plane moves while the rows are read one by one.
    """
    h, w = shape
    middle, half = np.array([w - 1, h - 1]) / 2, max(h, w) / 2
    centre, size = at.mean(axis=0), max(float(np.ptp(at, axis=0).max()) / 2, 1e-9)
    back = np.array([[1 / size, 0, -centre[0] / size], [0, 1 / size, -centre[1] / size], [0, 0, 1]])
    to_unit = np.array([[1 / half, 0, -middle[0] / half], [0, 1 / half, -middle[1] / half], [0, 0, 1]])
    first = to_unit @ matrix_of(start) @ np.linalg.inv(back)
    strength = strength_of(start)

    def source(at: Array) -> Array:
        return np.column_stack([(at - centre) / size, np.ones(len(at))])

    here = source(at)
    seen, weight = (xy - middle) / half, np.repeat(half / np.hypot(sigma, _ROUGH_PX), 2)
    usual = np.concatenate([_LENS_SIGMA, _MOTION_SIGMA[: 8 * moves]])
    x = np.append((first / first[2, 2]).ravel()[:8], np.zeros(len(usual)))
    prior = np.append(np.zeros(8), 1 / usual)
    last = np.inf
    for _ in range(_STEPS):
        with np.errstate(over="ignore", invalid="ignore"):  # where it diverges
            image, slopes = _seen(here, x, strength)
        if not np.isfinite(slopes).all():
            return None
        jacobian = slopes.reshape(-1, len(x)) * weight[:, None]
        off = (seen - image).ravel() * weight
        data = jacobian.T @ jacobian
        normal = data + np.diag(prior**2)
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

    def written(values: Array) -> Chain:
        matrix = np.linalg.inv(to_unit) @ np.append(values[:8], 1.0).reshape(3, 3) @ back
        mapping = of_degree(started(matrix, 1, shape, strength), _DEGREE)
        return with_coefficients(mapping, half * _expanded(values[8:]).T)

    try:
        root = np.linalg.inv(np.linalg.cholesky(normal)).T
    except np.linalg.LinAlgError:
        return None
    redundancy = 2 * len(at) - float(np.trace(np.linalg.solve(normal, data)))
    scale = np.sqrt(float(off @ off) / redundancy) if redundancy >= _SHOWN else 1.0
    return FoundMapping(
        written(x), lambda at: np.moveaxis(_seen(source(at), x, strength)[1] @ (half * scale * root), 2, 0)
    )


def _expanded(x: Array) -> Array:
    """Coefficients (36, 2) of distortion in the monomials 1, u, v, u², u v, v², …"""
    # They are found from values, of which a polynomial of that degree has no residuals.
    u, inverse = _expansion()
    return np.asarray(inverse @ (_through(u, np.zeros((len(u), 2, 0)), x)[0] - u))


@lru_cache(maxsize=1)
def _expansion() -> tuple[Array, Array]:
    """Points (n, 2), and the matrix (36, n) by which values there become coefficients."""
    side = np.linspace(-1.0, 1.0, _DEGREE + 2)
    u = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    terms = [u[:, 0] ** (n - j) * u[:, 1] ** j for n in range(_DEGREE + 1) for j in range(n + 1)]
    return u, np.linalg.pinv(np.stack(terms, axis=1))
