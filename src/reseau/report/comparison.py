"""PHOTO I against the truth, where a simulator knows it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..data import Array, ImagePoints
from ..errors import UsageError
from ..formats import ReseauDesign
from ..optics import PlaneMapping, RationalPolynomial
from ..procedures.oscilloscope import PhotoI
from ..refine import fit_mapping

__all__ = ["Comparison", "Stage", "compare_with_truth", "comparison_table", "similarity_residuals"]


@dataclass(frozen=True)
class Stage:
    """Root mean square of what is left of the errors of some marks, per axis, in the unit of the design."""

    name: str
    fitted: tuple[float, float]
    check: tuple[float, float]


@dataclass(frozen=True)
class Comparison:
    """What the truth says about a correction.

    Parameters
    ----------
    unit : str
        Of the design.
    marks, checked : int
        Marks that were fitted, and marks held out.
    position_px : (float, float)
        Root mean square error of the measured positions.
    position_normalised : (float, float)
        The same in units of their standard deviations: 1 where those are right.
    stages : tuple of Stage
        Marks against their designed coordinates: in the common system only, after the best similarity, and
        corrected.
    approximation : (float, float)
        What the model leaves of noise-free positions: its own error, apart from that of the measurement.
    check_normalised : (float, float)
        Corrected check marks against the same adjustment of noise-free positions, in units of their
        standard deviations.
    coefficients_normalised : float
        The same of the coefficients.
    """

    unit: str
    marks: int
    checked: int
    position_px: tuple[float, float]
    position_normalised: tuple[float, float]
    stages: tuple[Stage, ...]
    approximation: tuple[float, float]
    check_normalised: tuple[float, float]
    coefficients_normalised: float

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready data."""
        return asdict(self)


def _rms(values: Array) -> tuple[float, float]:
    """Root mean square per axis of (n, 2); NaN-free zero for none."""
    if not len(values):
        return 0.0, 0.0
    x, y = np.sqrt((values**2).mean(axis=0))
    return float(x), float(y)


def similarity_residuals(
    points: ImagePoints, target: Array, others: ImagePoints, others_target: Array
) -> tuple[Array, Array]:
    """What the best similarity leaves of points and of others that it was not fitted to.

    Parameters
    ----------
    points, others : ImagePoints
        Photo-coordinates.
    target, others_target : ndarray (n, 2), (m, 2)
        Designed coordinates.

    Returns
    -------
    ndarray (n, 2), ndarray (m, 2)
        Transformed minus designed.
    """
    model = RationalPolynomial.similarity()
    fitted = fit_mapping(model, ImagePoints.with_sigma(points.names, points.xy, 1.0), target).required()
    best = model.with_values(fitted.values)
    return best(points.xy) - target, best(others.xy) - others_target


def compare_with_truth(found: PhotoI, design: ReseauDesign, view: PlaneMapping) -> Comparison:
    """Compare a correction with the truth.

    Parameters
    ----------
    found : PhotoI
        The correction.
    design : ReseauDesign
        The reseau.
    view : PlaneMapping
        From the plane of the reseau to the image, without noise.

    Raises
    ------
    UsageError
        When the correction comes from a file and not from a fit.
    """
    camera, fit = found.camera, found.camera.fit
    if fit is None:
        raise UsageError("was not fitted here", where="correction")
    plane = dict(zip(design.ids, design.xy, strict=True))

    def true_photo(names: tuple[str, ...]) -> Array:
        exact = view(np.array([plane[name] for name in names]).reshape(-1, 2))
        return camera.photo_system(exact)

    marks = found.points
    errors = marks.xy - view(np.array([plane[name] for name in marks.names]))
    exact = ImagePoints(fit.points.names, true_photo(fit.points.names), fit.points.cov)
    noise_free = fit_mapping(camera.model, exact, fit.target).required()
    ideal = camera.model.with_values(noise_free.values)
    check_photo = ImagePoints(
        fit.check.names, camera.photo_system(marks.select(fit.check.names).xy), np.array(fit.check.cov)
    )
    best, best_check = similarity_residuals(fit.points, fit.target, check_photo, fit.check_target)
    raw, raw_check = fit.points.xy - fit.target, check_photo.xy - fit.check_target
    sigma = np.sqrt(np.diagonal(camera.cofactor))
    free = sigma > 0
    shift = (camera.model.values - ideal.values)[free] / sigma[free]
    return Comparison(
        unit=design.unit,
        marks=len(fit.points),
        checked=len(fit.check),
        position_px=_rms(errors),
        position_normalised=_rms(errors / marks.sigma),
        stages=(
            Stage("common system only", _rms(raw), _rms(raw_check)),
            Stage("best similarity", _rms(best), _rms(best_check)),
            Stage("corrected", _rms(fit.residuals), _rms(fit.check.xy - fit.check_target)),
        ),
        approximation=_rms(ideal(exact.xy) - fit.target),
        check_normalised=_rms((fit.check.xy - ideal(true_photo(fit.check.names))) / fit.check.sigma),
        coefficients_normalised=float(np.sqrt((shift**2).mean())),
    )


def comparison_table(truth: Comparison) -> str:
    """The comparison as a short table of text."""
    unit = truth.unit
    lines = [f"rms against the design, {unit:<12}     fitted marks        check marks"]
    lines.append(f"{'':31}" + 2 * f"{'x':>10}{'y':>9}")
    for stage in truth.stages:
        numbers = "".join(f"{x:10.4f}{y:9.4f}" for x, y in (stage.fitted, stage.check))
        lines.append(f"  {stage.name:29}{numbers}")
    x, y = truth.approximation
    lines.append(f"  {'approximation by the model':29}{x:10.4f}{y:9.4f}")
    lines.append("against the truth")
    x, y = truth.position_px
    lines.append(f"  {'measured positions, px':29}{x:10.4f}{y:9.4f}")
    for label, values in (
        ("… in their sigmas", truth.position_normalised),
        ("check marks in their sigmas", truth.check_normalised),
    ):
        lines.append(f"  {label:29}{values[0]:10.2f}{values[1]:9.2f}")
    lines.append(f"  {'coefficients in their sigmas':29}{truth.coefficients_normalised:10.2f}")
    return "\n".join(lines) + "\n"
