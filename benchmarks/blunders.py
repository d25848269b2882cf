"""Networks with many gross errors and exchanged names, from no approximate values: what is found, and said.

``python benchmarks/blunders.py [--count 200] [--seed 1] [--jobs N]``. 5 to 200 images of ordinary and wide
cameras; up to 40 % of the image points are displaced (to anywhere in the image, or by 10 to 1000 standard
deviations), up to 10 % have the name of another point of their image, and in one of eight networks all names
of an image are in another order. Half of the networks have six control points. Networks are drawn and
projected by NumPy and SciPy alone, without approximate poses or points, and adjusted as
``reseau bundle --reject`` does.

A network has converged to the right minimum where the parameters of the camera are within six standard
deviations of the true ones, and the image points without gross errors fit as their standard deviations say.
Counted are points with three or more good rays, as a good ray that is left alone determines no point: named
are gross errors above ten standard deviations, false those below four that are left out.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import numpy as np
from degenerate import HEIGHT, NAMES, PITCH, WIDTH, network_of, projected
from parts import add_options, executor_of, main_of, outcomes
from scipy.spatial.transform import Rotation

from reseau.bundle import Options, adjust_network
from reseau.core.data import Array

CAMERAS = {
    "ordinary": np.array([12.0, 0.05, -0.08, 4e-4, -2e-6]),
    "wide": np.array([6.5, -0.04, 0.06, -1.5e-3, 8e-6]),
}


class Case(NamedTuple):
    """What was found in a network: size, kind, share of gross errors, outcome, gross errors, false ones."""

    images: int
    kind: str
    share: float
    outcome: str
    named: int
    gross: int
    false: int
    good: int
    image_said: bool | None


def document_of(kind: str, points: Array, seen: list[tuple[int, int, Array]], images: int,
                sigma: float, control: int) -> dict[str, Any]:  # fmt: skip
    """The network of exact image points; the first points are control points."""
    count = len(points)
    return {
        "schema": "reseau-network/1", "unit": "mm", "datum": "control" if control else "free",
        "cameras": [{
            "id": "C", "width": WIDTH, "height": HEIGHT, "pitch_mm": [PITCH, PITCH], "model": "brown",
            "side": "object", "parameters": {"c": round(float(CAMERAS[kind][0]) * 1.03, 2)},
            "free": list(NAMES),
        }],
        "images": {
            "id": [f"i{k}" for k in range(images)], "camera": ["C"] * images,
            "X0": [None] * images, "rotation": [None] * images,
        },
        "points": {
            "id": [f"p{k}" for k in range(count)],
            "xyz": [points[k].tolist() if k < control else None for k in range(count)],
            "sigma": [[0.02] * 3 if k < control else None for k in range(count)],
            "role": ["control" if k < control else "tie" for k in range(count)],
        },
        "observations": {
            "image": [f"i{i}" for i, _, _ in seen], "point": [f"p{j}" for _, j, _ in seen],
            "x": [float(xy[0]) for _, _, xy in seen], "y": [float(xy[1]) for _, _, xy in seen],
            "sx": [sigma] * len(seen), "sy": [sigma] * len(seen),
        },
    }  # fmt: skip


def drawn(seed: int) -> tuple[str, dict[str, Any], Array, float, int]:
    """Kind of camera, a network without errors, errors (n, 2), their σ, the image in disorder (or −1)."""
    rng = np.random.default_rng(seed)
    kind = "wide" if rng.random() < 0.5 else "ordinary"
    images = round(10 ** rng.uniform(np.log10(5), np.log10(200)))
    count = int(rng.integers(40, 120))
    sigma = float(10 ** rng.uniform(-1, 0))
    camera = CAMERAS[kind]
    half = WIDTH * PITCH / 2 / camera[0]
    points = rng.uniform(-1, 1, (count, 3)) * [500, 400, 150]
    away = 500 / half * rng.uniform(0.9, 1.4, images)
    tilt = Rotation.from_euler(
        "xyz", np.column_stack([np.radians(rng.uniform(-40, 40, (images, 2))),
                                rng.uniform(-np.pi, np.pi, images)])
    )  # fmt: skip
    rotation = tilt.as_matrix()
    x0 = -np.einsum("nji,nj->ni", rotation, away[:, None] * [0, 0, 1] + rng.normal(size=(images, 3)) * 30)
    seen: list[tuple[int, int, Array]] = []
    for i in range(images):
        rays = (points - x0[i]) @ rotation[i].T
        xy = projected(rays, camera)
        with np.errstate(invalid="ignore"):
            inside = (xy > 5).all(axis=1) & (xy < [WIDTH - 6, HEIGHT - 6]).all(axis=1) & (rays[:, 2] > 0)
            inside &= np.linalg.norm(rays[:, :2] / rays[:, 2:], axis=1) < 1.3 * half * 1.25
        keep = np.flatnonzero(inside & (rng.random(count) < 0.85))
        seen += [(i, int(j), xy[j]) for j in keep]
    exact = np.array([xy for _, _, xy in seen])
    image = np.array([i for i, _, _ in seen])
    errors = sigma * rng.normal(size=exact.shape)
    gross = rng.random(len(exact)) < rng.uniform(0.05, 0.4)
    far = rng.random(len(exact)) < 0.5
    anywhere = rng.uniform(0, 1, exact.shape) * [WIDTH, HEIGHT] - exact
    angle, size = rng.uniform(0, 2 * np.pi, len(exact)), sigma * 10 ** rng.uniform(1, 3, len(exact))
    near = size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    errors = errors + gross[:, None] * np.where(far[:, None], anywhere, near)
    inside = np.clip(exact + errors, 0, [WIDTH - 1, HEIGHT - 1])
    errors = inside - exact
    swapped, disorder = rng.uniform(0, 0.1), -1
    if images >= 8 and rng.random() < 0.125:
        disorder = int(rng.integers(images))
    for i in range(images):
        rows = np.flatnonzero(image == i)
        order = rng.permutation(rows)
        chosen = order if i == disorder else order[: 2 * (round(swapped * len(rows)) // 2)]
        other = np.roll(chosen, 1) if i == disorder else chosen.reshape(-1, 2)[:, ::-1].ravel()
        errors[chosen] = (exact + errors)[other] - exact[chosen]
    control = 6 if rng.random() < 0.5 else 0
    return kind, document_of(kind, points, seen, images, sigma, control), errors, sigma, disorder


def outcome(seed: int) -> Case:
    """Draw a network, adjust it, and compare."""
    kind, document, errors, sigma, disorder = drawn(seed)
    size = np.linalg.norm(errors, axis=1) / sigma
    gross, true = size > 10, CAMERAS[kind]
    network = network_of(document, errors)
    images, share = len(network.images), float(gross.mean())
    result = adjust_network(network, Options(outliers="reject"))
    said = None
    if disorder >= 0:
        texts = [remark.text for remark in result.warnings] if result else [result.reason]
        name = f"i{disorder}"
        said = any(
            "image" in text and name in text.replace(",", " ").replace(":", " ").split() for text in texts
        )
    if not result:
        return Case(images, kind, share, str(result.code.value), 0, 0, 0, 0, said)
    own = result.cameras["C"]
    off = np.abs(own.values - true) / own.sigma
    rejected = result.rejected | ~result.fit.usable.images[network.image_of]
    usable = result.fit.usable.observations
    v = result.fit.residuals[: 2 * len(size)].reshape(-1, 2) / sigma
    fair = (np.bincount(network.point_of[~gross], minlength=len(network.points)) >= 3)[network.point_of]
    used = usable & fair & ~gross & np.isfinite(v).all(axis=1)
    enough = used.sum() > 0.9 * (fair & ~gross).sum()
    right = bool((off < 6).all() and enough and np.median((v[used] ** 2).sum(axis=1)) < 4)
    of, good = gross & fair, (size < 4) & fair
    return Case(
        images, kind, share, "right" if right else "wrong", int((rejected & of).sum()), int(of.sum()),
        int((rejected & good).sum()), int(good.sum()), said,
    )  # fmt: skip


def main() -> None:
    """Draw, adjust, count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--each", action="store_true", help="print each network")
    add_options(parser)
    given = parser.parse_args()
    jobs = [1_000_000 * given.seed + k for k in range(given.count)]
    cases = []
    for job, case in zip(jobs, outcomes(executor_of(given), outcome, jobs), strict=True):
        cases.append(case)
        if given.each:
            print(job, *case, flush=True)
    for name in ("ordinary", "wide"):
        own = [case for case in cases if case.kind == name]
        kinds = [case.outcome for case in own]
        right = kinds.count("right")
        others = {kind: kinds.count(kind) for kind in sorted(set(kinds)) if kind != "right"}
        print(f"{name}: {right} of {len(own)} converged to the right minimum; {others}")
    for name, of in (("named", "gross"), ("false", "good")):
        some, every = (sum(getattr(case, key) for case in cases if case.gross) for key in (name, of))
        print(f"{name}: {some} of {every} ({100 * some / max(every, 1):.2f} %)")
    said = [case.image_said for case in cases if case.image_said is not None]
    print(f"images in disorder named: {sum(said)} of {len(said)}")


if __name__ == "__main__":
    main_of(__file__)
