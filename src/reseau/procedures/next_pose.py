"""The photograph that would improve a calibration most.

With the joint covariance matrix S of the camera and of the points of the target, an image at another pose,
with the derivatives A by both and B by the six of its orientation, and the standard deviation s of an image
coordinate, leaves

    S − S Aᵀ P (s² I + P A S Aᵀ P)⁻¹ P A S,    P = I − B (BᵀB)⁻¹ Bᵀ

(Förstner & Wrobel 2016, sect. 4.2.7). The criterion is the largest standard deviation of the projection over
the image, as the verdict states it. Candidates are photographs that are simple to describe; the best of them
are varied in place, size and tilt, in steps that a person can follow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ..bundle import Network, Result, Stage
from ..bundle.diagnostics.fields import camera_mapping
from ..calibration import CameraMapping
from ..calibration.assessment import NextPhotograph
from ..calibration.camera import by_rotation, places, projection_slopes, worst
from ..core.data import Array, Mask, Rows
from ..optics import Pose
from ..optics.poses import matrix_to_vector, rotation_matrix

_MARGIN_PX = 6.0
"""Points closer to the edge of the image are not expected to be measured."""
PREDICTED = "predicted"
"""Name of the image that is not taken yet."""
_TILT, _STEEPEST = 42.0, 45.0
"""Tilt of candidates, and the largest, degrees."""
_SHARES, _ASIDE = (1.2, 0.7), 0.2
"""Shares of the image across which candidates extend; distance of their middle from that of the image, in
image widths and heights."""
_BACK = 1.2
"""Factor of the distance of a tilted target: it has an edge that is closer, and larger."""
_FOCUS = 1.6
"""Factor beyond the distances so far at which the image would be out of focus."""
_WHOLE = 0.75
"""Share of the points of the target that are inside the image."""
_STEPS = ((0.1, 1.2, 15.0), (0.05, 1.1, 5.0))
"""Changes of place (in image widths and heights), size and tilt (degrees) that are tried, in turn."""
_BEST, _ROUNDS = 4, 8
"""Candidates that are varied, and how often for each size of steps."""
_FIELD = 13
_FEW, _MANY = 48, 150
"""Points of the target to compare candidates, and to predict what is reached."""
_MOSTLY = 0.7
"""Share of the largest gain in coverage that a photograph must have."""
_WORTH = 0.97
"""A photograph that leaves more than this share of the uncertainty is not worth while."""
_STRAIGHT = 7.5
"""Tilt below which a target counts as straight, degrees."""
_EDGES = (
    "right edge", "lower right corner", "lower edge", "lower left corner", "left edge", "upper left corner",
    "upper edge", "upper right corner",
)  # fmt: skip
"""What is brought towards the camera, at every 45° from the right to the lower edge."""
_PLACES = {
    (0, 0): "middle", (-1, 0): "left half", (1, 0): "right half", (0, -1): "upper half", (0, 1): "lower half",
    (-1, -1): "upper left", (1, -1): "upper right", (-1, 1): "lower left", (1, 1): "lower right",
}  # fmt: skip
_TOWARDS = {
    (-1, 0): "left edge", (1, 0): "right edge", (0, -1): "upper edge", (0, 1): "lower edge",
    (-1, -1): "upper left", (1, -1): "upper right", (-1, 1): "lower left", (1, 1): "lower right",
}  # fmt: skip
_ROLLS = {0: "", 90: ", the camera turned by 90°"}


def with_image(
    network: Network, lens: CameraMapping, pose: Pose, uv: Array, stage: Stage | None = None
) -> Network | None:
    """Return the network with an image at another pose.

    Parameters
    ----------
    network : Network
        With one camera.
    lens : CameraMapping
        Its mapping.
    pose : Pose
        Of the image.
    uv : ndarray (p, 2)
        Ideal directions of all points; NaN where a point cannot be seen.
    stage : Stage, optional
        Heights of all images, with those of the new one.

    Returns
    -------
    Network or None
        None when fewer than four points are inside the image.
    """
    seen, inside = _inside(lens, uv)
    rows = np.flatnonzero(inside)
    if len(rows) < 4:
        return None
    m, bent = len(network.images), network.refraction
    cov = np.median(network.cov, axis=0)
    return replace(
        network,
        images=(*network.images, PREDICTED),
        stage=stage,
        refraction=None if bent is None else replace(bent, path_of=np.append(bent.path_of, bent.path_of[:1])),
        camera_of=np.append(network.camera_of, 0),
        x0=np.vstack([network.x0, pose.x0]),
        rotation=np.vstack([network.rotation, matrix_to_vector(pose.matrix)]),
        image_of=np.concatenate([network.image_of, np.full(len(rows), m)]),
        point_of=np.concatenate([network.point_of, rows]),
        xy=np.concatenate([network.xy, seen[rows]]),
        cov=np.concatenate([network.cov, np.tile(cov, (len(rows), 1, 1))]),
        groups=(*network.groups, None),
        files=(*network.files, PREDICTED),
    )


def _inside(lens: CameraMapping, uv: Array) -> tuple[Array, Mask]:
    """Images (p, 2) of directions, and whether they lie inside the image."""
    seen = lens.mapping(uv)
    size = np.array(lens.size) - 1
    rows = np.flatnonzero(np.isfinite(uv).all(axis=1))
    good = lens.mapping.one_to_one(uv[rows])
    good &= ((seen[rows] >= _MARGIN_PX) & (seen[rows] <= size - _MARGIN_PX)).all(axis=1)
    inside = np.zeros(len(uv), dtype=np.bool_)
    inside[rows[good]] = True
    return seen, inside


def next_photograph(result: Result, empty: Mask) -> NextPhotograph | None:
    """Choose the pose whose photograph lowers the largest uncertainty of the projection most.

    Parameters
    ----------
    result : Result
        A calibration with one camera, without windows, of a plane target.
    empty : ndarray of bool (rows, columns)
        Parts of the image without points; where there are any, only photographs that show the target in most
        of those that one photograph can reach are considered.

    Returns
    -------
    NextPhotograph or None
        None when no photograph lowers it by 3 %, or where the network is another one.
    """
    network = result.network
    camera = network.cameras[0]
    if len(network.cameras) > 1 or network.refraction is not None or network.stage is not None:
        return None
    if not camera.has_plane_mapping or camera.additional is not None:
        return None
    lens = camera_mapping(result, 0, formal=True)
    if lens.mapping.parallel or not result.fit.cofactors.reduced.known:
        return None
    target = _Target.of(result, lens)
    view = _best(target, _Information.of(result, lens, _FEW), empty)
    if view is None:
        return None
    pose, information = target.pose(view), _Information.of(result, lens, _MANY)
    uv = _directions(target.xyz, pose)
    xy, inside = _inside(lens, uv)
    after = information.after(pose, uv, inside)
    if not after < _WORTH * information.before:
        return None
    outline = lens.to_pixels(_directions(target.outline, pose))
    return NextPhotograph.of(pose, _words(view, outline, lens.size), outline, xy[inside], after)


class _View(NamedTuple):
    """How a photograph shows the target.

    `x` and `y` are the place of its middle from that of the image, in image widths and heights; `share` is
    that of the image across which it would extend if it were straight; `right` and `down` are the tilts,
    degrees, that bring its right and its lower edge towards the camera; `roll` turns the camera, degrees.
    """

    x: float
    y: float
    share: float
    right: float
    down: float
    roll: int


@dataclass(frozen=True, eq=False)
class _Target:
    """A target before a camera.

    `xyz` (p, 3) are its points, `half` (2,) half of its size, `front` the rotation of a camera that looks at
    it straight, `nearest` and `furthest` the distances at which it is in focus.
    """

    lens: CameraMapping
    xyz: Array
    middle: Array
    half: Array
    front: Array
    nearest: float
    furthest: float
    focal: float
    _rays: dict[tuple[float, float], Array] = field(default_factory=dict)

    @classmethod
    def of(cls, result: Result, lens: CameraMapping) -> _Target:
        part = result.fit.usable
        xyz, x0 = result.fit.values.xyz[part.points], result.fit.values.x0[part.images]
        middle = (xyz.max(axis=0) + xyz.min(axis=0)) / 2
        # The target is looked at from the side where the cameras were; y of the image is down.
        front = np.diag([1.0, -1.0, -1.0]) if x0[:, 2].mean() > middle[2] else np.eye(3)
        away = np.linalg.norm(x0 - middle, axis=1)
        nearest, furthest = float(away.min()) / _FOCUS, float(away.max()) * _FOCUS
        slope = lens.mapping.derivatives(np.zeros((1, 2))).d_xy[0]
        focal = float(np.sqrt(abs(np.linalg.det(slope))))
        return cls(lens, xyz, middle, np.ptp(xyz, axis=0)[:2] / 2, front, nearest, furthest, focal)

    def pose(self, view: _View) -> Pose:
        """The pose of the camera, in focus; not finite where the camera has no ray."""
        size, extent = np.array(self.lens.size), self.half[::-1] if view.roll % 180 else self.half
        ray = self._ray(view.x, view.y)
        range_ = float((2 * self.focal * extent / (view.share * size)).max() / ray[2])
        range_ = min(max(range_, self.nearest), self.furthest)
        tilt = rotation_matrix(np.deg2rad([-view.down, view.right, 0.0]))
        turn = tilt @ rotation_matrix(np.array([0.0, 0.0, np.deg2rad(view.roll)])) @ self.front
        return Pose(matrix_to_vector(turn), self.middle - turn.T @ (range_ * ray))

    def _ray(self, x: float, y: float) -> Array:
        """Direction (3,) of unit length of a place in the image; many photographs have the same."""
        if (x, y) not in self._rays:
            size = np.array(self.lens.size)
            ray = np.append(self.lens.mapping.inverse(((size - 1) / 2 + size * (x, y))[None])[0], 1.0)
            self._rays[x, y] = ray / np.linalg.norm(ray)
        return self._rays[x, y]

    @property
    def outline(self) -> Array:
        """Points (k, 3) around the target."""
        low, high = self.xyz.min(axis=0), self.xyz.max(axis=0)
        z = self.xyz[:, 2].mean()
        corners = np.array(
            [(x, y, z) for x, y in ((low[0], low[1]), (high[0], low[1]), high[:2], (low[0], high[1]))]
        )
        sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        return np.concatenate([np.linspace(a, b, 12, endpoint=False) for a, b in sides])


@dataclass(frozen=True, eq=False)
class _Information:
    """What a photograph of some points (p, 3) of the target adds to a calibration.

    `rows` are these points among all; `covariance` is the joint one of the camera and of them, `noise` the
    standard deviation of an image coordinate, `slopes` (g, 2, u) the derivatives of the projection over the
    image by the camera.
    """

    lens: CameraMapping
    xyz: Array
    rows: Rows
    covariance: Array
    noise: float
    slopes: Array

    @classmethod
    def of(cls, result: Result, lens: CameraMapping, most: int) -> _Information:
        """That of at most so many points; each stands for its part of all of them."""
        network, fit = result.network, result.fit
        points = np.flatnonzero(fit.usable.points)
        rows, count = np.arange(len(points)), len(points)
        if count > most:
            rows = np.sort(np.random.default_rng(0).choice(count, most, replace=False))
        points = points[rows]
        columns = result.camera_columns(0)[1]
        variance = float(np.median(network.cov[:, [0, 1], [0, 1]])) * fit.variance
        variance *= len(points) / count
        joint = fit.cofactors.joint(columns, points) * fit.variance
        slopes = projection_slopes(lens, places(lens, _FIELD, None)[0])[0]
        slopes = slopes[np.isfinite(slopes).all(axis=(1, 2))]
        return cls(lens, fit.values.xyz[points], rows, joint, float(np.sqrt(variance)), slopes)

    @property
    def before(self) -> float:
        """Largest standard deviation of the projection without the photograph."""
        k = len(self.lens.rows)
        return self._worst(self.covariance[:k, :k])

    def after(self, pose: Pose, uv: Array, inside: Mask) -> float:
        """The same with it; `uv` (p, 2) are directions of all points, those `inside` the image are seen."""
        uv, rows = uv[self.rows], np.flatnonzero(inside[self.rows])
        k, m = len(self.lens.rows), len(rows)
        if m < 4:
            return self.before
        seen, z = self.lens.mapping.derivatives(uv[rows]), pose(self.xyz[rows])[:, 2]
        by_shift = np.zeros((m, 2, 3))
        by_shift[:, 0, 0] = by_shift[:, 1, 1] = 1.0 / z
        by_shift[:, :, 2] = -uv[rows] / z[:, None]
        by_pose = np.concatenate([seen.d_xy @ by_rotation(uv[rows]), seen.d_xy @ by_shift], axis=2)
        camera = seen.d_parameters[:, :, self.lens.rows].reshape(2 * m, k) / self.noise
        point = seen.d_xy @ by_shift @ pose.matrix / self.noise
        at = k + 3 * rows[:, None] + np.arange(3)
        # A S of the camera and of the points that are seen, and A S Aᵀ.
        through = np.einsum("iak,ikc->iac", point, self.covariance[at][:, :, :k]).reshape(2 * m, k)
        between = self.covariance[at.ravel()][:, at.ravel()].reshape(m, 3, 3 * m)
        half = (point @ between).reshape(2 * m, m, 3).transpose(1, 0, 2)
        whole = (half @ point.transpose(0, 2, 1)).transpose(1, 0, 2).reshape(2 * m, 2 * m)
        whole += camera @ self.covariance[:k, :k] @ camera.T
        mixed = through @ camera.T
        whole += mixed + mixed.T
        through += camera @ self.covariance[:k, :k]
        q = np.linalg.qr(by_pose.reshape(2 * m, 6))[0]
        through -= q @ (q.T @ through)
        whole -= q @ (q.T @ whole)
        whole -= (whole @ q) @ q.T
        whole[np.diag_indices(2 * m)] += 1.0
        return self._worst(self.covariance[:k, :k] - through.T @ np.linalg.solve(whole, through))

    def _worst(self, camera: Array) -> float:
        sigma = worst(self.slopes @ camera @ np.swapaxes(self.slopes, 1, 2))
        return float(sigma.max()) if len(sigma) else float("inf")


def _best(target: _Target, information: _Information, empty: Mask) -> _View | None:
    """The photograph that lowers the largest uncertainty most."""
    lens, known = target.lens, dict[_View, tuple[float, float]]()

    def judged(view: _View) -> tuple[float, float]:
        """The uncertainty with it, infinite where too little of the target is seen, and what it covers."""
        if view not in known:
            pose = target.pose(view)
            uv = _directions(target.xyz, pose)
            xy, inside = _inside(lens, uv)
            enough = inside.sum() >= max(4, _WHOLE * len(inside))
            sigma = information.after(pose, uv, inside) if enough else np.inf
            known[view] = sigma, _gained(xy, inside, lens, empty)
        return known[view]

    candidates = list(_candidates())
    possible = [covers for sigma, covers in map(judged, candidates) if np.isfinite(sigma)]
    least = _MOSTLY * max(possible, default=0.0)

    def after(view: _View) -> float:
        sigma, covers = judged(view)
        return sigma if covers >= least else np.inf

    best = sorted(candidates, key=after)[:_BEST]
    for steps in _STEPS:
        for k, view in enumerate(best):
            for _ in range(_ROUNDS):
                better = min(_varied(view, *steps), key=after)
                if not after(better) < after(view):
                    break
                view = better
            best[k] = view
    chosen = min(best, key=after)
    return chosen if np.isfinite(after(chosen)) else None


def _candidates() -> Iterator[_View]:
    """The target fills the image, and more, at nine places; straight, or tilted about eight axes."""
    directions = np.deg2rad(45.0 * np.arange(8))
    tilts = [(0.0, 0.0), *(_TILT * np.column_stack([np.cos(directions), np.sin(directions)])).tolist()]
    for roll in _ROLLS:
        for k, (right, down) in enumerate(tilts):
            for share in _SHARES:
                for x, y in _PLACES:
                    away = _BACK if k else 1.0
                    yield _View(_ASIDE * x, _ASIDE * y, share / away, right, down, roll)


def _varied(view: _View, aside: float, larger: float, tilt: float) -> Iterator[_View]:
    """Neighbours of a photograph."""
    for sign in (-1, 1):
        for x, y in ((1, 0), (0, 1), (1, 1), (1, -1)):
            moved = view._replace(x=view.x + sign * x * aside, y=view.y + sign * y * aside)
            if max(abs(moved.x), abs(moved.y)) < 0.5:
                yield moved
        yield view._replace(share=view.share * larger**sign)
        for right, down in ((1, 0), (0, 1), (1, 1), (1, -1)):
            turned = np.array([view.right + sign * right * tilt, view.down + sign * down * tilt])
            turned *= min(1.0, _STEEPEST / max(float(np.hypot(*turned)), 1.0))
            yield view._replace(right=float(turned[0]), down=float(turned[1]))


def _words(view: _View, outline: Array, size: tuple[int, int]) -> str:
    """What the photograph looks like, from the outline (k, 2) of the target in it."""
    around = outline[np.isfinite(outline).all(axis=1)] / size
    low, high = np.clip(around.min(axis=0), 0.0, 1.0), np.clip(around.max(axis=0), 0.0, 1.0)
    share, aside = float((high - low).max()), (low + high - 1.0) / 2
    x, y = (int(np.sign(each)) if abs(each) > 0.08 else 0 for each in aside)
    place = x, y
    if min(high - low) > 0.8 or (share > 0.8 and place == (0, 0)):
        found = "the target fills the image"
    elif share > 0.6 and place != (0, 0):
        found = f"the target fills most of the image, towards its {_TOWARDS[place]}"
    else:
        found = f"the target in the {_PLACES[place]} of the image"
    if ((around < 0) | (around > 1)).any():
        found += ", a little of it outside"
    tilt = float(np.hypot(view.right, view.down))
    if tilt < _STRAIGHT:
        return f"{found}, straight from the front{_ROLLS[view.roll]}"
    edge = _EDGES[round(np.degrees(np.arctan2(view.down, view.right)) / 45) % 8]
    return f"{found}, its {edge} {5 * round(tilt / 5)}° towards the camera{_ROLLS[view.roll]}"


def _directions(xyz: Array, pose: Pose) -> Array:
    """Ideal directions (p, 2); NaN behind the camera."""
    x = pose(xyz)
    return x[:, :2] / np.where(x[:, 2:] > 0, x[:, 2:], np.nan)


def _gained(seen: Array, inside: Mask, lens: CameraMapping, empty: Mask) -> float:
    """Share of the parts of the image without points that have some then."""
    rows, columns = empty.shape
    at = seen[inside] / np.array(lens.size) * [columns, rows]
    cell = np.clip(at.astype(int), 0, [columns - 1, rows - 1])
    then = np.zeros_like(empty)
    then[cell[:, 1], cell[:, 0]] = True
    return float((then & empty).sum() / max(int(empty.sum()), 1))
