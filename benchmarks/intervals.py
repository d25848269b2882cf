"""Whether intervals of a calibration hold where the points of an image have errors in common.

Run from the checkout: ``python benchmarks/intervals.py [--seeds 200] [--seed 1] [--images 6 10 20 40]
[--errors 0 1 5] [--kinds smooth focal paper] [--free] [--jobs 1]``. A camera (k1, k2, p1, p2) is adjusted
from images of a flat board, drawn with OpenCV, with noise of 0.03 px, and errors that the points of an image
have in common, of 0, 1 and 5 times the noise (root mean square over the points): ``smooth`` is a field over
the image, another in each image: a polynomial, a few cosines, or a Gaussian process; ``focal`` is a principal
distance of each image; ``paper``, which is not drawn unless asked for, shifts the points of the board.
Printed is how often intervals of 95 % contain the true principal distances, the
principal point, and the projections at the centre and in the corners, these after the rotation that fits best
over the image; the median of the sigmas over the formal ones, and their root mean square over that of
the errors.

``--halves [--pairs 200]`` compares two calibrations of the same camera from other images: how often
``reseau compare`` finds a p below 0.05 and 0.01.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from drawn_networks import USUAL, Lens, Scene, SetUp, Target, World, draw_scene, network
from figures import record
from parts import add_options, executor_of, main_of, outcomes
from scipy.stats import t as student

from reseau.bundle import Result, adjust_network
from reseau.bundle.diagnostics.fields import camera_mapping
from reseau.calibration import CameraMapping, FieldDifference, calibration_difference
from reseau.core.data import Array, ImagePoints, Rows
from reseau.core.failure import Failure

SIGMA, POOL = 0.03, 240
"""Noise (px), and poses of each board from which those of a network are taken."""
TRUE = Lens(
    1280, 960, 1003.0, 1004.0, 645.3, 473.8, {"k1": -0.11, "k2": 0.08, "p1": 4e-4, "p2": -3e-4}
)  # fmt: skip
BOARDS = ((9, 6, 30.0, True), (8, 11, 25.0, False), (11, 8, 25.0, True))
ACROSS, DOWN = 9, 7
CENTRE, CORNERS = [(3, 4)], [(0, 0), (0, 8), (6, 0), (6, 8)]
KINDS = ("smooth", "focal", "paper")
GROUPS = ("distance", "point", "centre", "corners")
ASKED_POOLED, ASKED_CELL = (0.94, 0.96), (0.91, 0.98)
ASKED_P05, ASKED_P01 = (0.03, 0.07), 0.02


@dataclass(frozen=True)
class Job:
    """A network, or a pair of them: images, size of the common errors, their kind, target, seed."""

    images: int
    error: float
    kind: str
    free: bool
    seed: int
    pair: bool = False


@dataclass(frozen=True, eq=False)
class Done:
    """What a network says.

    Parameters
    ----------
    job : Job
        The network.
    off, sigma, dof : ndarray (14,)
        Errors of fx, fy, cx, cy and of the projections (x and y) at the centre and in four corners, with
        their sigmas and degrees of freedom.
    formal : ndarray (4,)
        Formal sigmas of fx, fy, cx, cy.
    p : float
        Of a pair.
    reason : str
        Why an adjustment failed.
    seconds : float
        Processor time.
    """

    job: Job
    off: Array
    sigma: Array
    dof: Array
    formal: Array
    p: float = float("nan")
    reason: str = ""
    seconds: float = 0.0


# -- networks


@cache
def pool(board: int) -> Scene:
    """Images of a board from many poses."""
    columns, rows, pitch, whole = BOARDS[board]
    row, column = (a.ravel() for a in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    xy = pitch * np.column_stack([column, -row]).astype(float)
    ids = tuple(f"{r}-{c}" for r, c in zip(row, column, strict=True))
    target = Target(ids, xy, np.column_stack([row, column]), None, whole)
    setup = SetUp("pool", lambda _: TRUE, lambda _: target, (POOL, POOL), SIGMA, "opencv", USUAL, ())
    return draw_scene(setup, np.random.default_rng([20, board]), True)


def drawn(job: Job, rng: np.random.Generator) -> Iterator[tuple[Scene, dict[str, ImagePoints]]]:
    """Scenes with some of the poses of a board, and their image points with noise and common errors.

    The halves of a pair have the same board, other poses, and the same kind of smooth errors.
    """
    every = pool(int(rng.integers(len(BOARDS))))
    field = str(rng.choice(["polynomial", "cosines", "process"]))
    rows = rng.choice(POOL, job.images * (1 + job.pair), replace=False)
    for half in np.split(rows, 1 + job.pair):
        scene = part_of(every, half)
        if job.kind == "paper":
            scene = replace(scene, world=printed(scene, job.error * SIGMA, rng))
        exact = scene.exact()
        measured = {}
        errors = common(job, field, exact, rng)
        for name, xy, error, own in zip(scene.images, exact, errors, scene.seen, strict=True):
            cov = np.tile(SIGMA**2 * np.eye(2), (len(xy), 1, 1))
            noise = SIGMA * rng.normal(size=xy.shape)
            measured[name] = ImagePoints(tuple(scene.target.ids[k] for k in own), xy + error + noise, cov)
        yield scene, measured


def part_of(every: Scene, rows: Rows) -> Scene:
    """Some of the images of a scene."""
    world = replace(
        every.world, rotation=every.world.rotation[rows], shift=every.world.shift[rows],
        zoom=every.world.zoom[rows], centre=every.world.centre[rows], resized=every.world.resized[rows],
        speed=every.world.speed[rows],
    )  # fmt: skip
    count = np.arange(len(rows))
    return replace(
        every, world=world, camera_of=0 * count, exposure_of=count, seen=tuple(every.seen[i] for i in rows),
        noise=(),
    )  # fmt: skip


def printed(scene: Scene, size: float, rng: np.random.Generator) -> World:
    """The world with points of the target that displace image points by so much (px)."""
    off, world = rng.normal(size=scene.world.xyz.shape), scene.world
    step = 1e-3 * scene.target.diagonal
    moved = np.concatenate(scene.exact(replace(world, xyz=world.xyz + step * off)))
    each = np.sqrt(np.mean((moved - np.concatenate(scene.exact())) ** 2)) / step
    return replace(world, xyz=world.xyz + size / each * off)


def common(job: Job, field: str, exact: list[Array], rng: np.random.Generator) -> Iterator[Array]:
    """Errors that the points of each image have in common, px."""
    middle = np.array([TRUE.cx, TRUE.cy])
    spread = np.sqrt(np.mean((np.concatenate(exact) - middle) ** 2))
    for xy in exact:
        if not job.error or job.kind == "paper":
            yield np.zeros_like(xy)
        elif job.kind == "focal":
            yield job.error * SIGMA / spread * rng.normal() * (xy - middle)
        else:
            s = (xy - middle) / (TRUE.width / 2)
            found = smooth(field, s, rng)
            yield job.error * SIGMA / np.sqrt(np.mean(found**2)) * found


def smooth(field: str, s: Array, rng: np.random.Generator) -> Array:
    """A random field (n, 2) at places in half widths of the image from its middle."""
    x, y = s.T
    if field == "polynomial":
        terms = np.column_stack([x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
        return np.asarray(terms @ rng.normal(size=(7, 2)))
    if field == "cosines":
        waves = rng.uniform(-1.5, 1.5, (4, 2)) * np.pi
        return np.asarray(np.cos(s @ waves.T + rng.uniform(0, 2 * np.pi, 4)) @ rng.normal(size=(4, 2)))
    length = 2 * rng.uniform(0.3, 1.0)
    away = ((s[:, None] - s[None]) ** 2).sum(axis=2)
    cov = np.exp(-0.5 * away / length**2) + 1e-9 * np.eye(len(s))
    return np.asarray(np.linalg.cholesky(cov) @ rng.normal(size=(len(s), 2)))


# -- what calibrations say


def truth() -> CameraMapping:
    """The true camera, without any uncertainty."""
    from reseau.optics import PixelGrid
    from reseau.optics.cameras.registry import camera_model

    model = camera_model("opencv")
    values = [TRUE.values.get(name, 0.0) for name in model.names]
    mapping = model.mapping(np.array(values), PixelGrid(TRUE.width, TRUE.height, (1.0, 1.0)))
    none = np.zeros(0, dtype=np.intp)
    return CameraMapping(mapping, TRUE.width, TRUE.height, none, np.zeros((0, 0)))


def formal(result: Result) -> Array:
    """Covariance of the camera by the residuals as if all were independent."""
    _, columns, _ = result.camera_columns(0)
    cov: Array = result.fit.cofactors.reduced.block(columns, columns) * result.fit.variance
    return cov


def at_places(
    found: FieldDifference, places: list[tuple[int, int]], dof: Array
) -> tuple[Array, Array, Array]:
    """Differences of x and y at some places, their sigmas, and degrees of freedom."""
    row, column = np.array(places).T
    off, cov = found.difference[row, column], found.cov[row, column]
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    own = getattr(found, "dof", None)
    given = (
        np.full(off.shape, dof.min())
        if own is None
        else np.broadcast_to(own, found.difference.shape)[row, column]
    )
    return off.ravel(), sigma.ravel(), given.ravel()


def adjusted(job: Job, scene: Scene, measured: dict[str, ImagePoints]) -> Result | Failure:
    return adjust_network(network(scene, measured, scene.world, "opencv", USUAL, not job.free))


def done(job: Job) -> Done:
    """Adjust a network, or a pair, and compare it with the truth, or with each other."""
    key = [job.seed, job.images, int(1000 * job.error), KINDS.index(job.kind), int(job.pair)]
    rng, begun = np.random.default_rng(key), time.process_time()
    none, few = np.full(14, np.nan), np.full(4, np.nan)
    results = [adjusted(job, *each) for each in drawn(job, rng)]
    lenses = []
    for each in results:
        if isinstance(each, Failure):
            return Done(job, none, none, none, few, reason=each.reason)
        lenses.append(camera_mapping(each, 0))
    if job.pair:
        p = calibration_difference(lenses[0], lenses[1]).p
        return Done(job, none, none, none, few, p, seconds=time.process_time() - begun)
    result, lens = results[0].required(), lenses[0]
    estimate: Any = result.camera(0)
    rows = [estimate.parameters.index(name) for name in USUAL[:4]]
    given = getattr(estimate, "dof", None)
    dof = np.full(len(estimate.values), np.inf) if given is None else np.asarray(given, dtype=float)
    dof = np.broadcast_to(dof, (len(estimate.values),))
    off = estimate.values[rows] - [TRUE.values[name] for name in USUAL[:4]]
    field = calibration_difference(truth(), lens, ACROSS, DOWN)
    parts = [(off, np.sqrt(np.diag(estimate.covariance)[rows]), dof[rows])]
    parts += [at_places(field, places, dof) for places in (CENTRE, CORNERS)]
    offs, sigmas, dofs = (np.concatenate(column) for column in zip(*parts, strict=True))
    small = np.sqrt(np.diag(formal(result))[rows])
    return Done(job, offs, sigmas, dofs, small, seconds=time.process_time() - begun)


# -- tables


def rows_of(group: str) -> Rows:
    """Where a group is in the columns of :class:`Done`."""
    ends = {"distance": (0, 2), "point": (2, 4), "centre": (4, 6), "corners": (6, 14)}[group]
    return np.arange(*ends)


def inside(found: list[Done], rows: Rows) -> Array:
    """Whether intervals of 95 % contain the truth."""
    off, sigma, dof = (np.array([getattr(e, name)[rows] for e in found]) for name in ("off", "sigma", "dof"))
    return np.asarray(np.abs(off) <= student.ppf(0.975, dof) * sigma)


def jobs_of(options: argparse.Namespace) -> Iterator[Job]:
    """Cells of images, errors and kinds; without errors there is one kind."""
    images = [n for n in options.images if n in (10, 20)] if options.halves else options.images
    for n in images:
        for error in options.errors:
            for kind in options.kinds if error else options.kinds[:1]:
                for seed in range(options.pairs if options.halves else options.seeds):
                    yield Job(n, error, kind, options.free, 100000 * options.seed + seed, options.halves)


def cells(found: list[Done]) -> Iterator[tuple[str, list[Done]]]:
    """Networks by images, errors and kind."""
    seen = dict.fromkeys((e.job.images, e.job.error, e.job.kind) for e in found)
    for n, error, kind in seen:
        own = [e for e in found if (e.job.images, e.job.error, e.job.kind) == (n, error, kind)]
        yield f"{n:3} images, {error:g} × {kind if error else '     '}", own


def coverage(found: list[Done]) -> None:
    """Print the coverage of each cell, and sigmas beside the formal ones and the errors."""
    print("coverage of 95 % intervals, %; ! outside of 91 to 98. Sigma: median over the formal one, and over")
    print("the rms of the errors; median degrees of freedom")
    print(f"{'':24}" + "".join(f"{group:>11}" for group in GROUPS) + f"{'all':>8}"
          + "   fx: formal  errors    cx: formal  errors   corners: errors   dof")  # fmt: skip
    every: dict[str, list[Array]] = {group: [] for group in (*GROUPS, "all")}
    for name, all_ in cells(found):
        own = [e for e in all_ if not e.reason]
        if not own:
            print(f"{name:24}  none adjusted")
            continue
        line = f"{name:24}"
        for group in (*GROUPS, "all"):
            hit = inside(own, np.arange(14) if group == "all" else rows_of(group))
            every[group].append(hit.ravel())
            share = float(hit.mean())
            low, high = ASKED_CELL
            line += f"{100 * share:{7 if group == 'all' else 10}.1f}" + (" " if low <= share <= high else "!")
            record(f"coverage, {name}", group, 100 * share, "%")
        off, sigma = np.array([e.off for e in own]), np.array([e.sigma for e in own])
        small = np.array([e.formal for e in own])
        for k in (0, 2):
            ratio = np.median(sigma[:, k] / small[:, k])
            line += f"{ratio:14.2f}{np.sqrt((sigma[:, k] ** 2).mean() / (off[:, k] ** 2).mean()):8.2f}"
        corners = rows_of("corners")
        typical = np.sqrt((sigma[:, corners] ** 2).mean(axis=0) / (off[:, corners] ** 2).mean(axis=0))
        line += f"{np.median(typical):18.2f}"
        line += f"{np.median([e.dof[0] for e in own]):9.3g}"
        lost = len(all_) - len(own)
        print(line + (f"  {lost} failed" if lost else ""))
    print(f"{'pooled':24}", end="")
    for group in (*GROUPS, "all"):
        share = float(np.concatenate(every[group]).mean())
        low, high = ASKED_POOLED
        print(f"{100 * share:{7 if group == 'all' else 10}.1f}{' ' if low <= share <= high else '!'}", end="")
        record("coverage, pooled", group, 100 * share, "%")
    print("   asked 94 to 96")


def halves(found: list[Done]) -> None:
    """Print how often pairs differ significantly."""
    print("pairs of calibrations: p < 0.05 and p < 0.01, %; asked 3 to 7, and at most 2")
    for name, all_ in [*cells(found), ("pooled", found)]:
        p = np.array([e.p for e in all_ if not e.reason])
        if not len(p):
            print(f"{name:24}  none adjusted")
            continue
        some, few = float((p < 0.05).mean()), float((p < 0.01).mean())
        good = ASKED_P05[0] <= some <= ASKED_P05[1] and few <= ASKED_P01
        record(f"halves, {name}", "p < 0.05", 100 * some, "%")
        record(f"halves, {name}", "p < 0.01", 100 * few, "%")
        print(f"{name:24} {len(p):5} pairs {100 * some:8.1f} {100 * few:8.1f}{'' if good else '  !'}"
              f"   median p {np.median(p):.2g}")  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1, help="of the whole run")
    parser.add_argument("--images", nargs="*", type=int, default=[6, 10, 20, 40])
    parser.add_argument("--errors", nargs="*", type=float, default=[0.0, 1.0, 5.0])
    parser.add_argument("--kinds", nargs="*", default=list(KINDS[:2]), choices=KINDS)
    parser.add_argument("--free", action="store_true", help="points of the target are unknowns")
    parser.add_argument("--halves", action="store_true", help="compare pairs of calibrations")
    parser.add_argument("--pairs", type=int, default=200, help="pairs of each cell")
    add_options(parser, jobs=1)
    options = parser.parse_args()
    with executor_of(options) as executor:
        found = list(outcomes(executor, done, jobs_of(options), together=20))
    (halves if options.halves else coverage)(found)
    lost = [e for e in found if e.reason]
    print(
        f"{len(found)} networks, {sum(e.seconds for e in found):.0f} s of processor time, {len(lost)} failed"
    )
    for e in lost[:10]:
        print(f"  {e.job}: {e.reason}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
