"""Windows and media between a camera and its object points: what they are, and their parameters in columns.

A window is a pane with two parallel surfaces, or a single surface between two media. It is fixed to the
camera (a port: *bundle-invariant* in Kotowski 1988), to a rig of cameras (the surface of water below cameras
that are fixed to each other) or to the object (the wall of a tank: *object-invariant*). A ray passes a *path*
of windows, those of the camera first, then those of the rig. Surfaces are

- plane: m·X = d, with the unit normal m ∝ w + a·s + b·t for the nominal normal w and two directions s, t
  perpendicular to it; with a curvature κ the surface is the sphere that touches this plane at d·m and has its
  centre at (d + 1/κ)·m;
- sphere: ``|X − C| = r``;
- cylinder: distance r from the line through x·s + y·t with the direction u ∝ w + a·s + b·t.

The second surface of a pane is farther from the camera by the thickness: at d + τ, or with the radius r + τ
outside the first. The radius of a sphere or cylinder is that of its inner surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from ...core.data import Array, Mask, Rows, twice
from ...core.display import Display
from ...core.errors import UsageError

Shape = Literal["plane", "sphere", "cylinder"]
On = Literal["camera", "rig", "object"]

_PARAMETERS: dict[Shape, tuple[str, ...]] = {
    "plane": ("tilt_X", "tilt_Y", "distance", "curvature"),
    "sphere": ("X", "Y", "Z", "radius"),
    "cylinder": ("tilt_X", "tilt_Y", "X", "Y", "radius"),
}
_ORDER: tuple[On, ...] = ("camera", "rig", "object")
"""To what the windows of a path are fixed, from the camera on."""
_KIND: dict[Shape, int] = {"plane": 0, "sphere": 1, "cylinder": 2}
# A surface is described by a unit vector, a point, and its curvature or radius.
_PRIMITIVES = 7


def window_parameters(shape: Shape, *, pane: bool = True) -> tuple[str, ...]:
    """Names of the parameters of a window.

    Parameters
    ----------
    shape : {"plane", "sphere", "cylinder"}
        Shape of its surfaces.
    pane : bool
        Whether it has two surfaces, and so a thickness.

    Examples
    --------
    >>> window_parameters("plane")
    ('tilt_X', 'tilt_Y', 'distance', 'curvature', 'thickness')
    """
    return (*_PARAMETERS[shape], *(("thickness",) if pane else ()))


@dataclass(frozen=True)
class RefractiveIndex:
    """A medium and its refractive index at the wavelength of the images.

    Parameters
    ----------
    name : str
        Name of the medium.
    value : float
        Index.
    free : bool
        Whether it is estimated.
    sigma : float, optional
        Standard deviation of a free index whose value is an observation.
    dispersion : callable, optional
        Index as a function of the wavelength (nm), for images formed by rays of several wavelengths.

    Examples
    --------
    >>> RefractiveIndex("water", 1.333, free=True, sigma=1e-4).label
    'index of water'
    """

    name: str
    value: float
    free: bool = False
    sigma: float | None = None
    dispersion: Callable[[float], float] | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.value) and 0.5 < self.value < 10):
            raise UsageError(f"{self.value} is not a refractive index", where=f"medium {self.name}")
        if self.sigma is not None and not (self.free and 0 < self.sigma < np.inf):
            raise UsageError("`sigma` must be positive, and the index free", where=f"medium {self.name}")

    @property
    def label(self) -> str:
        """Name of the index among the unknowns."""
        return f"index of {self.name}"


@dataclass(frozen=True, eq=False)
class Window:
    """A pane with two parallel surfaces, or a single surface, between media.

    Parameters
    ----------
    name : str
        Name of the window.
    shape : {"plane", "sphere", "cylinder"}
        Shape of its surfaces; see the module.
    on : {"camera", "rig", "object"}
        To what it is fixed, and in whose coordinate system it is given. That of the camera has its origin in
        the projection centre, x to the right, y down, z along the view; that of a rig is the one of its first
        camera.
    values : mapping of str to float
        Parameters by name, see :func:`window_parameters`; those left out are 0. Lengths are in the unit of
        object space, tilts are tangents, and the curvature is 1/length.
    media : tuple of str
        Names of the media from the camera to the object: three for a pane, two for a single surface.
    free : tuple of str
        Parameters to estimate.
    sigma : mapping of str to float
        Standard deviations of free parameters whose values are observations.
    direction : (float, float, float)
        Nominal normal of a plane, in the direction of the view, or axis of a cylinder.
    camera_side : {"inside", "outside"}
        Where the camera is, for a sphere or cylinder.

    Examples
    --------
    >>> port = Window("port", "plane", "camera", {"distance": 40.0, "thickness": 10.0},
    ...               ("air", "glass", "water"), free=("distance",))
    >>> port.labels
    ('tilt_X of port', 'tilt_Y of port', 'distance of port', 'curvature of port', 'thickness of port')
    """

    name: str
    shape: Shape
    on: On
    values: Mapping[str, float]
    media: tuple[str, ...]
    free: tuple[str, ...] = ()
    sigma: Mapping[str, float] = field(default_factory=dict)
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    camera_side: Literal["inside", "outside"] = "inside"

    def __post_init__(self) -> None:
        where = f"window {self.name}"
        if self.shape not in _PARAMETERS or self.on not in _ORDER:
            raise UsageError(
                f"a {self.shape} on the {self.on} is not known; a plane, sphere or cylinder is, "
                "on the camera, on the rig or on the object",
                where=where,
            )
        if len(self.media) not in (2, 3):
            raise UsageError(
                f"has {len(self.media)} media; a pane has three, a single surface two", where=where
            )
        if len(self.media) == 3 and self.values.get("thickness", 0.0) <= 0:
            raise UsageError("a pane needs a `thickness` above 0", where=where)
        for what, names in (("values", self.values), ("free", self.free), ("sigma", self.sigma)):
            for name in names:
                if name not in self.names:
                    raise UsageError(
                        f"`{what}` contains {name!r}, which is not one of {', '.join(self.names)}",
                        where=where,
                    )
        for name, value in self.values.items():
            if not np.isfinite(value):
                raise UsageError(f"{name} is not a number", where=where)
        for name, sigma in self.sigma.items():
            if name not in self.free or not 0 < sigma < np.inf:
                raise UsageError(f"`sigma` of {name} must be positive, and the parameter free", where=where)
        if self.shape != "plane" and not self.values.get("radius", 0.0) > 0:
            raise UsageError("needs a `radius` above 0", where=where)
        if self.shape == "plane" and self.on != "object" and not self.values.get("distance", 0.0) > 0:
            raise UsageError("needs a `distance` from the projection centre above 0", where=where)
        if not np.linalg.norm(self.direction) > 0:
            raise UsageError("`direction` must not be zero", where=where)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its parameters."""
        return window_parameters(self.shape, pane=self.is_pane)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of its parameters among the unknowns."""
        return tuple(f"{name} of {self.name}" for name in self.names)

    @property
    def is_pane(self) -> bool:
        """Whether it has two surfaces."""
        return len(self.media) == 3

    @property
    def start(self) -> Array:
        """Values of its parameters, in their order."""
        return np.array([self.values.get(name, 0.0) for name in self.names])

    @cached_property
    def frame(self) -> Array:
        """Nominal direction w and the perpendicular directions s, t of the tilts, as rows (3, 3).

        For the z-axis, s and t are the x- and y-axis.
        """
        w = np.asarray(self.direction, dtype=np.float64)
        w = w / np.linalg.norm(w)
        near = np.eye(3)[0] if abs(w[0]) < 0.9 else np.eye(3)[1]
        s = near - (near @ w) * w
        s /= np.linalg.norm(s)
        return np.stack([w, s, np.cross(w, s)])

    @property
    def _turning(self) -> int:
        """Number of parameters that turn a direction; they come first."""
        return 0 if self.shape == "sphere" else 2

    def unit(self, values: Array) -> tuple[Array, Array]:
        """Return the normal or axis (3,) and its derivatives by the two tilts (2, 3); zeros for a sphere."""
        if not self._turning:
            return np.zeros(3), np.zeros((2, 3))
        whole = self.frame[0] + values[:2] @ self.frame[1:]
        length = float(np.linalg.norm(whole))
        u = whole / length
        across = self.frame[1:]
        return u, (across - np.outer(across @ u, u)) / length

    def surfaces(self, values: Array) -> list[tuple[float, Array, Array]]:
        """Describe the surfaces in the order of the rays.

        Parameters
        ----------
        values : ndarray (u,)
            Parameters.

        Returns
        -------
        list of (float, ndarray (7,), ndarray (7, u))
            For each surface: 1 where rays pass along the gradient of its equation, otherwise −1; its unit
            vector, point, and curvature (plane) or radius; derivatives of these by the parameters.
        """
        pane = float(values[-1]) if self.is_pane else 0.0
        u, by_tilt = self.unit(values)
        found = []
        for second in range(2 if self.is_pane else 1):
            tau = pane if second else 0.0
            row, slope = np.zeros(_PRIMITIVES), np.zeros((_PRIMITIVES, len(values)))
            if self.shape == "plane":
                d, curvature = values[2] + tau, values[3]
                bent = 1 - curvature * tau
                row[:3], row[3:6], row[6] = u, d * u, curvature / bent
                slope[:3, :2], slope[3:6, :2] = by_tilt.T, d * by_tilt.T
                slope[3:6, 2], slope[6, 3] = u, 1 / bent**2
                if second:
                    slope[3:6, -1], slope[6, -1] = u, (curvature / bent) ** 2
            elif self.shape == "sphere":
                row[3:6], row[6] = values[:3], values[3] + tau
                slope[3:6, :3], slope[6, 3] = np.eye(3), 1.0
            else:
                row[:3], row[3:6], row[6] = u, values[2:4] @ self.frame[1:], values[4] + tau
                slope[:3, :2], slope[3:6, 2:4], slope[6, 4] = by_tilt.T, self.frame[1:].T, 1.0
            if second and self.shape != "plane":
                slope[6, -1] = 1.0
            found.append((1.0, row, slope))
        if self.shape != "plane" and self.camera_side == "outside":
            found = [(-1.0, row, slope) for _, row, slope in reversed(found)]
        return found

    def transformed(self, values: Array, scale: float, turn: Array, shift: Array) -> Array:
        """Return the parameters after the similarity X' = scale · turn · X + shift of object space.

        A window on the camera or on a rig only changes its lengths.
        """
        if self.on != "object":
            turn, shift = np.eye(3), np.zeros(3)
        return self._moved(values, scale, turn, shift, self)

    def on_camera(self, values: Array, turn: Array, base: Array, name: str) -> Self:
        """Return a window on a rig as one on a camera, which has this place (3, 3), (3,) on the rig.

        Parameters
        ----------
        values : ndarray (u,)
            Parameters in the axes of the rig.
        turn, base : ndarray (3, 3), (3,)
            Rotation from the axes of the rig to those of the camera, and its projection centre.
        name : str
            Name of the new window.
        """
        x, y, z = (turn @ self.frame[0]).tolist()
        bare = replace(self, name=name, on="object", direction=(x, y, z), free=(), sigma={})
        moved = self._moved(values, 1.0, turn, -turn @ base, bare)
        return replace(bare, on="camera", values=dict(zip(self.names, moved.tolist(), strict=True)))

    def _moved(self, values: Array, scale: float, turn: Array, shift: Array, onto: Window) -> Array:
        """Parameters after a similarity, with the nominal directions of another window."""
        moved = values.copy()
        u, _ = self.unit(values)
        if self.shape == "plane":
            # The centre of curvature is transformed; written so that it holds without curvature too.
            distance, curvature = values[2:4]
            grown = 1 + curvature * distance
            whole = grown * turn @ u + curvature / scale * shift
            length = float(np.linalg.norm(whole))
            along = float((turn @ u) @ shift)
            excess = 2 * distance + curvature * distance**2 + 2 * grown * along / scale
            moved[2] = scale * (excess + curvature * float(shift @ shift) / scale**2) / (length + 1)
            moved[:2], moved[3] = onto._tilts(whole), curvature / scale
        elif self.shape == "sphere":
            moved[:3], moved[3] = scale * turn @ values[:3] + shift, scale * values[3]
        else:
            axis = turn @ u
            at = scale * turn @ (values[2:4] @ self.frame[1:]) + shift
            at = at - (at @ onto.frame[0]) / (axis @ onto.frame[0]) * axis
            moved[:2], moved[2:4], moved[4] = onto._tilts(axis), onto.frame[1:] @ at, scale * values[4]
        if self.is_pane:
            moved[-1] = scale * values[-1]
        return moved

    def _tilts(self, along: Array) -> Array:
        tilts: Array = self.frame[1:] @ along / (self.frame[0] @ along)
        return tilts

    def changes(self, values: Array) -> Array:
        """Changes of the parameters (u, 7) by a small shift (3), rotation (3) and scale of object space.

        X' = X + t + ω × X + μX.
        """
        found = np.zeros((len(values), 7))
        if self.on == "object":
            for k in range(3):
                found[:, k] = self._change(values, np.eye(3)[k], np.zeros(3))
                found[:, 3 + k] = self._change(values, np.zeros(3), np.eye(3)[k])
        lengths = [name in ("distance", "X", "Y", "Z", "radius", "thickness") for name in self.names]
        found[lengths, 6] = values[lengths]
        if self.shape == "plane":
            found[3, 6] = -values[3]
        return found

    def _change(self, values: Array, shift: Array, turn: Array) -> Array:
        change = np.zeros(len(values))
        u, _ = self.unit(values)
        w, across = self.frame[0], self.frame[1:]
        if self.shape == "sphere":
            change[:3] = shift + np.cross(turn, values[:3])
            return change
        by = np.cross(turn, u)
        if self.shape == "plane":
            by = by + (shift - (shift @ u) * u) * values[3] / (1 + values[3] * values[2])
            change[2] = u @ shift
        else:
            at = values[2:4] @ across
            to = shift + np.cross(turn, at)
            to = to - (to @ w) / (u @ w) * u
            change[2:4] = across @ to
        change[:2] = (across @ by - values[:2] * (w @ by)) / (w @ u)
        return change


class Mounts(NamedTuple):
    """Paths of windows split by cameras, whose places on a rig they depend on; see :meth:`Refraction.split`.

    Parameters
    ----------
    path : ndarray of int (q,)
        Path of the refraction.
    rotation, base : ndarray (q, 3, 3), (q, 3)
        Rotation of the camera from the axes of the rig, and its projection centre there.
    column : ndarray of int (q,)
        First of the six derivatives by the place of the camera, after those by the free parameters: by a
        rotation about its axes and by its projection centre; −1 where the place is known.
    unknown : int
        Number of cameras with unknown places.
    """

    path: Rows
    rotation: Array
    base: Array
    column: Rows
    unknown: int


class RefractionColumns(NamedTuple):
    """Paths of windows as the compiled rays receive them; padded to the longest path, of k surfaces.

    Parameters
    ----------
    surfaces : ndarray of int (p,)
        Number of surfaces of each path.
    kind : ndarray of int (p, k)
        0 plane, 1 sphere, 2 cylinder.
    on_object : ndarray of bool (p, k)
        Whether the surface is fixed to the object.
    side : ndarray (p, k)
        1 where rays pass along the gradient, −1 against it.
    primitives : ndarray (p, k, 7)
        Unit vector, point, curvature or radius.
    by_parameters : ndarray (p, k, 7, f)
        Their derivatives by the free parameters, and by the places of cameras on a rig.
    indices : ndarray (p, k + 1)
        Refractive indices from the camera to the object.
    index_of : ndarray of int (p, k + 1)
        Number of the free parameter that the index is, −1 for a fixed one.
    """

    surfaces: Rows
    kind: Rows
    on_object: Mask
    side: Array
    primitives: Array
    by_parameters: Array
    indices: Array
    index_of: Rows


@dataclass(frozen=True, eq=False, repr=False)
class Refraction(Display):
    """Media and windows of a network, and the windows that the rays of each image pass.

    Parameters
    ----------
    media : tuple of RefractiveIndex
        Media.
    windows : tuple of Window
        Windows.
    paths : tuple of tuple of int
        Windows of each path, from the camera to the object.
    path_of : ndarray of int (m,)
        Path of each image; −1 for images in air.

    Raises
    ------
    UsageError
        When names occur twice, a medium is unknown, the media of consecutive windows differ, or a window on
        the object precedes one on the camera.

    Notes
    -----
    Derived in ``docs/mathematics/refraction.md``.

    Examples
    --------
    >>> media = (RefractiveIndex("air", 1.0), RefractiveIndex("glass", 1.52), RefractiveIndex("water", 1.333))
    >>> port = Window("port", "plane", "camera", {"distance": 40.0, "thickness": 10.0},
    ...               ("air", "glass", "water"), free=("distance",))
    >>> refraction = Refraction(media, (port,), ((0,),), np.array([0, 0]))
    >>> refraction
    <Refraction: 3 media, 1 window, 1 free parameter>
    >>> [name for name, free in zip(refraction.names, refraction.free) if free]
    ['distance of port']
    """

    media: tuple[RefractiveIndex, ...]
    windows: tuple[Window, ...]
    paths: tuple[tuple[int, ...], ...]
    path_of: Rows

    def __post_init__(self) -> None:
        for what, names in (
            ("media", [medium.name for medium in self.media]),
            ("windows", [window.name for window in self.windows]),
        ):
            if (again := twice(names)) is not None:
                raise UsageError(f"{again!r} is contained twice", where=f"refraction.{what}")
        known = [medium.name for medium in self.media]
        for window in self.windows:
            for name in window.media:
                if name not in known:
                    raise UsageError(f"the medium {name!r} is not in `media`", where=f"window {window.name}")
        for path in self.paths:
            for a, b in pairwise(path):
                one, other = self.windows[a], self.windows[b]
                if one.media[-1] != other.media[0]:
                    raise UsageError(
                        f"begins in {other.media[0]}, but {one.name} before it ends in {one.media[-1]}",
                        where=f"window {other.name}",
                    )
                if _ORDER.index(one.on) > _ORDER.index(other.on):
                    raise UsageError(
                        f"is on the {other.on}, but behind {one.name}, which is on the {one.on}",
                        where=f"window {other.name}",
                        do="list the windows from the camera to the object",
                    )

    def _facts(self) -> list[tuple[str, str]]:
        windows, free = len(self.windows), int(self.free.sum())
        return [
            (f"{len(self.media)} media", ""),
            (f"{windows} window{'s' * (windows != 1)}", ""),
            (f"{free} free parameter{'s' * (free != 1)}", ""),
        ]

    # -- parameters: those of the windows, then the indices

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters: those of the windows, then the indices."""
        own = [label for window in self.windows for label in window.labels]
        return (*own, *(medium.label for medium in self.media))

    @cached_property
    def values(self) -> Array:
        """Values (u,), in the order of the names."""
        own = [window.start for window in self.windows]
        return np.concatenate([*own, [medium.value for medium in self.media]])

    @cached_property
    def free(self) -> Mask:
        """Which parameters (u,) are estimated: free, and passed by the rays of an image."""
        own = [name in window.free for window in self.windows for name in window.names]
        given = np.array([*own, *(medium.free for medium in self.media)], dtype=np.bool_)
        return given & self.used

    @cached_property
    def used(self) -> Mask:
        """Parameters (u,) of windows and media that the rays of an image pass."""
        windows = {k for p in np.unique(self.path_of[self.path_of >= 0]) for k in self.paths[p]}
        media = {name for k in windows for name in self.windows[k].media}
        own = [k in windows for k, window in enumerate(self.windows) for _ in window.names]
        return np.array([*own, *(medium.name in media for medium in self.media)], dtype=np.bool_)

    @cached_property
    def sigma(self) -> Array:
        """Standard deviations (u,) of the parameters that are observations, NaN for the others."""
        own = [window.sigma.get(name) for window in self.windows for name in window.names]
        given = [*own, *(medium.sigma for medium in self.media)]
        return np.array([np.nan if s is None else s for s in given], dtype=np.float64)

    @cached_property
    def starts(self) -> Rows:
        """First parameter of each window, then of the media."""
        sizes = [len(window.names) for window in self.windows]
        return np.concatenate([[0], np.cumsum(sizes)]).astype(np.intp)

    def unit_of(self, name: str, unit: str) -> str:
        """Unit of a parameter by its name, where object space has the unit `unit`."""
        own = name.partition(" ")[0]
        return "" if own in ("tilt_X", "tilt_Y", "index") else f"1/{unit}" if own == "curvature" else unit

    def of_window(self, k: int, values: ArrayLike | None = None) -> Array:
        """Parameters of a window, out of those of all."""
        every = self.values if values is None else np.asarray(values, dtype=np.float64)
        return every[self.starts[k] : self.starts[k + 1]]

    def with_values(self, values: ArrayLike) -> Self:
        """Return the same windows and media with other values (u,)."""
        given = np.asarray(values, dtype=np.float64)
        windows = tuple(
            replace(window, values=dict(zip(window.names, self.of_window(k, given).tolist(), strict=True)))
            for k, window in enumerate(self.windows)
        )
        media = tuple(
            replace(medium, value=float(value))
            for medium, value in zip(self.media, given[self.starts[-1] :], strict=True)
        )
        return replace(self, windows=windows, media=media)

    def ports(self) -> Self:
        """Return the same with the windows on the camera only; images without any are in air."""
        paths = [tuple(k for k in path if self.windows[k].on == "camera") for path in self.paths]
        kept = [p for p, path in enumerate(paths) if path]
        # Air is −1, the last.
        number = np.array([kept.index(p) if p in kept else -1 for p in range(len(paths))] + [-1], np.intp)
        return replace(self, paths=tuple(paths[p] for p in kept), path_of=number[self.path_of])

    @cached_property
    def on_rig(self) -> Mask:
        """Paths (p,) with a window that is fixed to a rig."""
        return np.array([any(self.windows[k].on == "rig" for k in path) for path in self.paths], np.bool_)

    def split(self, camera_of: Rows) -> tuple[Rows, Rows, Rows]:
        """Split the paths with windows on a rig by cameras.

        Parameters
        ----------
        camera_of : ndarray of int (m,)
            Camera of each image.

        Returns
        -------
        path_of : ndarray of int (m,)
            Number of each image among the new paths; −1 for images in air.
        path, camera : ndarray of int (q,)
            Former path of each, and the camera it belongs to; −1 for all.
        """
        through = self.path_of >= 0
        own = np.where(self.on_rig[self.path_of], camera_of, -1) if len(self.paths) else camera_of
        pairs, number = np.unique(np.stack([self.path_of, own], axis=1)[through], axis=0, return_inverse=True)
        path_of = np.full(len(self.path_of), -1, dtype=np.intp)
        path_of[through] = number.ravel()
        return path_of, pairs[:, 0].astype(np.intp), pairs[:, 1].astype(np.intp)

    def on_cameras(self, camera_of: Rows, rotation: Array, base: Array) -> Self:
        """Return the same with the windows on a rig as windows on each of its cameras, all held.

        Parameters
        ----------
        camera_of : ndarray of int (m,)
            Camera of each image.
        rotation, base : ndarray (c, 3, 3), (c, 3)
            Places of the cameras on the rig.
        """
        if not self.on_rig.any():
            return self
        path_of, former, cameras = self.split(camera_of)
        windows, paths = list(self.windows), []
        for path, camera in zip(former.tolist(), cameras.tolist(), strict=True):
            found = []
            for k in self.paths[path]:
                window = self.windows[k]
                if window.on == "rig":
                    name = f"{window.name} before camera {camera}"
                    windows.append(window.on_camera(self.of_window(k), rotation[camera], base[camera], name))
                    k = len(windows) - 1
                found.append(k)
            paths.append(tuple(found))
        return replace(self, windows=tuple(windows), paths=tuple(paths), path_of=path_of)

    def transformed(self, values: Array, scale: float, turn: Array, shift: Array) -> Array:
        """Return the parameters after the similarity X' = scale · turn · X + shift of object space."""
        moved = values.copy()
        for k, window in enumerate(self.windows):
            own = slice(self.starts[k], self.starts[k + 1])
            moved[own] = window.transformed(values[own], scale, turn, shift)
        return moved

    def changes(self, values: Array, origin: Array) -> Array:
        """Changes of the parameters (u, 7) by a small shift, rotation and scale about `origin` (3,)."""
        found = np.zeros((len(values), 7))
        for k, window in enumerate(self.windows):
            own = slice(self.starts[k], self.starts[k + 1])
            found[own] = window.changes(values[own])
        # About the origin of the windows, the same rotation or scale is one with a shift.
        for axis in range(3):
            found[:, 3 + axis] -= found[:, :3] @ np.cross(np.eye(3)[axis], origin)
        found[:, 6] -= found[:, :3] @ origin
        return found

    @property
    def longest(self) -> int:
        """Number of surfaces of the longest path."""
        surfaces = [len(window.media) - 1 for window in self.windows]
        return max((sum(surfaces[k] for k in path) for path in self.paths), default=0)

    def columns(
        self, values: Array, origin: ArrayLike = (0.0, 0.0, 0.0), mounts: Mounts | None = None
    ) -> RefractionColumns:
        """Columns of the paths for :class:`~reseau.optics.refraction.RefractedRays`.

        Parameters
        ----------
        values : ndarray (u,)
            Parameters.
        origin : array_like (3,)
            Point of object space from which the coordinates of object points are counted.
        mounts : Mounts, optional
            Places of the cameras, where windows are fixed to a rig; the columns are those of its paths.

        Raises
        ------
        UsageError
            When a window is fixed to a rig, and there are no places of cameras.
        """
        if mounts is None and self.on_rig.any():
            raise UsageError("a window is on a rig; this needs the places of its cameras", where="refraction")
        paths = self.paths if mounts is None else [self.paths[p] for p in mounts.path]
        more = 0 if mounts is None else 6 * mounts.unknown
        at = np.asarray(origin, dtype=np.float64)
        described = [window.surfaces(self.of_window(k, values)) for k, window in enumerate(self.windows)]
        number = np.cumsum(self.free) - 1
        media = {medium.name: self.starts[-1] + k for k, medium in enumerate(self.media)}
        longest = self.longest
        shape = len(paths), longest
        columns = RefractionColumns(
            np.zeros(len(paths), np.intp),
            np.zeros(shape, np.intp),
            np.zeros(shape, np.bool_),
            np.ones(shape),
            np.zeros((*shape, _PRIMITIVES)),
            np.zeros((*shape, _PRIMITIVES, int(self.free.sum()) + more)),
            np.ones((len(paths), longest + 1)),
            np.full((len(paths), longest + 1), -1, np.intp),
        )
        for p, path in enumerate(paths):
            j = 0
            for k in path:
                window = self.windows[k]
                own = np.arange(self.starts[k], self.starts[k + 1])
                mine = self.free[own]
                for (side, row, slope), before in zip(described[k], window.media, strict=False):
                    columns.kind[p, j], columns.side[p, j] = _KIND[window.shape], side
                    columns.on_object[p, j] = window.on == "object"
                    columns.primitives[p, j] = row
                    if window.on == "object":
                        columns.primitives[p, j, 3:6] -= at
                    columns.by_parameters[p, j][:, number[own[mine]]] = slope[:, mine]
                    if window.on == "rig" and mounts is not None:
                        self._mount(columns, p, j, mounts)
                    self._index(columns, p, j, media[before], values, number)
                    j += 1
                self._index(columns, p, j, media[window.media[-1]], values, number)
            columns.surfaces[p] = j
        return columns

    def _mount(self, columns: RefractionColumns, p: int, j: int, mounts: Mounts) -> None:
        """Put a surface from the axes of the rig into those of the camera of the path."""
        turn, base, by = mounts.rotation[p], mounts.base[p], columns.by_parameters[p, j]
        row = columns.primitives[p, j]
        row[:3], row[3:6] = turn @ row[:3], turn @ (row[3:6] - base)
        by[:3], by[3:6] = turn @ by[:3], turn @ by[3:6]
        if mounts.column[p] >= 0:
            first = int(self.free.sum()) + mounts.column[p]
            for axis in range(3):
                by[:3, first + axis] = np.cross(np.eye(3)[axis], row[:3])
                by[3:6, first + axis] = np.cross(np.eye(3)[axis], row[3:6])
            by[3:6, first + 3 : first + 6] = -turn

    def _index(
        self, columns: RefractionColumns, p: int, j: int, row: int, values: Array, number: Rows
    ) -> None:
        columns.indices[p, j] = values[row]
        columns.index_of[p, j] = number[row] if self.free[row] else -1
