"""A fitted polynomial as two equations, with symbols and with numbers."""

from __future__ import annotations

from collections.abc import Mapping

from markupsafe import Markup

from ..core.numbers import power
from ..optics import RationalPolynomial
from ..optics.polynomials import monomials
from .tables import symbol

Equation = tuple[str, Markup, Markup]
"""Left-hand side, right-hand side in symbols, and in numbers."""

_SQUARE = {(4, 0): 1.0, (2, 2): 2.0, (0, 4): 1.0}


def equations(
    model: RationalPolynomial, value: Mapping[str, float], sigma: Mapping[str, float]
) -> tuple[Equation, Equation]:
    """Return the equations of X and Y.

    Parameters
    ----------
    model : RationalPolynomial
        The model, without denominators.
    value, sigma : mapping of str to float
        Values and sigmas of the coefficients in the equations, by name; each is printed with the digits
        that its sigma supports.
    """
    x, y = (_written(model, value, sigma, part) for part in "XY")
    return x, y


def _written(
    model: RationalPolynomial, value: Mapping[str, float], sigma: Mapping[str, float], part: str
) -> Equation:
    symbols, numbers = Markup(""), Markup("")
    for name, sums in model.terms.items():
        if name not in value or part not in sums:
            continue
        term = _term(sums[part])
        gap = Markup("&nbsp;") if term else Markup("")
        sign = Markup(" + ") if symbols else Markup("")
        symbols += sign + Markup("<i>{}</i>").format(symbol(name.partition(".")[0])) + gap + term
        shown = power(value[name], sigma[name])
        minus = shown.value.startswith("−")
        lead = (" − " if numbers else "−") if minus else (" + " if numbers else "")
        exponent = Markup("&thinsp;·&thinsp;10<sup>{}</sup>").format(shown.exponent) if shown.exponent else ""
        numbers += Markup("{}{}{}").format(lead, shown.value.lstrip("−"), exponent) + gap + term
    return part, symbols, numbers


def _term(text: str) -> Markup:
    """A printed sum of monomials; empty for the constant."""
    found = monomials(text)
    if found == {(0, 0): 1.0}:
        return Markup("")
    if found == _SQUARE:
        return Markup("(<i>x</i>² + <i>y</i>²)²")
    parts = Markup("")
    for (i, j), coefficient in found.items():
        size = abs(coefficient)
        sign = ("−" if coefficient < 0 else "") if not parts else (" − " if coefficient < 0 else " + ")
        parts += Markup("{}{}").format(sign, "" if size == 1 else f"{size:g}") + _monomial(i, j)
    return Markup("({})").format(parts) if len(found) > 1 else parts


def _monomial(i: int, j: int) -> Markup:
    letters = Markup("")
    for letter, exponent in (("x", i), ("y", j)):
        if exponent:
            letters += Markup("<i>{}</i>").format(letter) + ("" if exponent == 1 else "⁰¹²³⁴⁵⁶⁷⁸⁹"[exponent])
    return letters
