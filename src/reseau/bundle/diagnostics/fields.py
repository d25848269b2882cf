"""The mapping of an adjusted camera, and the uncertainty of its projection at finite distances."""

from __future__ import annotations

import numpy as np

from ...calibration.camera import CameraMapping, ProjectionField, Rival, by_rotation, places, reach
from ...calibration.rectification import Pair
from ...core.data import Array, Rows
from ...core.errors import UsageError
from .checks import listed
from .result import Result


def camera_mapping(
    result: Result, c: int, additional: str | None = None, *, formal: bool = False
) -> CameraMapping:
    """Return the mapping of an adjusted camera with its covariance.

    Parameters
    ----------
    result : Result
        The adjustment.
    c : int
        Row of the camera.
    additional : str, optional
        Set of additional parameters, ``group G`` or ``image I``; required where there are several.
    formal : bool
        Whether its covariance is the one that presumes independent errors of all image points.

    Raises
    ------
    UsageError
        When there is no such set, or there are several sets and none is named.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> camera = camera_mapping(result, 0)
    >>> camera.names, camera.width
    (('c', 'x0', 'y0', 'K1'), 640)
    """
    camera = result.network.cameras[c]
    names, columns, values = own_columns(result, c, additional)
    found = camera.parameters | dict(zip(names, values.tolist(), strict=True))
    rivals = tuple[Rival, ...]()
    if formal:
        covariance = result.fit.cofactors.reduced.block(columns, columns) * result.fit.variance
        degrees = float("inf")
    else:
        uncertain = result.uncertainty(columns)
        degrees = uncertain.degrees
        names, covariance, _ = result.with_considered(c, names, columns, uncertain.covariance)
        rivals = result.rivals_of(c)
    size, plane = (camera.width, camera.height), camera.plane_mapping()
    return CameraMapping.of_estimates(plane, size, found, names, covariance, dof=degrees, rivals=rivals)


def pair_of(result: Result, c: int) -> Pair:
    """Return a camera and its reference on a rig, with their joint covariance.

    Parameters
    ----------
    result : Result
        The adjustment.
    c : int
        Row of a camera that has a place on the rig.

    Raises
    ------
    UsageError
        When it has none.
    """
    found, places = result.places_by_reduced, result.fit.values.rig
    if found is None or places is None or c not in found[0]:
        raise UsageError("has no place with respect to another camera", where=result.network.cameras[c].label)
    k = int(np.flatnonzero(found[0] == c)[0])
    by_place, every, share = found[2][k], (int(found[1][k]), c), 1.0
    lenses, columns = [], []
    for each in every:
        lenses.append(camera_mapping(result, each))
        columns.append(result.camera_columns(each)[1])
        uncertain = result.uncertainty_of_points(columns[-1])
        root = np.linalg.pinv(uncertain.formal, hermitian=True)
        # As one variance: what the points of an image share makes both cameras and their places uncertain.
        share = max(share, float(np.trace(root @ uncertain.covariance)) / max(len(root), 1))
    starts, count = (0, len(lenses[0].rows)), sum(len(lens.rows) for lens in lenses)
    by = np.zeros((count + 6, by_place.shape[1]))
    by[count:] = by_place
    for start, own in zip(starts, columns, strict=True):
        by[start + np.arange(len(own)), own] = 1.0
    covariance = share * result.fit.variance * by @ result.fit.cofactors.reduced.full @ by.T
    for start, own, each in zip(starts, columns, every, strict=True):
        held = result.considered.get(each)
        if held is not None and held.names:
            slope = -by @ held.by
            slope[start + len(own) + np.arange(len(held.names))] = np.eye(len(held.names))
            covariance += slope @ held.square @ slope.T
    return Pair((lenses[0], lenses[1]), places.rotation[c], places.base[c], result.network.unit, covariance)


def own_columns(result: Result, c: int, additional: str | None) -> tuple[tuple[str, ...], Rows, Array]:
    """Return names, columns and values of the estimated parameters of a camera, with one additional set."""
    names, columns, values = result.camera_columns(c)
    camera = result.network.cameras[c]
    if camera.additional is None or camera.additional.per == "camera":
        return names, columns, values
    keep = [k for k, name in enumerate(names) if " of " not in name]
    own = [k for k, name in enumerate(names) if name.endswith(f" of {additional}")]
    if not own:
        sets = dict.fromkeys(name.partition(" of ")[2] for name in names if " of " in name)
        raise UsageError(
            "is not a set of additional parameters of this camera",
            where=f"{additional or 'none'}",
            do="name one of " + listed(sets),
        )
    keep += own
    return tuple(names[k].partition(" of ")[0] for k in keep), columns[keep], values[keep]


def projection_field_at(
    result: Result,
    c: int,
    distance: float,
    additional: str | None = None,
    across: int = 25,
    down: int | None = None,
) -> ProjectionField:
    """Compute the uncertainty of the projection of object points at a finite distance.

    Parameters
    ----------
    result : Result
        The adjustment.
    c : int
        Row of the camera.
    distance : float
        Distance of the points from the projection centre, in the unit of object space.
    additional : str, optional
        Set of additional parameters; required where there are several.
    across, down : int
        Number of positions along the axes, from edge to edge; `down` is proportional by default.

    Raises
    ------
    UsageError
        For a distance that is not positive, a camera without images or behind windows, or fewer than two
        positions.

    Notes
    -----
    A point p in the camera system is transformed to object space with the true pose of each image and back
    with the estimated one: dp = mean(δᵢ × p − Rᵢ dX0ᵢ). Errors of the interior orientation that the poses
    compensate cancel; the joint covariance of both is used (Kogan, *mrcal*: projection uncertainty by the
    mean of p over the frames). It refers to the datum of the network.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> projection_field_at(result, 0, 4.0, across=3, down=3).sigma.round(2)
    array([[0.18, 0.02, 0.18],
           [0.08, 0.01, 0.08],
           [0.18, 0.02, 0.18]])
    """
    if not distance > 0:
        raise UsageError(f"{distance:g} is not positive", where="distance")
    if result.network.behind_windows(c):
        raise UsageError(
            "the projection of points through windows is not known at a distance",
            where=result.network.cameras[c].label,
        )
    if result.network.cameras[c].parallel:
        raise UsageError(
            "the projection by parallel rays is the same at every distance",
            where=result.network.cameras[c].label,
            do="use the field without a distance",
        )
    camera = camera_mapping(result, c, additional, formal=True)
    _, columns, _ = own_columns(result, c, additional)
    covariance = _with_mean_pose(result, c, columns)
    xy, shape = places(camera, across, down)
    uv = camera.mapping.inverse(xy)
    known = np.isfinite(uv).all(axis=1)
    seen = camera.mapping.derivatives(uv[known])
    ray = np.column_stack([uv[known], np.ones(int(known.sum()))])
    z = distance / np.linalg.norm(ray, axis=1)
    by_point = np.zeros((len(z), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / z
    by_point[:, :, 2] = -uv[known] / z[:, None]
    slope = np.concatenate(
        [
            seen.d_parameters[:, :, camera.rows],
            seen.d_xy @ by_rotation(uv[known]),
            seen.d_xy @ by_point,
        ],
        axis=2,
    )
    cov = np.full((len(xy), 2, 2), np.nan)
    cov[known] = slope @ covariance @ np.swapaxes(slope, 1, 2)
    return ProjectionField(xy.reshape(*shape, 2), cov.reshape(*shape, 2, 2), reach(uv[known], camera))


def _with_mean_pose(result: Result, c: int, columns: Rows) -> Array:
    """Joint covariance of camera parameters and of the means of δᵢ and −Rᵢ dX0ᵢ over the images."""
    unknowns, rotation = result.fit.unknowns, result.fit.values.rotation
    images = np.flatnonzero((unknowns.pose >= 0) & (result.network.camera_of == c))
    if not len(images):
        raise UsageError("has no image", where=f"camera {result.network.cameras[c].id}")
    k, m = len(columns), len(images)
    at = np.concatenate([columns, (unknowns.pose[images, None] + np.arange(6)).ravel()])
    turn = np.zeros((k + 6, len(at)))
    turn[:k, :k] = np.eye(k)
    poses = turn[k:, k:].reshape(6, m, 6)
    poses[:3, :, :3] = np.eye(3)[:, None, :] / m
    poses[3:, :, 3:] = -np.swapaxes(rotation[images], 0, 1) / m
    cofactor = turn @ result.fit.cofactors.reduced.block(at, at) @ turn.T
    return cofactor * result.fit.variance
