"""Networks of any size with the statistics of those of *Bundle adjustment in the large* (BAL).

`ladybug`: a vehicle drives a closed circuit and looks to the side; a point is seen by neighbouring images.
`venice`: photographs by visitors; few places attract most of them, and places in view of each other are
connected. For each image there are

    BAL's network               points   image points   rays to a point   pairs of images with common points
    ladybug, 49 images           159         650             4.1               83 %
    ladybug, 1723 images          91         394             4.3
    venice, 52 images           1232        6680             5.4
    venice, 1778 images          559        2813             5.0

The first line was counted in the file itself. Numbers of points are parts of the names of BAL's files.
Numbers of image points with 1723 and 1778 images are those that benchmarks of other programs state for the
files; that with 52 images is from memory, and was not checked. The drawn ones agree in points, image points
and rays (with 49 images 159, 625, 3.9; 5 % of the points have more than 8 rays, in BAL 11), except `venice`
with few images (with 52 1106, 4688, 4.2). They differ in what is connected: BAL's vehicle comes back to
places where it was, so that 83 % of the pairs of 49 images have common points, of the drawn ones 34 %. The
normal equations of a vehicle that comes back have a wider band; those of `venice` are full.

Each image has a camera of its own with f, k1, k2, as in BAL. Image coordinates have errors of 0.5 px; the
approximate values are off by amounts that make residuals of some pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reseau.bundle import Network
from reseau.exchange.bal import centred_network
from reseau.optics.poses import matrix_to_vector, rotation_matrix

__all__ = ["KINDS", "Bal", "ladybug", "venice"]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

SIGMA = 0.5
"""Standard deviation of the image coordinates, px."""
_F, _HALF = 800.0, 700.0
"""Focal length and half of the width of an image, px."""
_PARALLAX = 0.02
"""Least angle between the rays to a point, rad."""


@dataclass(frozen=True)
class Bal:
    """A network as a BAL file has it: rotations (m, 3, 3) and shifts (m, 3) to cameras that look along −z."""

    rotation: Array
    shift: Array
    interior: Array
    xyz: Array
    image: Rows
    point: Rows
    xy: Array

    def network(self) -> Network:
        """Network with sigmas of the image coordinates as they are."""
        seen = (self.image, self.point, self.xy)
        names = tuple(str(i) for i in range(len(self.shift)))
        found = centred_network(self.rotation, self.shift, self.interior, self.xyz, seen, names)
        return replace(found, cov=found.cov * SIGMA**2)

    def write(self, path: Path) -> None:
        """Write it for other programs; they get image coordinates and f in standard deviations."""
        cameras = np.hstack([matrix_to_vector(self.rotation), self.shift, self.interior])
        cameras[:, 6] /= SIGMA
        with path.open("w") as file:
            file.write(f"{len(cameras)} {len(self.xyz)} {len(self.xy)}\n")
            for i, j, (x, y) in zip(
                self.image.tolist(), self.point.tolist(), (self.xy / SIGMA).tolist(), strict=True
            ):
                file.write(f"{i} {j} {x!r} {y!r}\n")
            for row in (*cameras, *self.xyz):
                file.write("\n".join(map(repr, row.tolist())) + "\n")


def ladybug(images: int, seed: int = 0) -> Bal:
    """A circuit of a vehicle, one unit of length between its images."""
    rng = np.random.default_rng([seed, images])
    angle = 2 * np.pi * np.arange(images) / images
    radius = images / (2 * np.pi)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(images)], axis=1)
    x0 = radius * out + rng.normal(0, 0.05, out.shape)
    points = round(images * _between(images, (49, 159.0), (1723, 91.0)))
    length = 2 + np.minimum(rng.geometric(1 / 3.3, points) - 1, images // 4)
    # In view of all images of its track, and not farther than the houses of a street are.
    depth = np.maximum(length / 1.2, 4.0) * rng.uniform(1.0, 3.0, points)
    first = rng.integers(images, size=points)
    middle = angle[first] + np.pi * (length - 1) / images
    across = rng.uniform(-0.25, 0.25, points) * depth / (radius + depth)
    where = middle + across
    xyz = (radius + depth)[:, None] * np.stack([np.cos(where), np.sin(where), np.zeros(points)], axis=1)
    xyz[:, 2] = rng.uniform(-0.4, 0.4, points) * depth
    point = np.repeat(np.arange(points), length)
    place = np.arange(len(point)) - np.repeat(np.cumsum(length) - length, length)
    image = (first[point] + place) % images
    return _drawn(_facing(out, rng), x0, xyz, image, point, rng)


def venice(images: int, seed: int = 0) -> Bal:
    """Photographs of places, of which the k-th attracts 1/k of those of the first."""
    rng = np.random.default_rng([seed, images, 1])
    places = max(4, images // 30)
    share = 1.0 / np.arange(1, places + 1)
    share /= share.sum()
    plan = 40.0 * np.sqrt(places) * rng.uniform(-1, 1, (places, 2))
    # Each place is the front of a building; photographs are taken from a sector before it.
    front = rng.uniform(0, 2 * np.pi, places)
    own = rng.choice(places, images, p=share)
    # At least three of each place, where there are enough of them.
    own[: min(images, 3 * places)] = np.arange(min(images, 3 * places)) % places
    turn = front[own] + rng.normal(0, 0.45, images)
    away = rng.uniform(20, 60, images)
    x0 = np.zeros((images, 3))
    x0[:, :2] = plan[own] + away[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    x0[:, 2] = rng.normal(1.7, 0.5, images)
    aim = np.column_stack([plan[own], np.full(images, 6.0)]) + rng.normal(0, 4.0, (images, 3))
    rotation = _facing((aim - x0) / np.linalg.norm(aim - x0, axis=1, keepdims=True), rng)
    points = round(images * _between(images, (52, 1230.0), (1778, 560.0)))
    at = rng.choice(places, points, p=share)
    along = np.stack([-np.sin(front), np.cos(front)], axis=1)[at]
    xyz = np.zeros((points, 3))
    xyz[:, :2] = plan[at] + rng.normal(0, 9.0, points)[:, None] * along + rng.normal(0, 2.0, (points, 2))
    xyz[:, 2] = rng.uniform(0, 15, points)
    wanted = np.minimum(2 + rng.pareto(1.6, points) * 3.0, images / 2).astype(np.intp)
    image, point = [], []
    for k in range(places):
        mine = np.flatnonzero(at == k)
        ray = np.column_stack([plan[k] - x0[:, :2], 6.0 - x0[:, 2]])
        far = np.linalg.norm(ray, axis=1)
        # Photographs of other places show this one too, behind or beside theirs.
        sees = np.flatnonzero(
            (np.einsum("mi,mi->m", ray, rotation[:, 2]) < -0.8 * far) & (far < 150) & (far > 15)
        )
        if len(sees) < 2:
            continue
        # Neighbours in the direction of view see the same points; one of ten is any other.
        sees = sees[np.argsort(np.arctan2(-ray[sees, 1], -ray[sees, 0]))]
        count = np.minimum(wanted[mine], len(sees))
        owner = np.repeat(mine, count)
        middle = rng.integers(len(sees), size=len(mine))
        near = np.rint(np.repeat(middle, count) + rng.normal(0, 0.6, len(owner)) * np.repeat(count, count))
        any_ = rng.random(len(owner)) < 0.1
        near[any_] = rng.integers(len(sees), size=int(any_.sum()))
        image.append(sees[near.astype(np.intp) % len(sees)])
        point.append(owner)
    pairs = np.unique(np.concatenate(point) * images + np.concatenate(image))
    return _drawn(rotation, x0, xyz, pairs % images, pairs // images, rng)


KINDS = {"ladybug": ladybug, "venice": venice}


def _between(images: int, small: tuple[int, float], large: tuple[int, float]) -> float:
    """Power law through two of BAL's networks, constant beyond them."""
    at = np.clip(images, small[0], large[0])
    power = np.log(large[1] / small[1]) / np.log(large[0] / small[0])
    return float(small[1] * (at / small[0]) ** power)


def _facing(view: Array, rng: np.random.Generator) -> Array:
    """Rotations (m, 3, 3) of cameras that look along unit vectors, up is about +z."""
    back = -view
    right = np.cross(np.array([0.0, 0.0, 1.0]), back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    turned = np.stack([right, np.cross(back, right), back], axis=1)
    found: Array = rotation_matrix(rng.normal(0, 0.03, view.shape)) @ turned
    return found


def _drawn(rotation: Array, x0: Array, xyz: Array, image: Rows, point: Rows, rng: np.random.Generator) -> Bal:
    """Image coordinates of what is inside the images, and approximate values of everything."""
    images = len(x0)
    f = _F * rng.uniform(0.9, 1.1, images)
    interior = np.column_stack([f, rng.normal(0, 0.02, images), rng.normal(0, 0.005, images)])
    inside = np.empty(len(image), dtype=bool)
    xy = np.empty((len(image), 2))
    for begin in range(0, len(image), 1_000_000):
        part = slice(begin, begin + 1_000_000)
        i = image[part]
        ray = np.einsum("nij,nj->ni", rotation[i], xyz[point[part]] - x0[i])
        p = -ray[:, :2] / ray[:, 2:]
        r2 = (p**2).sum(axis=1)
        scale = f[i] * (1 + r2 * (interior[i, 1] + r2 * interior[i, 2]))
        xy[part] = scale[:, None] * p
        inside[part] = (ray[:, 2] < -1.0) & (np.abs(xy[part]) < _HALF).all(axis=1)
    # A point needs two images from different directions, an image twenty points.
    while True:
        rays = np.bincount(point[inside], minlength=len(xyz))
        seen = np.bincount(image[inside], minlength=images)
        apart = _apart(x0, xyz, image[inside], point[inside]) > _PARALLAX
        good = inside & (rays[point] >= 2) & apart[point] & (seen[image] >= 20)
        if good.sum() == inside.sum():
            break
        inside = good
    kept, image = np.unique(image[inside], return_inverse=True)
    used, point = np.unique(point[inside], return_inverse=True)
    xy = xy[inside] + rng.normal(0, SIGMA, (int(inside.sum()), 2))
    near = _nearest(x0[kept], xyz[used], image, point)
    x0 = x0[kept] + 0.002 * near[:, None] * rng.normal(0, 1, (len(kept), 3))
    rotation = rotation_matrix(rng.normal(0, 0.002, x0.shape)) @ rotation[kept]
    start = interior[kept] * [1.0, 0.0, 0.0]
    start[:, 0] *= 1 + 0.005 * rng.normal(0, 1, len(kept))
    depth = np.linalg.norm(xyz[used[point]] - x0[image], axis=1)
    size = np.full(len(used), np.inf)
    np.minimum.at(size, point, depth)
    xyz = xyz[used] + 0.005 * size[:, None] * rng.normal(0, 1, (len(used), 3))
    shift = -np.einsum("mij,mj->mi", rotation, x0)
    return Bal(rotation, shift, start, xyz, image.astype(np.intp), point.astype(np.intp), xy)


def _apart(x0: Array, xyz: Array, image: Rows, point: Rows) -> Array:
    """Angle (rad) between two rays to each point (p,) that scatter as all of its rays do."""
    ray = xyz[point] - x0[image]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    count = np.maximum(np.bincount(point, minlength=len(xyz)), 1)
    mean = np.stack([np.bincount(point, ray[:, k], len(xyz)) / count for k in range(3)], axis=1)
    found: Array = np.sqrt(8.0 * np.maximum(1.0 - np.linalg.norm(mean, axis=1), 0.0))
    return found


def _nearest(x0: Array, xyz: Array, image: Rows, point: Rows) -> Array:
    """Distance (m,) of each image to the nearest point that it sees."""
    near = np.full(len(x0), np.inf)
    np.minimum.at(near, image, np.linalg.norm(xyz[point] - x0[image], axis=1))
    return near
