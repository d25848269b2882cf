"""Bundle adjustment compared with Ceres, COLMAP and SciPy: time, statistics, growth, coverage of covariances.

Run from the checkout: ``python benchmarks/bundle.py [--part peers|statistics|growth|cover]``. Networks are
read from $RESEAU_DATA/networks. Ceres needs g++ and libceres-dev (Debian), COLMAP needs pycolmap (PyPI);
without them only our times are printed. All use two threads and stop when the relative change of the sum of
squares is below 1e-6 (ours: corrections below 1e-6 standard deviations). Times are those of all processors
together, medians of rounds in which the programs take turns: what else runs hardly changes them. Import,
compilation and reading of files are not included. SciPy adjusts ladybug-49 once, with at most 200
evaluations.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from figures import record
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from shared import of_the_tests
from worlds import lenses

from reseau.bundle import Camera, Network, problem_of
from reseau.bundle.solver.posterior import cofactors_of
from reseau.bundle.solver.problem import BundleFit, BundleProblem
from reseau.core.threads import one_thread
from reseau.exchange.bal import read_bal
from reseau.io.network import Network1
from reseau.optics.cameras.projections import Fisheye
from reseau.optics.poses import rotation_matrix

DATA = (
    Path(os.environ.get("RESEAU_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")) / "networks"
)
SOURCE, COLMAP = (Path(__file__).parent / "ceres" / name for name in ("bundle.cc", "colmap.py"))
# Target of ½Σr²: that of Ceres for ladybug, the published 185.94²/2 for roma.
LADYBUG, ROMA = 1.334433e4, 0.5 * 185.940**2
REPEATS = 7


def compiled_peer(folder: Path) -> Path | None:
    if shutil.which("g++") is None or not Path("/usr/include/ceres/ceres.h").exists():
        print("no g++ or no libceres-dev: no comparison with Ceres")
        return None
    program = folder / "bundle"
    command = [
        "g++",
        "-O3",
        "-march=native",
        "-DNDEBUG",
        "-I/usr/include/eigen3",
        str(SOURCE),
        "-o",
        str(program),
    ]
    subprocess.run([*command, "-lceres", "-lglog", "-lpthread"], check=True)
    return program


def peer(program: Path, kind: str, network: Path, target: float) -> tuple[float, float, float, int]:
    words = subprocess.run(
        [program, kind, network, repr(target)], check=True, capture_output=True, text=True
    ).stdout.split()
    return float(words[0]), float(words[1]), float(words[2]), int(words[3])


def colmap_command(kind: str, network: Path) -> list[str | Path]:
    """The command that adjusts a network by COLMAP; nothing where it is not installed."""
    installed = importlib.util.find_spec("pycolmap") is not None
    return [sys.executable, COLMAP, kind, network] if installed else []


def colmap(kind: str, network: Path) -> tuple[float, float, float, int] | None:
    """Only the total time is known."""
    command = colmap_command(kind, network)
    if not command:
        return None
    words = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return float("nan"), float(words[0]), float(words[1]), int(words[2])


def by_scipy(network: Path) -> tuple[float, float, float, int]:
    """Adjust a BAL file by `scipy.optimize.least_squares`, as its cookbook does: only the total is known.

    Derivatives are differences, of groups of parameters that share no observation; steps are those of LSMR.
    """
    words = np.fromfile(network, sep=" ")
    m, p, n = (int(v) for v in words[:3])
    seen, start = words[3 : 3 + 4 * n].reshape(n, 4), words[3 + 4 * n :]
    image, point, xy = seen[:, 0].astype(int), seen[:, 1].astype(int), seen[:, 2:]

    def residuals(x: np.ndarray) -> np.ndarray:
        cameras, xyz = x[: 9 * m].reshape(m, 9)[image], x[9 * m :].reshape(p, 3)[point]
        turned = np.einsum("nij,nj->ni", rotation_matrix(cameras[:, :3]), xyz) + cameras[:, 3:6]
        uv = -turned[:, :2] / turned[:, 2:]
        r2 = (uv**2).sum(axis=1)
        scale = cameras[:, 6] * (1 + r2 * (cameras[:, 7] + r2 * cameras[:, 8]))
        return np.asarray(scale[:, None] * uv - xy).ravel()

    columns = np.hstack([9 * image[:, None] + np.arange(9), 9 * m + 3 * point[:, None] + np.arange(3)])
    rows = np.repeat(np.arange(2 * n), columns.shape[1])
    pattern = coo_array(
        (np.ones(len(rows)), (rows, np.repeat(columns, 2, axis=0).ravel())), (2 * n, len(start))
    )
    begun = time.process_time()
    found = least_squares(
        residuals, start, jac_sparsity=pattern.tocsr(), x_scale="jac", ftol=1e-6, method="trf", max_nfev=200
    )
    return float("nan"), time.process_time() - begun, float(found.cost), int(found.nfev)


def ours(problem: BundleProblem, target: float) -> tuple[float, float, float, int]:
    """Processor seconds to the target, and of the adjustment without statistics, ½Σr², iterations."""
    seen: list[tuple[float, float]] = []
    begun = time.process_time()
    watched = replace(problem, watch=lambda _, cost: seen.append((time.process_time() - begun, 0.5 * cost)))
    watched.adjusted()
    reached = next((t for t, cost in seen if cost <= target), -1.0)
    return reached, seen[-1][0] if seen else 0.0, seen[-1][1], len(seen)


def roma_problem() -> BundleProblem:
    network = Network.from_document(Network1.read(DATA / "roma.network.json"))
    return problem_of(network)[0]


def write_shared(problem: BundleProblem, path: Path) -> None:
    """A network of one Brown camera for the Ceres program."""
    network, camera = problem.network, problem.network.cameras[0]
    pitch = camera.pitch_mm[0]
    photo = (network.xy - [(camera.width - 1) / 2, (camera.height - 1) / 2]) * [pitch, -pitch]
    with path.open("w") as file:
        file.write(f"{len(network.images)} {len(network.points)} {len(network.xy)}\n{pitch!r}\n")
        file.write(" ".join(repr(float(v)) for v in camera.values[:5]) + "\n")
        for i, j, (x, y) in zip(network.image_of, network.point_of, photo.tolist(), strict=True):
            file.write(f"{i} {j} {x!r} {y!r}\n")
        for row in np.hstack([network.rotation, network.x0]).tolist() + problem.start.xyz.tolist():
            file.write(" ".join(map(repr, row)) + "\n")


def fisheye_problem() -> BundleProblem:
    """Forty images by a fisheye of 80°, drawn by OpenCV, from rough approximate values of everything."""
    networks = of_the_tests("bundle/networks.py")
    lens, rng = lenses.fisheye(80), np.random.default_rng(5)
    m, p = 40, 4000
    xyz = rng.uniform([-2, -2, -0.8], [2, 2, 0.8], (p, 3))
    angle = np.linspace(0, 4 * np.pi, m, endpoint=False)
    x0 = np.stack([2.5 * np.cos(angle), 2.5 * np.sin(angle), 1.5 + 0.3 * np.sin(3 * angle)], axis=1)
    rotation = np.stack([networks.looking_at(x, np.zeros(3), 0.8 * k) for k, x in enumerate(x0)])
    image_of, point_of, seen = [], [], []
    for i in range(m):
        xy = lens.project((xyz - x0[i]) @ rotation[i].T)
        rows = np.flatnonzero(np.isfinite(xy).all(axis=1) & (rng.uniform(size=p) < 0.5))
        image_of.append(np.full(len(rows), i))
        point_of.append(rows)
        seen.append(xy[rows] + rng.normal(0, 0.2, (len(rows), 2)))
    f = 1.02 * float(lens.matrix[0, 0])
    values = np.array([f, f, 639.5, 479.5] + 8 * [0.0])
    camera = Camera("A", 1280, 960, (1.0, 1.0), "fisheye", values, Fisheye.names[:8])
    small = networks.world(cameras=(networks.camera(),)).network
    saw = np.concatenate(point_of)
    network = replace(
        small, cameras=(camera,), images=tuple(f"i{k}" for k in range(m)),
        camera_of=np.zeros(m, dtype=np.intp), x0=x0 + rng.normal(0, 0.02, x0.shape),
        rotation=networks.matrix_to_vector(rotation_matrix(rng.normal(0, 0.005, x0.shape)) @ rotation),
        points=tuple(f"p{k}" for k in range(p)), xyz=xyz + rng.normal(0, 0.02, xyz.shape),
        sigma=np.full((p, 3), np.nan), role=("tie",) * p, image_of=np.concatenate(image_of), point_of=saw,
        xy=np.concatenate(seen), cov=np.tile(np.eye(2) * 0.04, (len(saw), 1, 1)), datum="free",
        datum_points=np.ones(p, dtype=bool), groups=(None,) * m, files=(None,) * m,
    )  # fmt: skip
    found = problem_of(network)[0]
    # The same approximate values for all programs.
    return replace(found, start=replace(found.start, xyz=network.xyz), rounds=99)


def write_fisheye(problem: BundleProblem, path: Path) -> None:
    """A network of one fisheye for the Ceres program."""
    network, camera = problem.network, problem.network.cameras[0]
    sigma = float(np.sqrt(network.cov[0, 0, 0]))
    with path.open("w") as file:
        file.write(f"{len(network.images)} {len(network.points)} {len(network.xy)}\n{sigma!r}\n")
        file.write(" ".join(repr(float(v)) for v in camera.values[:8]) + "\n")
        for i, j, (x, y) in zip(network.image_of, network.point_of, network.xy.tolist(), strict=True):
            file.write(f"{i} {j} {x!r} {y!r}\n")
        for row in np.hstack([network.rotation, network.x0]).tolist() + problem.start.xyz.tolist():
            file.write(" ".join(map(repr, row)) + "\n")


def rig_problem() -> BundleProblem:
    """Three cameras fixed to each other, forty exposures of 42 points, from rough approximate values."""
    network, rng = of_the_tests("bundle/rigs.py").drawn(1, cameras=3, exposures=40), np.random.default_rng(3)
    network = replace(
        network, x0=network.x0 + rng.normal(0, 2.0, network.x0.shape),
        rotation=network.rotation + rng.normal(0, 0.005, network.rotation.shape),
        distance_of=network.distance_of[:0], distance=network.distance[:0],
    )  # fmt: skip
    found = problem_of(network)[0]
    xyz = network.xyz + rng.normal(0, 2.0, network.xyz.shape)
    return replace(found, start=replace(found.start, xyz=xyz), rounds=99)


def write_rig(problem: BundleProblem, path: Path) -> None:
    """A rig for the Ceres program."""
    network, start = problem.network, problem.start
    rig, places = network.rig, start.rig
    assert rig is not None
    assert places is not None
    camera = network.cameras[0]
    pitch, sigma = camera.pitch_mm[0], float(np.sqrt(network.cov[0, 0, 0]))
    photo = (network.xy - [(camera.width - 1) / 2, (camera.height - 1) / 2]) * [pitch, -pitch]
    first = [int(np.flatnonzero((rig.exposure == e) & (rig.camera == 0))[0]) for e in np.unique(rig.exposure)]
    vectors = of_the_tests("bundle/rigs.py").matrix_to_vector
    interior = [
        [row[c.names.index("c")], row[c.names.index("K1")]]
        for c, row in zip(network.cameras, start.cameras, strict=True)
    ]
    with path.open("w") as file:
        counts = (len(network.cameras), len(first), len(network.points), len(network.xy))
        file.write(f"{' '.join(map(str, counts))} {sigma * pitch!r}\n")
        for rows in (
            interior, np.hstack([vectors(places.rotation), places.base]).tolist(),
            np.hstack([vectors(start.rotation[first]), start.x0[first]]).tolist(), start.xyz.tolist(),
        ):  # fmt: skip
            file.writelines(" ".join(repr(float(v)) for v in row) + "\n" for row in rows)
        for i, j, (x, y) in zip(network.image_of, network.point_of, photo.tolist(), strict=True):
            file.write(f"{rig.camera[i]} {rig.exposure[i]} {j} {x!r} {y!r}\n")


def peers() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = compiled_peer(folder)
        # All observations are kept, those of points at infinity too.
        ladybug, roma = problem_of(read_bal(DATA / "bal-ladybug-49.txt"))[0], roma_problem()
        ladybug = replace(ladybug, max_iterations=60, rounds=99)
        write_shared(roma, folder / "roma.txt")
        wide = fisheye_problem()
        write_fisheye(wide, folder / "fisheye.txt")
        fixed = rig_problem()
        write_rig(fixed, folder / "rig.txt")
        best, least = wide.adjusted(), fixed.adjusted()
        assert isinstance(best, BundleFit)
        assert isinstance(least, BundleFit)
        cases = (
            ("ladybug-49", "bal", DATA / "bal-ladybug-49.txt", ladybug, LADYBUG),
            ("roma", "shared", folder / "roma.txt", roma, ROMA),
            ("fisheye", "fisheye", folder / "fisheye.txt", wide, 0.5 * best.cost * (1 + 1e-6)),
            ("rig", "rig", folder / "rig.txt", fixed, 0.5 * least.cost * (1 + 1e-6)),
        )
        for title, kind, file, problem, target in cases:
            ours(replace(problem, max_iterations=2), target)
            mine, theirs, others = [], [], []
            for _ in range(REPEATS):
                mine.append(ours(problem, target))
                if program is not None:
                    theirs.append(peer(program, kind, file, target))
                found = None if kind in ("fisheye", "rig") else colmap(kind, file)
                if found is not None:
                    others.append(found)
            print(f"{title}: to ½Σr² ≤ {target:.8g}")
            said(title, "reseau", mine)
            if theirs:
                said(title, "Ceres", theirs, [a[0] / b[0] for a, b in zip(mine, theirs, strict=True)])
            if title == "ladybug-49":
                said(title, "SciPy", [by_scipy(file)])
            if others:
                said(title, "COLMAP", others, [a[1] / b[1] for a, b in zip(mine, others, strict=True)])


def said(
    title: str, who: str, runs: list[tuple[float, float, float, int]], ratios: list[float] | None = None
) -> None:
    """Print and record the times of a program."""
    for what, column in (("to the same sum of squares", 0), ("in total", 1)):
        record(f"{title}, {what}", who, [run[column] for run in runs], "s")
    record(f"{title}, ½Σr² at the end", who, [run[2] for run in runs])
    reached, whole, cost, steps = np.median(np.array(runs), axis=0)
    to_it = "        –" if np.isnan(reached) else f"{reached:7.3f} s"
    ratio = "" if ratios is None else f"; reseau takes {np.median(ratios):.2f} of it"
    print(
        f"  {who:6s} {to_it} to the target, {whole:.3f} s in total, ½Σr² {cost:.6f}, {steps:.0f} steps{ratio}"
    )


def statistics() -> None:
    fit = roma_problem().adjusted()
    assert isinstance(fit, BundleFit)
    chosen = fit.datum
    spent, numbers = [], []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        with one_thread():
            found = cofactors_of(fit.linear, fit.freedom, chosen, fit.usable.points)
        spent.append(time.perf_counter() - begun)
        begun = time.perf_counter()
        r = fit.solution.standardise().redundancy_numbers
        numbers.append(time.perf_counter() - begun)
    print(f"roma: covariances of all {len(found.points)} points and image points {np.median(spent):.3f} s")
    print(f"      redundancy numbers and tests of {len(r)} coordinates from them {np.median(numbers):.3f} s")
    print(f"      their sum minus the redundancy {r.sum() - fit.redundancy:.1e}")


def strip(images: int, seed: int = 0) -> Network:
    """A strip block: images in strips of twenty, points seen by three to nine of them."""
    networks = of_the_tests("bundle/networks.py")
    rng = np.random.default_rng(seed)
    strips = max(2, round((images / 20) ** 0.5 * 1.5))
    along = images // strips
    camera = networks.camera(free=("c", "x0", "y0", "K1"))
    row, column = np.divmod(np.arange(strips * along), along)
    x0 = np.column_stack([1.0 * column, 1.6 * row, np.full(len(row), 4.0)])
    x0 += rng.normal(0, 0.05, x0.shape)
    rotation = rotation_matrix(rng.normal(0, 0.02, x0.shape)) @ np.diag([1.0, -1.0, -1.0])
    points = 60 * len(x0)
    xyz = rng.uniform([-1, -1, -0.3], [along, 1.6 * strips, 0.3], (points, 3))
    image_of, point_of, seen = [], [], []
    for i, where in enumerate(x0):
        near = np.flatnonzero((np.abs(xyz[:, :2] - where[:2]) < 2.2).all(axis=1))
        xy = networks.image_points(camera, rotation[i], where, xyz[near])
        inside = (xy > 0).all(axis=1) & (xy < [639, 479]).all(axis=1)
        image_of.append(np.full(int(inside.sum()), i))
        point_of.append(near[inside])
        seen.append(xy[inside])
    sees, saw = np.concatenate(image_of), np.concatenate(point_of)
    xy = np.concatenate(seen) + rng.normal(0, 0.1, (len(sees), 2))
    small = networks.world(cameras=(camera,)).network
    return replace(
        small, images=tuple(f"i{k}" for k in range(len(x0))),
        camera_of=np.zeros(len(x0), dtype=np.intp), x0=x0,
        rotation=networks.matrix_to_vector(rotation), points=tuple(f"p{k}" for k in range(points)),
        xyz=np.full((points, 3), np.nan), sigma=np.full((points, 3), np.nan), role=("tie",) * points,
        image_of=sees, point_of=saw, xy=xy, cov=np.tile(np.eye(2) * 0.01, (len(xy), 1, 1)), datum="free",
        datum_points=np.ones(points, dtype=bool), groups=(None,) * len(x0), files=(None,) * len(x0),
    )  # fmt: skip


def growth() -> None:
    first = None
    for images in (60, 600, 2000):
        network = strip(images)
        problem, _ = problem_of(network)
        begun, seen = time.perf_counter(), []
        watched = replace(problem, watch=lambda *_, seen=seen: seen.append(time.perf_counter()))
        fit = watched.adjusted()
        total, n = time.perf_counter() - begun, 2 * len(network.xy)
        assert isinstance(fit, BundleFit), fit
        adjusting = seen[-1] - begun
        per = 1e6 * adjusting / n
        first = first or per
        rays = network.rays[network.rays > 1]
        status = Path("/proc/self/status").read_text().splitlines()
        memory = max(int(line.split()[1]) for line in status if "VmHWM" in line) / 2**20
        off = fit.redundancy_numbers.sum() - fit.redundancy
        print(
            f"{len(network.images):5d} images, {n} coordinates, {rays.mean():.1f} rays: adjusted "
            f"{adjusting:.2f} s, {per:.1f} µs each ({per / first:.2f}), with all statistics {total:.1f} s, "
            f"{memory:.2f} GiB, Σr − r = {off:.1e}"
        )


def cover() -> None:
    """Normalised errors of 400 simulated networks: variances should be one."""
    networks = of_the_tests("bundle/networks.py")
    for datum in ("control", "free"):
        world = networks.world(datum=datum, control=5 if datum == "control" else 0)
        table = []
        for seed in range(400):
            fit = world.problem(world.noisy(seed)).adjusted()
            assert isinstance(fit, BundleFit)
            table.append(networks.normalised_errors(world, fit))
        for name in table[0]:
            squares = np.array([row[name] for row in table])
            mean, sigma = squares.mean(), squares.std() / 20
            print(f"{datum:8s} {name:8s} mean square of normalised errors {mean:.3f} ± {sigma:.3f}")


def main() -> int:
    parts = {"peers": peers, "statistics": statistics, "growth": growth, "cover": cover}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", choices=parts)
    chosen = parser.parse_args().part
    for name, part in parts.items():
        if chosen in (None, name):
            part()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
