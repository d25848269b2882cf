"""Observations that are no image coordinates: distances, coordinates, interior orientation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..data import Array, Mask, Rows
from .network import Network
from .values import Values

__all__ = ["Further"]


@dataclass(frozen=True, eq=False)
class Further:
    """Observations that are no image coordinates: distances, coordinates, interior orientation.

    Parameters
    ----------
    ends : ndarray of int (d, 2)
        Points of the distances.
    coordinate : ndarray of int (q, 2)
        Point and axis of the observed coordinates.
    interior : ndarray of int (i, 2)
        Camera and row of the observed parameter.
    value, sigma : ndarray (d + q + i,)
        What was observed, and how well, in this order.
    """

    ends: Rows
    coordinate: Rows
    interior: Rows
    value: Array
    sigma: Array

    @classmethod
    def of(cls, network: Network, active: Mask, xyz: Array) -> Further:
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
        return cls(
            network.distance_of,
            coordinate,
            at,
            np.concatenate(
                [
                    network.distance[:, 0],
                    xyz[j, axis],
                    [network.cameras[c].values[row] for c, row in at],
                ]
            ),
            np.concatenate([network.distance[:, 1], network.sigma[j, axis], [s for *_, s in interior]]),
        )

    @property
    def slices(self) -> tuple[slice, slice, slice]:
        """Where distances, coordinates and interior orientation stand in `value`."""
        d, q = len(self.ends), len(self.coordinate)
        return slice(0, d), slice(d, d + q), slice(d + q, len(self.value))

    def computed(self, values: Values) -> Array:
        """What the values give for them."""
        a, b = values.xyz[self.ends[:, 0]], values.xyz[self.ends[:, 1]]
        return np.concatenate(
            [
                np.linalg.norm(b - a, axis=1),
                values.xyz[self.coordinate[:, 0], self.coordinate[:, 1]],
                values.cameras[self.interior[:, 0], self.interior[:, 1]],
            ]
        )
