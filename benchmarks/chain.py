"""The complete oscilloscope procedure in one world, compared with the truth and the noise-free chain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import group_a
import numpy as np
from photographs import Measured, Physics, measured

from reseau.core.data import Array, ImagePoints, Rows
from reseau.core.failure import Failure
from reseau.io import ReseauDesign
from reseau.measure.fitting import fit_mapping
from reseau.procedures.oscilloscope import PhotoII, photo_i, photo_ii
from reseau.report.factors import correctors, rods_of, with_rods_as_made
from reseau_sims import Truth, World

__all__ = ["FALSE_PX", "FAR_SIGMA", "Errors", "Found", "Trial", "trial"]

FALSE_PX, FAR_SIGMA = 3.0, 5.0
"""Points farther than this from all true ones are false; larger errors in sigmas indicate a wrong sigma."""

Mapping = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Found:
    """Points of a photograph compared with the truth.

    Parameters
    ----------
    known : int
        Points that there are.
    row : ndarray (n,)
        Which of them each found one is, −1 where it is none.
    errors : ndarray (m, 2)
        Errors of the positions of those that are one, over their sigmas.
    px : ndarray (m, 2)
        The same in pixels.
    """

    known: int
    row: Rows
    errors: Array
    px: Array


@dataclass(frozen=True, eq=False)
class Errors:
    """A correction of the instrument against the truth.

    Parameters
    ----------
    coefficients : ndarray (16,)
        Errors of the coefficients of group B over their sigmas.
    jointly : float
        Their weighted square by the whole covariance matrix, over 16.
    chain, truth : ndarray (m, 2)
        Errors of true coordinates over their sigmas, against the noise-free chain and against the truth.
    approximation, sigma : ndarray (m, 2)
        What the noise-free chain leaves of the truth, and standard deviations of the true coordinates, mm.
    factors : dict
        What is left of the errors as one group after the other is taken off, (m, 2) each, mm.
    verdict : str
        Which model of a display is preferred: "first" is the polynomials.
    """

    coefficients: Array
    jointly: float
    chain: Array
    truth: Array
    approximation: Array
    sigma: Array
    factors: dict[str, Array]
    verdict: str


@dataclass(frozen=True, eq=False)
class Trial:
    """One world.

    Parameters
    ----------
    measured : Measured
        What the photographs gave.
    rods, body : Found
        Rods of PHOTO II and points of PHOTO III beside the truth.
    group_a : ndarray (13,)
        Errors of the coefficients of group A over their sigmas; NaN where dropped.
    tolerance, exact : Errors
        With the rods' coordinates as designed and their tolerance, and as they truly are.
    depth : ndarray (m,)
        Of the points of PHOTO III, mm.
    """

    measured: Measured
    rods: Found
    body: Found
    group_a: Array
    tolerance: Errors
    exact: Errors
    depth: Array


def trial(seed: int, physics: Physics, folder: Path | None = None, echoes: str = "beam") -> Trial | str:
    """The procedure in one world; a text if it failed."""
    seen = measured(seed, physics, folder, echoes)
    return seen if isinstance(seen, str) else compared(seen)


def compared(seen: Measured) -> Trial | str:
    """Process the measurements of a world, and compare the results with the truth."""
    world = World.standard(seen.seed, display=seen.physics)
    first = photo_i(seen.marks, world.design)
    if isinstance(first, Failure):
        return f"seed {seen.seed}: {first.reason}"
    camera, truth, rods, body = first.camera, world.truth(), world.truth_ii(), world.truth_iii()
    true_fit = group_a.camera_without_noise(camera, dict(zip(truth.names, truth.xy, strict=True)))
    true_model = camera.model.with_values(true_fit.values)

    def refined(xy: Array) -> Array:
        return true_model(camera.photo_system(xy))

    in_ii = found_of(seen.pins, np.array([rods.names.index(name) for name in seen.pins.names]), rods.xy)
    in_iii = found_of(seen.body, nearest(seen.body.xy, body.xy), body.xy)
    names = [name for name, row in zip(seen.body.names, in_iii.row, strict=True) if row >= 0]
    points, at = seen.body.select(names), in_iii.row[in_iii.row >= 0]
    against = []
    for design in (world.test_object, with_rods_as_made(world.test_object, rods)):
        second = photo_ii(seen.pins, world.design, design, camera)
        if isinstance(second, Failure):
            return f"seed {seen.seed}: {second.reason}"
        true_chain = chain_without_noise(second, design, rods, refined)
        against.append(errors_of(second, true_chain, points, body.xy[at], body.object_xy[at]))
    a = group_a.coefficient_errors(camera, true_fit)
    return Trial(seen, in_ii, in_iii, a, against[0], against[1], -body.object_xy[at, 1])


def nearest(xy: Array, known: Array) -> Rows:
    """For each point the row of the corresponding known point, or −1, (n,)."""
    off = np.hypot(*(xy[:, None] - known[None]).transpose(2, 0, 1))
    row = off.argmin(axis=1)
    mine = (off.argmin(axis=0)[row] == np.arange(len(xy))) & (off.min(axis=1) <= FALSE_PX)
    return np.where(mine, row, -1)


def found_of(points: ImagePoints, row: Rows, known: Array) -> Found:
    """Count and compare positions; points far from all known points are false."""
    off = points.xy - known[row]
    row = np.where(np.hypot(*off.T) <= FALSE_PX, row, -1)
    right = row >= 0
    return Found(len(known), row, (off / points.sigma)[right], off[right])


def chain_without_noise(
    second: PhotoII, design: ReseauDesign, rods: Truth, refined: Mapping
) -> tuple[Array, Mapping]:
    """Group B adjusted to noise-free images and true positions of the rods.

    Parameters
    ----------
    second : PhotoII
        What the measured positions gave: model, weights and common system are taken from it.
    design : ReseauDesign
        What it was fitted to; of it the tolerance of the rods.
    rods : Truth
        The rods.
    refined : callable
        Group A without noise, from pixels to the common system.

    Returns
    -------
    values : ndarray (16,)
        The coefficients.
    chain : callable
        From pixels to object coordinates.
    """
    instrument, fit = second.instrument, second.instrument.fit
    assert fit is not None
    names, plane = fit.points.names, instrument.plane
    exact = dict(zip(rods.names, rods.xy, strict=True))
    made = dict(zip(rods.names, rods.object_xy, strict=True))
    tolerance = {point.id: point.sigma or 0.0 for point in design.points}
    target = plane.to_common(np.array([made[name] for name in names]))
    sigma = np.array([tolerance[name] for name in names])[:, None] * plane.scale
    used = group_a.without_noise(fit.points, exact, refined)
    found = fit_mapping(instrument.model, used, target, sigma).required()
    model = instrument.model.with_values(found.values)
    return found.values, lambda xy: plane.from_common(model(refined(xy)))


def errors_of(
    second: PhotoII, without_noise: tuple[Array, Mapping], points: ImagePoints, pixels: Array, xy: Array
) -> Errors:
    """Coefficients and true coordinates against the noise-free chain; `pixels` and `xy` are the truth."""
    instrument, fit = second.instrument, second.instrument.fit
    assert fit is not None
    values, chain = without_noise
    b = len(instrument.camera.model.names)
    covariance = instrument.covariance[b:, b:]
    sigma = np.sqrt(np.diagonal(covariance))
    normalised = (instrument.model.values - values) / sigma
    correlation = covariance / np.outer(sigma, sigma)
    true, left = instrument.apply(points), chain(pixels) - xy
    ways = correctors(instrument, rods_of(second), fit.target)
    return Errors(
        coefficients=normalised,
        jointly=float(normalised @ np.linalg.solve(correlation, normalised)) / len(values),
        chain=(true.xy - chain(pixels)) / true.sigma,
        truth=(true.xy - xy) / true.sigma,
        approximation=left,
        sigma=true.sigma,
        factors={name: way(points.xy) - xy for name, way in ways.items()},
        verdict="none" if fit.displays is None else fit.displays.verdict,
    )
