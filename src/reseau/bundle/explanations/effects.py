"""Displacements of image points by each possible cause, linearised at the adjusted network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...core.data import Array, Mask, Rows
from ...optics.mapping import PlaneMapping
from ...optics.poses import cross_matrix
from ..diagnostics.evidence import Effect, in_camera, places_seen, sigma_seen, used_rows
from ..diagnostics.fields import camera_mapping
from ..diagnostics.image_effects import creases, smooth_effects
from ..diagnostics.result import Result
from .sentences import EACH

_RADIAL = (3, 5, 7, 9)
"""Powers of the radius in the effects of a lens."""
_DEGREES = (2, 5)
"""Least and largest degree of polynomials over the image, of which the effects of a lens consist."""
_LENS_POWERS = [(i, d - i) for d in range(_DEGREES[0], _DEGREES[1] + 1) for i in range(d + 1)]
_BENDING = 4
"""Largest degree of the deflection of a target."""
_PLANE = 0.05
"""Largest thickness of a plane target by its width."""


@dataclass(frozen=True, eq=False)
class Family:
    """Displacements by one kind of cause, and the forms that it can have.

    Parameters
    ----------
    code : str
        The cause.
    effect : Effect
        All its columns.
    forms : mapping of str to ndarray
        By its name, columns of a group (k,) of which a form consists, or combinations of them: one matrix
        (q, k) for each group, (groups, q, k).
    moves : ndarray (p, 3, q), optional
        Shifts of the object points by one unit of each column, where these are what displaces image points.
    kind : str
        Of several families of a cause: radial, polynomial or coefficients of a lens, points of a target.
    alike : ndarray of int (q,), optional
        Kinds of the columns: those of a kind have the same standard deviation. By default each is one.
    """

    code: str
    effect: Effect
    forms: Mapping[str, Array | Rows]
    moves: Array | None = None
    kind: str = ""
    alike: Rows | None = None

    def seen_again(self, sight: Sight) -> Family:
        """The same effects, at another adjustment."""
        if self.moves is not None:
            return replace(self, effect=replace(self.effect, slope=sight.by_point @ self.moves[sight.point]))
        return next(one for one in families(sight, self.code) if one.kind == self.kind)


class Sight:
    """The used image points of an adjusted network: where they are seen, and how they move.

    Parameters
    ----------
    result : Result
        The adjustment.
    """

    def __init__(self, result: Result) -> None:
        self.result = result
        network = self.network = result.network
        self.rows = used_rows(result.fit)
        self.image: Rows = network.image_of[self.rows]
        self.point: Rows = network.point_of[self.rows]
        self.camera: Rows = network.camera_of[self.image]
        self.xy: Array = places_seen(result.fit)
        self.sigma: Array = sigma_seen(result.fit)

    @property
    def typical(self) -> float:
        """Standard deviation of the image points, px, root mean square."""
        return float(np.sqrt(np.mean(self.sigma**2)))

    @cached_property
    def mappings(self) -> list[PlaneMapping]:
        """Mappings of the cameras, with their estimates."""
        return [camera_mapping(self.result, c, formal=True).mapping for c in range(len(self.network.cameras))]

    @property
    def simple(self) -> bool:
        """Whether each camera has one mapping, and rays are straight."""
        network = self.network
        one = all(
            camera.has_plane_mapping and (camera.additional is None or camera.additional.per == "camera")
            for camera in network.cameras
        )
        return one and network.refraction is None

    @cached_property
    def in_camera(self) -> Array:
        """Points in the axes of their cameras (n, 3)."""
        return in_camera(self.result.fit)

    @cached_property
    def _slopes(self) -> tuple[Array, list[Array]]:
        """Derivatives of pixels by points in the axes of the camera (n, 2, 3), and by camera parameters."""
        by_place, by_parameters = np.zeros((len(self.rows), 2, 3)), []
        for c, mapping in enumerate(self.mappings):
            own = np.flatnonzero(self.camera == c)
            x, y, z = self.in_camera[own].T
            bend = np.zeros((len(own), 2, 3))
            if mapping.parallel:
                uv = np.column_stack([x, y])
                bend[:, 0, 0] = bend[:, 1, 1] = 1.0
            else:
                uv = np.column_stack([x / z, y / z])
                bend[:, 0, 0] = bend[:, 1, 1] = 1.0 / z
                bend[:, 0, 2], bend[:, 1, 2] = -uv[:, 0] / z, -uv[:, 1] / z
            seen = mapping.derivatives(uv)
            by_place[own] = np.nan_to_num(seen.d_xy) @ bend
            by_parameters.append(np.nan_to_num(seen.d_parameters))
        return by_place, by_parameters

    @property
    def by_place(self) -> Array:
        """Derivatives of pixels by the points in the axes of their cameras (n, 2, 3)."""
        return self._slopes[0]

    def by_parameters(self, c: int) -> Array:
        """Derivatives of the pixels of a camera by all parameters of its mapping."""
        return self._slopes[1][c]

    @cached_property
    def by_pose(self) -> Array:
        """Derivatives of pixels by rotations about the middle of the points and shifts (n, 2, 6).

        The axes are those of the camera. Rotations about the camera itself would move images as shifts do.
        """
        count = np.bincount(self.image, minlength=len(self.network.images))
        sums = [np.bincount(self.image, axis, len(count)) for axis in self.in_camera.T]
        middle: Array = np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]
        cross = -cross_matrix(self.in_camera - middle[self.image])
        return np.concatenate([self.by_place @ cross, self.by_place], axis=2)

    @cached_property
    def by_point(self) -> Array:
        """Derivatives of pixels by object coordinates (n, 2, 3)."""
        return self.by_place @ self.result.fit.values.rotation[self.image]


def families(sight: Sight, only: str = "") -> Iterator[Family]:
    """Yield the causes that the network can have, or one of them."""
    simple = [
        (_refocus, ("refocus",)), (_rolling, ("rolling-shutter",)), (_motion, ("motion",)),
        (_target, ("target-shape", "target-scale")),
    ]  # fmt: skip
    for made, codes in [(_lens, ("lens",)), *(simple if sight.simple else []), (_unknown, ("unknown",))]:
        if not only or only in codes:
            yield from (family for family in made(sight) if not only or family.code == only)


def _unknown(sight: Sight) -> Iterator[Family]:
    """What none of the others explains: a smooth field in each image."""
    effect, roots = smooth_effects(sight.result.fit)
    yield Family("unknown", effect, {f"smooth in each image, {name}": root for name, root in roots.items()})


def _lens(sight: Sight) -> Iterator[Family]:
    """What no coefficient of the model describes, of all cameras together."""
    network, every = sight.network, np.arange(2 * len(_LENS_POWERS))
    low = np.flatnonzero(np.repeat([i + j <= _DEGREES[0] + 1 for i, j in _LENS_POWERS], 2))
    kinds = [("radial", {"radial": np.arange(len(_RADIAL))})]
    kinds.append(("polynomial", {"low polynomial": low, "polynomial": every}))
    count = max((len(_held(sight, c)) for c in range(len(network.cameras))), default=0)
    if sight.simple and count:
        # The next coefficient, two, and all of them.
        kinds.append(
            ("coefficients", {f"{k} more": np.arange(k) for k in dict.fromkeys((1, 2, count)) if k <= count})
        )
    for kind, forms in kinds:
        family = Family("lens", Effect(np.zeros((0, 2, 0)), np.zeros(0, dtype=np.intp), 0), forms, kind=kind)
        width = {"radial": len(_RADIAL), "polynomial": len(every), "coefficients": count}[kind]
        slope = np.zeros((len(sight.rows), 2, width))
        for c in range(len(network.cameras)):
            rows = np.flatnonzero(sight.camera == c)
            own = lens_at(sight, family, c, sight.xy[rows], rows)
            slope[rows, :, : own.shape[2]] = own
        yield replace(family, effect=Effect(slope, sight.camera, len(network.cameras)))


def _held(sight: Sight, c: int) -> list[int]:
    """Coefficients of the model of a camera that were held."""
    camera = sight.network.cameras[c]
    model = camera.registered
    names = () if model is None else model.of_role("distortion")
    return [camera.names.index(name) for name in names if name not in camera.free]


def lens_at(sight: Sight, family: Family, c: int, xy: Array, rows: Rows | None = None) -> Array:
    """Displacements (n, 2, q) at places (px) of the image of a camera by the effects of a lens.

    `rows` are the used image points at these places, where they are such.
    """
    camera = sight.network.cameras[c]
    size = np.array([camera.width, camera.height])
    half = float(np.hypot(*size)) / 2
    if family.kind == "coefficients":
        columns = _held(sight, c)
        if rows is not None:
            return sight.by_parameters(c)[:, :, columns]
        uv = sight.mappings[c].inverse(xy)
        known = np.isfinite(uv).all(axis=1)
        found = np.full((len(xy), 2, family.effect.slope.shape[2]), np.nan)
        found[known] = 0.0
        found[known, :, : len(columns)] = sight.mappings[c].derivatives(uv[known]).d_parameters[:, :, columns]
        return found
    if family.kind == "radial":
        centre = sight.mappings[c](np.zeros((1, 2)))[0] if sight.simple else (size - 1) / 2
        at = (xy - centre) / half
        r = np.linalg.norm(at, axis=1)
        return np.stack([at * r[:, None] ** (power - 1) for power in _RADIAL], axis=2)
    x, y = ((xy - (size - 1) / 2) / half).T
    found = np.zeros((len(xy), 2, 2 * len(_LENS_POWERS)))
    for k, (i, j) in enumerate(_LENS_POWERS):
        found[:, 0, 2 * k] = found[:, 1, 2 * k + 1] = x**i * y**j
    return found


def camera_columns(sight: Sight) -> Array:
    """Displacements by the principal distance and the principal point of the camera (n, 2, 3)."""
    slope = np.zeros((len(sight.rows), 2, 3))
    for c, camera in enumerate(sight.network.cameras):
        rows, by = np.flatnonzero(sight.camera == c), sight.by_parameters(c)
        model, mapping = camera.registered, sight.mappings[c]
        if model is None:
            continue
        for name in model.of_role("scale"):
            k = mapping.names.index(name)
            slope[rows, :, 0] += by[:, :, k] * mapping.values[k]
        for axis, name in enumerate(model.of_role("centre")[:2]):
            slope[rows, :, 1 + axis] = by[:, :, mapping.names.index(name)]
    return slope


def _refocus(sight: Sight) -> Iterator[Family]:
    """Principal distance, and principal point, of each image."""
    effect = Effect(camera_columns(sight), sight.image, len(sight.network.images))
    forms = {"distance": [0], "distance and point": [0, 1, 2], "point": [1, 2]}
    forms_of = {name: np.array(columns) for name, columns in forms.items()}
    yield Family("refocus", effect, forms_of, alike=np.array([0, 1, 1]))


def _rolling(sight: Sight) -> Iterator[Family]:
    """Motion during the read-out of each image."""
    network = sight.network
    if network.shutters.any():
        return
    height = np.array([camera.height for camera in network.cameras])[sight.camera]
    time = sight.xy[:, 1] / height - 0.5
    # Rotations about the camera: it is held by hand.
    turned = -sight.by_place @ cross_matrix(sight.in_camera)
    slope = np.concatenate([turned, sight.by_place], axis=2) * time[:, None, None]
    effect = Effect(slope, sight.image, len(network.images))
    forms = {"all": np.arange(6), "turn": np.arange(3), "shift": np.arange(3, 6)}
    yield Family("rolling-shutter", effect, forms, alike=np.repeat([0, 1], 3))


def _motion(sight: Sight) -> Iterator[Family]:
    """Poses of images that are not as those taken at once, or as the stage, say."""
    network = sight.network
    if network.rig is None and network.stage is None:
        return
    effect = Effect(sight.by_pose, sight.image, len(network.images))
    forms = {"all": np.arange(6), "turn": np.arange(3), "shift": np.arange(3, 6)}
    yield Family("motion", effect, forms, alike=np.repeat([0, 1], 3))


def _target(sight: Sight) -> Iterator[Family]:
    """Points of the target, where they are held, elsewhere than designed."""
    network, values = sight.network, sight.result.fit.values
    held: Mask = np.asarray(network.held.all(axis=1))
    seen = np.unique(sight.point)
    if not held[seen].all() or len(seen) < 6:
        return
    middle, axes, plane = _axes(values.xyz[seen])
    points = Effect(sight.by_point, np.searchsorted(seen, sight.point), len(seen))
    yield Family("target-shape", points, {"points": np.arange(3)}, None, "points", np.zeros(3, dtype=int))
    if not plane:
        return
    # The axes of the design: prints are stretched along them.
    across = np.eye(3)[:2] if abs(axes[2, 2]) > 0.9 else axes[:2]
    flat = (values.xyz - middle) @ across.T
    half = np.ptp(flat[seen], axis=0) / 2
    x, y = (flat / np.where(half > 0, half, 1.0)).T
    powers = [(i, d - i) for d in range(2, _BENDING + 1) for i in range(d + 1)]
    bent = np.stack([np.outer(x**i * y**j, axes[2]) for i, j in powers], axis=2)
    forms = {"bent": np.arange(3), "bent more": np.arange(len(powers))}
    yield _moved(sight, "target-shape", bent, forms)
    stretched = np.stack([np.outer(x, across[0]), np.outer(y, across[0])], axis=2)
    yield _moved(
        sight, "target-scale", stretched, {"stretched": np.arange(1), "stretched and sheared": np.arange(2)}
    )
    steps = [_tag_steps(flat[:, axis], seen) for axis in range(2)]
    if all(step.any() for step in steps):
        spaced = np.outer(steps[0], across[0]) + np.outer(steps[1], across[1])
        yield _moved(sight, "target-scale", spaced[:, :, None], {"spacing of tags": np.arange(1)})


def creased(sight: Sight) -> Iterator[Family]:
    """Yield what differs over a plane target in each image: its heights, or anything smooth."""
    xyz = sight.result.fit.values.xyz
    seen = np.unique(sight.point)
    if not sight.simple or len(seen) < 6:
        return
    middle, axes, plane = _axes(xyz[seen])
    if not plane:
        return
    flat = (xyz[sight.point] - middle) @ axes[:2].T
    heights, any_way = sight.by_point @ axes[2:].T, np.tile(np.eye(2), (len(flat), 1, 1))
    for code, slope in (("target-shape", heights), ("unknown", any_way)):
        effect, roots = creases(sight.result.fit, flat, slope)
        yield Family(code, effect, {f"{EACH}, {name}": root for name, root in roots.items()})


def _axes(xyz: Array) -> tuple[Array, Array, bool]:
    """Centre of points, their principal axes (3, 3), the longest first, and whether they are plane."""
    middle = xyz.mean(axis=0)
    _, size, axes = np.linalg.svd(xyz - middle, full_matrices=False)
    return middle, axes, bool(size[2] <= _PLANE * size[1])


def _moved(sight: Sight, code: str, moves: Array, forms: Mapping[str, Rows]) -> Family:
    """A cause that shifts object points, alike in all images."""
    moves = np.nan_to_num(moves)
    effect = Effect(sight.by_point @ moves[sight.point], np.zeros(len(sight.rows), dtype=np.intp), 1)
    return Family(code, effect, forms, moves)


def _tag_steps(along: Array, seen: Rows) -> Array:
    """Shifts of the lines of a target whose spacing alternates, if one of the two spacings changes.

    Zero where the spacing does not alternate between two values.
    """
    tolerance = 1e-6 * np.ptp(along[seen])
    if not tolerance:
        return np.zeros_like(along)
    places = np.unique(np.round(along[seen] / tolerance).astype(np.int64)) * tolerance
    if len(places) < 4:
        return np.zeros_like(along)
    gaps = np.diff(places)
    odd, even = gaps[::2], gaps[1::2]
    alike = np.ptp(odd) < 1e-3 * odd.mean() and np.ptp(even) < 1e-3 * even.mean()
    if not alike or abs(odd.mean() - even.mean()) < 1e-3 * gaps.mean():
        return np.zeros_like(along)
    # One unit more of every second gap.
    moved = np.concatenate([[0.0], np.cumsum(np.arange(len(gaps)) % 2)])
    moved = moved - np.polyval(np.polyfit(places, moved, 1), places)
    nearest = np.abs(along[:, None] - places).argmin(axis=1)
    return np.asarray(moved[nearest])
