"""The sparse system of an adjustment: misfits, normal equations and corrections at given values."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import scipy.sparse

from ...adjust.stochastic import Weighting
from ...core.data import Array, Mask, Rows, rows_of_groups
from ...optics import PlaneMapping
from ..network import Network
from .arrow import Arrow, full
from .camera_basis import CameraBasis, camera_bases, with_bases
from .compiled import chunks_of, in_parallel
from .conjugate import Conjugate
from .constraints import Constrained, Constraints
from .imaging import Bent, Imaging, Seen, mapped
from .normal import (
    Pattern,
    Sums,
    assemble,
    assemble_blocks,
    gradients,
    product,
    reduce_sides,
    substitute,
    through,
)
from .observations import OtherObservations
from .unknowns import Unknowns
from .values import Correction, Values

__all__ = ["Linear", "Normal", "System", "residuals"]

# The sums of each part need as much memory as the matrix: large matrices are formed in one part.
_LARGE = 2000
# Relative rounding error of a computed image coordinate.
_ROUNDING = 1e-14


class System:
    """All observations of an adjustment with their weights.

    Parameters
    ----------
    unknowns : Unknowns
        Columns.
    others : OtherObservations
        Observations other than image coordinates.
    weighting : Weighting
        Weights of the image coordinates, in the order of the network.
    factors : ndarray
        Factors on the weights of the other observations.
    held : ndarray of bool (u,)
        Held reduced unknowns.
    origin : ndarray (3,)
        Point of object space from which the coordinates of points are counted.

    Attributes
    ----------
    fixed : ndarray of int
        Independent unknowns of a stage or a rig that are held as the datum.
    iterative : bool
        Whether the normal equations are solved by conjugate gradients, without their matrix.
    """

    def __init__(
        self, unknowns: Unknowns, others: OtherObservations, weighting: Weighting, factors: Array, held: Mask,
        origin: Array,
    ) -> None:  # fmt: skip
        network, order = unknowns.network, unknowns.order
        self.unknowns, self.others, self.held, self.origin = unknowns, others, held, origin
        image = network.image_of[order]
        extra = unknowns.extra_of[image]
        roots = weighting.roots[0].matrices
        self.seen = Seen(
            image, network.point_of[order], network.camera_of[image], extra,
            np.ascontiguousarray(network.xy[order]), np.ascontiguousarray(roots[order]),
        )  # fmt: skip
        self.sigma_root = np.sqrt(factors) / others.sigma
        self.movable = np.where(network.held, 0.0, 1.0)
        self.pattern = unknowns.pattern
        self.constraints = Constraints.of(unknowns)
        self.fixed: Rows = np.zeros(0, dtype=np.intp)
        self.iterative = False
        self.chunks = chunks_of(unknowns.first)
        self.imaging = Imaging(network, unknowns.extra_names, origin, unknowns.mounts)

    @cached_property
    def floor(self) -> float:
        """Sum of squares that is only rounding of the image coordinates."""
        seen = np.einsum("nij,nj->ni", self.seen.root, self.seen.xy)
        return float(_ROUNDING**2 * (seen**2).sum())

    def misfits(self, values: Values) -> tuple[Array, Array]:
        """Return weighted misfits of image coordinates (n, 2), in point order, and of other observations."""
        out = np.empty((len(self.seen.image), 2))
        at, first = values.orientation, self.unknowns.first

        bent, bend = self._bent(values, derivatives=False)

        def work(_: int, a: int, b: int) -> None:
            begin, end = int(first[a]), int(first[b])
            bend(begin, end)
            self.imaging.misfit(begin, end, self.seen, at, bent, values.cameras, values.extra, out)

        in_parallel(work, self.chunks)
        for mapping, _, rows in self.mappings(values):
            xy, *_more = mapped(mapping, at, self.seen.image[rows], self.seen.point[rows], bent, rows)
            out[rows] = self._weighted(rows, (xy - self.seen.xy[rows])[:, :, None])[:, :, 0]
        return out, (self.others.computed(values) - self.others.value) * self.sigma_root

    def _bent(self, values: Values, *, derivatives: bool) -> tuple[Bent, Callable[[int, int], None]]:
        """See :meth:`Imaging.bent`; rays begin where those of the last values were."""
        return self.imaging.bent(
            self.seen, values.orientation, values.refraction, values.rig, derivatives=derivatives,
            crossings=self._crossings,
        )  # fmt: skip

    @cached_property
    def _crossings(self) -> Array | None:
        """Where the rays of the observations cross the surfaces of their windows (n, k, 3), NaN at first."""
        refraction = self.imaging.refraction
        if refraction is None:
            return None
        return np.full((len(self.seen.image), max(refraction.longest, 1), 3), np.nan)

    def mappings(self, values: Values) -> list[tuple[PlaneMapping, int, Rows]]:
        """Return mapping, number and rows of the observations of each camera without a kernel."""
        return _mappings(self.unknowns.network, self.seen.camera, values)

    def _weighted(self, rows: Rows, matrix: Array) -> Array:
        weighted: Array = self.seen.root[rows] @ matrix
        return weighted

    def linearise(self, values: Values) -> Linear:
        """Compute misfits and derivatives at given values."""
        unknowns, n = self.unknowns, len(self.seen.image)
        rows, out = np.zeros((n, 2, unknowns.width)), np.empty((n, 2))
        at, first = values.orientation, unknowns.first
        a_out, b_out = rows[:, :, :-3], rows[:, :, -3:]

        bent, bend = self._bent(values, derivatives=True)

        def work(_: int, a: int, b: int) -> None:
            begin, end = int(first[a]), int(first[b])
            bend(begin, end)
            self.imaging.derive(
                begin, end, self.seen, at, bent, values.cameras, values.extra, unknowns.free, unknowns.count,
                self.movable, out, a_out, b_out,
            )  # fmt: skip

        in_parallel(work, self.chunks)
        for mapping, c, own in self.mappings(values):
            image, point, count = self.seen.image[own], self.seen.point[own], unknowns.count[c]
            xy, by_pose, by_camera, by_point, by_windows = mapped(mapping, at, image, point, bent, own)
            free = by_camera[:, :, unknowns.free[c, :count]]
            b = by_point * self.movable[point][:, None, :]
            out[own] = self._weighted(own, (xy - self.seen.xy[own])[:, :, None])[:, :, 0]
            rows[own, :, : 6 + count] = self._weighted(own, np.concatenate([by_pose, free], axis=2))
            rows[own, :, -3:] = self._weighted(own, b)
            place = unknowns.width - 3 - unknowns.extra_width - by_windows.shape[2]
            rows[own, :, place : place + by_windows.shape[2]] = self._weighted(own, by_windows)
        others = (self.others.computed(values) - self.others.value) * self.sigma_root
        return Linear(self, values, rows, out, others)

    @cached_property
    def through(self) -> tuple[Pattern, Rows, int]:
        """Pattern of the rays by the independent unknowns of a rig, their numbers (u,), their count."""
        constraints = self.constraints
        rig = None if constraints is None else constraints.sparse
        if rig is None:
            raise AssertionError("only for a rig whose rays depend on one exposure and one camera each")
        pose, place, to = rig.columns
        return self.unknowns.pattern_through(pose, place, to), to, rig.size

    @cached_property
    def prior_column(self) -> tuple[Rows, Rows, Rows, Rows]:
        """Columns of other observations of single reduced unknowns.

        Rows and columns of observed coordinates of kept points, then rows and columns of observed interior
        orientation, of observed parameters of windows and media, and of the motion of cameras.
        """
        unknowns, (_, coordinates, interior) = self.unknowns, self.others.slices
        kept = unknowns.kept[self.others.coordinate[:, 0]]
        rows = np.flatnonzero(kept >= 0)
        c, parameter = self.others.interior.T
        place = [int(np.flatnonzero(unknowns.free[i] == p)[0]) for i, p in zip(c, parameter, strict=True)]
        used = unknowns.camera[c] >= 0
        windows, bent = self.others.windows, self.others.refraction
        image, component = self.others.motion.T
        moved = unknowns.motion[image] >= 0
        return (
            coordinates.start + rows,
            kept[rows] + self.others.coordinate[rows, 1],
            np.concatenate(
                [
                    interior.start + np.flatnonzero(used),
                    windows.start + np.arange(len(bent)),
                    self.others.motions.start + np.flatnonzero(moved),
                ]
            ),
            np.concatenate(
                [
                    (unknowns.camera[c] + np.array(place, dtype=np.intp))[used],
                    unknowns.refraction + np.searchsorted(unknowns.refracting, bent),
                    (unknowns.motion[image] + component)[moved],
                ]
            ),
        )


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
            return np.eye(self.system.unknowns.size)
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

    def _add_others(self, sums: Sums, to: Rows | None = None) -> None:
        """Add distances, and observed coordinates and parameters among the reduced unknowns.

        `to` (u,) are new numbers of these unknowns, where they have been renumbered.
        """
        system = self.system
        bands, kept = len(sums.band), system.unknowns.kept
        if to is None:
            to = np.arange(system.unknowns.size)
        rows, columns, rows_interior, columns_interior = system.prior_column
        for row, column in zip([*rows, *rows_interior], [*columns, *columns_interior], strict=True):
            column = to[column]
            _add(sums, int(column), system.sigma_root[row], float(self.other_misfits[row]), bands)
        for k, column, slope in self.slopes():
            column = to[column]
            gradient = slope * self.other_misfits[k]
            sums.gradient[column] += gradient
            sums.diagonal[column] += slope**2
            if column[0] >= bands:
                sums.border[np.ix_(column - bands, column)] += np.outer(slope, slope)
            else:
                # All columns of a camera with a single image are in the band.
                for i, c in enumerate(column):
                    sums.band[c, column[i:] - c] += slope[i] * slope[i:]
        held = np.flatnonzero(kept >= 0)
        for j in held:
            for axis in np.flatnonzero(system.movable[j] == 0):
                _hold(sums, int(to[kept[j] + axis]))

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

    def normal(self, damping: float, *, turned: bool = True) -> Normal:
        """Form the damped normal equations, reduced to the unknowns other than points.

        Parameters
        ----------
        damping : float
            Relative to the diagonal.
        turned : bool
            Whether to form them for well-conditioned combinations of the parameters of cameras.
        """
        system, unknowns = self.system, self.system.unknowns
        if self.blocks is not None:
            return self._normal_through(damping)
        if system.iterative:
            return self._implicit(damping)
        u, bands = unknowns.size, unknowns.bands
        bases, rows = (self.bases, self.turned_rows) if turned else ((), self.rows)
        sums, inverse, side, diagonal, least = self._assembled(
            rows, system.pattern, damping, u, bands, unknowns.bandwidth
        )
        self._add_others(sums)
        sums.reduced[:] += sums.gradient
        for column in np.flatnonzero(system.held):
            _hold(sums, int(column))
        if damping:
            extra = damping * np.where(sums.diagonal > 0, sums.diagonal, 1.0)
            for basis in bases:
                extra[basis.columns] = 0.0
                basis.damp(sums, damping)
            sums.band[:, 0] += extra[:bands]
            corner = np.arange(u - bands)
            sums.border[corner, bands + corner] += extra[bands:]
        for basis in bases:
            sums.diagonal[basis.columns] = basis.diagonal
        return Normal(self, sums, inverse, side, diagonal, damping, least, bases)

    def _implicit(self, damping: float) -> Implicit:
        """Normal equations without their matrix."""
        system, unknowns, p = self.system, self.system.unknowns, len(self.prior)
        u, blocks, rows, bases = unknowns.size, unknowns.blocks, self.turned_rows, self.bases
        inverse, side, points = np.zeros((p, 3, 3)), np.zeros((p, 3)), np.zeros((p, 3))
        chunks, nothing = system.chunks, np.zeros((0, u))
        parts = [Sums(np.zeros((0, 1)), nothing, np.zeros(u), np.zeros(u), np.zeros(u)) for _ in chunks]
        near, least = [np.zeros(blocks.total) for _ in chunks], np.ones(len(chunks))

        def work(part: int, a: int, b: int) -> None:
            least[part] = assemble_blocks(
                a, b, rows, self.misfits, system.pattern, self.prior, damping, parts[part], inverse, side,
                points, blocks.first, blocks.base, near[part],
            )  # fmt: skip

        in_parallel(work, chunks)
        sums, own, more = parts[0], near[0], self.other_rows
        for other, entries in zip(parts[1:], near[1:], strict=True):
            own += entries
            for mine, theirs in zip(sums[2:], other[2:], strict=True):
                mine += theirs
        sums.gradient[:] += more.T @ self.other_misfits
        sums.diagonal[:] += more.power(2).sum(axis=0)
        sums.reduced[:] += sums.gradient
        held = system.held.copy()
        kept = np.flatnonzero(unknowns.kept >= 0)
        held[(unknowns.kept[kept, None] + np.arange(3))[system.movable[kept] == 0]] = True
        damped = damping * np.where(sums.diagonal > 0, sums.diagonal, 1.0)
        for basis in bases:
            damped[basis.columns] = 0.0
            sums.diagonal[basis.columns] = basis.diagonal
        added = [scipy.sparse.diags_array(damped).tocoo(), (more.T @ more).tocoo()]
        if damping:
            for basis in bases:
                block = damping * (basis.turn.T * basis.diagonal) @ basis.turn
                at = np.meshgrid(basis.columns, basis.columns, indexing="ij")
                added.append(
                    scipy.sparse.coo_array((block.ravel(), (at[0].ravel(), at[1].ravel())), shape=(u, u))
                )
        for part in added:
            blocks.add(own, part.row, part.col, part.data)
        extra = sum((part.tocsr() for part in added[1:]), added[0].tocsr())
        normal = Implicit(self, sums, inverse, side, points, damping, float(least.min(initial=1.0)), bases)
        normal.near, normal.extra = own, extra
        normal.hold(held)
        return normal

    @cached_property
    def other_rows(self) -> scipy.sparse.csr_array:
        """Weighted derivatives of the other observations by the reduced unknowns (k, u)."""
        root = self.system.sigma_root
        rows_kept, columns_kept, rows_interior, columns_interior = self.system.prior_column
        row, column = [rows_kept, rows_interior], [columns_kept, columns_interior]
        value = [root[rows_kept], root[rows_interior]]
        for k, columns, slope in self.slopes():
            row.append(np.full(len(columns), k))
            column.append(columns)
            value.append(slope)
        at = (np.concatenate(row), np.concatenate(column))
        shape = (len(root), self.system.unknowns.size)
        return scipy.sparse.csr_array((np.concatenate(value), at), shape=shape)

    def _assembled(
        self, rows: Array, pattern: Pattern, damping: float, u: int, bands: int, bandwidth: int
    ) -> tuple[Sums, Array, Array, Array, float]:
        """Sums over all points; V⁻¹, right-hand side and diagonal of each, and the smallest scaled pivot."""
        p = len(self.prior)
        inverse, side, diagonal = np.zeros((p, 3, 3)), np.zeros((p, 3)), np.zeros((p, 3))
        chunks = self.system.chunks if u < _LARGE or bands else [(0, p)]
        parts = [
            Sums(
                np.zeros((bands, bandwidth + 1)),
                np.zeros((u - bands, u)),
                np.zeros(u),
                np.zeros(u),
                np.zeros(u),
            )
            for _ in chunks
        ]
        least = np.ones(len(chunks))

        def work(part: int, a: int, b: int) -> None:
            least[part] = assemble(
                a, b, rows, self.misfits, pattern, self.prior, damping, parts[part], inverse, side, diagonal
            )

        in_parallel(work, chunks)
        sums = parts[0]
        for other in parts[1:]:
            for mine, theirs in zip(sums, other, strict=True):
                mine += theirs
        return sums, inverse, side, diagonal, float(least.min(initial=1.0))

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

    def _normal_through(self, damping: float) -> Normal:
        """Normal equations of the independent unknowns of a rig, formed without those of single images."""
        system, unknowns = self.system, self.system.unknowns
        pattern, to, size = system.through
        image = system.seen.image
        sums, inverse, side, points, least = self._assembled(self.rows_through, pattern, damping, size, 0, 0)
        self._add_others(sums, to)
        sums.reduced[:] += sums.gradient
        # The damping is that of poses, as without a rig.
        diagonal = np.zeros(unknowns.size)
        known = to >= 0
        diagonal[known] = sums.diagonal[to[known]]
        square = (self.rows[:, :, :6] ** 2).sum(axis=1)
        own, count = np.flatnonzero(unknowns.pose >= 0), len(unknowns.pose)
        for i in range(6):
            diagonal[unknowns.pose[own] + i] = np.bincount(image, square[:, i], count)[own]
        if damping:
            extra = damping * np.where(diagonal > 0, diagonal, 1.0)
            sparse = self.sparse_transformation
            sums.border[:] += (sparse.T @ scipy.sparse.diags_array(extra) @ sparse).toarray()
        return Normal(self, sums._replace(diagonal=diagonal), inverse, side, points, damping, least)


class Normal:
    """Reduced normal equations."""

    def __init__(
        self, linear: Linear, sums: Sums, inverse: Array, side: Array, diagonal: Array, damping: float,
        least: float, bases: tuple[CameraBasis, ...] = (),
    ) -> None:  # fmt: skip
        self.linear, self.sums, self.inverse, self.side = linear, sums, inverse, side
        self.diagonal, self.damping, self.least, self.bases = diagonal, damping, least, bases
        self.factors: Arrow | Conjugate | None = None
        self.accuracy = (0.0, 0.0)

    def hold(self, held: Mask) -> None:
        """Hold reduced unknowns (u,)."""
        for column in np.flatnonzero(held):
            _hold(self.sums, int(column))

    def factorise(self) -> Arrow | Conjugate:
        """Compute the Cholesky factors; the sums are overwritten.

        Raises
        ------
        Singular
            When the matrix is not positive definite.
        """
        return Arrow.factorise(self.sums.band, self.sums.border)

    def constrained(self, held: Mask | None = None) -> Constrained:
        """Return the normal equations of the independent unknowns, of which some (size,) may be held."""
        linear = self.linear
        t, slopes = linear.transformation, linear.constraint_slopes
        own = slopes.T @ linear.other_misfits[len(linear.other_misfits) - len(slopes) :]
        matrix, gradient = full(self.sums.band, self.sums.border), self.sums.reduced
        if linear.blocks is None:
            # A pose depends on few unknowns: nearly all of T is zero.
            sparse = linear.sparse_transformation
            matrix, gradient = sparse.T @ (sparse.T @ matrix).T, t.T @ gradient
        matrix, gradient = matrix + slopes.T @ slopes, gradient + own
        if held is not None:
            matrix[held], matrix[:, held] = 0.0, 0.0
            matrix[held, held] = 1.0
            gradient = np.where(held, 0.0, gradient)
        return Constrained(t, matrix, own, gradient)

    @property
    def turn(self) -> scipy.sparse.csr_array | None:
        """Reduced unknowns (u, u) from the combinations for which these are formed; None for themselves."""
        if not self.bases:
            return None
        u = self.linear.system.unknowns.size
        own = np.ones(u)
        parts = []
        for basis in self.bases:
            own[basis.columns] = 0.0
            at = np.meshgrid(basis.columns, basis.columns, indexing="ij")
            parts.append((basis.turn.ravel(), at[0].ravel(), at[1].ravel()))
        kept = np.flatnonzero(own)
        values, rows, columns = (
            np.concatenate(column) for column in zip(*parts, (own[kept], kept, kept), strict=True)
        )
        return scipy.sparse.csr_array((values, (rows, columns)), shape=(u, u))

    def correction(self, relative: float = 0.0, absolute: float = 0.0) -> Correction:
        """Solve for the correction.

        Parameters
        ----------
        relative, absolute : float
            Accuracy with conjugate gradients: see :meth:`Conjugate.solve`.

        Raises
        ------
        Singular
            When the matrix is not positive definite.
        """
        constraints, q, by_stage = self.linear.system.constraints, None, 0.0
        complete = True
        if constraints is None:
            factors = self.factors = self.factorise()
            self.accuracy = relative, absolute
            y = self._solved(factors, -self.sums.reduced)
            complete = isinstance(factors, Arrow) or factors.complete
            gradient = self.sums.gradient @ y
            y = self.in_parameters(y)
        else:
            columns = self.linear.system.held
            held = constraints.held(columns)
            held[self.linear.system.fixed] = True
            own = self.constrained(held if held.any() else None)
            q = Arrow.factorise(np.zeros((0, 1)), own.matrix).solve(-own.gradient)
            y, by_stage = own.back @ q, float(own.own @ q)
            gradient = self.sums.gradient @ (y if self.linear.blocks is None else q)
        points = self.points(-self.side[:, :, None], y[:, None])[:, :, 0]
        gradient += float((self.side * points).sum()) + by_stage
        bent = (self.sums.diagonal * y) @ y + float((self.diagonal * points**2).sum())
        predicted = float(-gradient + self.damping * bent)
        return Correction(y, points, predicted, float(np.sqrt(bent)), q, complete)

    def correction_for(self, misfits: Array, other_misfits: Array) -> Correction:
        """Solve for the correction with other misfits, with the factors of :meth:`correction`.

        Without a stage or a rig only. The predicted decrease is not computed.

        Parameters
        ----------
        misfits : ndarray (n, 2)
            Weighted misfits of the image coordinates.
        other_misfits : ndarray
            Weighted misfits of the other observations.
        """
        linear, system = self.linear, self.linear.system
        rows, pattern = linear.turned_rows if self.bases else linear.rows, system.pattern
        other = Linear(system, linear.values, linear.rows, misfits, other_misfits)
        side, gradient = other.prior[:, :, 1].copy(), np.zeros(system.unknowns.size)
        gradients(0, len(side), rows, misfits, pattern, side, gradient)
        one, at, more, interior = system.prior_column
        for row, column in zip([*one, *more], [*at, *interior], strict=True):
            gradient[column] += system.sigma_root[row] * other_misfits[row]
        for k, columns, slope in linear.slopes():
            gradient[columns] += slope * other_misfits[k]
        reduced = np.zeros((len(gradient), 1))
        reduce_sides(0, len(side), rows, pattern, self.inverse, side[:, :, None], reduced)
        held = system.held.copy()
        kept = np.flatnonzero(system.unknowns.kept >= 0)
        held[(system.unknowns.kept[kept, None] + np.arange(3))[system.movable[kept] == 0]] = True
        factors = self.factorise() if self.factors is None else self.factors
        y = self._solved(factors, np.where(held, 0.0, -(gradient + reduced[:, 0])))
        y = self.in_parameters(y)
        points = self.points(-side[:, :, None], y[:, None])[:, :, 0]
        bent = (self.sums.diagonal * y) @ y + float((self.diagonal * points**2).sum())
        return Correction(y, points, 0.0, float(np.sqrt(bent)))

    def _solved(self, factors: Arrow | Conjugate, side: Array) -> Array:
        return factors.solve(side) if isinstance(factors, Arrow) else factors.solve(side, *self.accuracy)

    def in_parameters(self, z: Array) -> Array:
        """Return reduced unknowns (u, …) for the parameters of cameras, from those for their combinations."""
        y = z.copy()
        for basis in self.bases:
            y[basis.columns] = basis.turn @ z[basis.columns]
        return y

    def points(self, side: Array, y: Array) -> Array:
        """Compute points (p, 3, s) from right-hand sides (p, 3, s) and reduced unknowns (u, s)."""
        linear, out = self.linear, np.zeros(side.shape)

        def work(_: int, a: int, b: int) -> None:
            substitute(a, b, linear.rows, linear.system.pattern, self.inverse, side, y, out)

        in_parallel(work, linear.system.chunks)
        return out

    def reduced_sides(self, side: Array) -> Array:
        """Compute −W V⁻¹ times right-hand sides (p, 3, s) of the points, (u, s)."""
        linear = self.linear
        out = np.zeros((linear.system.unknowns.size, side.shape[2]))
        reduce_sides(0, len(side), linear.rows, linear.system.pattern, self.inverse, side, out)
        return out


class Implicit(Normal):
    """Reduced normal equations without their matrix, for conjugate gradients.

    Attributes
    ----------
    near : ndarray
        Lower triangles of the diagonal blocks of the matrix.
    extra : sparse array (u, u)
        Damping, and what observations other than image coordinates add to the matrix.
    held : ndarray of bool (u,)
        Held unknowns.
    """

    near: Array
    extra: scipy.sparse.csr_array
    held: Mask | None = None

    def hold(self, held: Mask) -> None:
        """Hold reduced unknowns (u,)."""
        self.held = held.copy() if self.held is None else self.held | held
        for column in (self.sums.gradient, self.sums.reduced, self.sums.diagonal):
            column[held] = 0.0

    def factorise(self) -> Conjugate:
        """Invert the diagonal blocks.

        Raises
        ------
        Singular
            When a block is not positive definite.
        """
        system = self.linear.system
        held = system.held if self.held is None else self.held
        return Conjugate(self._product, system.unknowns.blocks.inverted(self.near, held))

    def _product(self, x: Array) -> Array:
        """Product of the matrix with a vector (u,)."""
        system, rows = self.linear.system, self.linear.turned_rows
        held = system.held if self.held is None else self.held
        free, chunks = np.where(held, 0.0, x), system.chunks
        parts = np.zeros((len(chunks), len(x)))

        def work(part: int, a: int, b: int) -> None:
            product(a, b, rows, system.pattern, self.inverse, free, parts[part])

        in_parallel(work, chunks)
        out: Array = parts.sum(axis=0) + self.extra @ free
        return np.where(held, x, out)


def _add(sums: Sums, column: int, root: float, misfit_: float, bands: int) -> None:
    sums.gradient[column] += root * misfit_
    sums.diagonal[column] += root**2
    if column < bands:
        sums.band[column, 0] += root**2
    else:
        sums.border[column - bands, column] += root**2


def _hold(sums: Sums, column: int) -> None:
    """Hold an unknown."""
    bands = len(sums.band)
    if column < bands:
        sums.band[column] = 0.0
        reach = min(column, sums.band.shape[1] - 1)
        back = np.arange(1, reach + 1)
        sums.band[column - back, back] = 0.0
        sums.band[column, 0] = 1.0
    else:
        sums.border[column - bands] = 0.0
    sums.border[:, column] = 0.0
    if column >= bands:
        sums.border[column - bands, column] = 1.0
    sums.gradient[column] = sums.reduced[column] = sums.diagonal[column] = 0.0


def residuals(
    network: Network, unknowns: Unknowns, rows: Rows, values: Values, origin: Array | None = None
) -> Array:
    """Compute v (px) of selected image observations of a network, (len(rows), 2).

    `origin` (3,) is the point from which the coordinates of the values are counted, by default that of the
    network.
    """
    image = network.image_of[rows]
    unit = np.tile(np.eye(2), (len(rows), 1, 1))
    seen = Seen(
        image,
        network.point_of[rows],
        network.camera_of[image],
        unknowns.extra_of[image],
        network.xy[rows],
        unit,
    )
    out, at = np.empty((len(rows), 2)), values.orientation
    at_origin = np.zeros(3) if origin is None else origin
    imaging = Imaging(network, unknowns.extra_names, at_origin, unknowns.mounts)
    bent, bend = imaging.bent(seen, at, values.refraction, values.rig, derivatives=False)
    bend(0, len(rows))
    imaging.misfit(0, len(rows), seen, at, bent, values.cameras, values.extra, out)
    for mapping, _, own in _mappings(network, seen.camera, values):
        xy, *_ = mapped(mapping, at, image[own], seen.point[own], bent, own)
        out[own] = xy - seen.xy[own]
    return out


def _mappings(network: Network, camera_of: Rows, values: Values) -> list[tuple[PlaneMapping, int, Rows]]:
    """Return mapping, number and rows of the observations of each camera without a kernel."""
    without = [c for c, camera in enumerate(network.cameras) if camera.compiled_kind is None]
    if not without:
        return []
    rays, at = rows_of_groups(camera_of, len(network.cameras)), values.cameras
    return [
        (network.cameras[c].bare_mapping(at[c, : len(network.cameras[c].names)]), c, rays[c]) for c in without
    ]
