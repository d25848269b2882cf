"""The linear problem of an adjustment at given values: weighted derivatives of all observations."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy

from ...core.data import Array, Rows
from .camera_basis import CameraBasis, camera_bases, with_bases
from .normal import through
from .system import System
from .values import Values


class Linear:
    """The linear problem at given values.

    Parameters
    ----------
    rows : ndarray (n, 2, w)
        Weighted derivatives of the image coordinates, in point order; the last three are by the point.
    misfits : ndarray (n, 2)
        Weighted misfits.
    other_misfits : ndarray
        Weighted misfits of the other observations.
    """

    def __init__(
        self, system: System, values: Values, rows: Array, misfits: Array, other_misfits: Array
    ) -> None:
        self.system, self.values = system, values
        self.rows, self.misfits, self.other_misfits = rows, misfits, other_misfits

    @property
    def cost(self) -> float:
        """vᵀPv."""
        return float((self.misfits**2).sum() + self.other_misfits @ self.other_misfits)

    @cached_property
    def transformation(self) -> Array:
        """T (u, size): reduced unknowns from the independent ones, with a stage or a rig."""
        constraints = self.system.constraints
        if constraints is None:
            raise AssertionError("only with a stage or a rig")
        return constraints.matrix(self.values.placed)

    @cached_property
    def sparse_transformation(self) -> scipy.sparse.csr_array:
        """The same without its zeros."""
        return scipy.sparse.csr_array(self.transformation)

    @cached_property
    def constraint_slopes(self) -> Array:
        """Weighted derivatives (a, size) of the last of the other observations, those of a stage or a rig.

        These are readings and axis of a stage, then the known bases of a rig.
        """
        constraints, others, values = self.system.constraints, self.system.others, self.values
        slopes = [np.zeros((0, self.transformation.shape[1]))]
        if constraints is not None and constraints.stage is not None and values.stage is not None:
            seen = (others.reading, others.tilt, others.shift, others.nominal)
            slopes.append(constraints.stage.slopes(values.stage, *seen))
        if constraints is not None and constraints.rig is not None and values.rig is not None:
            own = constraints.rig.slopes(values.rig, others.bases)
            if constraints.stage is not None and values.stage is not None:
                # No base depends on exposures: of the independent unknowns, only the others do.
                through = np.zeros((len(own), constraints.size))
                through[:, : len(constraints.stage.others)] = own[:, constraints.stage.others]
                own = through
            slopes.append(own)
        root = self.system.sigma_root[others.readings.start :]
        return np.concatenate(slopes) * root[:, None]

    @cached_property
    def prior(self) -> Array:
        """Weights of observed coordinates of eliminated points, and weighted misfits (p, 3, 2)."""
        network, others = self.system.unknowns.network, self.system.others
        prior = np.zeros((len(network.points), 3, 2))
        prior[..., 0] = np.where(self.system.movable == 0, 1.0, 0.0)
        at = others.slices[1]
        j, axis = others.coordinate.T
        root = self.system.sigma_root[at]
        prior[j, axis, 0] += root**2
        # Points without rays, and without an observed coordinate that is used, are not moved.
        prior[..., 0] = np.where((prior[..., 0] == 0) & (network.rays == 0)[:, None], 1.0, prior[..., 0])
        prior[j, axis, 1] = root * self.other_misfits[at]
        return prior

    def slopes(self) -> list[tuple[int, Rows, Array]]:
        """Return number, columns and weighted derivatives of observations of several reduced unknowns.

        These are distances (six columns each) and combinations of the parameters of a camera.
        """
        system, slopes = self.system, []
        for k, (a, b) in enumerate(system.others.ends):
            along = self.values.xyz[b] - self.values.xyz[a]
            along = along / np.linalg.norm(along) * system.sigma_root[k]
            slope = np.concatenate([-along * system.movable[a], along * system.movable[b]])
            column = np.concatenate([system.unknowns.kept[e] + np.arange(3) for e in (a, b)])
            slopes.append((k, column, slope))
        unknowns, others = system.unknowns, system.others
        for k, (c, row) in enumerate(zip(others.joint, others.combination, strict=True)):
            if unknowns.camera[c] < 0:
                continue
            at, count = others.combinations.start + k, unknowns.count[c]
            slope = row[unknowns.free[c, :count]] * system.sigma_root[at]
            slopes.append((at, unknowns.camera[c] + np.arange(count), slope))
        return slopes

    @cached_property
    def bases(self) -> tuple[CameraBasis, ...]:
        """Combinations of the parameters of cameras for which the normal equations are formed."""
        system, others = self.system, self.system.others
        if system.constraints is not None:
            return ()
        observed = {*others.interior[:, 0].tolist(), *others.joint.tolist()}
        return camera_bases(system.unknowns, system.seen.camera, observed, self.rows)

    @cached_property
    def turned_rows(self) -> Array:
        """Derivatives of the image coordinates (n, 2, w) by these combinations."""
        return with_bases(self.rows, self.system.unknowns, self.system.seen.camera, self.bases)

    @cached_property
    def other_rows(self) -> scipy.sparse.csr_array:
        """Weighted derivatives of the other observations by the reduced unknowns (k, u)."""
        root = self.system.sigma_root
        rows, columns = self.system.prior_column
        row, column, value = [rows], [columns], [root[rows]]
        for k, columns, slope in self.slopes():
            row.append(np.full(len(columns), k))
            column.append(columns)
            value.append(slope)
        at = (np.concatenate(row), np.concatenate(column))
        shape = (len(root), self.system.unknowns.size)
        return scipy.sparse.csr_array((np.concatenate(value), at), shape=shape)

    @cached_property
    def blocks(self) -> Array | None:
        """Derivatives (m, 6, 12) of poses by exposures and cameras of a rig; None where T is needed."""
        constraints, values = self.system.constraints, self.values
        rig = None if constraints is None else constraints.sparse
        if rig is None or values.rig is None:
            return None
        return rig.blocks(values.rig, values.rotation, values.x0)

    @cached_property
    def rows_through(self) -> Array:
        """Derivatives of the image coordinates (n, 2, w + 6) by the independent unknowns of a rig."""
        if self.blocks is None:
            raise AssertionError("only for a rig whose rays depend on one exposure and one camera each")
        unknowns, image = self.system.unknowns, self.system.seen.image
        place = unknowns.width - 3 - unknowns.extra_width - unknowns.bent_width
        rows = np.zeros((len(image), 2, unknowns.width + 6))
        through(self.rows, image, self.blocks, place, rows)
        return rows


def linearised(system: System, values: Values) -> Linear:
    """Compute the linear problem at given values."""
    return Linear(system, values, *system.derivatives(values))
