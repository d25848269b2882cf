"""The observations of an adjustment with their weights: misfits and derivatives at given values."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from ...adjust.stochastic import Weighting
from ...core.data import Array, Mask, Rows, rows_of_groups
from ...optics.mapping import PlaneMapping
from ..network.network import Network
from .constraints import Constraints
from .imaging import Bent, Imaging, Seen, mapped, mapped_points
from .normal import Pattern
from .observations import OtherObservations
from .threads import chunks_of, in_parallel
from .unknowns import Unknowns
from .values import Values

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
            xy = mapped_points(mapping, at, self.seen.image[rows], self.seen.point[rows], bent, rows)
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
        return self.seen.root[rows] @ matrix

    def derivatives(self, values: Values) -> tuple[Array, Array, Array]:
        """Compute weighted derivatives (n, 2, w) and misfits at given values, as those of :meth:`misfits`."""
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
        return rows, out, others

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
    def still(self) -> Rows:
        """Columns of held coordinates of points that are not eliminated."""
        points, columns = self.unknowns.kept_points
        return np.asarray(columns[self.movable[points] == 0], dtype=np.intp)

    @cached_property
    def prior_column(self) -> tuple[Rows, Rows]:
        """Rows and columns of other observations of single reduced unknowns.

        These are observed coordinates of points that are not eliminated, interior orientation, parameters of
        windows and media, and the motion of cameras.
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
            np.concatenate(
                [
                    coordinates.start + rows,
                    interior.start + np.flatnonzero(used),
                    windows.start + np.arange(len(bent)),
                    self.others.motions.start + np.flatnonzero(moved),
                ]
            ),
            np.concatenate(
                [
                    kept[rows] + self.others.coordinate[rows, 1],
                    (unknowns.camera[c] + np.array(place, dtype=np.intp))[used],
                    unknowns.refraction + np.searchsorted(unknowns.refracting, bent),
                    (unknowns.motion[image] + component)[moved],
                ]
            ),
        )


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
        xy = mapped_points(mapping, at, image[own], seen.point[own], bent, own)
        out[own] = xy - seen.xy[own]
    return out


def _mappings(network: Network, camera_of: Rows, values: Values) -> list[tuple[PlaneMapping, int, Rows]]:
    """Return mapping, number and rows of the observations of each camera without a kernel."""
    without = [c for c, kernel in enumerate(network.kernels) if kernel is None]
    if not without:
        return []
    rays, at = rows_of_groups(camera_of, len(network.cameras)), values.cameras
    return [
        (network.cameras[c].bare_mapping(at[c, : len(network.cameras[c].names)]), c, rays[c]) for c in without
    ]
