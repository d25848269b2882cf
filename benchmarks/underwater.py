"""The underwater project of Meid (1992, section 4): residuals and object points by three measurements.

Run from the checkout: ``python benchmarks/underwater.py [--strength NAME] [--seeds N]``; needs
batoid. Three photographs of 28 targets on a frame, behind a plane window of 25 mm, are drawn with rays that
share nothing with the project (``benchmarks/worlds/underwater.py``; lens, window and focus are fixed there).
The network is adjusted with centres of gravity, with ellipses through the edges, and with the procedure of
``reseau blurred``; six targets are control points, principal distance and radial distortion are free, and the
window is known.

For each strength of the blur: rms of the residuals outside the sharp centre of the middle photograph (pixels
and µm), rms and mean error of the object points that are not control (mm), the mean shift of the coordinates,
errors over sigmas of the object points, the standard deviations of the coordinates (pixels; those by rays
attain the Cramér–Rao bound, ``benchmarks/blurred.py``), and all of it for sharp photographs with the same
noise.
With `--assumed`: the same with a wrong design of the lens.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from worlds.blurred import ROWS, WAVELENGTHS, WEIGHTS, Array
from worlds.underwater import (
    LENS_SCALE,
    PITCH,
    PORT,
    PRINCIPAL,
    PSF,
    SIZE,
    STRENGTHS,
    Project,
    index,
    project,
)

from reseau.bundle import Camera, Network
from reseau.core.data import Frame
from reseau.io.targets import SpaceTargets, TargetColumns
from reseau.measure.blurred import BlurredOptions
from reseau.optics.lenses import AIR, LensCamera, Paraxial, Prescription, SensorPlane, glass, in_order
from reseau.optics.poses import matrix_to_vector
from reseau.optics.refraction import Refraction, RefractiveIndex, Window
from reseau.procedures.blurred_network import BlurredNetwork, NetworkOptions, measure_blurred_network

CENTRE_PX = 350.0
"""Radius of the sharp part of a photograph."""
CONTROL = 6
SIGMA_PX = 0.05
"""Of ordinary coordinates."""


@dataclass(frozen=True)
class Figures:
    """What one way of measuring gives for one project."""

    residuals_px: float
    points_mm: float
    mean_mm: float
    shift_px: float
    over_sigma: float
    sigma_px: float


def camera_of(strength: str, change: Callable[[Prescription], Prescription] | None = None) -> LensCamera:
    """The lens for the project, by its own tracer; `change` makes another one of it."""
    rows = [(c / LENS_SCALE, d * LENS_SCALE, glass(g) if g not in ("", "stop") else AIR) for c, d, g in ROWS]
    surfaces = list(in_order(rows))
    surfaces[5] = replace(surfaces[5], kind="plain")
    fixed = STRENGTHS[strength]
    surfaces[-1] = replace(surfaces[-1], vertex=np.array([0.0, 0.0, fixed.image_z]))
    lens = Prescription(
        tuple(surfaces), stop=5, stop_radius=fixed.stop_radius, wavelengths_nm=WAVELENGTHS, weights=WEIGHTS,
        reference=1,
    )  # fmt: skip
    return LensCamera(lens if change is None else change(lens), SensorPlane((PITCH, PITCH), PRINCIPAL))


def network_of(drawn: Project, camera: LensCamera) -> Network:
    """The network with coordinates rounded to pixels, which any measurement replaces."""
    images, m, p = tuple(drawn.images), len(drawn.images), len(drawn.points)
    image_of, point_of = np.repeat(np.arange(m), p), np.tile(np.arange(p), m)
    near = camera.corresponding(np.array([[0.0, 0.0, 1e5], [1e3, 0.0, 1e5]]))
    c = float(near[1, 0] - near[0, 0]) * PITCH * 100.0
    held = np.full((p, 3), np.nan)
    held[np.linspace(0, 19, CONTROL).astype(int)] = 0.0
    port = Window(
        "port", "plane", "camera", {"distance": PORT.distance, "thickness": PORT.thickness},
        ("air", "window", "water"),
    )  # fmt: skip
    media = (
        RefractiveIndex("air", 1.0),
        *(
            RefractiveIndex(name, index(name, WAVELENGTHS[1]), dispersion=lambda w, name=name: index(name, w))
            for name in ("window", "water")
        ),
    )
    true = np.concatenate([drawn.corresponding[name] for name in images])
    return Network(
        cameras=(
            Camera("cam", *SIZE, (PITCH, PITCH), "brown", np.array([c, *9 * [0.0]]), ("c", "K1", "K2", "K3"),
                   {"side": "object"}),
        ),
        images=images, camera_of=np.zeros(m, np.intp),
        x0=np.array([drawn.centres[name] for name in images]),
        rotation=matrix_to_vector(np.array([drawn.rotations[name] for name in images])),
        points=drawn.points, xyz=np.where(held == 0, drawn.xyz, np.nan), sigma=held,
        role=tuple("control" if row[0] == 0 else "tie" for row in held),
        image_of=image_of, point_of=point_of, xy=np.rint(true),
        cov=np.tile(np.eye(2) * SIGMA_PX**2, (m * p, 1, 1)),
        distance_of=np.zeros((0, 2), np.intp), distance=np.zeros((0, 2)), datum="control",
        datum_points=np.ones(p, dtype=bool), groups=(None,) * m, files=(None,) * m, unit="mm",
        refraction=Refraction(media, (port,), ((0,),), np.zeros(m, np.intp)),
    )  # fmt: skip


def targets_of(drawn: Project) -> SpaceTargets:
    """Shape, size and direction of the targets."""
    normals = tuple(tuple(float(v) for v in row) for row in drawn.normals)
    return SpaceTargets(
        unit="mm", polarity="dark",
        targets=TargetColumns(
            id=drawn.points, shape=("disk",) * len(drawn.points),
            size=tuple(float(2 * r) for r in drawn.radius), normal=normals,  # type: ignore[arg-type]
        ),
    )  # fmt: skip


def measured(drawn: Project, camera: LensCamera, initial: str) -> BlurredNetwork:
    """The procedure, begun with ordinary coordinates of a kind."""
    frames = {name: Frame(pixels, 255.0, name) for name, pixels in drawn.images.items()}
    options = NetworkOptions(BlurredOptions(psf_px=PSF, search_px=8.0), initial=initial)  # type: ignore[arg-type]
    found = measure_blurred_network(network_of(drawn, camera), frames, targets_of(drawn), camera, options)
    assert isinstance(found, BlurredNetwork), str(found)
    return found


def figures(drawn: Project, found: BlurredNetwork, number: int) -> Figures:
    """Residuals and errors of one round; 0 is that of the ordinary coordinates."""
    entry = found.rounds[number]
    network = entry.result.network
    outside = np.hypot(*(network.xy - PRINCIPAL).T) > CENTRE_PX
    middle = network.image_of == list(drawn.images).index("middle")
    free = np.array([role == "tie" for role in network.role])
    off = entry.result.points.xyz[free] - drawn.xyz[free]
    known = np.isfinite(off).all(axis=1)
    inverse = np.linalg.inv(entry.result.points.cov[free][known])
    over = np.einsum("pi,pij,pj->p", off[known], inverse, off[known]).mean() / 3
    return Figures(
        entry.rms_px(outside & middle),
        float(np.sqrt((off[known] ** 2).mean())),
        float(np.linalg.norm(off[known].mean(axis=0))),
        entry.shift_px,
        float(np.sqrt(over)),
        float(np.sqrt(np.einsum("nii->ni", network.cov[outside & middle]).mean())),
    )


def sharp_residuals(strength: str, seed: int) -> Figures:
    """The same network and noise, imaged by principal rays alone."""
    drawn = project(strength, seed, sharp=True)
    camera = camera_of(
        strength,
        lambda lens: replace(
            lens, stop_radius=0.2, wavelengths_nm=(WAVELENGTHS[1],), weights=(1.0,), reference=0
        ),
    )
    found = measured(drawn, camera, "centroid")
    return figures(drawn, found, found.chosen)


TRIPLET = (
    (22.01359, 3.25896, "N-SK16"), (-435.76044, 6.00755, ""), (-22.21328, 0.99998, "F2"),
    (20.29192, 4.75041, ""), (79.68360, 2.95208, "N-SK16"), (-18.39533, 0.0, ""),
)  # fmt: skip
"""Another lens, a Cooke triplet of 50 mm: radius, distance to the next surface, glass."""


def triplet(lens: Prescription) -> Prescription:
    """The triplet in place of the lens: of its focal length, f-number and defocus, as a user would set it."""
    true = Paraxial(lens)

    def scaled(scale: float, stop: float, behind: float) -> Prescription:
        rows = [(1 / (r * scale), d * scale, glass(g) if g else AIR) for r, d, g in TRIPLET]
        rows[-1] = (rows[-1][0], behind, AIR)
        return Prescription(
            in_order(rows), stop=3, stop_radius=stop, wavelengths_nm=WAVELENGTHS,
            weights=WEIGHTS, reference=1,
        )  # fmt: skip

    scale = true.focal_length / Paraxial(scaled(1.0, 1.0, 40.0)).focal_length
    first = Paraxial(scaled(scale, 1.0, 40.0 * scale))
    stop = (lens.stop_radius or 1.0) * true.entrance_pupil[1] / first.entrance_pupil[1]
    last = lens.surfaces[-2]
    behind = float(lens.surfaces[-1].vertex[2] - last.vertex[2]) - true.back_focus + first.back_focus
    return scaled(scale, stop, behind)


ASSUMED: dict[str, Callable[[Prescription], Prescription]] = {
    "the true design": lambda lens: lens,
    "focus off by 1 % of f": lambda lens: lens.moved((0.0, 0.0, 0.7)),
    "focus off by 0.1 % of f": lambda lens: lens.moved((0.0, 0.0, 0.07)),
    "N-SK2 instead of N-SSK2": lambda lens: replace(
        lens, surfaces=(replace(lens.surfaces[0], medium=glass("N-SK2")), *lens.surfaces[1:])
    ),
    "another lens (triplet)": triplet,
    "stop wider by 10 %": lambda lens: replace(lens, stop_radius=1.1 * (lens.stop_radius or 1.0)),
}


def _row(text: str, rows: list[Figures]) -> str:
    mean = {
        name: float(np.sqrt(np.mean([getattr(row, name) ** 2 for row in rows])))
        for name in ("residuals_px", "points_mm", "mean_mm", "shift_px", "over_sigma", "sigma_px")
    }
    spread = float(np.std([row.residuals_px for row in rows])) / max(1, len(rows)) ** 0.5
    return (
        f"  {text:<26}{mean['residuals_px']:>10.4f} ± {spread:.4f}{1e3 * PITCH * mean['residuals_px']:>8.2f}"
        f"{mean['points_mm']:>10.4f}{mean['mean_mm']:>9.4f}{mean['shift_px']:>9.3f}{mean['over_sigma']:>8.2f}"
        f"{mean['sigma_px']:>9.4f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--strength", choices=tuple(STRENGTHS))
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--assumed", action="store_true", help="with wrong designs of the lens as well")
    parser.add_argument("--report", type=Path, help="report of the first seed to write, HTML")
    chosen = parser.parse_args()
    print(
        f"{'':<28}{'residuals, px':>19}{'µm':>8}{'mm rms':>10}{'mm mean':>9}{'shift':>9}{'e/σ':>8}"
        f"{'σ, px':>9}"
    )
    for strength in [chosen.strength] if chosen.strength else STRENGTHS:
        rows: dict[str, list[Figures]] = {}
        begin = time.process_time()
        for seed in range(chosen.seeds):
            drawn = project(strength, seed)
            for initial in ("edge", "centroid"):
                found = measured(drawn, camera_of(strength), initial)
                rows.setdefault(initial, []).append(figures(drawn, found, 0))
            rows.setdefault("by rays (reseau blurred)", []).append(figures(drawn, found, found.chosen))
            rows.setdefault("sharp photographs", []).append(sharp_residuals(strength, seed))
            if chosen.assumed:
                for text, change in ASSUMED.items():
                    other = measured(drawn, camera_of(strength, change), "centroid")
                    rows.setdefault(text, []).append(figures(drawn, other, other.chosen))
            if seed == 0 and chosen.report is not None:
                from reseau.report.blurred_network import blurred_network_report

                chosen.report.write_text(blurred_network_report(found, title=f"underwater, {strength}"))
        blur: Array = np.concatenate(list(drawn.blur.values()))
        each = (time.process_time() - begin) / chosen.seeds
        print(f"{strength}: blur to {blur.max():.1f} px; {chosen.seeds} seeds, {each:.0f} s each")
        for text, entries in rows.items():
            print(_row(text, entries))


if __name__ == "__main__":
    main()
