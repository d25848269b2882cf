"""Rays a second through lenses, beside batoid and optiland, and how well the three agree ray by ray.

Run from the checkout: ``python benchmarks/raytrace.py [--rays N]``. The other programs are installed by
``pip install .[peers]``; missing ones are listed. Two lenses: a double Gauss of spheres, four of them with
a conic constant, and the whole LSST of batoid: three mirrors, three lenses and a filter, of whose surfaces
four are even aspheres. Each surface has a circular or annular aperture, and rays are vignetted. All
programs trace the same rays with two threads, in turn; of five times the median counts. The time includes
everything from rays in columns to points on the image and which rays arrived. Times of processors count,
too: other work on the machine disturbs them less.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "2"  # before batoid is imported

import numpy as np
from figures import record
from shared import of_the_tests

from reseau.core.data import Array
from reseau.optics.lenses import AIR, Aperture, Prescription, Tracer, in_order
from reseau.optics.lenses.media import Constant
from reseau.optics.lenses.trace import Rays

THREADS = 2
REPEATS = 5
WAVELENGTH = 500.0

Run = Callable[[], tuple[Array, Array]]
"""Traces the rays; points (n, 2) in mm, and whether rays arrived (n,)."""


def double_gauss() -> Prescription:
    """A double Gauss of f/3 with a focal length of 100 mm; four of its surfaces are conics."""
    rows = [
        (56.20238, 8.75, 1.6223),
        (152.28580, 0.5, 1.0),
        (37.68262, 12.5, 1.6074),
        (0.0, 3.8, 1.6034),
        (24.23130, 16.369445, 1.0),
        (0.0, 13.747957, 1.0),
        (-28.37731, 3.8, 1.6034),
        (0.0, 11.0, 1.6204),
        (-37.92546, 0.5, 1.0),
        (177.41176, 7.0, 1.6204),
        (-79.41143, 61.087267, 1.0),
    ]
    conics = {0: -0.2, 2: 0.1, 8: -0.1, 10: 0.3}
    media = [AIR if n == 1 else Constant(n) for _, _, n in rows]
    surfaces = in_order([(1 / r if r else 0.0, t, m) for (r, t, _), m in zip(rows, media, strict=True)])
    radii = [24.0, 23.0, 20.0, 18.0, 14.5, 12.0, 15.0, 17.0, 18.0, 20.0, 20.0, 60.0]
    surfaces = tuple(
        replace(surface, conic=conics.get(k, 0.0), apertures=(Aperture("circle", (radius, 0.0)),))
        for k, (surface, radius) in enumerate(zip(surfaces, radii, strict=True))
    )
    return Prescription(surfaces, stop=5, stop_radius=12.0, wavelengths_nm=(WAVELENGTH,), name="double Gauss")


def rays_into(lens: Prescription, radius: float, inner: float, count: int) -> Rays:
    """Parallel rays, somewhat oblique, that fill a circle or ring at the first surface."""
    rng = np.random.default_rng(1)
    r, angle = np.sqrt(rng.uniform(inner**2, radius**2, count)), rng.uniform(0, 2 * np.pi, count)
    towards = -1.0 if lens.surfaces[0].kind == "mirror" else 1.0
    direction = np.array([0.012, 0.007, towards])
    direction /= np.linalg.norm(direction)
    at = np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros(count)], axis=1)
    # Far in front of all surfaces: the light has to pass those that it meets later.
    reach = max(abs(surface.vertex[2]) for surface in lens.surfaces)
    return Rays(at - 1.5 * reach * direction, np.tile(direction, (count, 1)))


def ours(lens: Prescription, rays: Rays) -> Run:
    tracer = Tracer(lens, threads=THREADS)

    def run() -> tuple[Array, Array]:
        traced = tracer.trace(rays)
        return traced.xy, traced.arrived

    return run


def with_batoid(lens: Prescription, rays: Rays) -> Run:
    """The lens as separate interfaces of batoid; metres."""
    import batoid

    def surface_of(surface: Any) -> Any:
        if surface.curvature == 0:
            return batoid.Plane()
        radius = 1e-3 / surface.curvature
        if surface.coefficients:
            form = [a * 1e3 ** (2 * k + 3) for k, a in enumerate(surface.coefficients)]
            return batoid.Asphere(radius, surface.conic, form)
        return batoid.Quadric(radius, surface.conic) if surface.conic else batoid.Sphere(radius)

    def part_of(k: int) -> Any:
        surface = lens.surfaces[k]
        kind = {
            "mirror": batoid.Mirror,
            "refracting": batoid.RefractiveInterface,
            "plain": batoid.Detector if k == len(lens.surfaces) - 1 else batoid.Baffle,
        }[surface.kind]
        indices = lens.indices(WAVELENGTH)
        (aperture,) = surface.apertures or (None,)
        clear = None
        if aperture is not None:
            outer, inner = 1e-3 * aperture.size[0], 1e-3 * aperture.size[1]
            clear = batoid.ObscNegation(
                batoid.ObscAnnulus(inner, outer) if inner else batoid.ObscCircle(outer)
            )
        return kind(
            surface_of(surface),
            name=f"{k}",
            coordSys=batoid.CoordSys(origin=[0, 0, 1e-3 * surface.vertex[2]]),
            inMedium=batoid.ConstMedium(indices[k]),
            outMedium=batoid.ConstMedium(indices[k + 1]),
            obscuration=clear,
        )

    optic = batoid.CompoundOptic([part_of(k) for k in range(len(lens.surfaces))], name=lens.name)
    x, y, z = 1e-3 * rays.xyz.T
    start = batoid.RayVector(x, y, z, *rays.directions.T, wavelength=WAVELENGTH / 1e9)

    def run() -> tuple[Array, Array]:
        end = optic.trace(start.copy())
        return 1e3 * np.stack([end.x, end.y], axis=1), ~(end.vignetted | end.failed)

    return run


def with_optiland(lens: Prescription, rays: Rays) -> Run:
    """The lens in optiland with its NumPy backend, half of the rays in each of two threads."""
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic
    from optiland.physical_apertures import RadialAperture
    from optiland.rays import RealRays

    # Light travels along +z in optiland.
    sign = float(np.sign(rays.directions[0, 2]))
    indices = lens.indices(WAVELENGTH)

    def optic() -> Any:
        found = Optic()
        found.surfaces.add(index=0, radius=np.inf, z=-np.inf)
        for k, surface in enumerate(lens.surfaces, 1):
            given: dict[str, Any] = {
                "index": k,
                "z": sign * surface.vertex[2],
                "radius": sign / surface.curvature if surface.curvature else np.inf,
                "conic": surface.conic,
                "is_stop": k - 1 == lens.stop,
                "material": "mirror" if surface.kind == "mirror" else IdealMaterial(n=indices[k]),
            }
            if surface.coefficients:
                given["surface_type"] = "even_asphere"
                given["coefficients"] = [0.0, *(sign * a for a in surface.coefficients)]
            for aperture in surface.apertures:
                given["aperture"] = RadialAperture(r_max=aperture.size[0], r_min=aperture.size[1])
            found.surfaces.add(**given)
        found.wavelengths.add(value=WAVELENGTH / 1e3, is_primary=True)
        return found

    optics = [optic() for _ in range(THREADS)]
    parts = np.array_split(np.arange(len(rays)), THREADS)

    def part(k: int) -> tuple[Array, Array]:
        x, y, z = rays.xyz[parts[k]].T
        vx, vy, vz = rays.directions[parts[k]].T
        ones = np.ones(len(x))
        end = RealRays(x, y, sign * z, vx, vy, sign * vz, ones, WAVELENGTH / 1e3 * ones)
        optics[k].surfaces.trace(end)
        return np.stack([end.x, end.y], axis=1), np.asarray((end.i > 0) & np.isfinite(end.x))

    def run() -> tuple[Array, Array]:
        with ThreadPoolExecutor(THREADS) as pool:
            found = list(pool.map(part, range(THREADS)))
        return np.concatenate([xy for xy, _ in found]), np.concatenate([good for _, good in found])

    return run


def compare(lens: Prescription, rays: Rays) -> None:
    """Print rates and differences of all programs."""
    surfaces = len(lens.surfaces)
    runs: dict[str, Run] = {}
    for name, make in (("reseau", ours), ("batoid", with_batoid), ("optiland", with_optiland)):
        try:
            runs[name] = make(lens, rays)
        except ImportError:
            print(f"  {name}: not installed: pip install -e .[peers]")
    taken, worked = ({name: list[float]() for name in runs} for _ in range(2))
    found = {name: run() for name, run in runs.items()}
    for _ in range(REPEATS):
        for name, run in runs.items():
            start, busy = time.perf_counter(), time.process_time()
            run()
            taken[name].append(time.perf_counter() - start)
            worked[name].append(time.process_time() - busy)
    xy, arrived = found["reseau"]
    total = len(rays) * surfaces / 1e6
    print(f"{lens.name}: {surfaces} surfaces, {len(rays)} rays; {100 * arrived.mean():.1f} % arrive")
    print(
        "  million ray-surfaces a second, and a second of a processor (how much faster reseau is); "
        "largest difference, mm; rays that arrive otherwise"
    )
    for name in runs:
        both = arrived & found[name][1]
        away = np.hypot(*(found[name][0] - xy)[both].T).max()
        other = np.count_nonzero(arrived != found[name][1])
        rates = ""
        for of, unit in ((taken, "a second"), (worked, "a second of a processor")):
            rate = total / np.array(of[name])
            rates += f"{np.median(rate):>12.1f} ({np.median(of[name]) / np.median(of['reseau']):.1f} ×)"
            record(f"{lens.name}, million ray-surfaces {unit}", name, rate)
        record(f"{lens.name}, largest difference from reseau", name, away, "mm")
        print(f"  {name:<10}{rates}{away:>14.0e}{other:>10}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rays", type=int, default=500_000)
    count = parser.parse_args().rays
    gauss = double_gauss()
    compare(gauss, rays_into(gauss, 22.0, 0.0, count))
    try:
        import batoid
    except ImportError:
        print("LSST: batoid, which has its prescription, is not installed: pip install -e .[peers]")
        return
    path = Path(batoid.datadir) / "LSST" / "LSST_g_500.yaml"
    lsst = of_the_tests("optics/batoid_lenses.py").prescription(path, WAVELENGTH)
    compare(lsst, rays_into(lsst, 4300.0, 2500.0, count))


if __name__ == "__main__":
    main()
