"""The mapping of a lattice to an image, a projectivity followed by a polynomial; derivatives and inverse.

Both are :class:`reseau.optics.RationalPolynomial`; here they are evaluated without their tables of terms,
for the many small sets of points of a search. No polynomial in the image by a projectivity describes a frame
behind a fisheye: at 70° from the axis that is far outside of it, at 90° nowhere. A fisheye can lie between
both.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from math import isqrt

import numpy as np

from ...core.data import Array
from ...optics import Equidistant, RationalPolynomial
from ...optics.composition import Chain
from ...optics.mapping import PlaneMapping
from .lattice_images import images


@lru_cache(maxsize=64)
def _polynomial(degree: int, offset: tuple[float, float], scale: float) -> RationalPolynomial:
    """The polynomial that is the identity; reading its table of terms takes longer than using it."""
    return RationalPolynomial.polynomial(degree, offset=offset, scale=scale)


@lru_cache(maxsize=1)
def _projectivity() -> RationalPolynomial:
    """The projectivity that is the identity, as :func:`_polynomial`."""
    return RationalPolynomial.projective()


def started(matrix: Array, degree: int, shape: tuple[int, ...], strength: float = 0.0) -> Chain:
    """A projectivity (3, 3) to a frame of this height and width, followed by a polynomial that is zero.

    With a `strength` there is a fisheye between both (:class:`reseau.optics.Equidistant`) about the middle of
    the frame, half whose longer side is the unit.
    """
    h, w = shape
    curved = _polynomial(degree, ((w - 1) / 2, (h - 1) / 2), max(h, w) / 2)
    first: PlaneMapping = _projectivity().with_values((matrix / matrix[2, 2]).ravel()[:8])
    if strength > 0:
        first = Chain(first, Equidistant(np.array([strength]), curved.offset, curved.scale))
    return Chain(first, curved)


def strength_of(mapping: Chain) -> float:
    """Strength of the fisheye of a mapping; 0 without one."""
    return float(mapping.first.values[8]) if len(mapping.first.values) > 8 else 0.0


def matrix_of(mapping: Chain) -> Array:
    """Projectivity (3, 3) of a mapping."""
    return np.append(mapping.first.values[:8], 1.0).reshape(3, 3)


def of_degree(mapping: Chain, degree: int) -> Chain:
    """The mapping with a zero polynomial of a given degree."""
    assert isinstance(mapping.second, RationalPolynomial)
    return Chain(mapping.first, _polynomial(degree, mapping.second.offset, mapping.second.scale))


def with_coefficients(mapping: Chain, added: Array) -> Chain:
    """The mapping with values (2, m) added to the coefficients of its polynomial."""
    return Chain(mapping.first, mapping.second.with_values(mapping.second.values + added.ravel()))


@lru_cache(maxsize=16)
def numbers_of(mapping: Chain) -> tuple[Array, Array, Array]:
    """Projectivity (3, 3), coefficients (2, m) of the polynomial, offset, scale and fisheye before it (4,).

    The monomials are 1, u, v, u², u v, v², … as :meth:`reseau.optics.RationalPolynomial.polynomial` orders
    them. The arrays are kept for the next call: copy them to change them.
    """
    curved = mapping.second
    assert isinstance(curved, RationalPolynomial)
    normal = np.array([*curved.offset, curved.scale, strength_of(mapping)])
    return matrix_of(mapping), curved.values.reshape(2, -1), normal


def degree_of(mapping: Chain) -> int:
    """Degree of the polynomial; one of degree d has (d + 1)(d + 2) coefficients."""
    return isqrt(len(mapping.second.values)) - 1


def images_of(mapping: Chain, at: Array) -> Array:
    """Images (n, 2) of lattice coordinates (n, 2)."""
    return images(numbers_of(mapping), at)[0]


def slope_of(mapping: Chain, at: Array) -> Array:
    """Derivatives (n, 2, 2) of a mapping at lattice coordinates (n, 2)."""
    return images(numbers_of(mapping), at, 1)[1]


def stretches(slope: Array) -> tuple[Array, Array]:
    """Largest and smallest scale (n,) of linear mappings (n, 2, 2): their singular values, in closed form."""
    (a, b), (c, d) = np.moveaxis(slope, 0, 2)
    # (s₁ ± s₂)² is the sum of the squares, plus or minus twice the determinant.
    total, apart = np.hypot(a + d, b - c), np.hypot(a - d, b + c)
    return (total + apart) / 2, np.abs(total - apart) / 2


def second_order(mapping: Chain, at: Array) -> tuple[Array, Array, Array]:
    """A mapping at points (n, 2) with its first (n, 2, 2) and second derivatives (n, 2, 2, 2)."""
    return images(numbers_of(mapping), at, 2)


def straightened(mapping: Chain, xy: Array) -> Array:
    """Lattice coordinates (n, 2) of image points by the projectivity alone."""
    back = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(matrix_of(mapping)).T
    return np.ascontiguousarray(back[:, :2] / back[:, 2:])


def reduced(mapping: Chain, factor: float, shift: Array) -> Chain:
    """A mapping to an enlarged image as one to the original; the point x is at factor · x + shift there."""
    curved = mapping.second
    assert isinstance(curved, RationalPolynomial)
    matrix, coefficients = (numbers.copy() for numbers in numbers_of(mapping)[:2])
    matrix[:2] = (matrix[:2] - np.outer(shift, matrix[2])) / factor
    coefficients[:, 0] -= shift
    offset = (np.array(curved.offset) - shift) / factor
    moved = replace(
        curved,
        values=(coefficients / factor).ravel(),
        offset=(float(offset[0]), float(offset[1])),
        scale=curved.scale / factor,
    )
    return Chain(mapping.first.with_values(matrix.ravel()[:8]), moved)
