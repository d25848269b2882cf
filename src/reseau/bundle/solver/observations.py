"""Observations that are no image coordinates: distances, coordinates, interior orientation, readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.data import Array, Mask, Rows
from ..network import Network, perpendicular
from .values import Values

__all__ = ["OtherObservations"]


@dataclass(frozen=True, eq=False)
class OtherObservations:
    """Observations that are no image coordinates: distances, coordinates, interior orientation, readings.

    Parameters
    ----------
    ends : ndarray of int (d, 2)
        Points of the distances.
    coordinate : ndarray of int (q, 2)
        Point and axis of the observed coordinates.
    interior : ndarray of int (i, 2)
        Camera and row of the observed parameter.
    reading : ndarray of int (r,)
        Images of a stage's readings.
    across : ndarray (3, t)
        Two directions at right angles to the axis that a stage should have: along them it is observed to be
        zero; none without a stage.
    value, sigma : ndarray (d + q + i + r + t,)
        What was observed, and how well, in this order.
    """

    ends: Rows
    coordinate: Rows
    interior: Rows
    reading: Rows
    across: Array
    value: Array
    sigma: Array

    @classmethod
    def of(cls, network: Network, active: Mask, xyz: Array) -> OtherObservations:
        """Those of a network; coordinates `xyz` (p, 3) are reduced ones, of points that take part."""
        interior = [
            (c, camera.names.index(name), camera.sigma[name])
            for c, camera in enumerate(network.cameras)
            for name in camera.free
            if name in camera.sigma
        ]
        coordinate = np.argwhere(network.observed & active[:, None]).astype(np.intp)
        at = np.array([(c, row) for c, row, _ in interior], dtype=np.intp).reshape(-1, 2)
        j, axis = coordinate.T
        stage = network.stage
        read = np.zeros(0) if stage is None else stage.reading
        across_axis = np.zeros((3, 0)) if stage is None else perpendicular(stage.axis)
        tilts = across_axis.shape[1]
        return cls(
            network.distance_of,
            coordinate,
            at,
            np.arange(len(read), dtype=np.intp),
            across_axis,
            np.concatenate(
                [
                    network.distance[:, 0],
                    xyz[j, axis],
                    [network.cameras[c].values[row] for c, row in at],
                    read,
                    np.zeros(tilts),
                ]
            ),
            np.concatenate(
                [
                    network.distance[:, 1],
                    network.sigma[j, axis],
                    [s for *_, s in interior],
                    np.full(len(read), 0.0 if stage is None else stage.sigma),
                    np.full(tilts, 0.0 if stage is None else stage.axis_sigma),
                ]
            ),
        )

    @property
    def slices(self) -> tuple[slice, slice, slice]:
        """Where distances, coordinates and interior orientation stand in `value`; a stage's come last."""
        d, q = len(self.ends), len(self.coordinate)
        return slice(0, d), slice(d, d + q), slice(d + q, d + q + len(self.interior))

    @property
    def readings(self) -> slice:
        """Where the readings of a stage stand in `value`."""
        start = len(self.ends) + len(self.coordinate) + len(self.interior)
        return slice(start, start + len(self.reading))

    @property
    def tilts(self) -> slice:
        """Where the two angles of its axis do."""
        return slice(self.readings.stop, len(self.value))

    def computed(self, values: Values) -> Array:
        """What the values give for them."""
        a, b = values.xyz[self.ends[:, 0]], values.xyz[self.ends[:, 1]]
        return np.concatenate(
            [
                np.linalg.norm(b - a, axis=1),
                values.xyz[self.coordinate[:, 0], self.coordinate[:, 1]],
                values.cameras[self.interior[:, 0], self.interior[:, 1]],
                [] if values.stage is None else values.stage.reading[self.reading],
                [] if values.stage is None else values.stage.axis @ self.across,
            ]
        )
