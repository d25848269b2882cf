"""The report of PHOTO I: one page that stands alone, the same to the byte for the same input."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from ..data import Frame, ImagePoints
from ..errors import UsageError
from ..formats import ReseauDesign
from ..procedures.oscilloscope import PhotoI
from ..provenance import Provenance
from ..refine.correction import CorrectionFit
from .comparison import Comparison, similarity_residuals
from .figures import distortion_figure, residual_figure
from .numbers import aligned, grouped, power
from .overlay import frame_overlay

__all__ = ["photo_i_report"]


def photo_i_report(
    found: PhotoI,
    design: ReseauDesign,
    *,
    frame: Frame | None = None,
    title: str = "PHOTO I",
    provenance: Provenance | None = None,
    truth: Comparison | None = None,
) -> str:
    """Render the report.

    Parameters
    ----------
    found : PhotoI
        What the procedure found.
    design : ReseauDesign
        The reseau.
    frame : Frame, optional
        The photograph; without it the page has no picture.
    title : str
        Its heading.
    provenance : Provenance, optional
        Inputs, options, version.
    truth : Comparison, optional
        What a simulator knows.

    Returns
    -------
    str
        An HTML page without any external resource and without clock times.

    Raises
    ------
    UsageError
        When the correction was read from a file: it has no residuals to show.
    """
    fit = found.camera.fit
    if fit is None:
        raise UsageError("was read from a file and has no residuals", where="correction")
    check_photo = _check_photo(found, fit)
    before, before_check = similarity_residuals(fit.points, fit.target, check_photo, fit.check_target)
    after_check = fit.check.xy - fit.check_target
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("reseau.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("photo_i.html.j2").render(
        title=title,
        design=design,
        unit=design.unit,
        summary=_summary(found, fit, before, after_check),
        frame=None if frame is None else Markup(_overlay(found, frame, fit)),
        missing=_missing(found),
        residuals=Markup(
            residual_figure(
                (fit.target, before, fit.residuals),
                (fit.check_target, before_check, after_check),
                design.unit,
            )
        ),
        field=Markup(distortion_figure(found.camera, fit.target, design.unit)),
        stages=_stages(fit, before, before_check, after_check, design.unit),
        coefficients=_coefficients(found),
        steps=_steps(fit),
        tests=_tests(fit),
        check=_check(fit),
        truth=None if truth is None else _truth(truth),
        provenance=(provenance or Provenance()).to_dict(),
        marks=len(fit.points),
        held=len(fit.check),
        alpha=fit.elimination.alpha,
    )


def _check_photo(found: PhotoI, fit: CorrectionFit) -> ImagePoints:
    """Check marks in the common system, uncorrected."""
    marks = found.points.select(fit.check.names)
    return ImagePoints(marks.names, found.camera.photo_system(marks.xy), marks.cov)


def _rms(values: Any) -> float:
    """Root mean square length of vectors."""
    return float(np.sqrt((np.asarray(values) ** 2).sum(axis=1).mean())) if len(values) else 0.0


def _summary(found: PhotoI, fit: CorrectionFit, before: Any, after_check: Any) -> list[tuple[str, str, str]]:
    """The figures at the head of the page: number, unit, what it is."""
    measured = found.measured
    n = len(found.points)
    expected = n if measured is None else len(measured.ids)
    sigma = float(np.sqrt((found.points.sigma**2).mean()))
    items = [
        (f"{n}\u2009/\u2009{expected}", "", "marks measured"),
        (f"{sigma:.4f}", "px", "standard deviation of a coordinate"),
        (f"{_rms(before) * 1000:.0f}", "µm", "rms before: best similarity"),
        (f"{_rms(fit.residuals) * 1000:.2f}", "µm", "rms after correction"),
    ]
    if len(after_check):
        items.append((f"{_rms(after_check) * 1000:.2f}", "µm", "rms of the check marks"))
    return items


def _overlay(found: PhotoI, frame: Frame, fit: CorrectionFit) -> str:
    measured = found.measured
    if measured is None:
        names, xy = found.points.names, found.points.xy
        return frame_overlay(frame, names, xy, np.ones(len(names), dtype=bool), fit.check.names)
    xy = np.where(measured.ok[:, None], measured.xy, measured.predicted)
    return frame_overlay(frame, measured.ids, xy, measured.ok, fit.check.names)


def _missing(found: PhotoI) -> list[tuple[str, str]]:
    measured = found.measured
    if measured is None:
        return []
    return [
        (name, why) for name, why, ok in zip(measured.ids, measured.why, measured.ok, strict=True) if not ok
    ]


def _stages(fit: CorrectionFit, before: Any, before_check: Any, after_check: Any, unit: str) -> Any:
    """Root mean squares per axis of fitted and check marks, before and after."""
    rows = []
    for name, fitted, check in (
        ("best similarity", before, before_check),
        ("corrected", fit.residuals, after_check),
    ):
        row = [name, *np.sqrt((fitted**2).mean(axis=0)), np.abs(fitted).max()]
        row += [*np.sqrt((check**2).mean(axis=0)), np.abs(check).max()] if len(check) else 3 * [np.nan]
        rows.append(row)
    columns = [aligned([row[k] for row in rows], 4) for k in range(1, 7)]
    return [(row[0], *cells) for row, *cells in zip(rows, *columns, strict=True)]


def _coefficients(found: PhotoI) -> list[dict[str, Any]]:
    """All coefficients of the full model, those dropped without a value."""
    camera, fit = found.camera, found.camera.fit
    assert fit is not None  # asked before
    sigma = dict(zip(camera.model.names, np.sqrt(np.diagonal(camera.cofactor)), strict=True))
    value = dict(zip(camera.model.names, camera.model.values, strict=True))
    tests = {test.name: test for test in fit.elimination.kept}
    dropped = {step.name: step.test for step in fit.elimination.steps}
    quantities = camera.calibration(name="").parameters
    rows = []
    for name in fit.elimination.full.names:
        test = tests.get(name) or dropped.get(name)
        rows.append(
            {
                "name": Markup(f"{name[0]}<sub>{name[1:]}</sub>") if name[1:] else name,
                "value": power(value[name], sigma[name]) if name in value else None,
                "unit": _unit(quantities[name].unit) if name in quantities else "",
                "statistic": "" if test is None else grouped(test.statistic),
                "p": "" if test is None else _probability(test.p),
                "verdict": "not tested" if test is None else "dropped" if name in dropped else "kept",
            }
        )
    return rows


def _unit(unit: str) -> Markup | str:
    """A unit with its exponent raised: mm^-3 as mm⁻³."""
    base, _, exponent = unit.partition("^")
    if unit == "1":
        return ""
    return Markup("{}<sup>{}</sup>").format(base, exponent.replace("-", "−")) if exponent else base


def _probability(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _steps(fit: CorrectionFit) -> Sequence[dict[str, str]]:
    return [
        {
            "name": step.name,
            "parameters": str(step.parameters),
            "statistic": f"{step.test.statistic:.2f}",
            "critical": f"{step.test.critical:.2f}",
            "p": _probability(step.test.p),
            "before": f"{step.sigma0_before:.3f}",
            "after": f"{step.sigma0_after:.3f}",
        }
        for step in fit.elimination.steps
    ]


def _tests(fit: CorrectionFit) -> dict[str, Any]:
    """The global test and that for a local model."""
    globally = fit.adjustment.global_test(fit.elimination.alpha)
    need = None if fit.local is None else [float(p) for p in np.atleast_1d(fit.local.need)]
    return {
        "statistic": f"{globally.statistic:.1f}",
        "redundancy": globally.redundancy,
        "lower": f"{globally.lower:.1f}",
        "upper": f"{globally.upper:.1f}",
        "p": _probability(globally.p),
        "passed": globally.passed,
        "sigma0": f"{fit.adjustment.sigma0:.3f}",
        "scaled": fit.adjustment.scale == "a-posteriori",
        "too_large": globally.statistic > globally.upper,
        "need": None if need is None else [_probability(p) for p in need],
        "local": need is not None and min(need) < fit.elimination.alpha,
    }


def _check(fit: CorrectionFit) -> list[tuple[str, ...]]:
    """Check marks: designed coordinates, what the correction leaves (µm), sigma (µm), and their ratio."""
    left, sigma = (fit.check.xy - fit.check_target) * 1000, fit.check.sigma * 1000
    columns = [
        *(aligned(fit.check_target[:, k], 2) for k in range(2)),
        *(aligned(left[:, k], 2) for k in range(2)),
        *(aligned(sigma[:, k], 2) for k in range(2)),
        *(aligned(left[:, k] / sigma[:, k], 1) for k in range(2)),
    ]
    return [(name, *cells) for name, *cells in zip(fit.check.names, *columns, strict=True)]


def _truth(truth: Comparison) -> list[tuple[str, ...]]:
    """What the simulator knows: quantity, x, y, unit."""
    return [
        ("error of the measured positions", *aligned(truth.position_px, 4), "px"),
        ("the same in their standard deviations", *aligned(truth.position_normalised, 2), ""),
        ("approximation error of the model", *aligned(np.array(truth.approximation) * 1000, 2), "µm"),
        ("check marks in their standard deviations", *aligned(truth.check_normalised, 2), ""),
    ]
