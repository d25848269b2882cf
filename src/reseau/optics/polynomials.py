"""Plane mappings by polynomials and quotients of polynomials: one class whose terms are data.

::

    X = NX / (1 + D) + PX
    Y = NY / (1 + D) + PY

Each of the five is a polynomial in x and y, linear in the parameters; a parameter may occur in several of
them. The projectivity, the camera and the ultrasonic instrument of Wishahy, the affine, similarity, bilinear
and full polynomial transformations, and Wong's model of a display differ in their table of terms only.
"""

from __future__ import annotations

import re
from collections.abc import Mapping as Named
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from ..core.data import Array, Mask
from ..core.errors import FormatError, UsageError
from .mapping import Derivatives, PlaneMapping, as_points, as_values

PARTS = ("NX", "NY", "D", "X", "Y")
NX, NY, D, PX, PY = range(5)

Terms = Named[str, Named[str, str]]

_NO_VALUES: Array = np.zeros(0)
_MONOMIAL = re.compile(r"([+-]?)((?:\d+\.?\d*(?:e[+-]?\d+)?)?)((?:[xy]\d*)*)")
_POWER = re.compile(r"([xy])(\d*)")


def monomials(text: str) -> dict[tuple[int, int], float]:
    """Read a sum of monomials such as ``x3 + 2x2y2 - y``: coefficients by the powers of x and y.

    Raises
    ------
    FormatError
        When the text is not such a sum.
    """
    compact = text.replace(" ", "").replace("*", "").replace("^", "")
    found: dict[tuple[int, int], float] = {}
    at = 0
    while at < len(compact):
        match = _MONOMIAL.match(compact, at)
        if match is None or not match[2] + match[3] or (at > 0 and not match[1]):
            raise FormatError(
                "is not a sum of monomials in x and y", where=repr(text), do="write as in `x3 + 2x2y2`"
            )
        powers = {"x": 0, "y": 0}
        for letter, power in _POWER.findall(match[3]):
            powers[letter] += int(power or 1)
        key = powers["x"], powers["y"]
        found[key] = found.get(key, 0.0) + float(match[1] + (match[2] or "1"))
        at = match.end()
    return found


class _Tables(NamedTuple):
    """The terms as arrays: coefficients of each part for one list of m monomials."""

    powers: tuple[tuple[int, int], ...]
    fixed: Array
    by_parameter: Array


@lru_cache(maxsize=64)
def _read(rows: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]) -> _Tables:
    """Read the terms of the fixed part and of each parameter; once per model, not per iteration."""
    read: list[tuple[int, int, dict[tuple[int, int], float]]] = []
    for k, (name, sums) in enumerate(rows):
        for part, text in sums:
            if part not in PARTS:
                raise FormatError(f"is not one of {', '.join(PARTS)}", where=f"part {part!r} of {name!r}")
            read.append((k, PARTS.index(part), monomials(text)))
    powers = tuple(sorted({power for *_, sum_ in read for power in sum_}))
    table = np.zeros((len(rows), len(PARTS), len(powers)))
    for k, row, sum_ in read:
        for power, coefficient in sum_.items():
            table[k, row, powers.index(power)] += coefficient
    table.flags.writeable = False
    return _Tables(powers, table[0], table[1:])


@dataclass(frozen=True, eq=False)
class RationalPolynomial(PlaneMapping):
    """X = NX/(1+D) + PX, Y = NY/(1+D) + PY, with parameters attached to monomials.

    Parameters
    ----------
    terms : mapping
        For each parameter the sums of monomials that it multiplies, by part (``NX``, ``NY``, ``D``, ``X``,
        ``Y``): ``{"k": {"X": "x3 + xy2", "Y": "y3 + yx2"}}``.
    values : array_like (u,), optional
        Values of the parameters in the order of the terms; default zero.
    fixed : mapping
        Monomials without a parameter, by part: ``{"X": "x", "Y": "y"}``.
    offset : (float, float)
        Subtracted from the points first, in their unit.
    scale : float
        Divides the points after that. High degrees need coordinates between −1 and 1: the normal equations of
        degree 7 in pixels cannot be solved in double precision.

    Raises
    ------
    FormatError
        When a part is unknown or a sum of monomials cannot be read.
    UsageError
        When the number of values is wrong or the scale is not positive.

    Examples
    --------
    >>> barrel = RationalPolynomial({"k": {"X": "x3 + xy2", "Y": "y3 + yx2"}}, fixed={"X": "x", "Y": "y"})
    >>> barrel.with_values({"k": -0.01})([[1.0, 2.0]])
    array([[0.95, 1.9 ]])
    """

    terms: Terms
    values: Array = field(default_factory=lambda: _NO_VALUES)
    fixed: Named[str, str] = field(default_factory=dict)
    offset: tuple[float, float] = (0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not (self.scale > 0 and np.isfinite([*self.offset, self.scale]).all()):
            raise UsageError(f"is {self.scale!r}; a positive number is needed", where="scale of a polynomial")
        values = np.zeros(len(self.terms)) if self.values is _NO_VALUES else self.values
        object.__setattr__(self, "values", as_values(self.names, values))
        _ = self._tables  # reports an unreadable table now and not at the first point

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the terms."""
        return tuple(self.terms)

    def _replaced(self, values: Array) -> Self:
        # The table of terms is kept: reading it takes longer than using it.
        changed = copy(self)
        changed.__dict__.pop("_coefficients", None)
        object.__setattr__(changed, "values", as_values(self.names, values))
        return changed

    @cached_property
    def _tables(self) -> _Tables:
        rows = [("", self.fixed), *self.terms.items()]
        return _read(tuple((name, tuple(sums.items())) for name, sums in rows))

    @cached_property
    def _coefficients(self) -> Array:
        return self._tables.fixed + np.tensordot(self.values, self._tables.by_parameter, 1)

    @cached_property
    def _polynomial_only(self) -> bool:
        return not self._tables.fixed[:3].any() and not self._tables.by_parameter[:, :3].any()

    def _monomials(self, xy: Array, slope: bool) -> tuple[Array, Array]:
        """Monomials (m, n) and, if asked, their derivatives by the given x and y (2, m, n)."""
        powers = self._tables.powers
        u = (xy - self.offset).T / self.scale
        table = np.ones((max((max(p) for p in powers), default=0) + 1, *u.shape))
        for i in range(1, len(table)):
            np.multiply(table[i - 1], u, out=table[i])
        m = np.empty((len(powers), len(xy)))
        d = np.zeros((2, len(powers), len(xy))) if slope else np.empty((2, 0, 0))
        for row, (i, j) in enumerate(powers):
            np.multiply(table[i, 0], table[j, 1], out=m[row])
            if slope and i:
                d[0, row] = table[i - 1, 0] * table[j, 1] * (i / self.scale)
            if slope and j:
                d[1, row] = table[i, 0] * table[j - 1, 1] * (j / self.scale)
        return m, d

    def _value(self, xy: Array) -> Array:
        m, _ = self._monomials(xy, slope=False)
        if self._polynomial_only:
            return (self._coefficients[PX:] @ m).T
        parts = self._coefficients @ m
        with np.errstate(divide="ignore", invalid="ignore"):
            value: Array = (parts[[NX, NY]] / (1 + parts[D]) + parts[[PX, PY]]).T
        return value

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        m, d_m = self._monomials(xy, slope=True)
        parts, d_parts = self._coefficients @ m, self._coefficients @ d_m
        with np.errstate(divide="ignore", invalid="ignore"):
            quotient = parts[[NX, NY]] / (1 + parts[D])
            # (direction, coordinate, n): the derivative of N/(1+D) is (N' − (N/(1+D))·D')/(1+D).
            d_quotient = (d_parts[:, [NX, NY]] - quotient * d_parts[:, [D]]) / (1 + parts[D])
        d_xy = np.ascontiguousarray((d_quotient + d_parts[:, [PX, PY]]).transpose(2, 1, 0))
        return (quotient + parts[[PX, PY]]).T, d_xy

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        value, d_xy = self._slope(points)
        m, _ = self._monomials(points, slope=False)
        by_parameter = self._tables.by_parameter
        polynomial = by_parameter[:, PX:] @ m  # (u, 2, n)
        if not self._polynomial_only:
            numerators = by_parameter[:, :D] @ m
            denominator = by_parameter[:, [D]] @ m
            parts = self._coefficients[:PX] @ m
            with np.errstate(divide="ignore", invalid="ignore"):
                quotient = parts[:D] / (1 + parts[D])
                polynomial = polynomial + (numerators - quotient * denominator) / (1 + parts[D])
        return Derivatives(value, d_xy, np.ascontiguousarray(polynomial.transpose(2, 1, 0)))

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Mask of points up to which the mapping has not folded nor passed the horizon 1 + D = 0."""
        points = as_points(xy)
        m, _ = self._monomials(points, slope=False)
        with np.errstate(invalid="ignore"):
            before_the_horizon: Mask = 1 + self._coefficients[D] @ m > 0
        return super().one_to_one(points) & before_the_horizon

    def _centre(self) -> Array:
        return np.array([self.offset])

    def without(self, *names: str) -> RationalPolynomial:
        """The reduced model without these parameters; the others keep their values.

        Raises
        ------
        UsageError
            When a name is not a parameter.
        """
        for name in names:
            self.value_of(name)
        kept = [name for name in self.names if name not in names]
        values = np.array([self.value_of(name) for name in kept])
        terms = {name: self.terms[name] for name in kept}
        return RationalPolynomial(terms, values, self.fixed, self.offset, self.scale)

    def to_dict(self, *, values: bool = True) -> dict[str, Any]:
        """The model as JSON-ready data, with or without the values of its parameters."""
        content: dict[str, Any] = {
            "terms": {name: dict(sums) for name, sums in self.terms.items()},
            "fixed": dict(self.fixed),
            "offset": [float(c) for c in self.offset],
            "scale": float(self.scale),
        }
        return content | ({"values": self.values.tolist()} if values else {})

    @classmethod
    def from_dict(cls, content: Named[str, Any]) -> Self:
        """Read what :meth:`to_dict` wrote; parameters without values are zero.

        Raises
        ------
        FormatError
            When the data are not such a model.
        """
        extra = set(content) - {"terms", "fixed", "offset", "scale", "values"}
        if extra or "terms" not in content:
            raise FormatError(
                f"unknown key `{min(extra)}`" if extra else "missing key `terms`", where="model"
            )
        try:
            terms = {
                str(k): {str(part): str(s) for part, s in v.items()} for k, v in content["terms"].items()
            }
            fixed = {str(part): str(s) for part, s in content.get("fixed", {}).items()}
            x, y = (float(c) for c in content.get("offset", (0.0, 0.0)))
            values = as_values(tuple(terms), content.get("values", np.zeros(len(terms))))
            return cls(terms, values, fixed, (x, y), float(content.get("scale", 1.0)))
        except (TypeError, ValueError, AttributeError, UsageError) as error:
            raise FormatError(f"is not a rational polynomial ({error})", where="model") from None

    @classmethod
    def from_terms(
        cls, terms: Terms, values: Named[str, float] | None = None, **options: Any
    ) -> RationalPolynomial:
        """A model from its table of terms; values by name, the others zero. Options as in the class."""
        return RationalPolynomial(terms, **options).with_values(values or {})

    def split(self) -> RationalPolynomial:
        """The model with a parameter for every monomial, as ``A6.x3`` and ``A6.xy2`` for ``A6``."""
        terms: dict[str, dict[str, str]] = {}
        values = []
        for (name, sums), value in zip(self.terms.items(), self.values, strict=True):
            parts = [
                (part, text.strip())
                for part, whole in sums.items()
                for text in whole.replace("-", "+-").split("+")
            ]
            for part, text in parts:
                terms[name if len(parts) == 1 else f"{name}.{text}"] = {part: text}
                values.append(value)
        return replace(self, terms=terms, values=np.array(values))

    @classmethod
    def projective(cls) -> RationalPolynomial:
        """Projectivity, Wishahy eq. (3); initially the identity."""
        return cls.from_terms(_PROJECTIVE, {"a1": 1.0, "b2": 1.0})

    @classmethod
    def camera(cls) -> RationalPolynomial:
        """Camera and film of an oscilloscope (group A), Wishahy eq. (5a, b); initially the identity.

        The projectivity a1 b1 c1 a2 b2 c2 a0 b0, film deformation d1 d2 on xy, symmetric lens distortion k,
        and the terms of fourth order h1 on x⁴ and h2 on y⁴.
        """
        return cls.from_terms(_CAMERA, {"a1": 1.0, "b2": 1.0})

    @classmethod
    def ultrasonic(cls, *, reduced: bool = False) -> RationalPolynomial:
        """Ultrasonic instrument (group B), Wishahy eq. (7a, b); initially the identity.

        Parameters
        ----------
        reduced : bool
            Whether to use the model that remains after the F-tests of the paper:
            X = A0 + A1·x + A6·xy² + A7·x⁴, Y = B0 + B1·y + B2·x + B6·yx² + B7·y⁴.
        """
        return cls.from_terms(_ULTRASONIC_REDUCED if reduced else _ULTRASONIC, {"A1": 1.0, "B1": 1.0})

    @classmethod
    def affine(cls) -> RationalPolynomial:
        """Affine transformation X = a1·x + b1·y + c1, Y = a2·x + b2·y + c2; initially the identity."""
        return cls.from_terms(_AFFINE, {"a1": 1.0, "b2": 1.0})

    @classmethod
    def similarity(cls) -> RationalPolynomial:
        """Similarity X = X0 + a·x − b·y, Y = Y0 + b·x + a·y; initially the identity."""
        return cls.from_terms(_SIMILARITY, {"a": 1.0})

    @classmethod
    def bilinear(cls) -> RationalPolynomial:
        """Affine transformation with d1, d2 on xy; initially the identity."""
        return cls.from_terms(_BILINEAR, {"a1": 1.0, "b2": 1.0})

    @classmethod
    def polynomial(
        cls, degree: int, *, offset: tuple[float, float] = (0.0, 0.0), scale: float = 1.0
    ) -> RationalPolynomial:
        """Full bivariate polynomial: ``X_ij``, ``Y_ij`` at xⁱyʲ, i + j ≤ degree; initially the identity.

        Offset and scale normalise the points: from degree 3 use the centre of the image and half its larger
        side.

        Raises
        ------
        UsageError
            When the degree is not between 1 and 9.
        """
        if not 1 <= degree <= 9:
            raise UsageError(f"is {degree}, not between 1 and 9", where="degree of a polynomial")
        powers = [(n - j, j) for n in range(degree + 1) for j in range(n + 1)]
        terms = {f"{axis}_{i}{j}": {axis: f"x{i}y{j}"} for axis in "XY" for i, j in powers}
        start = {"X_00": offset[0], "Y_00": offset[1], "X_10": scale, "Y_01": scale}
        return cls.from_terms(terms, start, offset=offset, scale=scale)


_AFFINE = {
    "a1": {"X": "x"},
    "b1": {"X": "y"},
    "c1": {"X": "1"},
    "a2": {"Y": "x"},
    "b2": {"Y": "y"},
    "c2": {"Y": "1"},
}
_BILINEAR = _AFFINE | {"d1": {"X": "xy"}, "d2": {"Y": "xy"}}
_SIMILARITY = {
    "X0": {"X": "1"},
    "Y0": {"Y": "1"},
    "a": {"X": "x", "Y": "y"},
    "b": {"X": "-y", "Y": "x"},
}
_PROJECTIVE = {name: {f"N{part}": term for part, term in sums.items()} for name, sums in _AFFINE.items()} | {
    "a0": {"D": "x"},
    "b0": {"D": "y"},
}
_CAMERA = _PROJECTIVE | {
    "d1": {"X": "xy"},
    "d2": {"Y": "xy"},
    "k": {"X": "x3 + xy2", "Y": "y3 + yx2"},
    "h1": {"X": "x4"},
    "h2": {"Y": "y4"},
}
_R4 = "x4 + 2x2y2 + y4"
_ULTRASONIC = {
    **{f"A{i}": {"X": t} for i, t in enumerate(["1", "x", "y", "xy", "x2", "y2", "x3 + xy2", _R4])},
    **{f"B{i}": {"Y": t} for i, t in enumerate(["1", "y", "x", "xy", "y2", "x2", "y3 + yx2", _R4])},
}
_ULTRASONIC_REDUCED = {
    **{name: {"X": t} for name, t in {"A0": "1", "A1": "x", "A6": "xy2", "A7": "x4"}.items()},
    **{name: {"Y": t} for name, t in {"B0": "1", "B1": "y", "B2": "x", "B6": "yx2", "B7": "y4"}.items()},
}
