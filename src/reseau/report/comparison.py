"""Comparison of results with the truth of a simulator."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.data import Array, ImagePoints
from ..core.errors import UsageError
from ..io import ReseauDesign
from ..measure.fitting import fit_mapping
from ..optics.mapping import PlaneMapping
from ..procedures.oscilloscope import PhotoI, PhotoII, PhotoIII
from .factors import best_similarity, factor_by_factor, identified
from .tables import rms_pair
from .truth import BodyComparison, CameraComparison, Comparison, Known, KnownPoints, RodComparison, Stage


def similarity_residuals(
    points: ImagePoints, target: Array, others: ImagePoints, others_target: Array
) -> tuple[Array, Array]:
    """Return the residuals of the best similarity at fitted points and at other points.

    Parameters
    ----------
    points, others : ImagePoints
        Photo-coordinates.
    target, others_target : ndarray (n, 2), (m, 2)
        Design coordinates.

    Returns
    -------
    ndarray (n, 2), ndarray (m, 2)
        Transformed minus design coordinates.
    """
    best = best_similarity(points.xy, target)
    return best(points.xy) - target, best(others.xy) - others_target


def compare_with_truth(
    known: Known,
    first: PhotoI,
    reseau: ReseauDesign,
    second: PhotoII | None = None,
    test_object: ReseauDesign | None = None,
    third: Sequence[PhotoIII] = (),
) -> Comparison:
    """Compare the results of the procedure with the truth.

    Parameters
    ----------
    known : Known
        The truth.
    first, second, third : PhotoI, PhotoII, sequence of PhotoIII
        Results for the photographs.
    reseau, test_object : ReseauDesign
        The designs.

    Raises
    ------
    UsageError
        When a correction comes from a file and not from a fit.
    """
    camera = compare_camera(first, reseau, known.view)
    if second is None or test_object is None:
        return Comparison(reseau.unit, camera)
    return Comparison(
        reseau.unit,
        camera,
        None if known.rods is None else _compare_rods(second, test_object, known.rods),
        tuple(_compare_body(found, body) for found, body in zip(third, known.bodies, strict=False)),
        factor_by_factor(second, test_object, third, known),
    )


def compare_camera(found: PhotoI, design: ReseauDesign, view: PlaneMapping) -> CameraComparison:
    """Compare group A with the truth.

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
    return CameraComparison(
        marks=len(fit.points),
        checked=len(fit.check),
        position_px=rms_pair(errors),
        position_normalised=rms_pair(errors / marks.sigma),
        stages=(
            Stage("common system only", rms_pair(raw), rms_pair(raw_check)),
            Stage("best similarity", rms_pair(best), rms_pair(best_check)),
            Stage("corrected", rms_pair(fit.residuals), rms_pair(fit.check.xy - fit.check_target)),
        ),
        approximation=rms_pair(ideal(exact.xy) - fit.target),
        check_normalised=rms_pair((fit.check.xy - ideal(true_photo(fit.check.names))) / fit.check.sigma),
        coefficients_normalised=float(np.sqrt((shift**2).mean())),
    )


def _compare_rods(second: PhotoII, test_object: ReseauDesign, made: KnownPoints) -> RodComparison:
    pins = second.pins if second.measured is None else second.measured.points
    row_of = {name: i for i, name in enumerate(made.names)}
    at = [row_of[name] for name in pins.names]
    errors = pins.xy - made.xy[at]
    designed = dict(zip(test_object.ids, test_object.xy, strict=True))
    off = made.object_xy[at] - np.array([designed[name] for name in pins.names])
    return RodComparison(
        len(pins), len(made.names), rms_pair(errors), rms_pair(errors / pins.sigma), rms_pair(off)
    )


def _compare_body(found: PhotoIII, known: KnownPoints) -> BodyComparison:
    row = identified(found.true, known)
    is_one = row >= 0
    at, names = row[is_one], [name for name, one in zip(found.true.names, is_one, strict=True) if one]
    true = found.true.select(names)
    seen = (found.points if found.measured is None else found.measured.points).select(names)
    position, error = seen.xy - known.xy[at], true.xy - known.object_xy[at]
    return BodyComparison(
        points=len(names),
        known=len(known.names),
        strays=int((~is_one).sum()),
        position_px=rms_pair(position),
        position_normalised=rms_pair(position / seen.sigma),
        error=rms_pair(error),
        error_normalised=rms_pair(error / true.sigma),
        sigma=rms_pair(true.sigma),
        identity={name: known.names[i] for name, i in zip(names, at, strict=True)},
        errors={name: (float(x), float(y)) for name, (x, y) in zip(names, error, strict=True)},
    )
