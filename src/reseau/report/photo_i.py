"""The section of the report on PHOTO I: camera and film, group A."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from ..core.data import Array, Frame, ImagePoints
from ..core.errors import UsageError
from ..core.figures import Panel
from ..core.numbers import aligned
from ..io import ReseauDesign
from ..procedures.oscilloscope import PhotoI
from ..refine import CorrectionFit
from .comparison import similarity_residuals
from .figures import distortion_figure, residual_figure
from .overlay import frame_overlay, marks_of
from .tables import (
    Estimates,
    Item,
    Row,
    axis_rows,
    coefficient_rows,
    declined_rows,
    model_tests,
    rms,
    step_rows,
)
from .truth import CameraComparison


def photo_i_section(
    found: PhotoI, design: ReseauDesign, frame: Frame | None, truth: CameraComparison | None
) -> Row:
    """Return the content of the section's template.

    Parameters
    ----------
    found : PhotoI
        Result of the procedure.
    design : ReseauDesign
        The reseau.
    frame : Frame or None
        The photograph; None omits the picture.
    truth : CameraComparison or None
        Comparison with the truth of a simulator.

    Raises
    ------
    UsageError
        When the correction was read from a file and has no residuals.
    """
    fit = found.camera.fit
    if fit is None:
        raise UsageError("was read from a file and has no residuals", where="correction of the camera")
    marks = found.points.select(fit.check.names)
    check_photo = ImagePoints(marks.names, found.camera.photo_system(marks.xy), marks.cov)
    before, before_check = similarity_residuals(fit.points, fit.target, check_photo, fit.check_target)
    after_check = fit.check.xy - fit.check_target
    panel = Panel(design.unit)
    return {
        "summary": _summary(found, fit, before, after_check),
        "frame": None if frame is None else Markup(_overlay(found, frame, fit)),
        "missing": [] if found.measured is None else declined_rows(found.measured),
        "residuals": Markup(
            residual_figure(
                (fit.target, before, fit.residuals),
                (fit.check_target, before_check, after_check),
                panel,
                ("before: best similarity", "after: corrected"),
            )
        ),
        "field": Markup(distortion_figure(found.camera.model, fit.target, panel)),
        "stages": axis_rows(
            [("best similarity", [before, before_check]), ("corrected", [fit.residuals, after_check])],
            4,
            largest=True,
        ),
        "coefficients": coefficient_rows(fit.elimination, _estimates(found)),
        "steps": step_rows(fit.elimination),
        "tests": model_tests(fit.adjustment, fit.elimination.alpha, fit.local),
        "check": _check(fit),
        "truth": None if truth is None else _truth(truth),
        "marks": len(fit.points),
        "held": len(fit.check),
        "alpha": f"{fit.elimination.alpha:g}",
    }


def _summary(found: PhotoI, fit: CorrectionFit, before: Array, after_check: Array) -> list[Item]:
    measured = found.measured
    n = len(found.points)
    expected = n if measured is None else len(measured.ids)
    sigma = float(np.sqrt((found.points.sigma**2).mean()))
    items = [
        (f"{n}\u2009/\u2009{expected}", "", "marks measured"),
        (f"{sigma:.4f}", "px", "standard deviation of a coordinate"),
        (f"{rms(before) * 1000:.0f}", "µm", "rms before: best similarity"),
        (f"{rms(fit.residuals) * 1000:.2f}", "µm", "rms after correction"),
    ]
    if len(after_check):
        items.append((f"{rms(after_check) * 1000:.2f}", "µm", "rms of the check marks"))
    return items


def _overlay(found: PhotoI, frame: Frame, fit: CorrectionFit) -> str:
    return frame_overlay(frame, marks_of(found.points, found.measured, fit.check.names))


def _estimates(found: PhotoI) -> Estimates:
    """Estimates of the coefficients, including the uncertainty of O and S."""
    camera = found.camera
    quantities = camera.calibration(name="").parameters
    return Estimates(
        dict(zip(camera.model.names, map(float, camera.model.values), strict=True)),
        {name: quantities[name].sigma for name in camera.model.names},
        {name: quantities[name].unit for name in camera.model.names},
    )


def _check(fit: CorrectionFit) -> list[tuple[str, ...]]:
    """Check marks: design coordinates, remaining errors (µm), sigmas (µm), and their ratio."""
    left, sigma = (fit.check.xy - fit.check_target) * 1000, fit.check.sigma * 1000
    columns = [
        *(aligned(fit.check_target[:, k], 2) for k in range(2)),
        *(aligned(left[:, k], 2) for k in range(2)),
        *(aligned(sigma[:, k], 2) for k in range(2)),
        *(aligned(left[:, k] / sigma[:, k], 1) for k in range(2)),
    ]
    return [(name, *cells) for name, *cells in zip(fit.check.names, *columns, strict=True)]


def _truth(truth: CameraComparison) -> list[tuple[Any, ...]]:
    """Comparison with the truth: quantity, x, y, unit."""
    return [
        ("error of the measured positions", *aligned(truth.position_px, 4), "px"),
        ("the same in units of their standard deviations", *aligned(truth.position_normalised, 2), ""),
        ("approximation error of the model", *aligned(np.array(truth.approximation) * 1000, 2), "µm"),
        ("check marks in units of their standard deviations", *aligned(truth.check_normalised, 2), ""),
    ]
