"""Estimates of an adjustment in columns, with their standard deviations: cameras, images, points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...adjust.significance import CoefficientTest
from ...core.data import Array, Rows
from ...core.display import Display
from ...core.numbers import measured, plain
from ..network.shutter import MOTION


@dataclass(frozen=True, eq=False, repr=False)
class CameraEstimate(Display):
    """Estimated parameters of one camera.

    Parameters
    ----------
    id : str
        Name of the camera.
    parameters : tuple of str (u,)
        Names of the estimated parameters, with the group or image for sets of additional parameters.
    values : ndarray (u,)
        Estimates, in the units of `units`.
    covariance : ndarray (u, u)
        Their covariance, which contains what the points of each image have in common.
    units : tuple of str (u,)
        Units; empty for dimensionless parameters.
    formal : ndarray (u, u), optional
        The covariance that presumes independent errors of all image points; by default the same.
    dof : ndarray (u,), optional
        Degrees of freedom of the variances, for intervals by Student's distribution.

    Examples
    --------
    >>> camera = CameraEstimate("front", ("c",), np.array([8.01234]), np.array([[4e-6]]), ("mm",))
    >>> camera
    <CameraEstimate: front, c 8.0123 ± 0.0020 mm>
    >>> camera["c"], camera.sigma
    (8.01234, array([0.002]))
    """

    id: str
    parameters: tuple[str, ...]
    values: Array
    covariance: Array
    units: tuple[str, ...]
    formal: Array | None = field(default=None, kw_only=True)
    dof: Array | None = field(default=None, kw_only=True)

    @property
    def sigma(self) -> Array:
        """Standard deviations (u,)."""
        return _deviations(self.covariance)

    @property
    def sigma_formal(self) -> Array:
        """Standard deviations (u,) that presume independent errors of all image points."""
        return self.sigma if self.formal is None else _deviations(self.formal)

    @property
    def correlation(self) -> Array:
        """Correlation matrix (u, u)."""
        known = self.formal is None or bool(np.isfinite(self.covariance).all())
        covariance = self.covariance if known or self.formal is None else self.formal
        size = np.sqrt(np.diag(covariance))
        size = np.where(size > 0, size, 1.0)
        correlation: Array = covariance / np.outer(size, size)
        np.fill_diagonal(correlation, 1.0)
        return correlation

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.parameters.index(name)])

    @property
    def texts(self) -> tuple[str, ...]:
        """Estimates with standard deviations and units, as they are printed."""
        rows = zip(self.values.tolist(), self.sigma.tolist(), self.units, strict=True)
        return tuple("not determined" if np.isnan(s) else measured(value, s, unit) for value, s, unit in rows)

    def _facts(self) -> list[tuple[str, str]]:
        return [(self.id, ""), *zip(self.parameters, self.texts, strict=True)]

    def _columns(self) -> dict[str, list[object]]:
        return {
            "parameter": list(self.parameters),
            "value": self.values.tolist(),
            "sigma": self.sigma.tolist(),
            "unit": list(self.units),
        }


@dataclass(frozen=True, eq=False, repr=False)
class RefractionEstimate(CameraEstimate):
    """Estimated parameters of windows and media, in the manner of those of a camera.

    Parameters
    ----------
    given : ndarray (u,)
        Values in the network, with which the estimates are compared.
    tests : tuple of CoefficientTest
        Test of each estimate against the given value.
    partners : tuple of (str, float)
        For each parameter the unknown of a camera, an image, a window or a medium with which it is correlated
        most, and the correlation.

    Examples
    --------
    >>> found = RefractionEstimate("windows and media", ("distance of port",), np.array([40.2]),
    ...     np.array([[0.01]]), ("mm",), np.array([40.0]), (), (("c of camera cam", -0.97),))
    >>> found
    <RefractionEstimate: windows and media, distance of port 40.20 ± 0.10 mm>
    """

    given: Array
    tests: tuple[CoefficientTest, ...]
    partners: tuple[tuple[str, float], ...]


@dataclass(frozen=True, eq=False, repr=False)
class StageEstimate(Display):
    """Axis and readings of a stage.

    Parameters
    ----------
    kind : {"linear", "rotary"}
        How it moves.
    carries : {"object", "camera"}
        What it moves.
    direction, position : ndarray (3,)
        Unit vector of the axis, about which the object turns (or along which it is shifted), and of a rotary
        axis its point next to the centroid of the object points.
    cov : ndarray (6, 6)
        Their covariance, of rank 4: the direction has none along itself, nor the position along the axis.
    images : tuple of str (k,)
        Images on the stage.
    reading : ndarray (k,)
        Readings: rad, or the unit of object space.
    reading_sigma : ndarray (k,)
        Their standard deviations; zero for readings that are held.
    residual : ndarray (k,)
        Estimated minus given reading; NaN for one that was not given.
    unit : str
        Unit of object space.

    Examples
    --------
    >>> cov = np.diag([1e-8, 1e-8, 0.0, 4e-4, 4e-4, 0.0])
    >>> none = np.zeros(0)
    >>> axis = StageEstimate("rotary", "object", np.array([0.0, 0.0, 1.0]), np.array([12.0, -7.0, 0.0]), cov,
    ...     (), none, none, none, "mm")
    >>> axis
    <StageEstimate: rotary, axis ± 0.0057 deg, position ± 0.02 mm>
    """

    kind: str
    carries: str
    direction: Array
    position: Array
    cov: Array
    images: tuple[str, ...]
    reading: Array
    reading_sigma: Array
    residual: Array
    unit: str

    @property
    def direction_sigma(self) -> float:
        """Largest standard deviation of the direction (rad)."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.cov[:3, :3])[-1], 0.0)))

    @property
    def position_sigma(self) -> float:
        """Largest standard deviation of the position, across the axis."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.cov[3:, 3:])[-1], 0.0)))

    def _facts(self) -> list[tuple[str, str]]:
        facts = [(self.kind, ""), ("axis", f"± {plain(np.rad2deg(self.direction_sigma), 2)} deg")]
        if self.kind == "rotary":
            facts.append(("position", f"± {plain(self.position_sigma, 2)} {self.unit}"))
        return facts


@dataclass(frozen=True, eq=False, repr=False)
class RigEstimate(Display):
    """Relative orientations of the cameras of a rig.

    Parameters
    ----------
    cameras, references : tuple of str (k,)
        Cameras, and for each the camera whose axes are those of the rig.
    rotation : ndarray (k, 3, 3)
        From the axes of the rig to those of the camera.
    base : ndarray (k, 3)
        Projection centres in the axes of the rig, in the unit of object space.
    cov : ndarray (k, 6, 6)
        Covariances of a small rotation about the axes of the camera (rad) and of the base.
    unit : str
        Unit of object space.

    Examples
    --------
    >>> base, cov = np.array([[120.0, 0.0, 5.0]]), 1e-4 * np.eye(6)[None]
    >>> rig = RigEstimate(("right",), ("left",), np.eye(3)[None], base, cov, "mm")
    >>> rig
    <RigEstimate: right from left base 120.104 ± 0.010 mm>
    >>> rig.length.round(3), rig.length_sigma
    (array([120.104]), array([0.01]))
    """

    cameras: tuple[str, ...]
    references: tuple[str, ...]
    rotation: Array
    base: Array
    cov: Array
    unit: str

    @property
    def sigma(self) -> Array:
        """Standard deviations (k, 6) of rotation (rad) and base."""
        return _deviations(self.cov)

    @property
    def length(self) -> Array:
        """Lengths (k,) of the bases."""
        return np.asarray(np.linalg.norm(self.base, axis=1))

    @property
    def length_sigma(self) -> Array:
        """Standard deviations (k,) of the lengths."""
        along = self.base / self.length[:, None]
        return np.asarray(np.sqrt(np.einsum("ki,kij,kj->k", along, self.cov[:, 3:, 3:], along)))

    @property
    def angles(self) -> Array:
        """Angles (k,) of the rotations, degrees."""
        cosine = (np.trace(self.rotation, axis1=1, axis2=2) - 1) / 2
        return np.asarray(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (f"{camera} from {reference}", f"base {measured(float(length), float(sigma), self.unit)}")
            for camera, reference, length, sigma in zip(
                self.cameras, self.references, self.length, self.length_sigma, strict=True
            )
        ]


@dataclass(frozen=True, eq=False, repr=False)
class PriorInfluence(Display):
    """How much observed parameters of a camera, such as a regularisation, determine its estimates.

    Parameters
    ----------
    parameters : tuple of str (u,)
        Parameters that are observations.
    given, sigma_given : ndarray (u,)
        Observed values and their standard deviations.
    share : ndarray (u,)
        Share of the observation in the information on each parameter: 0 where the images alone determine it,
        1 where they say nothing. It is 1 less the redundancy number of the observation.
    sigma : ndarray (u,)
        Standard deviations of the estimates.
    sigma_images : ndarray (u,)
        The part of these that the noise of all other observations causes. Where the observation is not a
        measurement, the rest stands for what the regularisation smooths away.
    sigma0 : float
        Standard deviation of unit weight without these observations and their share of the redundancy.

    Examples
    --------
    >>> one = np.ones(2)
    >>> found = PriorInfluence(("k1", "k2"), 0 * one, one, np.array([0.1, 1.0]), one, one, 1.0)
    >>> found, round(found.determined, 1)
    (<PriorInfluence: 2 observed parameters, the images determine 0.9 of them>, 0.9)
    """

    parameters: tuple[str, ...]
    given: Array
    sigma_given: Array
    share: Array
    sigma: Array
    sigma_images: Array
    sigma0: float

    @property
    def determined(self) -> float:
        """Number of parameters that the images determine: the sum of the redundancy numbers."""
        return float((1 - self.share).sum())

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (f"{len(self.parameters)} observed parameters", ""),
            (f"the images determine {self.determined:.1f} of them", ""),
        ]

    def _columns(self) -> dict[str, list[object]]:
        return {
            "parameter": list(self.parameters), "given": self.given.tolist(),
            "s_given": self.sigma_given.tolist(), "share": self.share.tolist(), "s": self.sigma.tolist(),
            "s_images": self.sigma_images.tolist(),
        }  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class MotionEstimates(Display):
    """Motions of the images of cameras with a shutter: velocity (vx, vy, vz) and rotation rates (wx, wy, wz).

    Parameters
    ----------
    names : tuple of str (k,)
        Names of the images.
    values : ndarray (k, 6)
        Velocity along the axes of the camera, in units of object space per second; rates about them, rad per
        second.
    cov : ndarray (k, 6, 6)
        Their covariances; zero for components that were not estimated.
    tests : tuple of CoefficientTest
        Of each component of each image against zero, ``vx of image I``; those that were estimated.
    unit : str
        Unit of object space.

    Examples
    --------
    >>> motion = MotionEstimates(("i1",), np.ones((1, 6)), 0.01 * np.eye(6)[None], (), "m")
    >>> motion
    <MotionEstimates: 1 image, speed 1.7 m/s in the median>
    >>> motion.sigma.round(3)
    array([[0.1, 0.1, 0.1, 0.1, 0.1, 0.1]])
    """

    names: tuple[str, ...]
    values: Array
    cov: Array
    tests: tuple[CoefficientTest, ...]
    unit: str

    @property
    def sigma(self) -> Array:
        """Standard deviations (k, 6)."""
        return _deviations(self.cov)

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (f"{len(self.names)} image{'s' * (len(self.names) != 1)}", ""),
            ("speed", _median(self.values[:, :3], f"{self.unit}/s")),
        ]

    def _columns(self) -> dict[str, list[object]]:
        found: dict[str, list[object]] = {"image": list(self.names)}
        for k, name in enumerate(MOTION):
            found[name], found[f"s_{name}"] = self.values[:, k].tolist(), self.sigma[:, k].tolist()
        return found


@dataclass(frozen=True, eq=False, repr=False)
class ImageEstimates(Display):
    """Exterior orientations of all images; NaN for images that are not oriented.

    Parameters
    ----------
    names : tuple of str (m,)
        Names of the images.
    cameras : tuple of str (m,)
        Name of the camera of each image.
    x0 : ndarray (m, 3)
        Projection centres, in the unit of object space.
    rotation : ndarray (m, 3)
        Rotation vectors, rad; x_c = R(X − X0).
    cov : ndarray (m, 6, 6)
        Covariances of X0, Y0, Z0 and the rotation vector.
    unit : str
        Unit of object space.

    Examples
    --------
    >>> images = ImageEstimates(("i1",), ("cam",), np.ones((1, 3)), np.zeros((1, 3)), np.eye(6)[None], "m")
    >>> images
    <ImageEstimates: 1 image, sigma of X0 1.7 m in the median>
    >>> images.sigma.shape, len(images)
    ((1, 6), 1)
    """

    names: tuple[str, ...]
    cameras: tuple[str, ...]
    x0: Array
    rotation: Array
    cov: Array
    unit: str

    def __len__(self) -> int:
        return len(self.names)

    @property
    def sigma(self) -> Array:
        """Standard deviations (m, 6) of X0, Y0, Z0 and of the rotation vector."""
        return _deviations(self.cov)

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (f"{len(self)} image{'s' * (len(self) != 1)}", ""),
            ("sigma of X0", _median(self.sigma[:, :3], self.unit)),
        ]

    def _columns(self) -> dict[str, list[object]]:
        found: dict[str, list[object]] = {"image": list(self.names), "camera": list(self.cameras)}
        names = ("X0", "Y0", "Z0", "rx_rad", "ry_rad", "rz_rad")
        for k, (name, value) in enumerate(zip(names, np.hstack([self.x0, self.rotation]).T, strict=True)):
            found |= {name: value.tolist(), f"sigma_{name}": self.sigma[:, k].tolist()}
        return found


@dataclass(frozen=True, eq=False, repr=False)
class PointEstimates(Display):
    """Object points; NaN for undetermined points, covariance zero for held points.

    Parameters
    ----------
    names : tuple of str (p,)
        Names of the points.
    roles : tuple of {"tie", "control", "check"} (p,)
        Use of each point.
    xyz : ndarray (p, 3)
        Coordinates, in the unit of object space.
    cov : ndarray (p, 3, 3)
        Their covariances.
    rays : ndarray of int (p,)
        Number of images of each point.
    unit : str
        Unit of object space.

    Examples
    --------
    >>> cov = 1e-6 * np.eye(3)[None]
    >>> points = PointEstimates(("p1",), ("tie",), np.ones((1, 3)), cov, np.array([4]), "m")
    >>> points
    <PointEstimates: 1 point, sigma 0.0017 m in the median>
    >>> points.sigma
    array([[0.001, 0.001, 0.001]])
    """

    names: tuple[str, ...]
    roles: tuple[str, ...]
    xyz: Array
    cov: Array
    rays: Rows
    unit: str

    def __len__(self) -> int:
        return len(self.names)

    @property
    def sigma(self) -> Array:
        """Standard deviations (p, 3)."""
        return _deviations(self.cov)

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (f"{len(self)} point{'s' * (len(self) != 1)}", ""),
            ("sigma", _median(self.sigma, self.unit)),
        ]

    def _columns(self) -> dict[str, list[object]]:
        found: dict[str, list[object]] = {"point": list(self.names), "role": list(self.roles)}
        for k, name in enumerate("XYZ"):
            found |= {name: self.xyz[:, k].tolist(), f"sigma_{name}": self.sigma[:, k].tolist()}
        return found | {"rays": self.rays.tolist()}


def _deviations(cov: Array) -> Array:
    """Return the standard deviations (…, k) of covariances (…, k, k)."""
    return np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))


def _median(sigma: Array, unit: str) -> str:
    """Median of the spatial standard deviations (k, 3) of estimated points, with unit."""
    size = np.linalg.norm(sigma, axis=1)
    known = size[np.isfinite(size) & (size > 0)]
    return f"{np.median(known):.2g} {unit} in the median" if len(known) else "held"
