"""Observations other than image coordinates: distances, coordinates, parameters, stage, bases of a rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...core.errors import UsageError
from ..network.camera import Camera
from ..network.network import Network
from ..network.stage import perpendicular
from .values import Values


@dataclass(frozen=True, eq=False)
class OtherObservations:
    """Observations other than image coordinates: distances, coordinates, parameters, stage, bases of a rig.

    Parameters
    ----------
    ends : ndarray of int (d, 2)
        End points of the distances.
    coordinate : ndarray of int (q, 2)
        Point and axis of the observed coordinates.
    interior : ndarray of int (i, 2)
        Camera and row of each parameter observed by itself.
    joint : ndarray of int (k,)
        Camera of each parameter observed with a joint covariance C = L Lᵀ.
    combination : ndarray (k, w)
        Rows of L⁻¹: the observations are the uncorrelated combinations L⁻¹ p of the parameters p.
    refraction : ndarray of int (w,)
        Rows of the observed parameters of windows and media.
    motion : ndarray of int (v, 2)
        Image and component of the observed velocities and rotation rates.
    reading : ndarray of int (r,)
        Images of the stage readings.
    tilt, shift : ndarray (3, t) and (3, h)
        Two directions perpendicular to the nominal axis of a stage; the components along them of its
        direction, and of its distance from its nominal position, are observed as zero. Empty where they are
        not observed.
    nominal : ndarray (3,)
        Nominal position of a rotary axis, in reduced coordinates.
    bases : ndarray of int (b, 2)
        Cameras of the known bases of a rig.
    value, sigma : ndarray (d + q + i + k + w + v + r + t + h + b,)
        Observed values and their standard deviations, in this order.
    """

    ends: Rows
    coordinate: Rows
    interior: Rows
    joint: Rows
    combination: Array
    refraction: Rows
    motion: Rows
    reading: Rows
    tilt: Array
    shift: Array
    nominal: Array
    bases: Rows
    value: Array
    sigma: Array

    @classmethod
    def of(cls, network: Network, active: Mask, xyz: Array, origin: Array | None = None) -> OtherObservations:
        """Collect the observations of a network.

        `xyz` (p, 3) are reduced, that is counted from `origin` (3,), and `active` the adjusted points.
        """
        interior = [
            (c, camera.names.index(name), camera.sigma[name])
            for c, camera in enumerate(network.cameras)
            for name in camera.free
            if name in camera.sigma
        ]
        coordinate = np.argwhere(network.observed & active[:, None]).astype(np.intp)
        at = np.array([(c, row) for c, row, _ in interior], dtype=np.intp).reshape(-1, 2)
        joint, combination, observed = _combinations(network.cameras)
        bent = network.refraction
        windows = np.zeros(0, np.intp) if bent is None else np.flatnonzero(bent.free & (bent.sigma > 0))
        j, axis = coordinate.T
        moved = np.argwhere(network.motion_sigma > 0).astype(np.intp)
        read, tilt, shift, nominal = _of_stage(network)
        stage, more = network.stage, tilt.shape[1] + shift.shape[1]
        known = np.zeros((0, 2)) if network.rig is None else network.rig.base
        return cls(
            network.distance_of,
            coordinate,
            at,
            joint,
            combination,
            windows.astype(np.intp),
            moved,
            read,
            tilt,
            shift,
            nominal - (np.zeros(3) if origin is None else origin),
            np.zeros((0, 2), dtype=np.intp) if network.rig is None else network.rig.base_of,
            np.concatenate(
                [
                    network.distance[:, 0],
                    xyz[j, axis],
                    [network.cameras[c].values[row] for c, row in at],
                    observed,
                    [] if bent is None else bent.values[windows],
                    network.motions[moved[:, 0], moved[:, 1]],
                    [] if stage is None else stage.reading[read],
                    np.zeros(more),
                    known[:, 0],
                ]
            ),
            np.concatenate(
                [
                    network.distance[:, 1],
                    network.sigma[j, axis],
                    [s for *_, s in interior],
                    np.ones(len(joint)),
                    [] if bent is None else bent.sigma[windows],
                    network.motion_sigma[moved[:, 0], moved[:, 1]],
                    [] if stage is None else stage.sigmas[read],
                    np.full(tilt.shape[1], 0.0 if stage is None else stage.axis_sigma),
                    np.full(shift.shape[1], 0.0 if stage is None else stage.point_sigma),
                    known[:, 1],
                ]
            ),
        )

    @property
    def slices(self) -> tuple[slice, slice, slice]:
        """Positions of distances, coordinates and single interior parameters in `value`."""
        d, q = len(self.ends), len(self.coordinate)
        return slice(0, d), slice(d, d + q), slice(d + q, d + q + len(self.interior))

    @property
    def combinations(self) -> slice:
        """Positions of the combinations of interior parameters in `value`."""
        start = self.slices[2].stop
        return slice(start, start + len(self.joint))

    @property
    def windows(self) -> slice:
        """Positions of the parameters of windows and media in `value`."""
        start = self.combinations.stop
        return slice(start, start + len(self.refraction))

    @property
    def motions(self) -> slice:
        """Positions of velocities and rotation rates in `value`."""
        start = self.windows.stop
        return slice(start, start + len(self.motion))

    @property
    def readings(self) -> slice:
        """Positions of the stage readings in `value`."""
        start = self.motions.stop
        return slice(start, start + len(self.reading))

    @property
    def tilts(self) -> slice:
        """Positions of the observed components of the axis of a stage in `value`."""
        start = self.readings.stop
        return slice(start, start + self.tilt.shape[1] + self.shift.shape[1])

    @property
    def base_lengths(self) -> slice:
        """Positions of the bases of a rig in `value`."""
        return slice(self.tilts.stop, len(self.value))

    def computed(self, values: Values) -> Array:
        """Compute the observations from the unknowns."""
        a, b = values.xyz[self.ends[:, 0]], values.xyz[self.ends[:, 1]]
        width = self.combination.shape[1]
        return np.concatenate(
            [
                np.linalg.norm(b - a, axis=1),
                values.xyz[self.coordinate[:, 0], self.coordinate[:, 1]],
                values.cameras[self.interior[:, 0], self.interior[:, 1]],
                (self.combination * values.cameras[self.joint, :width]).sum(axis=1),
                values.refraction[self.refraction],
                values.motion[self.motion[:, 0], self.motion[:, 1]],
                [] if values.stage is None else values.stage.reading[self.reading],
                [] if values.stage is None else values.stage.axis @ self.tilt,
                [] if values.stage is None else (values.stage.foot(self.nominal) - self.nominal) @ self.shift,
                [] if values.rig is None else values.rig.lengths(self.bases),
            ]
        )


def _of_stage(network: Network) -> tuple[Rows, Array, Array, Array]:
    """Images of observed readings, directions of observed components of the axis, nominal position."""
    nothing, stage = np.zeros((3, 0)), network.stage
    if stage is None:
        return np.zeros(0, dtype=np.intp), nothing, nothing, np.zeros(3)
    with np.errstate(invalid="ignore"):
        observed = (stage.pose >= 0) & (stage.sigmas > 0)
    read = np.flatnonzero(observed & (network.same_reading == np.arange(len(observed))))
    across = nothing if stage.axis is None else perpendicular(stage.axis / np.linalg.norm(stage.axis))
    tilt = across if 0 < stage.axis_sigma < np.inf else nothing
    shift = across if 0 < stage.point_sigma < np.inf else nothing
    return read.astype(np.intp), tilt, shift, np.zeros(3) if stage.point is None else stage.point


def _combinations(cameras: Sequence[Camera]) -> tuple[Rows, Array, Array]:
    """Return cameras, coefficients and values of uncorrelated combinations of jointly observed parameters."""
    width = max(len(camera.names) for camera in cameras)
    joint, rows, observed = list[int](), [np.zeros((0, width))], [np.zeros(0)]
    for c, camera in enumerate(cameras):
        if camera.covariance is None:
            continue
        sigma = np.sqrt(np.diag(camera.covariance))
        at = [k for k in (camera.names.index(name) for name in camera.free) if sigma[k] > 0]
        if not at:
            continue
        scale = sigma[at]
        try:
            root = np.linalg.cholesky(camera.covariance[np.ix_(at, at)] / np.outer(scale, scale))
        except np.linalg.LinAlgError:
            raise UsageError(
                "the covariance of its parameters is not positive definite",
                where=f"camera {camera.id}",
            ) from None
        coefficients = np.zeros((len(at), width))
        coefficients[:, at] = scipy.linalg.solve_triangular(root, np.diag(1.0 / scale), lower=True)
        joint += [c] * len(at)
        rows.append(coefficients)
        observed.append(coefficients[:, : len(camera.values)] @ camera.values)
    return np.array(joint, dtype=np.intp), np.concatenate(rows), np.concatenate(observed)
