"""Image points of a plane target that lie nearer to the place of another point than to their own.

The places of all points in an image follow from those that agree with each other: by a homography, and a
polynomial for what lenses bend. Neither a camera nor an adjustment is needed, so that wrong names and gross
errors are found before they spoil one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...core.threads import one_thread
from ...optics.mapping import PlaneMapping
from ..network.network import Network

_DEGREE, _ROUNDS = 5, 3
"""Degree of the polynomial that lenses bend images by, and how often it is improved."""
_LEAST = 12
"""Points of an image from which others are judged."""
_AGREE = 0.5
"""Part of the points of an image that must agree; where fewer do, none can be said to be wrong."""


_CORNERS = (0.0, 45.0, 65.0, 85.0, 105.0)
"""Angles of the corners of the image to the axis, degrees, that are tried for wide lenses; 0 for others."""
_WITHIN = 0.2
"""Distance of points that agree, in that of neighbours: names that are wrong by one do not agree halfway."""
_NEAR = (1.0, 5.0)
"""The same for names of near points: of the next one, and of corners of the same tag."""
_FAR = 1e7
"""Coordinate of what is not imaged."""
_MOSTLY = 0.995
"""Part of the image points that agree from which no other projection is tried."""


@dataclass(frozen=True, eq=False)
class Misnamed:
    """Image points that contradict the others of their image.

    Parameters
    ----------
    rows : ndarray of int (k,)
        Rows of the network.
    point : ndarray of int (k,)
        Points in whose places they lie; −1 where there is none.
    off_px : ndarray (k,)
        Distances from their own places; NaN where these are not known.
    log_odds : float
        Logarithm of the odds that names are wrong, not places.
    labels : tuple of str
        Names of the points, and of their images.

    Examples
    --------
    >>> one = np.array([3])
    >>> Misnamed(one, one, np.array([12.0]), 4.0, ("7 in a.jpg",)).code
    'names'
    """

    rows: Rows
    point: Rows
    off_px: Array
    log_odds: float
    labels: tuple[str, ...]

    @property
    def code(self) -> str:
        """Whether names or places are wrong."""
        return "names" if self.log_odds > 0 else "blunders"

    @property
    def nowhere(self) -> int:
        """Number of image points that lie in no place of a point."""
        return int((self.point < 0).sum())


@dataclass(frozen=True, eq=False)
class _Image:
    """Where the points of the target lie in an image.

    Parameters
    ----------
    agree : int
        Number of image points whose names agree.
    own : ndarray (k,)
        Distances of the image points from the places of their names, in the distance of these from the
        nearest other point.
    off : ndarray (k,)
        The same in pixels.
    nearest : ndarray of int (k,)
        The point in whose place each image point lies.
    near : ndarray (k,)
        Distance from it, px.
    spread : float
        Deviation of points that agree, px.
    cell : ndarray (k,)
        Area (px²) in which the nearest point is the same.
    sense : float
        Sign of the determinant of the homography.
    """

    agree: int
    own: Array
    off: Array
    nearest: Rows
    near: Array
    spread: float
    cell: Array
    sense: float


@one_thread()
def misnamed(
    network: Network, lenses: Sequence[PlaneMapping] | None = None, before: Misnamed | None = None
) -> Misnamed | None:
    """Find image points that lie in the places of other points, or in none.

    Parameters
    ----------
    network : Network
        With known coordinates of the points of a plane target; approximate values are enough.
    lenses : sequence of PlaneMapping, optional
        Of its cameras, where they are known.
    before : Misnamed, optional
        What was found without them.

    Returns
    -------
    Misnamed or None
        None where all is consistent, or the target is not plane.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> misnamed(example_network()) is None
    True
    """
    known = np.flatnonzero(np.isfinite(network.xyz).all(axis=1))
    if len(known) < _LEAST:
        return None
    xyz = network.xyz[known]
    _, size, axes = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)
    if size[2] > 1e-3 * size[1]:
        return None
    plane = np.full((len(network.points), 2), np.nan)
    plane[known] = (xyz - xyz.mean(axis=0)) @ axes[:2].T / size[0] * np.sqrt(len(known))
    tree = scipy.spatial.cKDTree(plane[known])
    cameras, guess = network.cameras, network.point_of.copy()
    if before is not None:
        guess[before.rows] = np.where(before.point < 0, guess[before.rows], before.point)
    found = dict[int, tuple[Rows, _Image | None]]()
    for c in range(len(cameras)):
        images = np.flatnonzero(network.camera_of == c)
        lens = None if lenses is None else _Calibrated(lenses[c])
        found |= _images(network, images, plane, guess, known, tree, lens)
    judged = [each for _, each in found.values() if each is not None]
    if not judged:
        return None
    # A printed target is not seen from behind.
    usual = float(np.sign(sum(each.sense for each in judged)))
    rows, points, off, odds = list[Rows](), list[Rows](), list[Array](), 0.0
    for own, best in found.values():
        if best is None:
            # Which of them are wrong is not seen without a camera.
            rows.append(own)
            points.append(np.full(len(own), -1, dtype=np.intp))
            off.append(np.full(len(own), np.nan))
            continue
        wrong: Mask = best.own > 0.5
        if usual and best.sense == -usual:
            wrong = np.ones(len(own), dtype=np.bool_)
            odds += np.inf
        if not wrong.any():
            continue
        # No two image points are in one place.
        taken = np.isin(best.nearest, network.point_of[own[~wrong]])
        near = wrong & (best.nearest != network.point_of[own]) & ~taken
        rows.append(own[wrong])
        points.append(np.where(near, best.nearest, -1)[wrong].astype(np.intp))
        off.append(best.off[wrong])
        if usual != -best.sense:
            distance = np.where(near, best.near, np.inf)[wrong]
            odds += _log_odds(distance, best.cell[wrong], best.spread)
    if not rows:
        return None
    every = np.concatenate(rows)
    labels = [
        f"{network.points[network.point_of[k]]} in {network.images[network.image_of[k]]}" for k in every
    ]
    return Misnamed(every, np.concatenate(points), np.concatenate(off), odds, tuple(labels))


def _log_odds(near: Array, cell: Array, spread: float) -> float:
    """Logarithm of the odds that points lie at the places of others, not anywhere in their cells (px²).

    How well these places are known is between the scatter of points that agree and the size of a cell; one
    of ten may lie anywhere all the same.
    """
    sizes = np.geomspace(spread, max(float(np.sqrt(np.median(cell))) / 2, 2 * spread), 12)
    density = np.exp(-0.5 * (near / sizes[:, None]) ** 2) / (2 * np.pi * sizes[:, None] ** 2)
    each = np.log(0.9 * density * cell + 0.1).sum(axis=1)
    return float(scipy.special.logsumexp(each) - np.log(len(sizes)))


def _images(
    network: Network,
    images: Rows,
    plane: Array,
    guess: Rows,
    known: Rows,
    tree: scipy.spatial.cKDTree,
    calibrated: _Calibrated | None,
) -> dict[int, tuple[Rows, _Image | None]]:
    """Places of the points in the images of a camera, with the projection by which most names agree."""
    rays, parts = network.rays_of_images, dict[int, Rows]()
    for image in images.tolist():
        own = rays[image]
        own = own[np.isfinite(plane[network.point_of[own]]).all(axis=1)]
        if len(own) >= _LEAST:
            parts[image] = own
    if not parts:
        return {}
    camera = network.cameras[int(network.camera_of[images[0]])]
    size = np.array([camera.width, camera.height])
    total, best, most = sum(map(len, parts.values())), None, -1
    half = float(np.hypot(*size)) / 2
    focals = (half / np.radians(corner) if corner else 0.0 for corner in _CORNERS)
    guesses = (_Lens((size - 1) / 2, half, focal) for focal in focals)
    for first in guesses if calibrated is None else (calibrated,):
        lens: _Projection = first
        views = {}
        for image, own in parts.items():
            view = _view(network.xy[own], network.point_of[own], guess[own], plane, tree, known, lens)
            if view is not None:
                views[image] = view
        for _ in range(_ROUNDS):
            lens = lens.bent_by(views.values())
            for view in views.values():
                view.fit(lens)
        agree = sum(view.agree for view in views.values())
        if agree > most:
            best, most = (views, lens), agree
        if most > _MOSTLY * total:
            break
    assert best is not None
    views, lens = best
    return {
        image: (own, views[image].judged(lens, known) if image in views else None)
        for image, own in parts.items()
    }


class _Projection(Protocol):
    """How a camera images a plane, and whether that is known."""

    @property
    def known(self) -> bool: ...

    def plane(self, xy: Array) -> Array:
        """Places of pixels in the plane of a perspective image."""

    def pixels(self, at: Array) -> Array:
        """Pixels of places in that plane."""

    def bent_by(self, views: Iterable[_View]) -> _Projection:
        """The projection with what the agreeing points of all images have in common."""


@dataclass(frozen=True, eq=False)
class _Lens:
    """A projection about the middle of the image, perspective or for a focal length equidistant, bent."""

    middle: Array
    half: float
    focal: float
    bend: Array | None = None
    known: ClassVar[bool] = False

    def plane(self, xy: Array) -> Array:
        """Places of pixels in the plane of a perspective image, px."""
        xy = xy if self.bend is None else xy - self._terms(xy) @ self.bend
        if not self.focal:
            return xy
        off = xy - self.middle
        angle = np.minimum(np.linalg.norm(off, axis=1) / self.focal, 1.48)
        return np.asarray(off * (np.tan(angle) / np.maximum(angle, 1e-9))[:, None])

    def straight(self, at: Array) -> Array:
        """Pixels of places in that plane, not bent."""
        if not self.focal:
            return at
        r = np.linalg.norm(at, axis=1) / self.focal
        return np.asarray(self.middle + at * (np.arctan(r) / np.maximum(r, 1e-9))[:, None])

    def pixels(self, at: Array) -> Array:
        """Pixels of places in that plane."""
        xy = self.straight(at)
        return xy if self.bend is None else xy + self._terms(xy) @ self.bend

    def bent_by(self, views: Iterable[_View]) -> _Lens:
        """The lens with the polynomial that the agreeing points of all images have in common."""
        good = [view for view in views if view.mask.any()]
        if not good:
            return self
        at = np.concatenate([self.straight(_mapped(view.h, view.design))[view.mask] for view in good])
        xy = np.concatenate([view.xy[view.mask] for view in good])
        return replace(self, bend=np.linalg.lstsq(self._terms(at), xy - at, rcond=None)[0])

    def _terms(self, xy: Array) -> Array:
        x, y = np.clip((xy - self.middle) / self.half, -1.2, 1.2).T
        powers = [(i, d - i) for d in range(2, _DEGREE + 1) for i in range(d + 1)]
        return np.stack([x**i * y**j for i, j in powers], axis=1)


class _Calibrated:
    """A camera that is known."""

    known: ClassVar[bool] = True

    def __init__(self, mapping: PlaneMapping) -> None:
        self._mapping = mapping

    def plane(self, xy: Array) -> Array:
        """Directions of pixels; far away where there are none."""
        return np.nan_to_num(self._mapping.inverse(xy), nan=_FAR)

    def pixels(self, at: Array) -> Array:
        """Pixels of directions; far away where there are none."""
        known = np.flatnonzero(np.isfinite(at).all(axis=1))
        known = known[self._mapping.one_to_one(at[known])]
        xy = np.full(at.shape, _FAR)
        xy[known] = np.nan_to_num(self._mapping(at[known]), nan=_FAR)
        return xy

    def bent_by(self, views: Iterable[_View]) -> _Calibrated:
        """Itself."""
        return self


class _View:
    """One image: its points as they are named, or as if the target were turned, and their homography."""

    def __init__(
        self,
        xy: Array,
        names: Rows,
        guess: Rows,
        plane: Array,
        lens: _Projection,
        within: float = _WITHIN,
    ) -> None:
        self.xy, self.names, self.plane, self.design = xy, names, plane, plane[guess]
        self.step, uv = _spacing(xy), lens.plane(xy)
        self.off = np.full(len(xy), np.inf)
        self.h, inside = cv2.findHomography(
            self.design, uv, cv2.RANSAC, within * _spacing(uv), maxIters=300, confidence=0.999
        )
        self.mask: Mask = np.zeros(len(xy), dtype=np.bool_) if self.h is None else inside.ravel() > 0
        self.fit(lens)

    @property
    def agree(self) -> int:
        """Number of points that agree."""
        return int(self.mask.sum())

    def fit(self, lens: _Projection) -> None:
        """Fit the homography to the points that agree, and look which these are."""
        for _ in range(2):
            if self.mask.sum() < 6:
                self.mask = np.zeros(len(self.xy), dtype=np.bool_)
                return
            h, _ = cv2.findHomography(self.design[self.mask], lens.plane(self.xy)[self.mask], 0)
            if h is None:
                return
            self.h = h
            self.off = np.linalg.norm(lens.pixels(_mapped(h, self.design)) - self.xy, axis=1)
            self.mask = self.off < _WITHIN * self.step

    def renamed(self, known: Rows, lens: _Projection) -> Rows:
        """The points in whose places the image points lie."""
        places = lens.pixels(_mapped(self.h, self.plane[known]))
        return np.asarray(known[scipy.spatial.cKDTree(places).query(self.xy)[1]])

    def placed(self, known: Rows, lens: _Projection) -> tuple[int, int]:
        """Numbers of image points in the places of points, and of those in their own places."""
        if self.h is None or not self.mask.any():
            return 0, 0
        found = self.judged(lens, known)
        return int((found.near < _WITHIN * self.step).sum()), int((found.own < _WITHIN).sum())

    def judged(self, lens: _Projection, known: Rows) -> _Image:
        """Where the points lie, and whether in the places of their names."""
        places = np.full(self.plane.shape, np.nan)
        places[known] = lens.pixels(_mapped(self.h, self.plane[known]))
        tree = scipy.spatial.cKDTree(places[known])
        near, at = tree.query(self.xy)
        nearest = known[at]
        gap = tree.query(places[self.names], k=2)[0][:, 1]
        cell = tree.query(places[nearest], k=2)[0][:, 1] ** 2
        own = np.linalg.norm(places[self.names] - self.xy, axis=1)
        spread = float(np.sqrt(np.mean(self.off[self.mask] ** 2) / 2)) if self.mask.any() else np.inf
        return _Image(
            self.agree, own / np.maximum(gap, 1e-9), own, nearest, near, max(spread, 1e-3 * self.step), cell,
            float(np.sign(np.linalg.det(self.h))),
        )  # fmt: skip


def _view(
    xy: Array,
    names: Rows,
    guess: Rows,
    plane: Array,
    tree: scipy.spatial.cKDTree,
    known: Rows,
    lens: _Projection,
) -> _View | None:
    """The view of an image in which most names agree, if the target is as named, turned or mirrored.

    `guess` are the points that are perhaps seen.
    """
    designs = [guess, *(known[tree.query(turned[names])[1]] for turned in _turned(plane))]
    best = _View(xy, names, names, plane, lens)
    for within in (_WITHIN, *_NEAR):
        # Where few agree, the names are perhaps those of near points: they are taken from the places.
        for design in designs if best.agree <= _AGREE * len(names) else ():
            view = _View(xy, names, design, plane, lens, within)
            if within > _WITHIN and view.h is not None:
                view = _View(xy, names, view.renamed(known, lens), plane, lens)
            best = max(best, view, key=lambda view: view.agree)
            if best.agree > _AGREE * len(names):
                break
    if lens.known and best.mask.any() and best.agree < len(names):
        # What is named one place further agrees with itself, too, but for the points at the ends of the rows.
        seen = plane[best.renamed(known, lens)]
        shifted = (known[tree.query(seen + step)[1]] for step in _steps(plane[known], tree))
        views = [best, *(_View(xy, names, design, plane, lens) for design in shifted)]
        best = max(views, key=lambda view: view.placed(known, lens))
        return best if best.placed(known, lens)[0] > _AGREE * len(names) else None
    return best if best.agree > _AGREE * len(names) else None


def _steps(plane: Array, tree: scipy.spatial.cKDTree) -> Array:
    """The usual differences of neighbouring points, and the opposite ones (k, 2)."""
    off = plane[tree.query(plane, k=3)[1][:, 1:]] - plane[:, None]
    off = off.reshape(-1, 2)
    off = off[np.linalg.norm(off, axis=1) < 1.5 * np.median(np.linalg.norm(off, axis=1))]
    across = np.abs(off[:, 0]) > np.abs(off[:, 1])
    kinds = [np.median(np.abs(part), axis=0) * along for part, along in (
        (off[across], [1, 0]), (off[~across], [0, 1])) if len(part)]  # fmt: skip
    return np.array([sign * kind for kind in kinds for sign in (1.0, -1.0)]).reshape(-1, 2)


def _turned(plane: Array) -> Iterator[Array]:
    """The plane as it is, turned by quarters, and mirrored (p, 2)."""
    for flip in (1.0, -1.0):
        for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            yield plane @ np.array([[c, -s], [s, c]]) * [flip, 1.0]


def _mapped(h: Any, at: Array) -> Array:
    mapped = np.column_stack([at, np.ones(len(at))]) @ h.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _spacing(xy: Array) -> float:
    """Distance of points from their nearest neighbours; the median."""
    return float(np.median(scipy.spatial.cKDTree(xy).query(xy, k=2)[0][:, 1]))
