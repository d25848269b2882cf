"""Remaining errors of points after correcting for one group, the other, and both."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..calibration import InstrumentCorrection
from ..core.data import Array, ImagePoints
from ..core.errors import UsageError
from ..core.failure import Failure
from ..io import ReseauDesign
from ..measure.fitting import fit_mapping
from ..optics import RationalPolynomial
from ..optics.mapping import PlaneMapping
from ..procedures.oscilloscope import PhotoII, PhotoIII
from ..refine import correct_instrument
from .tables import rms_pair
from .truth import Factor, Known, KnownPoints

FACTORS = ("scales and best similarity", "group A", "group B", "groups A and B", "(7a, b) without group A")
"""Corrections; the last is for comparison: one polynomial fitted directly to the photo-coordinates."""

Corrector = Callable[[Array], Array]
"""From pixels of PHOTO I to object coordinates, (n, 2)."""

_GATE = 0.3
"""Largest distance of a found point from a true one, as part of the least distance between true points."""


def best_similarity(source: Array, target: Array) -> PlaneMapping:
    """Return the least-squares similarity from points to their targets, with equal weights.

    Raises
    ------
    EstimationError
        When it is not determined.
    """
    model = RationalPolynomial.similarity()
    names = [str(i) for i in range(len(source))]
    return model.with_values(
        fit_mapping(model, ImagePoints.with_sigma(names, source, 1.0), target).required().values
    )


def rods_of(second: PhotoII) -> ImagePoints:
    """Return the images of the rods used to fit group B, in pixels of PHOTO I.

    Raises
    ------
    UsageError
        When the correction was read from a file.
    """
    fit = second.instrument.fit
    if fit is None:
        raise UsageError("was read from a file and has no residuals", where="correction of the instrument")
    return second.pins.select(fit.points.names)


def correctors(instrument: InstrumentCorrection, rods: ImagePoints, target: Array) -> dict[str, Corrector]:
    """Return functions from pixels to object coordinates, with more and more corrections.

    Each except the complete one and the last is followed by the best similarity to the rods, so that
    position, rotation and scale do not count. All use the scales λ1 and λ2.

    Parameters
    ----------
    instrument : InstrumentCorrection
        Groups A and B.
    rods : ImagePoints
        The rods' images in pixels of PHOTO I.
    target : ndarray (n, 2)
        Their coordinates in the common system.

    Returns
    -------
    dict
        By the names in `FACTORS`; without the last where it cannot be fitted.
    """
    photo, camera = instrument.camera.photo_system, instrument.camera.model
    model, plane = instrument.model, instrument.plane

    def aligned(correct: Corrector) -> Corrector:
        similarity = best_similarity(correct(rods.xy), target)
        return lambda xy: plane.from_common(similarity(correct(xy)))

    found = dict(
        zip(
            FACTORS,
            (
                aligned(photo),
                aligned(lambda xy: camera(photo(xy))),
                aligned(lambda xy: model(photo(xy))),
                lambda xy: plane.from_common(model(camera(photo(xy)))),
            ),
            strict=False,
        )
    )
    alone = fit_mapping(model, ImagePoints.with_sigma(rods.names, photo(rods.xy), 1.0), target)
    if not isinstance(alone, Failure):
        direct = model.with_values(alone.values)
        found[FACTORS[-1]] = lambda xy: plane.from_common(direct(photo(xy)))
    return {name: _quiet(corrector) for name, corrector in found.items()}


def _quiet(corrector: Corrector) -> Corrector:
    """Return no coordinates for no points; a mapping needs at least one."""
    return lambda xy: corrector(xy) if len(xy) else np.zeros((0, 2))


def factor_by_factor(
    second: PhotoII,
    test_object: ReseauDesign,
    third: Sequence[PhotoIII] = (),
    known: Known | None = None,
) -> tuple[Factor, ...]:
    """Return the remaining errors after each correction.

    Parameters
    ----------
    second : PhotoII
        Groups A and B.
    test_object : ReseauDesign
        The rods.
    third : sequence of PhotoIII
        Points of bodies.
    known : Known, optional
        The truth; without it only the rods are compared.

    Raises
    ------
    UsageError
        When the correction was read from a file.
    """
    instrument, rods, fit = second.instrument, rods_of(second), second.instrument.fit
    assert fit is not None  # asked by `rods_of`
    designed = dict(zip(test_object.ids, test_object.xy, strict=True))
    xy = np.array([designed[name] for name in rods.names])
    held, body = second.pins.select(fit.check.names), _known_body(third, known)
    ways = correctors(instrument, rods, fit.target)
    ideal = _had_rods_been_known(second, test_object, known)
    return tuple(
        Factor(
            name,
            rms_pair(way(rods.xy) - xy),
            rms_pair(way(held.xy) - fit.check_target) if len(held) else None,
            rms_pair(way(body[0]) - body[1]) if body else None,
            rms_pair(ideal[name](body[0]) - body[1]) if body and name in ideal else None,
        )
        for name, way in ways.items()
    )


def _known_body(third: Sequence[PhotoIII], known: Known | None) -> tuple[Array, Array] | None:
    """Pixels and true coordinates of all points of bodies that the truth knows."""
    pixels, true = [], []
    for found, body in zip(third, () if known is None else known.bodies, strict=False):
        row = identified(found.true, body)
        pixels.append(found.points.xy[row >= 0])
        true.append(body.object_xy[row[row >= 0]])
    return (np.concatenate(pixels), np.concatenate(true)) if sum(map(len, pixels)) else None


def _had_rods_been_known(
    second: PhotoII, test_object: ReseauDesign, known: Known | None
) -> dict[str, Corrector]:
    """The corrections computed with the true coordinates of the rods."""
    if known is None or known.rods is None:
        return {}
    exact = with_rods_as_made(test_object, known.rods)
    rods = rods_of(second)
    found = correct_instrument(rods, exact, second.instrument.camera)
    if isinstance(found, Failure) or found.fit is None:
        return {}
    return correctors(found, rods.select(found.fit.points.names), found.fit.target)


def with_rods_as_made(test_object: ReseauDesign, made: KnownPoints) -> ReseauDesign:
    """Return the test object with the true coordinates of its rods, without tolerance."""
    true = dict(zip(made.names, made.object_xy.tolist(), strict=True))
    points = tuple(
        point.model_copy(update={"x": true[point.id][0], "y": true[point.id][1], "sigma": None})
        for point in test_object.points
    )
    return test_object.model_copy(update={"points": points})


def identified(true: ImagePoints, known: KnownPoints) -> Array:
    """Return for each point found the row of the true point, −1 where there is none, (n,)."""
    apart = np.hypot(*(known.object_xy[:, None] - known.object_xy[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    off = np.hypot(*(true.xy[:, None] - known.object_xy[None]).transpose(2, 0, 1))
    row = off.argmin(axis=1)
    # The nearest true point is taken if no other found point is nearer to it.
    mine = off.argmin(axis=0)[row] == np.arange(len(true))
    near = off.min(axis=1) < _GATE * apart.min()
    return np.where(mine & near, row, -1)
