"""Displays: Wong's model of a cathode-ray tube, with the beam of an ultrasonic instrument.

The model is a sum of corrections to the displayed point::

    X = x + (Δx)s + (Δx)d + (Δx)o + (Δx)ε        Y = y + (Δy)s + (Δy)d + (Δy)o

    symmetric     (Δx)s = x(k0 + k1r² + k2r⁴ + k3r⁶)          (Δy)s = y(k0 + k1r² + k2r⁴ + k3r⁶)
    decentering   (Δx)d = −(g1r² + g2r⁴ + g3r⁶) sin θ         (Δy)d = (g1r² + g2r⁴ + g3r⁶) cos θ
    orientation   (Δx)o = P0 + P1xy + P2x² − P3y              (Δy)o = P4 + P2xy + P3x + P1y²
    beam          (Δx)ε = m1x + m2y

(Wong 1975, Mathematical formulation and digital analysis in close-range photogrammetry; Wishahy, section B.)

Where Wishahy's printed formulas are inconsistent, the components above are used, not their expansion:

- The Δ are called distortions but are added to the measured point: they are corrections, also here.
- (6a, b) print h1 and h3 without the prime at x² and y², the list after (7) prints h1, h2, h3, h4 without it:
  all mean the h' of the decentering. With it the signs of (6) follow from the components.
- The beam's (Δx)ε is (Δx)e in the sum.
- In (7) all sixteen coefficients are free, but the thirteen parameters of (6) imply three conditions:
  A4 − A5 = B3 (both P2), B4 − B5 = A3 (both P1) and A6 = B6 (both k1). (7) is
  :meth:`RationalPolynomial.ultrasonic`; a fitted display satisfies the conditions.
- h'1 = g1 sin θ … h'4 = g2 cos θ are four numbers from three: (6) and (7) ignore h'1·h'4 = h'2·h'3.
"""

from __future__ import annotations

from .polynomials import RationalPolynomial

_RADII = ["x2 + y2", "x4 + 2x2y2 + y4", "x6 + 3x4y2 + 3x2y4 + y6"]
_X_RADII = ["x", "x3 + xy2", "x5 + 2x3y2 + xy4", "x7 + 3x5y2 + 3x3y4 + xy6"]
_Y_RADII = ["y", "y3 + yx2", "y5 + 2x2y3 + x4y", "y7 + 3x2y5 + 3x4y3 + x6y"]
_SYMMETRIC = {f"k{i}": {"X": x, "Y": y} for i, (x, y) in enumerate(zip(_X_RADII, _Y_RADII, strict=True))}
_ORIENTATION = {
    "P0": {"X": "1"},
    "P1": {"X": "xy", "Y": "y2"},
    "P2": {"X": "x2", "Y": "xy"},
    "P3": {"X": "-y", "Y": "x"},
    "P4": {"Y": "1"},
}
_BEAM = {"m1": {"X": "x"}, "m2": {"X": "y"}}
_UNCHANGED = {"X": "x", "Y": "y"}


def _negative(terms: str) -> str:
    return "-" + terms.replace("+", "-")


def wong_display() -> RationalPolynomial:
    """Wong's display, linear in its parameters, with decentering by h'1 … h'4; initially the identity.

    Parameters k0 … k3, h'1 and h'2 (−r², −r⁴ in X), h'3 and h'4 (r², r⁴ in Y), P0 … P4, m1, m2: 15 in all.
    With k2 = k3 = 0 it is Wishahy's eq. (6a, b).

    Examples
    --------
    >>> display = wong_display().with_values({"k0": 0.02, "P0": 1.5})
    >>> len(display.names), display([[10.0, 20.0]]).round(3)
    (15, array([[11.7, 20.4]]))
    """
    decentering = {
        "h'1": {"X": _negative(_RADII[0])},
        "h'2": {"X": _negative(_RADII[1])},
        "h'3": {"Y": _RADII[0]},
        "h'4": {"Y": _RADII[1]},
    }
    return RationalPolynomial(_SYMMETRIC | decentering | _ORIENTATION | _BEAM, fixed=_UNCHANGED)
