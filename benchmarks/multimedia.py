"""Multi-media bundle: Monte Carlo through windows, real images of a cavity, errors that go unseen, speed.

Run from the checkout: ``python benchmarks/multimedia.py [--part NAME] [--seeds N]``.
Images are drawn by rays of their own (``benchmarks/worlds/water.py``); the cavity needs RESEAU_DATA.

- montecarlo: camera, windows, media, poses and points of three arrangements (a dome, a plane port, the wall
  of a tank): mean squares of the errors over their variances for every parameter, compared with χ² (99.9 %,
  divided by the number of parameters); pooled eᵀC⁻¹e over all unknowns and over points, as square roots. The
  interior orientation is observed as after a calibration in air, thickness and index of the glass with sigmas
  of 0.1 mm and 0.001; the other parameters are free, but for the index of the water behind the dome (0.001):
  the rays of a dome hardly depend on it.
- cavity: four cameras before a cavity with a fluid: stored calibration, fits of single cameras and joint
  ones, F-tests and correlations of free windows.
- unseen: what a wrong assumption does to the points, and whether the global test notices.
- speed: the time of an adjustment through windows over that of the same network in air.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.stats
from figures import record
from parts import add_options, executor_of, main_of, outcomes
from shared import of_the_tests
from worlds.water import Array, Scene, Surface, around

from reseau.adjust import Options
from reseau.bundle import Camera, Network, Result, adjust_network, problem_of
from reseau.bundle.solver.problem import BundleFit, BundleProblem
from reseau.core.threads import one_thread
from reseau.execution import Executor
from reseau.optics.poses import matrix_to_vector
from reseau.optics.refraction import Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex

FOCAL, CENTRE, K1, SIZE = 1200.0, (639.5, 511.5), -0.08, (1280, 1024)
SIGMA_PX = 0.05
GLASS, WATER = 1.52, 1.334
CALIBRATED = {"fx": 0.2, "fy": 0.2, "cx": 0.2, "cy": 0.2, "k1": 2e-4}
CONTROL = 8
LEVEL = 0.001


@dataclass(frozen=True)
class Arrangement:
    """A window as it is drawn, and as it is given to the adjustment; lengths in metres."""

    surfaces: tuple[Surface, ...]
    window: Window
    water_sigma: float | None = None


def _plane(distance: float, behind: float, *, on_camera: bool) -> Surface:
    if on_camera:
        return Surface((0.0, 0.0, distance), (0.0, 0.0, 1.0), 0.0, behind, True)
    return Surface((0.0, 0.0, -distance), (0.0, 0.0, -1.0), 0.0, behind, False)


ARRANGEMENTS = {
    "dome": Arrangement(
        tuple(
            Surface((0.002, -0.001, 0.004), (0.0, 0.0, 1.0), radius, index, True)
            for radius, index in ((0.08, GLASS), (0.088, WATER))
        ),
        Window(
            "dome", "sphere", "camera", {"X": 0.002, "Y": -0.001, "Z": 0.004, "radius": 0.08,
            "thickness": 0.008}, ("air", "glass", "water"), ("X", "Y", "Z", "radius", "thickness"),
            {"radius": 2e-4, "thickness": 1e-4},
        ),
        1e-3,
    ),
    "plane port": Arrangement(
        (_plane(0.04, GLASS, on_camera=True), _plane(0.05, WATER, on_camera=True)),
        Window(
            "port", "plane", "camera", {"distance": 0.04, "thickness": 0.01}, ("air", "glass", "water"),
            ("tilt_X", "tilt_Y", "distance", "thickness"), {"thickness": 1e-4},
        ),
    ),
    "tank wall": Arrangement(
        (_plane(-0.9, GLASS, on_camera=False), _plane(-0.88, WATER, on_camera=False)),
        Window(
            "wall", "plane", "object", {"distance": -0.9, "thickness": 0.02}, ("air", "glass", "water"),
            ("tilt_X", "tilt_Y", "distance", "thickness"), {"thickness": 1e-4}, direction=(0.0, 0.0, -1.0),
        ),
    ),
}  # fmt: skip


class World:
    """A network whose truth is known."""

    def __init__(self, kind: str | None, images: int = 10, points: int = 60) -> None:
        rotation, x0, xyz = around(images, points)
        self.arrangement = None if kind is None else ARRANGEMENTS[kind]
        surfaces = () if self.arrangement is None else self.arrangement.surfaces
        self.scene = Scene(rotation, x0, xyz, FOCAL, CENTRE, K1, SIZE, surfaces)
        self.image, self.point, self.xy = self.scene.pixels()

    def network(self, seed: int, *, calibrated: bool = True) -> Network:
        """The network observed with noise; poses and points other than control are to be found."""
        rng, scene = np.random.default_rng(1000 + seed), self.scene
        m, p, n = len(scene.x0), len(scene.xyz), len(self.xy)
        true = np.array([FOCAL, FOCAL, *CENTRE, K1, 0, 0, 0, 0, 0, 0, 0])
        values, sigma = true.copy(), dict[str, float]()
        if calibrated:
            sigma = dict(CALIBRATED)
            values[:5] += rng.normal(size=5) * list(sigma.values())
        camera = Camera("cam", *SIZE, (0.005, 0.005), "opencv", values, tuple(CALIBRATED), sigma=sigma)
        held = np.full((p, 3), np.nan)
        held[:CONTROL] = 0.0
        return Network(
            cameras=(camera,),
            images=tuple(f"i{k}" for k in range(m)),
            camera_of=np.zeros(m, np.intp),
            x0=np.full((m, 3), np.nan),
            rotation=np.full((m, 3), np.nan),
            points=tuple(f"p{k}" for k in range(p)),
            xyz=np.where(held == 0, scene.xyz, np.nan),
            sigma=held,
            role=tuple("control" if k < CONTROL else "tie" for k in range(p)),
            image_of=self.image,
            point_of=self.point,
            xy=self.xy + SIGMA_PX * rng.normal(size=(n, 2)),
            cov=np.tile(np.eye(2) * SIGMA_PX**2, (n, 1, 1)),
            distance_of=np.zeros((0, 2), np.intp),
            distance=np.zeros((0, 2)),
            datum="control",
            datum_points=np.ones(p, dtype=bool),
            groups=(None,) * m,
            files=(None,) * m,
            unit="m",
            refraction=self._refraction(rng),
        )

    def _refraction(self, rng: np.random.Generator) -> Refraction | None:
        if self.arrangement is None:
            return None
        window = self.arrangement.window
        observed = {n: window.values[n] + s * rng.normal() for n, s in window.sigma.items()}
        window, water = replace(window, values={**window.values, **observed}), self.arrangement.water_sigma
        media = (
            RefractiveIndex("air", 1.0),
            RefractiveIndex("glass", GLASS + 1e-3 * rng.normal(), free=True, sigma=1e-3),
            RefractiveIndex("water", WATER + (water or 0.0) * rng.normal(), free=True, sigma=water),
        )
        return Refraction(media, (window,), ((0,),), np.zeros(len(self.scene.x0), np.intp))

    def errors(self, fit: BundleFit) -> tuple[Array, Array]:
        """Errors of all reduced unknowns (u,) and of the points (p, 3)."""
        unknowns, scene = fit.unknowns, self.scene
        off = np.zeros(unknowns.size)
        true = np.array([FOCAL, FOCAL, *CENTRE, K1])
        at = unknowns.camera[0] + np.arange(5)
        off[at] = fit.values.cameras[0, unknowns.free[0, :5]] - true
        for i, first in enumerate(unknowns.pose):
            off[first : first + 3] = matrix_to_vector(fit.values.rotation[i] @ scene.rotation[i].T)
            off[first + 3 : first + 6] = fit.values.x0[i] - scene.x0[i]
        refraction = fit.problem.network.refraction
        if refraction is not None and self.arrangement is not None:
            exact = [self.arrangement.window.values.get(n, 0.0) for n in self.arrangement.window.names]
            whole = np.array([*exact, 1.0, GLASS, WATER])
            off[unknowns.refraction_columns] = (fit.values.refraction - whole)[unknowns.refracting]
        return off, fit.values.xyz - scene.xyz


class Errors(NamedTuple):
    """Squared errors over variances of the unknowns, of all of them jointly, and of the points."""

    squares: Array
    pooled: float
    points: float
    sigma0: float
    names: tuple[str, ...]


def drawn(world: World, seed: int) -> Errors | None:
    """Errors of one adjustment; None where it has no result."""
    problem, _ = problem_of(world.network(seed))
    fit = problem.adjusted(Options(scale="a-priori"))
    if not isinstance(fit, BundleFit):
        return None
    off, away = world.errors(fit)
    q = fit.cofactors.reduced.full
    size = np.sqrt(np.diag(q))
    pooled = off / size @ np.linalg.solve(q / np.outer(size, size), off / size) / len(off)
    own = np.linalg.inv(fit.cofactors.points[CONTROL:])
    points = np.mean(np.einsum("pi,pij,pj->p", away[CONTROL:], own, away[CONTROL:])) / 3
    return Errors(off**2 / np.diag(q), float(pooled), float(points), fit.sigma0, fit.unknowns.names)


def monte_carlo(executor: Executor, seeds: int) -> None:
    print("errors over standard deviations; every parameter against chi-squared, pooled over all unknowns\n")
    print(f"{'':<12}{'unknowns':>9}{'outside':>9}{'largest':>9}{'pooled':>8}{'points':>8}{'sigma0':>8}")
    for kind in ARRANGEMENTS:
        every = list(outcomes(executor, partial(drawn, World(kind)), range(seeds), together=4))
        done = [each for each in every if each is not None]
        count, failed, names = len(done), len(every) - len(done), done[0].names
        mean = np.mean([each.squares for each in done], axis=0)
        pooled, points, sigma0 = (np.mean([each[k] for each in done]) for k in (1, 2, 3))
        part = LEVEL / len(mean) / 2
        low, high = scipy.stats.chi2.ppf([part, 1 - part], count) / count
        outside = np.flatnonzero((mean < low) | (mean > high))
        print(
            f"{kind:<12}{len(mean):>9}{len(outside):>9}{np.sqrt(mean.max()):>9.3f}"
            f"{np.sqrt(pooled):>8.3f}{np.sqrt(points):>8.3f}{sigma0:>8.3f}"
            + (f"  {failed} of {seeds} not adjusted" if failed else "")
            + (f"  outside: {', '.join(names[k] for k in outside)}" if len(outside) else "")
        )


def cavity() -> None:
    folder = Path(os.environ.get("RESEAU_DATA", "")) / "multimedia_cavity"
    if not folder.is_dir():
        print("cavity: skipped, RESEAU_DATA has no multimedia_cavity")
        return
    tests = of_the_tests("bundle/cavity.py")
    network = tests.cavity(folder)
    off = tests.misfits(network)
    stored = [float(np.sqrt((off[network.image_of == k] ** 2).mean())) for k in range(4)]
    counts = np.bincount(network.image_of)
    print(f"detections {counts.tolist()}; stored calibration, rms px: {_list(stored)}")
    for k, value in enumerate(stored):
        record("rms with OpenPTV's stored calibration", f"camera {k + 1}", value, "px")
    for text, free in (
        ("exterior orientation", ()),
        ("and c, x0, y0", tests.INTERIOR),
        ("and K1, P1, P2, B1, B2", tests.INTERIOR + tests.ADDITIONAL),
    ):
        whole = tests.cavity(folder, free)
        single = [_fit(tests.of_camera(whole, k)) for k in range(4)]
        joint = _fit(whole)
        apart = max(
            float(np.abs(joint.residuals[: 2 * len(whole.xy)].reshape(-1, 2)[whole.image_of == k].ravel()
                         - single[k].residuals).max())
            for k in range(4)
        )  # fmt: skip
        for k, fit in enumerate(single):
            record(f"sigma0 with {text.removeprefix('and ')} free", f"camera {k + 1}", fit.sigma0, "px")
        record(f"sigma0 with {text.removeprefix('and ')} free", "jointly", joint.sigma0, "px")
        print(
            f"{text:<26} sigma0 {_list([fit.sigma0 for fit in single])}; joint {joint.sigma0:.4f} in "
            f"{joint.iterations} iterations, residuals equal to {apart:.1e} px"
        )
    for window in (("distance",), ("distance", "tilt_X", "tilt_Y")):
        whole = tests.cavity(folder, tests.INTERIOR, window)
        held, freed = _fit(tests.cavity(folder, tests.INTERIOR)), adjust_network(whole)
        if not isinstance(freed, Result):
            print(f"windows with free {', '.join(window)}: {freed}")
            continue
        more = 2 * len(window)
        f = (held.cost - freed.fit.cost) / more / freed.sigma0**2
        p = scipy.stats.f.sf(f, more, freed.redundancy)
        print(f"windows with free {', '.join(window)}: sigma0 {held.sigma0:.4f} -> {freed.sigma0:.4f}; "
              f"F({more}, {freed.redundancy}) = {f:.1f}, p = {p:.1g}")  # fmt: skip
        assert freed.refraction is not None
        for name, value, s, (partner, r) in zip(
            freed.refraction.parameters, freed.refraction.values, freed.refraction.sigma,
            freed.refraction.partners, strict=True,
        ):  # fmt: skip
            print(f"  {name:<20} {value:9.4f} ± {s:.2g}; {r:+.3f} with {partner}")
        for k in range(4):
            alone = problem_of(tests.of_camera(whole, k))[0].adjusted()
            text = f"sigma0 {alone.sigma0:.4f}" if isinstance(alone, BundleFit) else str(alone)
            print(f"  cam{k + 1} with a window of its own: {text}")


def _list(values: list[float]) -> str:
    return " ".join(f"{value:.4f}" for value in values)


def _fit(network: Network) -> BundleFit:
    fit = problem_of(network)[0].adjusted()
    assert isinstance(fit, BundleFit), str(fit)
    return fit


def unseen() -> None:
    print("what a wrong assumption does; all else of the window held, mean of five adjustments\n")
    heads = f"{'points, mm rms':>15}{'sigma0':>8}{'global test notices':>21}{'largest w':>11}"
    print(f"{'':<12}{'assumption':<26}{heads}")
    for kind, arrangement in ARRANGEMENTS.items():
        window, world = arrangement.window, World(kind)
        shift = "X" if kind == "dome" else "distance"
        cases = {
            "right": {},
            "refraction ignored": None,
            "index of water + 0.001": {"index of water": 1e-3},
            "thickness + 1 mm": {f"thickness of {window.name}": 1e-3},
            f"{shift} + 2 mm": {f"{shift} of {window.name}": 2e-3},
        }
        for text, wrong in cases.items():
            rows = [_assumed(world, seed, wrong) for seed in range(5)]
            rms, sigma0, noticed, largest = np.mean([row for row in rows if row is not None], axis=0)
            print(f"{kind:<12}{text:<26}{rms:>15.3f}{sigma0:>8.2f}{noticed:>20.0%} {largest:>11.1f}")


def _assumed(world: World, seed: int, wrong: dict[str, float] | None) -> tuple[float, ...] | None:
    """Error of the points, sigma0, whether the global test finds it too large, and the largest test value."""
    network, arrangement = world.network(seed), world.arrangement
    assert arrangement is not None
    assert network.refraction is not None
    refraction, window = network.refraction, arrangement.window
    true = {f"{n} of {window.name}": window.values.get(n, 0.0) for n in window.names}
    true |= {"index of air": 1.0, "index of glass": GLASS, "index of water": WATER}
    values = [true[name] + (wrong or {}).get(name, 0.0) for name in refraction.names]
    assumed = None if wrong is None else refraction.held(refraction.names).with_values(values)
    result = adjust_network(replace(network, refraction=assumed))
    if not isinstance(result, Result):
        return None
    off, test = result.points.xyz[CONTROL:] - world.scene.xyz[CONTROL:], result.global_test()
    noticed = test is not None and test.statistic > test.upper
    return (
        1e3 * float(np.sqrt(np.nanmean(off**2))),
        result.sigma0,
        noticed,
        float(np.nanmax(result.test_values)),
    )


def speed() -> None:
    problems: dict[str, BundleProblem] = {}
    for kind in (None, *ARRANGEMENTS):
        network = World(kind, images=40, points=600).network(0)
        if network.refraction is not None:
            known = network.refraction.held(network.refraction.names)
            problems[f"{kind}, known"] = problem_of(replace(network, refraction=known))[0]
        problems["air" if kind is None else f"{kind}, free"] = problem_of(network)[0]
    spent: dict[str, list[tuple[float, int]]] = {}
    for again in range(6):
        for kind, problem in problems.items():
            with one_thread():
                begin = time.process_time()
                fit = problem.adjusted()
                passed = time.process_time() - begin
            if again:
                # The first run compiles.
                spent.setdefault(kind, []).append((passed, fit.iterations))
    air = min(spent["air"])
    print(f"{len(problems['air'].network.xy)} image points, processor time\n")
    print(f"{'':<20}{'iterations':>11}{'whole, s':>10}{'x air':>7}{'per iteration, x air':>22}")
    for kind, found in spent.items():
        whole, steps = min(found)
        each = whole / steps / (air[0] / air[1])
        print(f"{kind:<20}{steps:>11}{whole:>10.3f}{whole / air[0]:>7.2f}{each:>22.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=("montecarlo", "cavity", "unseen", "speed"))
    parser.add_argument("--seeds", type=int, default=200)
    add_options(parser)
    chosen = parser.parse_args()

    def drawn_often() -> None:
        with executor_of(chosen) as executor:
            monte_carlo(executor, chosen.seeds)

    parts: dict[str, Callable[[], None]] = {
        "montecarlo": drawn_often,
        "cavity": cavity,
        "unseen": unseen,
        "speed": speed,
    }
    for name, run in parts.items():
        if chosen.part in (None, name):
            print(f"\n== {name}")
            run()


if __name__ == "__main__":
    main_of(__file__)
