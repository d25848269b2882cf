"""The section of the report on PHOTO II: the ultrasonic instrument, group B."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy
from markupsafe import Markup

from ..calibration import InstrumentCorrection
from ..calibration.entries import unit_of
from ..core.data import Array, Frame
from ..core.figures import Panel
from ..core.numbers import aligned, power
from ..io import ReseauDesign
from ..optics import RationalPolynomial
from ..optics.displays import wong_display
from ..optics.polynomials import monomials
from ..procedures.oscilloscope import PhotoII
from ..refine import CAUSES, Causes, InstrumentFit, Rivalry
from .factors import FACTORS, correctors, rods_of
from .figures import distortion_figure, residual_figure
from .overlay import Arcs, frame_overlay, marks_of
from .tables import (
    Estimates,
    Item,
    Row,
    axis_rows,
    coefficient_rows,
    declined_rows,
    model_tests,
    probability,
    rms,
    step_rows,
    symbol,
    unit_markup,
)
from .truth import RodComparison

_PITCH = 0.1
"""Grid step of the distortion and length of the longest vectors, as part of the extent of the rods."""

_MEANING = {
    "P0": ("orientation", "displacement of the picture in x"),
    "P1": ("orientation", "obliquity of the camera’s axis to the tube’s: xy in X, y² in Y"),
    "P2": ("orientation", "obliquity of the camera’s axis to the tube’s: x² in X, xy in Y"),
    "P3": ("orientation", "rotation of the picture"),
    "P4": ("orientation", "displacement of the picture in y"),
    "k0": ("symmetric", "scale of the deflection"),
    "k1": ("symmetric", "radial distortion r³: deflection lens and field, curved screen"),
    "h'1": ("asymmetric", "decentred deflection in x, with r²"),
    "h'2": ("asymmetric", "decentred deflection in x, with r⁴"),
    "h'3": ("asymmetric", "decentred deflection in y, with r²"),
    "h'4": ("asymmetric", "decentred deflection in y, with r⁴"),
    "m1": ("beam", "diameter and frequency of the transducer, with x"),
    "m2": ("beam", "divergence of the sound beam, with the depth y"),
}


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Residuals of fitted and of check rods: design coordinates, residuals before and after group B."""

    fitted: tuple[Array, Array, Array]
    check: tuple[Array, Array, Array]


def photo_ii_section(
    found: PhotoII, design: ReseauDesign, frame: Frame | None, truth: RodComparison | None
) -> Row:
    """Return the content of the section's template.

    Parameters
    ----------
    found : PhotoII
        Result of the procedure.
    design : ReseauDesign
        The rods of the test object.
    frame : Frame or None
        The photograph; None omits the picture.
    truth : RodComparison or None
        Comparison with the truth of a simulator.

    Raises
    ------
    UsageError
        When the correction was read from a file and has no residuals.
    """
    left, instrument = _residuals(found, design), found.instrument
    fit = instrument.fit
    assert fit is not None  # asked with the residuals
    tolerance = np.array([point.sigma or 0.0 for point in design.points])
    extent = float(np.ptp(left.fitted[0], axis=0).max())
    typical = float(np.quantile(np.hypot(*left.fitted[1].T), 0.9))
    sigma = float(np.sqrt((tolerance**2).mean()))
    panel = Panel(design.unit, _PITCH * extent, max(typical, 1e-12), sigma, ("X", "Y"))
    titles = ("before: group A and the scales", "after: group B")
    return {
        "summary": _summary(found, design, left, sigma),
        "frame": None if frame is None else Markup(_overlay(found, frame)),
        "missing": [] if found.measured is None else declined_rows(found.measured),
        "setup": _setup(found),
        "notes": [*(() if found.measured is None else found.measured.notes), *found.notes],
        "residuals": Markup(residual_figure(left.fitted, left.check, panel, titles)),
        "stages": axis_rows(
            [(title, [left.fitted[k], left.check[k]]) for k, title in ((1, titles[0]), (2, titles[1]))],
            3,
            largest=True,
        ),
        "tolerance": f"{sigma:.2f}\u00a0{design.unit}" if sigma else None,
        "field": Markup(
            distortion_figure(
                instrument.model, fit.target, Panel(design.unit, panel.pitch, labels=("x", "y"))
            )
        ),
        "truth": None if truth is None else _truth(truth, design.unit),
        "rods": len(fit.points),
        "held": len(fit.check),
        "design": design,
        **_model(found, fit, design.unit),
    }


def _model(found: PhotoII, fit: InstrumentFit, unit: str) -> Row:
    """The coefficients with their tests, the causes, and the alternative model."""
    instrument, elimination = found.instrument, fit.elimination
    return {
        "coefficients": coefficient_rows(elimination, _estimates(instrument)),
        "steps": step_rows(elimination),
        "tests": model_tests(elimination.full, elimination.alpha, fit.local),
        "reduced": _reduced(instrument.model, fit),
        "causes": None if found.causes is None else _causes(found.causes, fit, unit),
        "displays": None if fit.displays is None else _displays(fit.displays),
        "all_terms": set(elimination.full.names) <= set(instrument.model.names),
        "alpha": f"{elimination.alpha:g}",
    }


def _residuals(found: PhotoII, design: ReseauDesign) -> _Residuals:
    rods, fit = rods_of(found), found.instrument.fit
    assert fit is not None  # asked by `rods_of`
    place = dict(zip(design.ids, design.xy, strict=True))
    ways = correctors(found.instrument, rods, fit.target)
    groups = []
    for points in (rods, found.pins.select(fit.check.names)):
        xy = np.array([place[name] for name in points.names]).reshape(-1, 2)
        groups.append((xy, ways[FACTORS[1]](points.xy) - xy, ways[FACTORS[3]](points.xy) - xy))
    return _Residuals(groups[0], groups[1])


def _summary(found: PhotoII, design: ReseauDesign, left: _Residuals, tolerance: float) -> list[Item]:
    unit, measured = design.unit, found.measured
    expected = len(design.ids) if measured is None else len(measured.ids)
    items = [
        (f"{len(found.pins)}\u2009/\u2009{expected}", "", "rods measured"),
        (f"{np.sqrt((found.pins.sigma**2).mean()):.3f}", "px", "standard deviation of a coordinate"),
        (f"{rms(left.fitted[1]):.3f}", unit, "rms before: group A and the scales"),
        (f"{rms(left.fitted[2]):.3f}", unit, "rms after group B"),
    ]
    if tolerance:
        items.append((f"{np.sqrt(2) * tolerance:.3f}", unit, "tolerance of the rods (length of the vector)"))
    return items


def _overlay(found: PhotoII, frame: Frame) -> str:
    """Rods with the centre lines of their arcs; rejected ones with their names."""
    measured, fit = found.measured, found.instrument.fit
    check = () if fit is None else fit.check.names
    if measured is None:
        return frame_overlay(frame, marks_of(found.pins, None, check))
    arcs = Arcs(measured.length, measured.curvature, measured.tilt)
    labels = {name: name for name in measured.ids}
    return frame_overlay(frame, marks_of(found.pins, measured, check, arcs=arcs, labels=labels))


def _setup(found: PhotoII) -> list[tuple[Markup, str, str]]:
    """Scales and rotation of the photograph: symbol, value, meaning."""
    plane, registration = found.instrument.plane, found.registration
    rows = [
        (Markup("<i>λ</i><sub>1</sub>"), f"{plane.scale[0]:.5f}", "scale along M′N′"),
        (Markup("<i>λ</i><sub>2</sub>"), f"{plane.scale[1]:.5f}", "scale across it"),
        (Markup("<i>κ</i>"), aligned([np.rad2deg(plane.rotation)], 3)[0] + "°", "rotation of the object"),
    ]
    if registration is not None:
        shown = f"{registration.displacement_px:.3f} px (p = {probability(registration.p)})"
        rows.append((Markup("<i>d</i>"), shown, "displacement since PHOTO I"))
    return rows


def _estimates(instrument: InstrumentCorrection) -> Estimates:
    """Estimates of the applied coefficients, including the uncertainty of group A."""
    names, first = instrument.model.names, len(instrument.camera.model.names)
    sigma = np.sqrt(np.diagonal(instrument.covariance))[first:]
    return Estimates(
        dict(zip(names, map(float, instrument.model.values), strict=True)),
        dict(zip(names, map(float, sigma), strict=True)),
        {name: unit_of(instrument.model, name, instrument.unit) for name in names},
    )


def _reduced(model: RationalPolynomial, fit: InstrumentFit) -> Row:
    """The model reduced by tests of every monomial (of every coefficient with few rods), as two equations."""
    record = fit.elimination if fit.monomials is None else fit.monomials
    reduced = record.adjustment
    kept = [name for name in reduced.names if name not in record.dropped]
    value = {name: reduced[name] for name in kept}
    sigma = {name: reduced.sigma_of(name) for name in kept}
    return {
        "equations": equations(model if fit.monomials is None else model.split(), value, sigma),
        "kept": len(kept),
        "dropped": len(record.dropped),
        "sigma0": f"{reduced.sigma0:.3f}",
        "full_sigma0": f"{record.full.sigma0:.3f}",
    }


def _causes(causes: Causes, fit: InstrumentFit, unit: str) -> Row:
    """The causes with their standard deviations, tests and largest effects; the conditions."""
    adjustment, display = causes.adjustment, wong_display()
    globally = adjustment.global_test()
    rows = []
    for name in CAUSES:
        value = adjustment[name]
        # The a priori covariance of the coefficients is used: three conditions are too few to scale it.
        sigma = float(np.sqrt(adjustment.cofactor[adjustment.index(name), adjustment.index(name)]))
        alone = RationalPolynomial({name: display.terms[name]}, np.array([value]))
        p = float(scipy.special.chdtrc(1, (value / sigma) ** 2))
        rows.append(
            {
                "name": symbol(name),
                "group": _MEANING[name][0],
                "value": power(value, sigma),
                "unit": unit_markup(unit_of(display, name, unit)),
                "effect": f"{np.hypot(*alone(fit.points.xy).T).max():.3f}",
                "p": probability(p),
                "significant": p < fit.elimination.alpha,
                "meaning": _MEANING[name][1],
            }
        )
    conditions = [
        {
            "name": _condition(test.condition),
            "misclosure": power(test.misclosure, test.sigma),
            "statistic": f"{test.statistic:.2f}",
            "critical": f"{test.critical:.2f}",
            "p": probability(test.p),
            "verdict": "holds" if test.holds else "does not hold",
        }
        for test in causes.conditions
    ]
    together = {
        "statistic": f"{globally.statistic:.2f}",
        "critical": f"{scipy.special.chdtri(globally.redundancy, 0.05):.2f}",
        "p": probability(float(scipy.special.chdtrc(globally.redundancy, globally.statistic))),
    }
    return {"rows": rows, "conditions": conditions, "together": together}


def _condition(text: str) -> Markup:
    """A condition with its coefficients as printed symbols."""
    words = [Markup("<i>{}</i>").format(symbol(word)) if word.isalnum() else word for word in text.split()]
    return Markup(" ").join(words)


def _displays(found: Rivalry) -> Row:
    """Polynomials and Wong's model: number of parameters, sigma0, leave-one-out rms; the verdict."""
    models = ((found.first, "polynomials (7a, b)"), (found.second, "Wong’s display model"))
    columns = [aligned(found.rms[:, k], 3) for k in range(2)]
    rows = [
        (name, str(len(fit.names)), str(fit.redundancy), f"{fit.sigma0:.3f}", *cells)
        for (fit, name), *cells in zip(models, *columns, strict=True)
    ]
    verdict = {
        "first": "The polynomials predict the rods significantly better.",
        "second": "Wong’s model predicts the rods significantly better.",
    }
    return {
        "rows": rows,
        "p": probability(found.p),
        "verdict": verdict.get(found.verdict, "Neither model predicts the rods significantly better."),
    }


def _truth(truth: RodComparison, unit: str) -> list[tuple[str, ...]]:
    """Comparison with the truth: quantity, x, y, unit."""
    return [
        ("error of the measured positions", *aligned(truth.position_px, 3), "px"),
        ("the same in units of their standard deviations", *aligned(truth.position_normalised, 2), ""),
        ("true minus design coordinates of the rods", *aligned(truth.made, 3), unit),
    ]


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
