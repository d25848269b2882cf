"""Entries of calibration files of both groups of an oscilloscope: coefficients, systems, tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..adjust.elimination import Elimination
from ..optics import RationalPolynomial
from ..optics.composition import Similarity
from ..optics.polynomials import monomials
from .document import Calibration


def tests_of(elimination: Elimination) -> tuple[dict[str, Any], ...]:
    """Tests of every coefficient, dropped ones first in their order, as in a calibration file."""
    dropped = [(step.test, "dropped") for step in elimination.steps]
    kept = [(test, "kept") for test in elimination.kept]
    return tuple(
        {
            "parameter": test.name,
            "distribution": test.distribution,
            "statistic": float(test.statistic),
            "critical": float(test.critical),
            "p": float(test.p),
            "verdict": verdict,
        }
        for test, verdict in dropped + kept
    )


def with_stored_values(model: RationalPolynomial, calibration: Calibration) -> RationalPolynomial:
    """The model with its values in a calibration file, which may hold those of other models too."""
    values = calibration.values()
    return model.with_values(np.array([values[name] for name in model.names]))


def unit_of(model: RationalPolynomial, name: str, unit: str) -> str:
    """Unit of a coefficient: that of X over the power of its monomials."""
    part, text = next(iter(model.terms[name].items()))
    exponent = (0 if part == "D" else 1) - max(i + j for i, j in monomials(text))
    return "1" if exponent == 0 else unit if exponent == 1 else f"{unit}^{exponent}"


def system_to_dict(system: Similarity) -> dict[str, Any]:
    """A similarity as JSON-ready data."""
    values = dict(zip(system.names, map(float, system.values), strict=True))
    return values | {"mirrored": system.mirrored}


def system_from_dict(content: dict[str, Any]) -> Similarity:
    """Read what :func:`system_to_dict` wrote."""
    values = np.array([float(content[name]) for name in Similarity.names])
    return Similarity(values, bool(content["mirrored"]))
