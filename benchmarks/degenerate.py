"""Networks of a camera that turns and moves a little: is it said where there is no depth, do intervals hold?

``python benchmarks/degenerate.py [--count 1000] [--seed 1] [--jobs N]``. The camera turns about a place from
which it moves by 0 to 35 % of the distance of the points; half of the bases are spread evenly on a
logarithmic scale from a hundred-thousandth. Networks are drawn and projected by NumPy and SciPy alone, with
errors of 0.1 to 1 px, without approximate poses or points, and adjusted as ``reseau bundle`` does.

Rotations alone predict image points that are left out as well, on average, where what they cannot explain of
the image points without errors (λ, a non-central χ²) is not more than one for each unknown that they lack.
The 95 % intervals are those of the parameters of the camera, in networks with depth.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.special
from parts import add_options, executor_of, main_of, outcomes
from scipy.spatial.transform import Rotation

from reseau.bundle import Network, Options, adjust_network
from reseau.core.data import Array
from reseau.core.failure import Code
from reseau.io.network import Network1

WIDTH, HEIGHT, PITCH = 2400, 1800, 0.005
NAMES = ("c", "x0", "y0", "K1", "K2")
TRUE = np.array([12.0, 0.05, -0.08, 4e-4, -2e-6])
STEPS = 15


class Case(NamedTuple):
    """What was found in a network: λ and unknowns that rotations lack, outcome, intervals."""

    base: float
    excess: float
    lacking: int
    outcome: str
    inside: int
    of: int


def projected(rays: Array, camera: Array = TRUE) -> Array:
    """Pixels of rays in the system of a camera, with the distortion of the true point."""
    c, x0, y0, k1, k2 = camera
    plane = c * rays[:, :2] / rays[:, 2:]
    r2 = (plane**2).sum(axis=1, keepdims=True)
    plane = plane * (1 + k1 * r2 + k2 * r2**2) + [x0, -y0]
    return np.asarray(plane / PITCH + [(WIDTH - 1) / 2, (HEIGHT - 1) / 2])


def drawn(seed: int) -> tuple[dict[str, Any], Array, Array, Array, float]:
    """A network without errors, its points, stations, image points, and the standard deviation of these."""
    rng = np.random.default_rng(seed)
    images, points = int(rng.integers(5, 12)), int(rng.integers(30, 90))
    base = 0.35 * rng.random() if rng.random() < 0.5 else 10 ** rng.uniform(-5, np.log10(0.35))
    base = 0.0 if rng.random() < 0.15 else base
    sigma = 10 ** rng.uniform(-1, 0)
    distance = 1000 * (1 + 0.5 * rng.uniform(-1, 1, points))
    angle = np.radians(rng.uniform(-28, 28, (2, points)))
    xyz = distance[:, None] * np.column_stack([np.tan(angle[0]), np.tan(angle[1]), np.ones(points)])
    x0 = rng.normal(size=(images, 3)) * base * 1000 / np.sqrt(3)
    turns = np.column_stack(
        [np.radians(rng.uniform(-14, 14, (images, 2))), rng.uniform(-np.pi, np.pi, images)]
    )
    rotation = Rotation.from_euler("xyz", turns).as_matrix()
    seen: list[tuple[int, int, Array]] = []
    for i in range(images):
        rays = (xyz - x0[i]) @ rotation[i].T
        xy = projected(rays)
        inside = (xy > 5).all(axis=1) & (xy < [WIDTH - 6, HEIGHT - 6]).all(axis=1) & (rays[:, 2] > 0)
        seen += [(i, j, xy[j]) for j in np.flatnonzero(inside)]
    document = document_of(images, points, seen, sigma, 12.3, NAMES)
    return document, xyz, x0, rotation, sigma


def document_of(
    images: int, points: int, seen: list[tuple[int, int, Array]], sigma: float, c: float, free: Sequence[str]
) -> dict[str, Any]:
    """A free network without approximate values, of image points (image, point, xy)."""
    xy = np.array([row[2] for row in seen])
    return {
        "schema": "reseau-network/1", "unit": "mm", "datum": "free",
        "cameras": [{
            "id": "C", "width": WIDTH, "height": HEIGHT, "pitch_mm": [PITCH, PITCH], "model": "brown",
            "side": "object", "parameters": {"c": c}, "free": list(free),
        }],
        "images": {
            "id": [f"i{k}" for k in range(images)], "camera": ["C"] * images,
            "X0": [None] * images, "rotation": [None] * images,
        },
        "points": {
            "id": [f"p{k}" for k in range(points)], "xyz": [None] * points, "sigma": [None] * points,
            "role": ["tie"] * points,
        },
        "observations": {
            "image": [f"i{row[0]}" for row in seen], "point": [f"p{row[1]}" for row in seen],
            "x": xy[:, 0].tolist(), "y": xy[:, 1].tolist(), "sx": [sigma] * len(xy), "sy": [sigma] * len(xy),
        },
    }  # fmt: skip


def network_of(document: dict[str, Any], errors: Array) -> Network:
    """The network, with errors added to its image points."""
    seen = dict(document["observations"])
    seen["x"], seen["y"] = (np.add(seen[axis], errors[:, k]).tolist() for k, axis in enumerate("xy"))
    return Network.from_document(Network1.from_content(document | {"observations": seen}, where="drawn"))


def unexplained(document: dict[str, Any], rotation: Array, xyz: Array, sigma: float) -> tuple[float, int]:
    """λ: what rotations cannot explain of image points without errors, and the unknowns that they lack."""
    seen = document["observations"]
    image, point = (np.array([int(name[1:]) for name in seen[key]]) for key in ("image", "point"))
    point = np.unique(point, return_inverse=True)[1]
    names = np.unique([int(name[1:]) for name in seen["point"]])
    xy, m, p = np.array([seen["x"], seen["y"]]).T, len(rotation), len(names)
    k = len(TRUE)
    scale = np.array([1.0, 0.01, 0.01, 1e-4, 1e-6])

    def misfits(at: Array) -> Array:
        turned = Rotation.from_rotvec(at[k : k + 3 * m].reshape(m, 3)).as_matrix() @ rotation
        shift = at[k + 3 * m :].reshape(p, 2)
        ray = xyz[names] / xyz[names][:, 2:] + np.pad(shift, ((0, 0), (0, 1)))
        rays = np.einsum("nij,nj->ni", turned[image], ray[point])
        return np.asarray((projected(rays, TRUE + scale * at[:k]) - xy) / sigma).ravel()

    pattern = scipy.sparse.lil_array((2 * len(xy), k + 3 * m + 2 * p), dtype=np.int8)
    pattern[:, :k] = 1
    for row, (i, j) in enumerate(zip(image, point, strict=True)):
        pattern[2 * row : 2 * row + 2, k + 3 * i : k + 3 * i + 3] = 1
        pattern[2 * row : 2 * row + 2, k + 3 * m + 2 * j : k + 3 * m + 2 * j + 2] = 1
    found = scipy.optimize.least_squares(
        misfits, np.zeros(pattern.shape[1]), jac_sparsity=pattern, x_scale="jac", max_nfev=40
    )
    return 2 * float(found.cost), 3 * m + p - 4


def outcome(seed: int) -> Case:
    """Draw a network, adjust it, and compare."""
    document, xyz, x0, rotation, sigma = drawn(seed)
    count = len(document["observations"]["x"])
    base = float(np.sqrt(((x0 - x0.mean(axis=0)) ** 2).sum(axis=1).mean()) / 1000)
    excess, lacking = unexplained(document, rotation, xyz, sigma)
    errors = sigma * np.random.default_rng((seed, 1)).normal(size=(count, 2))
    result = adjust_network(network_of(document, errors), Options())
    if not result:
        if result.code is Code.ONE_STATION:
            return Case(base, excess, lacking, "one-station", 0, 0)
        return Case(base, excess, lacking, str(result.code.value), 0, 0)
    own = result.cameras["C"]
    half = scipy.special.stdtrit(own.dof if own.dof is not None else np.inf, 0.975) * own.sigma
    inside = np.abs(own.values - TRUE) < half
    return Case(base, excess, lacking, "depth", int(inside.sum()), len(inside))


def main() -> None:
    """Draw, adjust, count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser)
    given = parser.parse_args()
    jobs = [1_000_000 * given.seed + k for k in range(given.count)]
    cases = list(outcomes(executor_of(given), outcome, jobs))
    ratio = np.array([case.excess / case.lacking for case in cases])
    found = np.array([case.outcome for case in cases])
    for name, of in (
        ("rotations predict as well (λ up to 1 an unknown)", ratio <= 1),
        ("λ from 1 to 4", (ratio > 1) & (ratio <= 4)),
        ("λ above 4", ratio > 4),
    ):
        code, count = found[of], max(int(of.sum()), 1)
        said = int((code == "one-station").sum())
        others = {kind: int((code == kind).sum()) for kind in sorted(set(code)) if kind != "one-station"}
        print(f"{name}: {count} networks, one station in {said} ({100 * said / count:.1f} %); {others}")
    inside, every = (sum(getattr(case, name) for case in cases) for name in ("inside", "of"))
    print(f"95 % intervals of the camera with depth: {100 * inside / max(every, 1):.1f} % of {every}")


if __name__ == "__main__":
    main_of(__file__)
