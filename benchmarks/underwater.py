"""The underwater project of Meid (1992, section 4): residuals and object points by three measurements.

Run from the checkout: ``python benchmarks/underwater.py [--strength NAME] [--seeds N] [--keep FOLDER]``;
needs batoid. Three photographs of 28 targets on a frame, behind a plane window of 25 mm, are drawn with rays
that share nothing with the project (``benchmarks/worlds/underwater.py``; lens, window and focus are fixed
there). The network is adjusted with centres of gravity, with ellipses through the edges, and with the
procedure of ``reseau blurred``; six targets are control points, the camera has two focal lengths and four
radial coefficients (three leave 0.0025 px of this lens), and the window is known.

For each strength of the blur: rms of the residuals outside the sharp centre of the middle photograph (pixels,
with its interval of 95 %, and µm), the rms that the standard deviations of the coordinates and the redundancy
numbers predict, rms of the errors of the object points that are not control and of their means over all seeds
(mm), the mean shift of the coordinates, errors over sigmas of the object points with their interval, the
standard deviations of the coordinates (pixels; those by rays attain the Cramér–Rao bound,
``benchmarks/blurred.py``), grey-value residuals over noise (misfit) and the number of image points left out,
and all of it for sharp photographs with the same noise. With `--assumed`: the same with a wrong design of the
lens. With `--keep`, the figures of each seed are kept in a file, and those there are not computed again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from parts import add_options, executor_of, main_of, outcomes
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

from reseau.bundle import Camera, Network, Result, adjust_network
from reseau.core.data import Frame
from reseau.io.targets import SpaceTargets, TargetColumns
from reseau.measure.blurred import BlurredOptions
from reseau.measure.ordinary import ordinary_coordinates
from reseau.optics.lenses import AIR, Paraxial, Prescription, ThinLens, glass, in_order
from reseau.optics.lenses.ray_maps import LensCamera, SensorPlane
from reseau.optics.poses import matrix_to_vector
from reseau.optics.refraction import Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex
from reseau.procedures.blurred import thin_lens_of
from reseau.procedures.blurred_network import BlurredNetwork, NetworkOptions, measure_blurred_network

CENTRE_PX = 350.0
"""Radius of the sharp part of a photograph."""
CONTROL = 6
SIGMA_PX = 0.05
"""Of ordinary coordinates."""
FREE = ("fx", "fy", "k1", "k2", "k3", "k4")
SIGMA_RADIAL = 2.0
"""Of the radial coefficients about 0: those of the numerator and the denominator are hardly separable."""


@dataclass(frozen=True)
class Figures:
    """What one way of measuring gives for one project.

    Residuals outside the sharp centre and what their sigmas predict, errors of the object points that are not
    control, mean shift of the coordinates, errors over sigmas, sigmas of the coordinates; grey-value
    residuals of the targets over the noise of the worst photograph, and the image points left out.
    """

    residuals_px: float
    predicted_px: float
    errors_mm: list[list[float]]
    shift_px: float
    over_sigma: float
    sigma_px: float
    misfit: float = float("nan")
    left_out: int = 0


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


def network_of(drawn: Project, camera: LensCamera | ThinLens) -> Network:
    """The network with coordinates rounded to pixels, which any measurement replaces."""
    images, m, p = tuple(drawn.images), len(drawn.images), len(drawn.points)
    image_of, point_of = np.repeat(np.arange(m), p), np.tile(np.arange(p), m)
    near = camera.corresponding(np.array([[0.0, 0.0, 1e5], [1e3, 0.0, 1e5]]))
    f = float(near[1, 0] - near[0, 0]) * 100.0
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
            Camera("cam", *SIZE, (PITCH, PITCH), "opencv", np.array([f, f, *PRINCIPAL, *8 * [0.0]]), FREE,
                   sigma=dict.fromkeys(FREE[2:], SIGMA_RADIAL)),
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


def measured(
    drawn: Project, camera: LensCamera | ThinLens, initial: str, known: LensCamera | None = None
) -> BlurredNetwork:
    """The procedure, begun with ordinary coordinates of a kind."""
    frames = {name: Frame(pixels, 255.0, name) for name, pixels in drawn.images.items()}
    options = NetworkOptions(BlurredOptions(psf_px=PSF, search_px=8.0), initial=initial)  # type: ignore[arg-type]
    network = network_of(drawn, known if isinstance(camera, ThinLens) and known is not None else camera)
    found = measure_blurred_network(network, frames, targets_of(drawn), camera, options)
    assert isinstance(found, BlurredNetwork), str(found)
    return found


def ordinary(drawn: Project, camera: LensCamera, method: str) -> Result:
    """The network adjusted with ordinary coordinates of a kind alone."""
    network = network_of(drawn, camera)
    xy = network.xy.copy()
    for i, (name, pixels) in enumerate(drawn.images.items()):
        rows = network.image_of == i
        frame = Frame(pixels, 255.0, name)
        found = ordinary_coordinates(frame, xy[rows], polarity="dark", method=method)  # type: ignore[arg-type]
        xy[rows] = np.where(np.isfinite(found), found, xy[rows])
    result = adjust_network(replace(network, xy=xy))
    assert isinstance(result, Result), str(result)
    return result


def figures(drawn: Project, result: Result, shift_px: float = 0.0) -> Figures:
    """Residuals and errors of an adjustment."""
    network = result.network
    outside = np.hypot(*(network.xy - PRINCIPAL).T) > CENTRE_PX
    rows = outside & (network.image_of == list(drawn.images).index("middle"))
    free = np.array([role == "tie" for role in network.role])
    off = result.points.xyz[free] - drawn.xyz[free]
    known = np.isfinite(off).all(axis=1)
    inverse = np.linalg.inv(result.points.cov[free][known])
    over = np.einsum("pi,pij,pj->p", off[known], inverse, off[known]).mean() / 3
    variances = np.einsum("nii->ni", network.cov)
    return Figures(
        float(np.sqrt(np.nanmean(result.residuals[rows] ** 2))),
        float(np.sqrt(np.nanmean((result.redundancy_numbers * variances)[rows]))),
        off.tolist(),
        shift_px,
        float(np.sqrt(over)),
        float(np.sqrt(variances[rows].mean())),
    )


def by_rays(drawn: Project, camera: LensCamera | ThinLens, known: LensCamera | None = None) -> Figures:
    """Figures of the procedure."""
    found = measured(drawn, camera, "centroid", known)
    chosen = found.rounds[found.chosen]
    return replace(
        figures(drawn, found.result, chosen.shift_px),
        misfit=max(photograph.misfit for photograph in chosen.measured.values()),
        left_out=int(chosen.declined.sum()),
    )


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


def blurred_figures(strength: str, seed: int) -> dict[str, Figures]:
    """Figures of one seed by the way of measuring."""
    drawn, camera = project(strength, seed), camera_of(strength)
    return {
        "ellipses through edges": figures(drawn, ordinary(drawn, camera, "edge")),
        "centres of gravity": figures(drawn, ordinary(drawn, camera, "centroid")),
        "by rays (reseau blurred)": by_rays(drawn, camera),
    }


def stand_in(strength: str, drawn: Project) -> ThinLens:
    """A thin lens with the principal distance of the camera, the focus and the aperture of the true lens."""
    camera = camera_of(strength)
    true, lens = Paraxial(camera.lens), camera.lens
    f = abs(true.focal_length)
    defocus = float(lens.surfaces[-1].vertex[2] - lens.surfaces[-2].vertex[2]) - true.back_focus
    f_number = f / (2 * (lens.stop_radius or 1.0) * abs(true.entrance_pupil[1]))
    return thin_lens_of(network_of(drawn, camera).cameras[0], distance=f + f**2 / defocus, f_number=f_number)


def assumed_figures(strength: str, seed: int) -> dict[str, Figures]:
    """Figures of one seed with wrong designs of the lens."""
    drawn = project(strength, seed)
    designs = {text: by_rays(drawn, camera_of(strength, change)) for text, change in ASSUMED.items()}
    return designs | {"thin lens (no design)": by_rays(drawn, stand_in(strength, drawn), camera_of(strength))}


def sharp_figures(strength: str, seed: int) -> dict[str, Figures]:
    """The same network and noise, imaged by principal rays alone."""
    camera = camera_of(
        strength,
        lambda lens: replace(
            lens, stop_radius=0.2, wavelengths_nm=(WAVELENGTHS[1],), weights=(1.0,), reference=0
        ),
    )
    return {"sharp photographs": by_rays(project(strength, seed, sharp=True), camera)}


def kept(path: Path | None, compute: Callable[[], dict[str, Figures]]) -> dict[str, Figures]:
    """Figures, read from a file if it is there, or computed and written to it."""
    if path is None:
        return compute()
    if not path.exists():
        found = {text: asdict(row) for text, row in compute().items()}
        part = path.with_suffix(".part")
        part.write_text(json.dumps(found))
        part.replace(path)
    return {text: Figures(**row) for text, row in json.loads(path.read_text()).items()}


Job = tuple[str, int, Callable[[], dict[str, Figures]]]
"""Name of a file, seed, and what computes its figures."""


def timed(folder: Path | None, job: Job) -> tuple[dict[str, Figures], float]:
    """Figures of a seed, and the processor time that they took."""
    name, seed, compute = job
    begin = time.process_time()
    found = kept(None if folder is None else folder / f"{name}-{seed:03d}.json", compute)
    return found, time.process_time() - begin


def _rms(values: Array) -> tuple[float, float]:
    """Root mean square of values of all seeds, and half of its interval of 95 %."""
    square = values**2
    rms = float(np.sqrt(square.mean()))
    error = float(square.std(ddof=1)) / np.sqrt(len(square)) if len(square) > 1 else np.nan
    return rms, 1.96 * error / (2 * rms) if rms > 0 else 0.0


def _row(text: str, rows: list[Figures]) -> str:
    def column(name: str) -> Array:
        return np.array([getattr(row, name) for row in rows])

    errors = column("errors_mm").astype(float)
    errors = errors[:, np.isfinite(errors).any(axis=(0, 2))]  # points that no seed determined
    bias = np.nanmean(errors, axis=0)
    residuals, over = _rms(column("residuals_px")), _rms(column("over_sigma"))
    off = _rms(np.sqrt(np.nanmean(errors**2, axis=(1, 2))))
    return (
        f"  {text:<26}{residuals[0]:>8.4f} ± {residuals[1]:.4f}{1e3 * PITCH * residuals[0]:>6.2f}"
        f"{_rms(column('predicted_px'))[0]:>10.4f}{off[0]:>8.4f} ± {off[1]:.4f}"
        f"{np.sqrt(np.nanmean(bias**2)):>8.4f}{_rms(column('shift_px'))[0]:>8.3f}"
        f"{over[0]:>7.2f} ± {over[1]:.2f}{_rms(column('sigma_px'))[0]:>9.4f}"
        f"{_rms(column('misfit'))[0]:>8.2f}{column('left_out').mean():>10.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--strength", choices=tuple(STRENGTHS))
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--assumed", action="store_true", help="with wrong designs of the lens as well")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the figures of each seed here")
    parser.add_argument("--report", type=Path, help="report of the first seed to write, HTML")
    add_options(parser)
    chosen = parser.parse_args()
    if chosen.keep is not None:
        chosen.keep.mkdir(parents=True, exist_ok=True)
    strengths = [chosen.strength] if chosen.strength else list(STRENGTHS)
    if chosen.report is not None:
        from reseau.report.blurred_network import blurred_network_report

        found = measured(project(strengths[0], 0), camera_of(strengths[0]), "centroid")
        chosen.report.write_text(blurred_network_report(found, title=f"underwater, {strengths[0]}"))
    print(
        f"{'':<28}{'residuals, px':>17}{'µm':>6}{'predicted':>10}{'mm rms':>17}{'bias':>8}{'shift':>8}"
        f"{'e/σ':>14}{'σ, px':>9}{'misfit':>8}{'left out':>10}"
    )
    # Seed by seed, so that what is kept after a stop is of all strengths.
    rows: dict[str, dict[str, list[Figures]]] = {name: {} for name in ("sharp", *strengths)}
    jobs, spent = list[Job](), 0.0
    for seed in range(chosen.seeds):
        # Nothing of a sharp photograph but the place of the sensor depends on the strength.
        jobs.append(("sharp", seed, partial(sharp_figures, "medium", seed)))
        for strength in strengths:
            jobs.append((strength, seed, partial(blurred_figures, strength, seed)))
            if chosen.assumed:
                jobs.append((f"{strength}-assumed", seed, partial(assumed_figures, strength, seed)))
    with executor_of(chosen) as executor:
        done = outcomes(executor, partial(timed, chosen.keep), jobs)
        for (name, _, _), (found, seconds) in zip(jobs, done, strict=True):
            spent += seconds
            for text, row in found.items():
                rows[name.removesuffix("-assumed")].setdefault(text, []).append(row)
    each = spent / chosen.seeds / len(strengths)
    for strength in strengths:
        blur: Array = np.concatenate(list(project(strength, 0).blur.values()))
        print(f"{strength}: blur to {blur.max():.1f} px; {chosen.seeds} seeds, {each:.1f} s each")
        for text, entries in (rows[strength] | rows["sharp"]).items():
            print(_row(text, entries))


if __name__ == "__main__":
    main_of(__file__)
