"""Additional parameters by series: ``chebyshev2`` … ``chebyshev6`` and ``fourier1`` … ``fourier3``.

Series of orthogonal functions over the format of the image describe any smooth distortion, to the degree of
the series; they have no physical reason. The base is half of the longer side of the format, so that x/b and
y/b are between −1 and 1. Each degree is a model of its own. A test of each parameter shows which of them the
image points support.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ...core.compiled import Kernel, kernel
from ...core.data import Array
from ...core.errors import UsageError
from ..mapping import Derivatives, PlaneMapping, as_points, as_values
from .kernels import CameraColumns, corrected
from .registry import AdditionalModel, register_additional

# Parameters of the first two degrees of Chebyshev's series, which exclude those of the orientations.
_LOW = 6


@dataclass(frozen=True, eq=False)
class _Series(PlaneMapping):
    """Base of the series: (x, y) + Σ p·(f, g), with fields (f, g) of x/b, y/b."""

    values: Array = field(default_factory=lambda: np.zeros(0))
    base_mm: float = 1.0
    degree: int = 1

    letter: ClassVar[str]

    def __post_init__(self) -> None:
        given = np.atleast_1d(np.asarray(self.values, dtype=np.float64))
        object.__setattr__(
            self, "values", as_values(self.names, given if given.size else np.zeros(self.count))
        )
        if not self.base_mm > 0:
            raise UsageError(f"{self.base_mm:g} is not above zero", where="base of the additional parameters")

    @property
    def count(self) -> int:
        """Number of parameters."""
        raise NotImplementedError

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters: a letter and their number."""
        return tuple(f"{self.letter}{k}" for k in range(1, self.count + 1))


@dataclass(frozen=True, eq=False)
class ChebyshevCorrection(_Series):
    """Products of Chebyshev's polynomials up to a total degree: (x, y) + (Δx, Δy), mm.

    With X = x/b, Y = y/b, the fields of the first two degrees are::

        (X, −Y), (Y, X), (T2(X), −XY), (−XY, T2(Y)), (T2(Y), 0), (0, T2(X))

    and those of degree s the products (Tm(X)·Tn(Y), 0) and (0, Tm(X)·Tn(Y)) with m + n = s, m descending.
    Left out are six fields that orientations cause: shifts (principal point), scale (principal distance),
    rotation (kappa), and (T2(X), 2XY), (2XY, T2(Y)) of small tilts (omega, phi). The others are orthogonal to
    them with Chebyshev's weight. ``chebyshevN`` has (N + 1)(N + 2) − 6 parameters.

    Tang, R., Fritsch, D. & Cramer, M. (2012), A novel family of mathematical self-calibration additional
    parameters for airborne camera systems, EuroCOW, with the fields of the orientations as in Ebner (1976).

    Parameters
    ----------
    values : array_like (u,)
        T1, T2 … (mm).
    base_mm : float
        b, half of the longer side of the format.
    degree : int
        Total degree, at least 2.

    Examples
    --------
    >>> ChebyshevCorrection(base_mm=4.0, degree=2).with_values({"T1": 0.1})([[2.0, 1.0]])
    array([[2.05 , 0.975]])
    """

    degree: int = 2
    letter: ClassVar[str] = "T"

    @property
    def count(self) -> int:
        """Number of parameters."""
        return (self.degree + 1) * (self.degree + 2) - 6

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        value, by_x, by_y = self._fields(*(points / self.base_mm).T)
        slope = np.stack([by_x @ self.values, by_y @ self.values], axis=2) / self.base_mm
        return Derivatives(points + value @ self.values, np.eye(2) + slope, value)

    def _fields(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        (tx, dx), (ty, dy) = (_chebyshev(each, self.degree) for each in (x, y))
        out = np.zeros((3, len(x), 2, self.count))

        def put(k: int, axis: int, m: int, n: int, factor: int = 1) -> None:
            out[0, :, axis, k] = factor * tx[m] * ty[n]
            out[1, :, axis, k] = factor * dx[m] * ty[n]
            out[2, :, axis, k] = factor * tx[m] * dy[n]

        # Parameter, coordinate, degrees in X and Y, and factor of the products of the first two degrees.
        for low in (
            (0, 0, 1, 0), (0, 1, 0, 1, -1), (1, 0, 0, 1), (1, 1, 1, 0), (2, 0, 2, 0), (2, 1, 1, 1, -1),
            (3, 0, 1, 1, -1), (3, 1, 0, 2), (4, 0, 0, 2), (5, 1, 2, 0),
        ):  # fmt: skip
            put(*low)
        k = _LOW
        for s in range(3, self.degree + 1):
            for n in range(s + 1):
                put(k, 0, s - n, n)
                put(k + 1, 1, s - n, n)
                k += 2
        return out[0], out[1], out[2]


@dataclass(frozen=True, eq=False)
class FourierCorrection(_Series):
    """A Fourier series over the format: (x, y) + (Δx, Δy), mm.

    With u = πx/b, v = πy/b, for m = 0 … N and n = −N … N, n > 0 where m = 0, as (m, n) and (−m, −n) are the
    same wave, in this order: (cos(mu + nv), 0), (sin(mu + nv), 0), (0, cos(mu + nv)), (0, sin(mu + nv)).
    The constants, which are those of the principal point, are left out. ``fourierN`` has 2(2N + 1)² − 2
    parameters, 16 and 48 for N = 1 and 2.

    Tang, R., Fritsch, D. & Cramer, M. (2012), New rigorous and flexible Fourier self-calibration models for
    airborne camera calibration, ISPRS J. Photogrammetry and Remote Sensing 71, eq. (13)–(15).

    Parameters
    ----------
    values : array_like (u,)
        F1, F2 … (mm).
    base_mm : float
        b, half of the longer side of the format.
    degree : int
        N, at least 1.

    Examples
    --------
    >>> FourierCorrection(base_mm=4.0).with_values({"F1": 0.1})([[2.0, 4.0]]).round(6)
    array([[1.9, 4. ]])
    """

    letter: ClassVar[str] = "F"

    @property
    def count(self) -> int:
        """Number of parameters."""
        return 2 * (2 * self.degree + 1) ** 2 - 2

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        return corrected(_by_fourier, self.values, self.base_mm, self.degree, as_points(xy))


def _chebyshev(x: Array, degree: int) -> tuple[list[Array], list[Array]]:
    """T0 … Tn at points (n,), and their derivatives: T'(k+1) = 2Tk + 2x·T'k − T'(k−1)."""
    t, d = [np.ones_like(x), x], [np.zeros_like(x), np.ones_like(x)]
    for k in range(1, degree):
        t.append(2 * x * t[k] - t[k - 1])
        d.append(2 * t[k] + 2 * x * d[k] - d[k - 1])
    return t, d


@kernel
def _by_chebyshev(
    e: int, x: float, y: float, cameras: CameraColumns, dx: float, dy: float, sxx: float, sxy: float,
    syx: float, syy: float, more: Array,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """See :func:`reseau.optics.cameras.kernels.additional`."""
    b, base, degree = cameras.extra, cameras.base[e, 0], int(cameras.base[e, 1])
    t, d = np.empty((2, degree + 1)), np.empty((2, degree + 1))
    for axis in range(2):
        z = (x if axis == 0 else y) / base
        t[axis, 0], t[axis, 1], d[axis, 0], d[axis, 1] = 1.0, z, 0.0, 1.0
        for k in range(1, degree):
            t[axis, k + 1] = 2.0 * z * t[axis, k] - t[axis, k - 1]
            d[axis, k + 1] = 2.0 * t[axis, k] + 2.0 * z * d[axis, k] - d[axis, k - 1]
    more[:, :] = 0.0
    # Parameter, coordinate, degrees and sign of each product.
    k = 0
    for s in range(degree + 1):
        for n in range(s + 1):
            m = s - n
            for axis in range(2):
                sign, at = 1.0, k + axis
                if s < 3:
                    at = -1
                    if axis == 0 and m == 1 and n == 0:
                        at = 0
                    elif axis == 1 and m == 0 and n == 1:
                        at, sign = 0, -1.0
                    elif (axis == 0 and m == 0 and n == 1) or (axis == 1 and m == 1 and n == 0):
                        at = 1
                    elif axis == 0 and m == 2:
                        at = 2
                    elif axis == 1 and m == 1 and n == 1:
                        at, sign = 2, -1.0
                    elif axis == 0 and m == 1 and n == 1:
                        at, sign = 3, -1.0
                    elif axis == 1 and n == 2:
                        at = 3
                    elif axis == 0 and n == 2:
                        at = 4
                    elif axis == 1 and m == 2:
                        at = 5
                if at < 0:
                    continue
                value = sign * t[0, m] * t[1, n]
                along = sign * b[e, at] / base
                more[axis, at] = value
                if axis == 0:
                    dx += b[e, at] * value
                    sxx += along * d[0, m] * t[1, n]
                    sxy += along * t[0, m] * d[1, n]
                else:
                    dy += b[e, at] * value
                    syx += along * d[0, m] * t[1, n]
                    syy += along * t[0, m] * d[1, n]
            if s > 2:
                k += 2
        if s == 2:
            k = 6
    return dx, dy, sxx, sxy, syx, syy


@kernel
def _by_fourier(
    e: int, x: float, y: float, cameras: CameraColumns, dx: float, dy: float, sxx: float, sxy: float,
    syx: float, syy: float, more: Array,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """See :func:`reseau.optics.cameras.kernels.additional`."""
    b, degree = cameras.extra, int(cameras.base[e, 1])
    wave = np.pi / cameras.base[e, 0]
    more[:, :] = 0.0
    k = 0
    for m in range(degree + 1):
        for n in range(-degree if m else 1, degree + 1):
            phase = wave * (m * x + n * y)
            c, s = np.cos(phase), np.sin(phase)
            more[0, k], more[0, k + 1], more[1, k + 2], more[1, k + 3] = c, s, c, s
            dx += b[e, k] * c + b[e, k + 1] * s
            dy += b[e, k + 2] * c + b[e, k + 3] * s
            along_x, along_y = b[e, k + 1] * c - b[e, k] * s, b[e, k + 3] * c - b[e, k + 2] * s
            sxx += wave * m * along_x
            sxy += wave * n * along_x
            syx += wave * m * along_y
            syy += wave * n * along_y
            k += 4
    return dx, dy, sxx, sxy, syx, syy


def _register(name: str, series: type[_Series], degree: int, own: Kernel[..., Any]) -> None:
    def build(values: Array, base_mm: float) -> _Series:
        return series(values, base_mm, degree)

    names = series(degree=degree).names
    register_additional(AdditionalModel(f"{name}{degree}", names, build, own, degree))


for _degree in range(2, 7):
    _register("chebyshev", ChebyshevCorrection, _degree, _by_chebyshev)
for _degree in range(1, 4):
    _register("fourier", FourierCorrection, _degree, _by_fourier)
