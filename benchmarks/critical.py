"""Networks whose points are near a quadric through the projection centres: is it said, do intervals hold?

``python benchmarks/critical.py [--count 400] [--seed 1] [--jobs N]``. Two to four images show 15 to 60 points
on a cylinder, a hyperboloid of one sheet or a cone, of which the projection centres are on a generator, or
on a plane, or in a volume; points depart from it by 0 to 30 % of their distance. Networks are drawn and
projected by NumPy and SciPy alone, with errors of 0.1 to 1 px, without approximate poses or points, and
adjusted as ``reseau bundle`` does.

Two images are ambiguous where distances from epipolar lines (Sampson) without errors allow, along the weakest
combination of the relative orientation, another one that is ten times less probable by standard deviations
than by these distances, or from random starts another minimum before both images with an excess below
2 ln 1000, or where the weakest combination has a standard deviation of 0.1 (rad) and more; and clear where
it is as probable within a third. Intervals of 95 % are those of rotations between images, in networks without
the code `ambiguous`.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
import scipy.special
from degenerate import HEIGHT, PITCH, WIDTH, document_of, network_of, projected
from parts import add_options, executor_of, main_of, outcomes
from scipy.spatial.transform import Rotation

from reseau.bundle import Result, adjust_network
from reseau.core.data import Array
from reseau.core.failure import Code

SURFACES = ("cylinder", "hyperboloid", "cone", "plane", "volume")
CAMERA = np.array([12.0, 0.0, 0.0, 0.0, 0.0])
LEAST, CHANCE, SINGULAR = 15, 2 * np.log(10.0), 0.1


class Case(NamedTuple):
    """What was found in a network: its kind, whether it is ambiguous, outcome, errors in their sigmas."""

    surface: str
    images: int
    departure: float
    ambiguous: bool | None
    outcome: str
    ratios: tuple[float, ...]


def on_surface(surface: str, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (count, 3) of about two units of distance, and the direction of the projection centres."""
    x, angle = rng.uniform(-1.2, 1.2, count), rng.uniform(-0.75, 0.75, count)
    bend = rng.uniform(0.1, 0.6)
    if surface == "volume":
        depth = rng.uniform(1.2, 2.8, count)
        return np.column_stack([x, rng.uniform(-0.8, 0.8, count), depth - 1]), np.array([1.0, 0.2, 0.1])
    if surface == "plane":
        tilt = np.tan(rng.uniform(-0.6, 0.6, 2))
        y = rng.uniform(-0.8, 0.8, count)
        return np.column_stack([x, y, 1 + tilt[0] * x + tilt[1] * y]), np.array([1.0, 0.0, 0.0])
    radius, along = np.ones(count), np.array([1.0, 0.0, 0.0])
    if surface == "hyperboloid":
        radius, along = np.sqrt(1 + bend * x**2), np.array([1.0, np.sqrt(bend), 0.0])
    if surface == "cone":
        radius, along = 1 + 0.6 * bend * x, np.array([1.0, 0.0, -0.6 * bend])
    return np.column_stack([x, radius * np.sin(angle), radius * np.cos(angle)]), along


def drawn(seed: int) -> tuple[dict[str, Any], Array, Array, Array, str, float, float]:
    """A network without errors, its points, stations and rotations, surface, departure, and sigma."""
    rng = np.random.default_rng(seed)
    surface = SURFACES[int(rng.integers(len(SURFACES)))]
    images, points = int(rng.choice([2, 2, 3, 4])), int(rng.integers(25, 90))
    departure = (
        0.0 if rng.random() < 0.2 else 0.3 * rng.random() if rng.random() < 0.4 else 10 ** rng.uniform(-4, -1)
    )
    departure = 0.0 if surface == "volume" else departure
    sigma = 10 ** rng.uniform(-1, 0)
    xyz, along = on_surface(surface, points, rng)
    base = np.linspace(-0.5, 0.5, images) * rng.uniform(0.3, 1.0)
    x0 = np.array([0.0, 0.0, -1.0]) + base[:, None] * along
    if surface in ("volume", "plane"):
        x0 = x0 + 0.1 * rng.normal(size=x0.shape)
    xyz = xyz + departure * rng.normal(size=(points, 1)) * (xyz - [0, 0, -1])
    turns = np.column_stack([rng.uniform(-0.08, 0.08, (images, 2)), rng.uniform(-np.pi, np.pi, images)])
    turns[:, 1] += 0.5 * np.arctan(x0[:, 0] / 2)
    rotation = Rotation.from_euler("xyz", turns).as_matrix()
    xyz, x0, seen = 1000 * xyz, 1000 * x0, list[tuple[int, int, Array]]()
    for i in range(images):
        rays = (xyz - x0[i]) @ rotation[i].T
        xy = projected(rays, CAMERA)
        inside = (xy > 5).all(axis=1) & (xy < [WIDTH - 6, HEIGHT - 6]).all(axis=1) & (rays[:, 2] > 0)
        seen += [(i, j, xy[j]) for j in np.flatnonzero(inside)]
    count = np.bincount([j for _, j, _ in seen], minlength=points)
    seen = [row for row in seen if count[row[1]] > 1]
    document = document_of(images, points, seen, sigma, float(CAMERA[0]), ())
    return document, xyz, x0, rotation, surface, departure, sigma


def is_ambiguous(xyz: Array, x0: Array, rotation: Array, sigma: float, seen: Array) -> bool | None:
    """Whether two images without errors have other relative orientations; None where it is not clear."""
    rays = [(xyz[seen] - x0[i]) @ rotation[i].T for i in (0, 1)]
    a, b = (ray / ray[:, 2:] for ray in rays)
    base = rotation[0] @ (x0[1] - x0[0])
    base, turn = base / np.linalg.norm(base), rotation[1] @ rotation[0].T
    across = np.linalg.svd(base[None])[2][1:]

    def off(p: Array) -> Array:
        t = base + p[3:] @ across
        cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
        e = Rotation.from_rotvec(p[:3]).as_matrix() @ turn @ cross
        right, left = a @ e.T, b @ e
        size = np.sqrt((right[:, :2] ** 2).sum(axis=1) + (left[:, :2] ** 2).sum(axis=1))
        return np.asarray((b * right).sum(axis=1) / size * CAMERA[0] / PITCH / sigma)

    slope = scipy.optimize.approx_fprime(np.zeros(5), off, 1e-7)
    values, vectors = np.linalg.eigh(slope.T @ slope)
    if values[0] < 1 / SINGULAR**2:
        return True
    scale = vectors / np.sqrt(np.maximum(values, 1e-12))
    sigmas = np.linalg.norm(scale, axis=1)

    def allowed(t: float) -> tuple[bool, float]:
        """Whether it is allowed to go so far along the weakest combination; the largest difference there."""
        least = scipy.optimize.least_squares(
            lambda q: off(scale @ np.concatenate([[t], q])), np.zeros(4), method="lm", max_nfev=400
        )
        at = scale @ np.concatenate([[t], least.x])
        return bool(2 * least.cost <= CHANCE), float(np.abs(at / sigmas).max())

    found = 0.0
    for sign in (1.0, -1.0):
        near, far = 0.0, np.inf
        for _ in range(12):
            t = min(max(2 * near, 1.0), (near + far) / 2)
            good, most = allowed(sign * t)
            near, far, found = (t, far, max(found, most)) if good else (near, t, found)
    rng = np.random.default_rng(0)
    for _ in range(20):
        start = np.concatenate([0.4 * rng.normal(size=3), 0.7 * rng.normal(size=2)])
        least = scipy.optimize.least_squares(off, start, method="lm", max_nfev=200)
        turned, t = Rotation.from_rotvec(least.x[:3]).as_matrix() @ turn, base + least.x[3:] @ across
        # Depths along both rays: R (z a − t) = w b.
        one, other, shift = a @ turned.T, -b, turned @ t
        dots = [(u * v).sum(axis=1) for u, v in ((one, one), (one, other), (other, other))]
        right = [one @ shift, other @ shift]
        z, w = dots[2] * right[0] - dots[1] * right[1], dots[0] * right[1] - dots[1] * right[0]
        if 2 * least.cost < 2 * np.log(1000.0) and (z > 0).all() and (w > 0).all():
            # Full turns are none.
            least.x[:3] = Rotation.from_rotvec(least.x[:3]).as_rotvec()
            found = max(found, float(np.abs(least.x / sigmas).max()))
    return True if found**2 > 2 * CHANCE else False if found**2 < 1.3 * CHANCE else None


def ratios(result: Result, rotation: Array) -> tuple[float, ...]:
    """Errors of the rotations between images in their standard deviations; none where these are NaN."""
    found = list[float]()
    estimated = result.fit.values.rotation
    for b in range(1, len(rotation)):
        names = [f"d{axis} of image i{i}" for i in (0, b) for axis in "xyz"]
        turn = estimated[b] @ estimated[0].T
        slope = np.concatenate([-turn, np.eye(3)], axis=1)
        sigma = np.sqrt(np.diag(slope @ result.covariance_of(*names) @ slope.T))
        off = Rotation.from_matrix(turn @ (rotation[b] @ rotation[0].T).T).as_rotvec()
        half = scipy.special.stdtrit(result.redundancy, 0.975) * sigma
        found += (off / half)[np.isfinite(half)].tolist()
    return tuple(found)


def outcome(seed: int) -> Case | None:
    """Draw a network, adjust it, and compare; None where too few points are seen."""
    document, xyz, x0, rotation, surface, departure, sigma = drawn(seed)
    count, images = len(document["observations"]["x"]), len(rotation)
    seen = np.array([int(name[1:]) for name in document["observations"]["point"]], dtype=np.intp)
    if (
        len(np.unique(seen)) < LEAST
        or np.bincount([int(name[1:]) for name in document["observations"]["image"]], minlength=images).min()
        < LEAST
    ):
        return None
    ambiguous = is_ambiguous(xyz, x0, rotation, sigma, np.unique(seen)) if images == 2 else None
    errors = sigma * np.random.default_rng((seed, 1)).normal(size=(count, 2))
    result = adjust_network(network_of(document, errors))
    if not result:
        return Case(surface, images, departure, ambiguous, str(result.code.value), ())
    code = any(remark.code is Code.AMBIGUOUS for remark in result.warnings)
    oriented = bool(np.isfinite(result.fit.values.x0).all())
    own = ratios(result, rotation) if oriented else ()
    return Case(surface, images, departure, ambiguous, "ambiguous" if code else "unique", own)


def main() -> None:
    """Draw, adjust, count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser)
    given = parser.parse_args()
    jobs = [1_000_000 * given.seed + k for k in range(given.count)]
    cases = [case for case in outcomes(executor_of(given), outcome, jobs) if case is not None]
    print(f"{len(cases)} networks")
    for surface in SURFACES:
        for images in (2, 3, 4):
            own = [case for case in cases if case.surface == surface and case.images == images]
            kinds = {
                kind: sum(case.outcome == kind for case in own) for kind in sorted({c.outcome for c in own})
            }
            print(f"{surface}, {images} images: {kinds}")
    for said, of in (("ambiguous", True), ("clear", False), ("between", None)):
        own = [case for case in cases if case.ambiguous is of and case.images == 2]
        code = sum(case.outcome == "ambiguous" for case in own)
        print(f"two images, {said} without errors: {code} of {len(own)} with the code")
    for outcome_, name in (("unique", "without"), ("ambiguous", "with")):
        own = [case for case in cases if case.outcome == outcome_]
        ratio = np.abs(np.concatenate([[], *(case.ratios for case in own)]))
        far = sum(max(map(abs, case.ratios), default=0.0) > 2.5 for case in own)
        print(
            f"{name} the code: {100 * (ratio < 1).mean():.1f} % of {len(ratio)} intervals hold; "
            f"in {far} of {len(own)} networks an error is above 2.5 half intervals"
        )


if __name__ == "__main__":
    main_of(__file__)
