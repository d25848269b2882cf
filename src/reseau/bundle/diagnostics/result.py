"""The result of a bundle adjustment: estimates with their covariances and tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import scipy

from ...adjust.components import VarianceComponents
from ...adjust.outliers import SnoopingStep
from ...adjust.significance import CoefficientTest, GlobalTest, ratio_test
from ...calibration.camera import Rival
from ...core.data import Array, Mask, Rows
from ...core.display import Display, Table
from ...core.errors import UsageError
from ...core.failure import Code, Estimated, Remark
from ...core.threads import one_thread
from ...optics.cameras.registry import distortion_names
from ...optics.poses import matrix_to_angles, matrix_to_vector, rotation_matrix
from ..network.network import Network
from ..network.stage import perpendicular
from ..solver.problem import BundleFit
from ..solver.rank import missing_windows
from .considered import Considered, considered
from .estimates import (
    CameraEstimate,
    ImageEstimates,
    MotionEstimates,
    PointEstimates,
    PriorInfluence,
    RefractionEstimate,
    RigEstimate,
    StageEstimate,
)
from .evidence import ODDS
from .other_solutions import OtherSolution, excluded
from .shared import SharedErrors, Uncertainty, shared_errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_STEP = 1e-6
# Minimum redundancy of an image for a variance factor.
_UNCONTROLLED = 1e-6
# What cannot be, and what contradicts the rest where residuals are too large.
_IMPOSSIBLE = frozenset({Code.IMPLAUSIBLE, Code.NOT_CONVERGED})
_DOUBTFUL = frozenset({Code.DOUBTFUL_CONTROL, Code.INCONSISTENT, Code.OUTSIDE, Code.READINGS})


@dataclass(frozen=True)
class Eliminated:
    """A parameter that was dropped because it was not significant.

    Parameters
    ----------
    camera : str
        Name of the camera.
    test : CoefficientTest
        Test of the parameter before it was dropped.
    sigma0 : float
        Standard deviation of unit weight without the parameter.

    Examples
    --------
    >>> step = Eliminated("camera", ratio_test("K2", 1.3, 1.0, 215), 1.01)
    >>> step.test.name, step.test.significant
    ('K2', False)
    """

    camera: str
    test: CoefficientTest
    sigma0: float


@dataclass(frozen=True, eq=False, repr=False)
class Result(Estimated, Display):
    """Result of a bundle adjustment, with covariances and tests; truthy.

    Standard deviations and covariances are a posteriori (multiplied by the estimated variance factor);
    without redundancy they are a priori. Undetermined values are NaN.

    Parameters
    ----------
    network : Network
        The adjusted network.
    fit : BundleFit
        The adjustment.
    rejected : ndarray of bool (n,)
        Image points left out by data snooping.
    steps : tuple of SnoopingStep
        Steps of data snooping, with the observation numbers of
        :class:`~reseau.bundle.solver.problem.BundleProblem`.
    warnings : tuple of Remark
        Warnings about the adjustment.
    components : VarianceComponents, optional
        Factors on the input standard deviations, where they were estimated.
    eliminated : tuple of Eliminated, optional
        Dropped parameters in order; None without elimination.
    validation : (float, float), optional
        Cross-validation: root mean square error of predicted image coordinates, in their standard deviations,
        with all parameters and with the kept ones.
    rivals : tuple of tuple of Rival, optional
        Models of other kinds that each camera may have, where the model was chosen by these observations: the
        covariances of cameras contain these, and what coefficients could do that were held at zero. None of
        a camera whose model was given.
    others : tuple of OtherSolution, optional
        Solutions that the observations allow as well, and standard deviations exclude: what differs has none.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> result
    <Result: 8 images, 20 points, sigma0 1.005, redundancy 215, 0 image points left out, 1 warning>
    >>> result.points.xyz.shape, result.images.sigma.shape
    ((20, 3), (8, 6))
    >>> result.cameras["camera"]
    <CameraEstimate: camera, c 8.00... mm, ...>
    """

    network: Network
    fit: BundleFit
    rejected: Mask
    steps: tuple[SnoopingStep, ...] = ()
    warnings: tuple[Remark, ...] = ()
    components: VarianceComponents[BundleFit] | None = None
    eliminated: tuple[Eliminated, ...] | None = None
    validation: tuple[float, float] | None = None
    rivals: tuple[tuple[Rival, ...] | None, ...] | None = None
    others: tuple[OtherSolution, ...] = ()

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight; NaN without redundancy."""
        return self.fit.sigma0

    @property
    def redundancy(self) -> int:
        """Number of observations minus unknowns plus datum constraints."""
        return self.fit.redundancy

    @property
    def contradiction(self) -> Remark | None:
        """What contradicts the rest, the foremost; None where nothing does.

        Values that cannot be, and an adjustment that has not converged; where residuals are larger than their
        sigmas say, observations that are doubtful for a reason other than chance, and single image points
        that have most of what vᵀPv is too large.
        """
        test, codes = self.global_test(), _IMPOSSIBLE
        if test is not None and not test.passed and self.sigma0 > 1:
            codes = codes | _DOUBTFUL
            if self._gross_part > 0.5:
                codes = codes | {Code.GROSS_ERRORS}
        return next((remark for remark in self.warnings if remark.code in codes), None)

    @property
    def _gross_part(self) -> float:
        """Part of what vᵀPv is too large that single image points have, more each than by chance."""
        v = np.nan_to_num(self.residuals[self.used])
        square = np.einsum("ni,nij,nj->n", v, np.linalg.inv(self.network.cov[self.used]), v)
        gross = square > scipy.special.chdtri(2, 0.01 / max(len(square), 1))
        return float(square[gross].sum() / max(self.fit.cost - self.redundancy, 1e-300))

    @property
    def status(self) -> Literal["ok", "contradictory"]:
        """Whether the result contradicts itself; commands then end with the exit status 3."""
        return "ok" if self.contradiction is None else "contradictory"

    def global_test(self, alpha: float = 0.05) -> GlobalTest | None:
        """Test the variance factor against one; None without redundancy."""
        return self.fit.global_test(alpha) if self.redundancy > 0 else None

    def _facts(self) -> list[tuple[str, str]]:
        part = self.fit.usable
        return [
            (f"{int(part.images.sum())} images", ""),
            (f"{int(part.points.sum())} points", ""),
            ("sigma0", f"{self.sigma0:.3f}"),
            ("redundancy", f"{self.redundancy}"),
            (f"{int(self.rejected.sum())} image points left out", ""),
            (f"{len(self.warnings)} warning{'s' * (len(self.warnings) != 1)}", ""),
        ]

    def _columns(self) -> dict[str, list[object]]:
        network = self.network
        columns: dict[str, list[object]] = {
            "image": [network.images[i] for i in network.image_of],
            "point": [network.points[j] for j in network.point_of],
        } | {f"{axis}_px": network.xy[:, k].tolist() for k, axis in enumerate("xy")}
        for name, values in (("v", self.residuals), ("r", self.redundancy_numbers), ("w", self.test_values)):
            unit = "_px" if name == "v" else ""
            columns |= {f"{name}{axis}{unit}": values[:, k].tolist() for k, axis in enumerate("xy")}
        return columns | {"rejected": self.rejected.tolist()}

    def plot(self, axes: Axes | None = None, camera: int = 0) -> Axes:
        """Draw the image points of a camera and their residuals, enlarged, with matplotlib.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        camera : int
            Number of the camera.
        """
        from ...core.figures import ACCENT, FAINT, draw_arrows, image_axes, new_axes, nice

        network, entry = self.network, self.network.cameras[camera]
        rows = self.used_by(camera)
        xy, v = network.xy[rows], self.residuals[rows]
        axes = new_axes(axes)
        axes.plot(*xy.T, ".", color=FAINT, markersize=1.5)
        size = np.hypot(*v.T)
        typical = float(np.quantile(size, 0.9)) if len(size) else 0.0
        enlarged = nice(0.03 * entry.width / typical) if typical > 0 else 1.0
        shown = slice(None, None, max(1, len(xy) // 3000))
        draw_arrows(axes, xy[shown], enlarged * v[shown], ACCENT, 0.002)
        image_axes(
            axes, entry.width, entry.height, f"residuals × {enlarged:g}, rms {self.rms_px(camera):.2g} px"
        )
        return axes

    # -- estimates in columns

    def camera(self, c: int) -> CameraEstimate:
        """Return the estimated parameters of the c-th camera of the network.

        What the image points do not determine has no standard deviation.
        """
        names, columns, values = self.camera_columns(c)
        entry = self.network.cameras[c]
        units = tuple(entry.unit_of(name) for name in names)
        found = self.uncertainty(columns)
        covariance = found.covariance
        if not self.perspective(c)[1]:
            scale = np.isin(names, entry.registered.of_role("scale") if entry.registered else ())
            covariance = np.where(scale[:, None] | scale, np.nan, covariance)
        doubt = self.in_doubt[0][columns]
        covariance = np.where(doubt[:, None] | doubt, np.nan, covariance)
        return CameraEstimate(entry.id, names, values, covariance, units, formal=found.formal, dof=found.dof)

    def perspective(self, c: int) -> tuple[float, bool]:
        """Return the reciprocal focal length in its sigmas, and whether it predicts better than zero.

        Examples
        --------
        >>> from reseau.bundle import adjust_network, example_network
        >>> adjust_network(example_network()).perspective(0)[1]
        True
        """
        model = self.network.cameras[c].registered
        if model is None or model.parallel or not self.fit.cofactors.reduced.known:
            return np.inf, True
        names, _, values = self.camera_columns(c)
        sigma = np.sqrt(np.diag(self.formal_camera_covariance(c)))
        of = zip(names, values.tolist(), sigma.tolist(), strict=True)
        size = min(
            [abs(v) / s for name, v, s in of if name in model.of_role("scale") and s > 0], default=np.inf
        )
        return size, bool(0.5 * size**2 - 1 > ODDS)

    @cached_property
    def _without_distance(self) -> Mask:
        """Images whose distances are not determined, as the focal length of their camera is not (m,)."""
        cameras = [not self.perspective(c)[1] for c in range(len(self.network.cameras))]
        return np.array(cameras, dtype=bool)[self.network.camera_of]

    @cached_property
    def in_doubt(self) -> tuple[Mask, Mask]:
        """Reduced unknowns (u,) and points (p,) in which other solutions differ beyond their deviations."""
        return excluded(self.fit, self.others)

    @cached_property
    def shared(self) -> SharedErrors | None:
        """What the points of each image have in common; None where it cannot be estimated."""
        return shared_errors(self.fit) if self.fit.cofactors.reduced.known else None

    def uncertainty(self, columns: Rows) -> Uncertainty:
        """Covariance of parameters of cameras (k,), by their columns among the reduced unknowns.

        It contains what the points of each image have in common and, where the model was chosen, what
        coefficients could do that were not estimated.
        """
        found = self.uncertainty_of_points(columns)
        more = [each.errors(columns)[: len(columns), : len(columns)] for each in self.considered.values()]
        return found if not more else found.with_errors(np.sum(more, axis=0))

    def rivals_of(self, c: int) -> tuple[Rival, ...]:
        """Models of other kinds that a camera may have."""
        own = self.considered.get(c)
        return own.rivals if own is not None else (self.rivals[c] or ()) if self.rivals else ()

    def with_considered(
        self, c: int, names: tuple[str, ...], columns: Rows, covariance: Array
    ) -> tuple[tuple[str, ...], Array, Array | None]:
        """Names and covariance of a camera's parameters with coefficients that were held, and their part."""
        k, own = len(columns), self.considered.get(c)
        if own is None:
            return names, covariance, None
        part = own.errors(columns)
        total = part.copy()
        total[:k, :k] = covariance
        return (*names, *own.names), total, part

    @cached_property
    def considered(self) -> dict[int, Considered]:
        """Coefficients of each camera that were held at zero, where some were."""
        found = dict[int, Considered]()
        for c, rivals in enumerate(self.rivals or ()):
            if rivals is None:
                continue
            columns = self.camera_columns(c)[1]
            own = considered(self.fit, c, columns, self.uncertainty_of_points(columns).covariance, rivals)
            if own is not None:
                found[c] = own
        return found

    def uncertainty_of_points(self, columns: Rows) -> Uncertainty:
        """The covariance that contains what the points of each image have in common."""
        if self.shared is not None and len(columns):
            return self.shared.uncertainty(columns)
        formal = self.fit.cofactors.reduced.block(columns, columns) * self.fit.variance
        # Without redundancy the covariance is that of the given standard deviations.
        degrees = float(self.redundancy) if self.redundancy > 0 else np.inf
        return Uncertainty(formal, formal, np.full(len(columns), degrees), degrees)

    @cached_property
    def cameras(self) -> dict[str, CameraEstimate]:
        """Estimated parameters of each camera by its name."""
        return {camera.id: self.camera(c) for c, camera in enumerate(self.network.cameras)}

    @cached_property
    def images(self) -> ImageEstimates:
        """Exterior orientations."""
        network = self.network
        order = [3, 4, 5, 0, 1, 2]
        covariance = self.pose_covariance[:, order][:, :, order]
        return ImageEstimates(
            network.images,
            tuple(network.cameras[c].id for c in network.camera_of),
            self.fit.values.x0,
            self.rotation,
            np.where(self._without_distance[:, None, None], np.nan, covariance),
            network.unit,
        )

    @cached_property
    def points(self) -> PointEstimates:
        """Object points; what only images without a distance show has no standard deviation."""
        network = self.network
        sound = ~self._without_distance[network.image_of]
        held: Mask = np.all(network.held | network.observed, axis=1)
        held[network.point_of[sound]] = True
        return PointEstimates(
            network.points,
            network.role,
            self.fit.values.xyz,
            np.where(held[:, None, None], self.point_covariance, np.nan),
            network.rays,
            network.unit,
        )

    @cached_property
    def refraction(self) -> RefractionEstimate | None:
        """Estimated parameters of windows and media; None where none is free."""
        bent, unknowns, fit = self.network.refraction, self.fit.unknowns, self.fit
        rows = unknowns.refracting
        if bent is None or not len(rows):
            return None
        names = tuple(bent.names[row] for row in rows)
        columns = unknowns.refraction_columns
        at = np.arange(columns.start, columns.stop)
        cofactor = fit.cofactors.reduced.block(at, at)
        values, given = fit.values.refraction[rows], bent.values[rows]
        own = np.diag(cofactor)
        observed = bent.sigma[rows] ** 2
        # The difference from an observed value has the cofactor of its residual.
        difference = np.where(observed > 0, observed - own, own)
        ratio = (values - given) / np.sqrt(np.where(difference > 0, difference, np.inf))
        sigma0 = self.sigma0 if self.redundancy > 0 else None
        tests = tuple(
            ratio_test(name, float(r), sigma0, self.redundancy) for name, r in zip(names, ratio, strict=True)
        )
        return RefractionEstimate(
            "windows and media", names, values, cofactor * fit.variance,
            tuple(bent.unit_of(name, self.network.unit) for name in names), given, tests,
            self._partners(at),
        )  # fmt: skip

    @cached_property
    @one_thread()
    def rig(self) -> RigEstimate | None:
        """Relative orientations of the cameras of a rig; None without one."""
        found = self.places_by_reduced
        places = self.fit.values.rig
        if found is None or places is None:
            return None
        (at, references, by), names = found, [camera.id for camera in self.network.cameras]
        cov = by @ self.fit.cofactors.reduced.full @ np.swapaxes(by, 1, 2) * self.fit.variance
        cameras, first = (tuple(names[k] for k in rows) for rows in (at, references))
        return RigEstimate(cameras, first, places.rotation[at], places.base[at], cov, self.network.unit)

    @cached_property
    def places_by_reduced(self) -> tuple[Rows, Rows, Array] | None:
        """Cameras (k,) with places on a rig, their references, and derivatives of rotation and base (k, 6, u)
        by the reduced unknowns."""
        linear, places = self.fit.linear, self.fit.values.rig
        constraints = None if linear.system.constraints is None else linear.system.constraints.rig
        if constraints is None or places is None:
            return None
        t = constraints.matrix(places, linear.values.rotation, linear.values.x0)
        return constraints.cameras, constraints.references[constraints.cameras], constraints.by_reduced(t)

    @cached_property
    def stage(self) -> StageEstimate | None:
        """Axis and readings of a stage; None without one."""
        network, values, linear = self.network, self.fit.values, self.fit.linear
        stage, moved, cofactors = network.stage, values.stage, self.fit.cofactors.stage
        own = None if linear.system.constraints is None else linear.system.constraints.stage
        if stage is None or moved is None or own is None or cofactors is None or linear.values.stage is None:
            return None
        across, start = perpendicular(moved.axis), own.own.start
        middle = values.xyz[self.fit.usable.points].mean(axis=0)
        # Of direction and position by the unknowns: a turned axis moves its point beside the centroid.
        slopes = np.zeros((6, len(cofactors)))
        if own.direction >= 0:
            columns = slice(own.direction - start, own.direction - start + 2)
            slopes[:3, columns] = across
            slopes[3:, columns] = across * float(moved.axis @ (middle - moved.point))
        if own.position >= 0:
            columns = slice(own.position - start, own.position - start + 2)
            slopes[3:, columns] = across
        if not stage.rotary:
            slopes[3:] = 0.0
        column_of = dict(zip(own.frames.key.tolist(), own.reading.tolist(), strict=True))
        images = np.flatnonzero((stage.pose >= 0) & self.fit.usable.images)
        column = np.array([column_of.get(int(own.frames.key_of[i]), -1) for i in images], dtype=np.intp)
        # The last entry is that of readings that are held.
        variance = np.append(np.diag(cofactors), 0.0)[np.where(column >= 0, column - start, -1)]
        given = np.where(np.isnan(stage.sigmas[images]), np.nan, stage.reading[images])
        return StageEstimate(
            stage.kind, stage.carries, moved.axis, moved.foot(middle) if stage.rotary else np.full(3, np.nan),
            slopes @ cofactors @ slopes.T * self.fit.variance, tuple(network.images[i] for i in images),
            moved.reading[images], np.sqrt(np.maximum(variance, 0.0) * self.fit.variance),
            moved.reading[images] - given, network.unit,
        )  # fmt: skip

    def priors(self, c: int) -> PriorInfluence | None:
        """How much observed parameters of the c-th camera determine it; None where none is observed.

        Single parameters with a sigma, not those of a calibration with a joint covariance.
        """
        camera, unknowns = self.network.cameras[c], self.fit.unknowns
        names = [name for name in camera.free if name in camera.sigma]
        if not names or unknowns.camera[c] < 0:
            return None
        at = unknowns.camera[c] + np.array([camera.free.index(name) for name in names])
        given = np.array([camera.parameters[name] for name in names])
        sigma = np.array([camera.sigma[name] for name in names])
        own = self.fit.cofactors.reduced.block(at, at)
        share = np.clip(np.diag(own) / sigma**2, 0.0, 1.0)
        images = np.diag(own) - ((own / sigma) ** 2).sum(axis=1)
        rows = [camera.names.index(name) for name in names]
        off = self.fit.values.cameras[c, rows] - given
        left = self.redundancy - float((1 - share).sum())
        cost = self.fit.cost - float(((off / sigma) ** 2).sum())
        scale = np.sqrt(self.fit.variance)
        return PriorInfluence(
            tuple(names), given, sigma, share, scale * np.sqrt(np.diag(own)),
            scale * np.sqrt(np.maximum(images, 0.0)), np.sqrt(cost / left) if left > 0 else float("nan"),
        )  # fmt: skip

    @cached_property
    def motion(self) -> MotionEstimates | None:
        """Velocities and rotation rates of images; None where none was estimated."""
        unknowns, network, sigma0 = self.fit.unknowns, self.network, self.sigma0
        images = np.flatnonzero(unknowns.motion >= 0)
        if not len(images):
            return None
        at = unknowns.motion[images, None] + np.arange(6)
        cofactor, values = self.fit.cofactors.reduced.blocks(at), self.fit.values.motion[images]
        size = np.sqrt(np.maximum(np.diagonal(cofactor, axis1=1, axis2=2), 0.0))
        tests = tuple(
            ratio_test(
                unknowns.names[at[k, c]], float(values[k, c] / size[k, c]),
                sigma0 if self.redundancy > 0 else None, self.redundancy,
            )
            for k, c in np.argwhere(network.motion_free[images])
        )  # fmt: skip
        cov = cofactor * self.fit.variance
        return MotionEstimates(tuple(network.images[i] for i in images), values, cov, tests, network.unit)

    def _partners(self, columns: Rows) -> tuple[tuple[str, float], ...]:
        """Most correlated other reduced unknown of each of these columns, and the correlation."""
        reduced, names = self.fit.cofactors.reduced, self.fit.unknowns.names
        size = np.sqrt(np.maximum(reduced.diagonal, 0.0))
        size = np.where(size > 0, size, np.inf)
        found = []
        for column, q in zip(columns, reduced.rows(columns), strict=True):
            r = q / (size * size[column])
            r[column] = 0.0
            best = int(np.argmax(np.abs(r)))
            found.append((names[best], float(r[best])))
        return tuple(found)

    @cached_property
    def misses_windows(self) -> Rows:
        """Image points (k,) without a ray through the windows of their image; straight rays are used."""
        return missing_windows(self.network, self.fit.values, self.fit.usable.observations)

    # -- cameras

    def camera_columns(self, c: int) -> tuple[tuple[str, ...], Rows, Array]:
        """Return names, columns among the reduced unknowns, and values of the estimated camera parameters.

        Additional parameters are named ``b1`` … ``b12``; where a camera has several sets, followed by the
        group or image.
        """
        unknowns, values = self.fit.unknowns, self.fit.values
        camera, names, columns, found = self.network.cameras[c], [], [], []
        if unknowns.camera[c] >= 0:
            count = len(camera.free)
            names += list(camera.free)
            columns += list(unknowns.camera[c] + np.arange(count))
            found += values.cameras[c, unknowns.free[c, :count]].tolist()
        for e, (owner, label) in enumerate(unknowns.extra_names):
            if owner == c and unknowns.extra[e] >= 0 and camera.additional is not None:
                count = unknowns.extra_count[e]
                names += [camera.additional.name(i, label) for i in range(count)]
                columns += list(unknowns.extra[e] + np.arange(count))
                found += values.extra[e, :count].tolist()
        return tuple(names), np.array(columns, dtype=np.intp), np.array(found)

    def camera_covariance(self, c: int) -> Array:
        """Return the covariance of the estimated camera parameters, ordered as :meth:`camera_columns`.

        It contains what the points of each image have in common; see :mod:`.shared`.
        """
        return self.uncertainty(self.camera_columns(c)[1]).covariance

    def formal_camera_covariance(self, c: int) -> Array:
        """Return the covariance that presumes independent errors of all image points."""
        _, columns, _ = self.camera_columns(c)
        return self.fit.cofactors.reduced.block(columns, columns) * self.fit.variance

    def camera_tests(self, c: int, alpha: float = 0.05) -> tuple[CoefficientTest, ...]:
        """Test each distortion and additional parameter of a camera against zero."""
        names, columns, values = self.camera_columns(c)
        tested = distortion_names(names, self.network.cameras[c].model)
        size = np.sqrt(np.diag(self.fit.cofactors.reduced.block(columns, columns)))
        sigma0 = self.sigma0 if self.redundancy > 0 else None
        return tuple(
            ratio_test(name, float(value / s), sigma0, self.redundancy, alpha)
            for name, value, s in zip(names, values, size, strict=True)
            if s > 0 and name in tested
        )

    # -- images

    @cached_property
    def rotation(self) -> Array:
        """Rotation vectors (m, 3), rad."""
        return self._of_images(matrix_to_vector)

    @cached_property
    def angles(self) -> Array:
        """Omega, phi, kappa (m, 3), rad; see :func:`~reseau.optics.poses.angles_to_matrix`."""
        return self._of_images(matrix_to_angles)

    def _of_images(self, function: Callable[[Array], Array]) -> Array:
        part, rotation = self.fit.usable.images, self.fit.values.rotation
        found = np.full((len(part), 3), np.nan)
        found[part] = function(rotation[part])
        return found

    @cached_property
    def pose_covariance(self) -> Array:
        """Covariances (m, 6, 6) of rotation vector and projection centre; NaN for images without pose."""
        return self._pose_covariance(matrix_to_vector)

    @cached_property
    def angle_sigma(self) -> Array:
        """Standard deviations (m, 3) of omega, phi, kappa, rad."""
        return np.sqrt(np.diagonal(self._pose_covariance(matrix_to_angles), axis1=1, axis2=2)[:, :3])

    def _pose_covariance(self, parameters: Callable[[Array], Array]) -> Array:
        """Propagate from rotations about the camera axes to other rotation parameters."""
        unknowns = self.fit.unknowns
        images = np.flatnonzero(unknowns.pose >= 0)
        at = unknowns.pose[images, None] + np.arange(6)
        block = self.fit.cofactors.reduced.blocks(at) * self.fit.variance
        turn = np.tile(np.eye(6), (len(images), 1, 1))
        rotation = self.fit.values.rotation[images]
        # Projection centres of parallel rays are along the axes of the camera.
        along = self.network.parallel[images]
        turn[along, 3:, 3:] = np.swapaxes(rotation[along], 1, 2)
        for axis in range(3):
            small = rotation_matrix(_STEP * np.eye(3)[axis])
            change = parameters(small @ rotation) - parameters(small.T @ rotation)
            # Remove jumps of an angle at ±π.
            turn[:, :3, axis] = ((change + np.pi) % (2 * np.pi) - np.pi) / (2 * _STEP)
        full = np.full((len(unknowns.pose), 6, 6), np.nan)
        block[self.in_doubt[0][at].any(axis=1)] = np.nan
        full[images] = turn @ block @ np.swapaxes(turn, 1, 2)
        return full

    # -- points

    @cached_property
    def point_covariance(self) -> Array:
        """Covariances (p, 3, 3) of the points; zero for held coordinates, NaN where not determined."""
        part = (self.fit.usable.points & ~self.in_doubt[1])[:, None, None]
        return np.where(part, self.fit.cofactors.points * self.fit.variance, np.nan)

    @cached_property
    def point_sigma(self) -> Array:
        """Standard deviations (p, 3) of the points."""
        return np.sqrt(np.maximum(np.diagonal(self.point_covariance, axis1=1, axis2=2), 0.0))

    @cached_property
    def check_points(self) -> tuple[Rows, Array]:
        """Rows of the check points, and their differences, estimated minus given (k, 3)."""
        rows = np.flatnonzero([role == "check" for role in self.network.role])
        rows = rows[self.fit.usable.points[rows]]
        return rows, self.fit.values.xyz[rows] - self.network.xyz[rows]

    # -- joint covariances

    def covariance_of(self, *names: str) -> Array:
        """Return the joint covariance of any unknowns.

        Parameters
        ----------
        *names : str
            Names such as ``c of camera C``, ``X0 of image I`` (or Y0, Z0), ``dx of image I`` (or dy, dz:
            rotations about the camera axes, rad), ``X of point P`` (or Y, Z), ``b1 of group G``,
            ``distance of W`` for a window, ``index of M`` for a medium.

        Returns
        -------
        ndarray (k, k)
            In the order of the names; zero for held coordinates.

        Raises
        ------
        UsageError
            When a name is not that of an estimated unknown.
        """
        unknowns, network = self.fit.unknowns, self.network
        column_of = {name: k for k, name in enumerate(unknowns.names)}
        point_row = {name: j for j, name in enumerate(network.points)}
        columns, points, places = list[int](), list[int](), list[tuple[bool, int, int]]()
        for name in names:
            axis, _, label = name.partition(" of point ")
            if name in column_of:
                places.append((False, len(columns), 0))
                columns.append(column_of[name])
            elif label in point_row and axis in "XYZ" and self.fit.usable.points[point_row[label]]:
                j = point_row[label]
                points += [j] if j not in points else []
                places.append((True, points.index(j), "XYZ".index(axis)))
            else:
                raise UsageError("is not an estimated unknown", where=name)
        joint = self.fit.cofactors.joint(np.array(columns, dtype=np.intp), np.array(points, dtype=np.intp))
        at = [len(columns) + 3 * k + axis if of_point else k for of_point, k, axis in places]
        doubt = np.concatenate([self.in_doubt[0][columns], np.repeat(self.in_doubt[1][points], 3)])
        joint[doubt], joint[:, doubt] = np.nan, np.nan
        return joint[np.ix_(at, at)] * self.fit.variance

    # -- observations

    def rms_px(self, camera: int | None = None) -> float:
        """Root mean square of the residuals of an image coordinate, px, without points that were left out.

        The figure of OpenCV is that of the distances, larger by the root of 2. `camera` is the row of one
        camera; by default all.
        """
        v = self.residuals[self.used if camera is None else self.used_by(camera)]
        return float(np.sqrt((v**2).mean())) if len(v) else float("nan")

    @property
    def used(self) -> Mask:
        """Image points (n,) that were adjusted."""
        known = np.isfinite(self.residuals).all(axis=1)
        return np.asarray(self.fit.usable.observations & known & ~self.rejected)

    def used_by(self, camera: int) -> Rows:
        """Return the rows of the image points of a camera that were adjusted."""
        rows = self.network.rays_of_cameras[camera]
        return rows[self.used[rows]]

    def residuals_by_image(self) -> Table:
        """Residuals of each image: its camera, points, those left out, root mean square and largest, px."""
        network, rows = self.network, self.network.image_of
        count = np.bincount(rows[self.used], minlength=len(network.images))
        squares = np.where(self.used[:, None], np.nan_to_num(self.residuals) ** 2, 0.0).sum(axis=1)
        largest = np.zeros(len(network.images))
        np.maximum.at(largest, rows, np.sqrt(squares))
        total = np.bincount(rows, squares, len(network.images))
        rms = np.sqrt(np.divide(total, 2 * count, out=np.full(len(count), np.nan), where=count > 0))
        left_out = np.bincount(rows[self.rejected], minlength=len(network.images))
        return Table(
            "images",
            {"image": list(network.images), "camera": [network.cameras[c].id for c in network.camera_of],
             "points": count.tolist(), "left_out": left_out.tolist(), "rms_px": rms.tolist(),
             "largest_px": np.where(count > 0, largest, np.nan).tolist()},
        )  # fmt: skip

    @property
    def residuals(self) -> Array:
        """v (n, 2) of the image coordinates, px; NaN where undetermined."""
        return self._of_image_points(self.fit.residuals)

    @cached_property
    def redundancy_numbers(self) -> Array:
        """Redundancy numbers (n, 2) of the image coordinates."""
        return self._of_image_points(self.fit.redundancy_numbers)

    @cached_property
    def test_values(self) -> Array:
        """``w = |v|/(sigma0·σ·√r)`` of the image coordinates (n, 2); NaN for rejected ones."""
        sigma0 = self.sigma0 if self.redundancy > 0 and self.sigma0 > 0 else 1.0
        return self._of_image_points(np.abs(self.fit.w)) / sigma0

    def minimal_detectable_errors(self, alpha: float = 0.001, power: float = 0.8) -> Array:
        """Return the errors of single image coordinates (n, 2) detectable with this power, px."""
        return self._of_image_points(self.fit.minimal_detectable_errors(alpha, power))

    def external_reliability(self, alpha: float = 0.001, power: float = 0.8) -> Array:
        """Return the largest effect of undetected errors on any result (n, 2), in its standard deviations."""
        return self._of_image_points(self.fit.external_lengths(alpha, power))

    @cached_property
    def scatter(self) -> tuple[Array, Array]:
        """Sums of v²/σ² of x and y in each image (m, 2), and their expectations for correct sigmas (m, 2).

        The expectation is the sum of the variances of the residuals over σ²: the sum of the redundancy
        numbers, if x and y are uncorrelated.
        """
        cov = self.network.cov
        variance = np.diagonal(cov, axis1=1, axis2=2)
        kept = self.used[:, None]
        hat = next(iter(self.fit.solution.hats()))
        left = np.diagonal(cov - cov @ hat @ cov, axis1=1, axis2=2) / variance
        squares = np.nan_to_num(self.residuals) ** 2 / variance
        sums = np.zeros((2, len(self.network.images), 2))
        for total, values in zip(sums, (squares, left), strict=True):
            np.add.at(total, self.network.image_of, np.where(kept, values, 0.0))
        return sums[0], sums[1]

    @cached_property
    def variance_factors(self) -> Array:
        """Factors by which the input sigmas of x and y in each image are too small (m, 2); NaN if unknown.

        To first order; :func:`~reseau.bundle.estimate_components` iterates.
        """
        return _factors(*self.scatter)

    def rejected_points(self) -> list[tuple[str, str, float, float]]:
        """Return image, point, test value and critical value of the rejected image points.

        Test values are NaN for gross errors that were left out before data snooping. Points of images that
        were left out as a whole are not among them.
        """
        network = self.network
        rows = np.flatnonzero(self.rejected & self.fit.usable.images[network.image_of])
        return [
            (network.images[network.image_of[k]], network.points[network.point_of[k]], *map(float, test))
            for k, test in zip(rows, self.rejected_tests[rows], strict=True)
        ]

    @cached_property
    def rejected_tests(self) -> Array:
        """Test values at rejection and critical values (n, 2) of rejected image points, otherwise NaN."""
        tests = np.full((len(self.network.xy), 2), np.nan)
        for step in self.steps:
            row = step.index[0] // 2
            if row < len(tests):
                tests[row] = step.statistic, step.critical
        tests[~self.rejected] = np.nan
        return tests

    def _of_image_points(self, flat: Array) -> Array:
        n = len(self.network.xy)
        return flat[: 2 * n].reshape(n, 2)


def _factors(squares: Array, expected: Array) -> Array:
    known = expected > _UNCONTROLLED
    return np.sqrt(np.divide(squares, expected, out=np.full_like(squares, np.nan), where=known))
