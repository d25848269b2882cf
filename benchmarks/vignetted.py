"""Blurred targets where apertures cut the pupil: bias and errors over sigmas, by ring of the field.

Run from the checkout: ``python benchmarks/vignetted.py [--targets N] [--draws M] [--rays R] [--rings NAME]``;
needs nothing besides the project. Disks, dark on bright ground and bright on dark ground, are drawn by
counting rays from the sensor (``benchmarks/worlds/counted.py``, which shares nothing with the project)
through two lenses with the rims of their elements, in air and through a window into water; some 20 million
rays for each target. Each is measured without noise, for the bias, and with noise of 40 dB below the
contrast, even or of photons.

Reported by lens and ring of the field: the open part of the pupil, the blur, the mean error along the radius
(bias) with its standard deviation, and errors over sigmas.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import cv2
import numpy as np
from figures import ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes
from worlds.counted import DOUBLE_GAUSS, TRIPLET, WATER, Array, View, drawn

from reseau.core.data import Frame
from reseau.measure.blurred import BlurredOptions, measure_blurred
from reseau.optics.formation import mark_outline
from reseau.optics.lenses import AIR, Aperture, Medium, Prescription, PupilElements, glass, in_order
from reseau.optics.lenses.images import PlaneTarget
from reseau.optics.lenses.media import Sellmeier
from reseau.optics.lenses.ray_maps import LensCamera, SensorPlane

WAVELENGTHS, WEIGHTS, REFERENCE = (480.0, 546.07, 620.0), (0.3, 1.0, 0.5), 1
RINGS = {"centre": (0.0, 0.35), "middle": (0.35, 0.65), "rim": (0.65, 0.85), "corner": (0.85, 1.0)}
"""Distance from the axis in half diagonals."""
BRIGHT, DARK, DECIBELS = 200.0, 50.0, 40.0
PSF = 0.3
"""Expected width of the remaining blur, pixels; nothing but the pixel blurs besides the rays."""
DISTANCE = 60
"""Of the targets, in focal lengths."""


@dataclass(frozen=True)
class Case:
    """A lens with its sensor in a medium, and one target."""

    view: View
    ring: str
    seed: int


def views() -> list[View]:
    """The lenses in air and in water, with a blur of about 3 to 6 px (rms radius)."""
    found = []
    for design, pitch, defocus in ((DOUBLE_GAUSS, 0.005, 0.08), (TRIPLET, 0.012, 0.8)):
        for water in (None, 30.0):
            found.append(View(design, WAVELENGTHS, WEIGHTS, pitch, defocus, water))
    return found


def camera_of(view: View) -> LensCamera:
    """The same camera for the project; pixels are counted from the axis."""

    def medium(name: str) -> Medium:
        return Sellmeier(*WATER, "water") if name == "water" else glass(name) if name else AIR

    surfaces = list(in_order([(c, d, medium(m)) for c, d, m, _ in view.rows]))
    for k, (*_, rim) in enumerate(view.rows):
        apertures = (Aperture("circle", (rim, 0.0)),) if np.isfinite(rim) and k != view.stop else ()
        surfaces[k] = replace(
            surfaces[k], apertures=apertures, kind="plain" if k == view.stop else "refracting"
        )
    # The first vertex of the lens is the origin, behind a window or not.
    surfaces = [replace(s, vertex=np.array([0.0, 0.0, z])) for s, z in zip(surfaces, view.z, strict=True)]
    lens = Prescription(
        tuple(surfaces),
        stop=view.stop,
        stop_radius=view.rows[view.stop][3],
        wavelengths_nm=view.wavelengths,
        weights=view.weights,
        reference=REFERENCE,
        before=AIR if view.water is None else medium("water"),
    )
    return LensCamera(lens, SensorPlane((view.pitch,) * 2, (0.0, 0.0)), centre=np.zeros(3))


def of_case(draws: int, rays: int, case: Case) -> list[dict[str, object]]:
    """Rows of one target: dark and bright, without noise and with it."""
    view, rng = case.view, np.random.default_rng((case.seed, list(RINGS).index(case.ring)))
    design = view.design
    away = rng.uniform(*RINGS[case.ring]) * design.half_diagonal
    angle, distance = rng.uniform(0, 2 * np.pi), DISTANCE * design.focal_length
    bend = 1.0 if view.water is None else 0.75
    centre = np.array([*(bend * away / design.focal_length * np.array([np.cos(angle), np.sin(angle)])), 1.0])
    centre *= distance
    tilt = rng.uniform(0, np.deg2rad(25)) * np.array([np.cos(2 * angle), np.sin(2 * angle), 0.0])
    axes = cv2.Rodrigues(tilt)[0][:, :2]
    radius = rng.uniform(5, 11) * view.pitch / design.focal_length * distance * bend
    flip = np.array([1.0, -1.0, -1.0])  # from camera axes to those of the lens
    truth = view.principal_pixel(centre * flip, WAVELENGTHS[REFERENCE])
    camera = camera_of(view)
    plane = PlaneTarget(centre, axes, mark_outline("disk", 2 * radius, None, radius / 15))
    spots, light = camera.spots(centre[None], PupilElements.gauss(8))
    xy = spots[np.linalg.norm(light, axis=-1) > 0]
    half = (
        int(radius / distance / bend * design.focal_length / view.pitch + np.hypot(*(xy - truth).T).max()) + 7
    )
    columns, rows = np.rint(truth)[:, None] + np.arange(-half, half + 1)
    target, seen = drawn(view, centre * flip, flip[:, None] * axes, radius, columns, rows, rays, case.seed)
    placed = replace(camera, sensor=replace(camera.sensor, principal_px=(-columns[0], -rows[0])))
    at = truth - [columns[0], rows[0]]
    outward = truth / np.hypot(*truth)
    contrast = BRIGHT - DARK
    middle = seen[half, half]
    scenes = {
        "dark": (BRIGHT * seen - contrast * target) / middle,
        "bright": (DARK * seen / 5 + contrast * target) / middle,
    }
    sigma = contrast * 10 ** (-DECIBELS / 20)
    found = []
    for (polarity, image), noise in product(scenes.items(), ("none", "even", "photon")):
        variance = np.full(image.shape, sigma**2)
        if noise == "photon":
            # Mean variance in the window as before; 2.7 times as much noise in the light as in the dark.
            variance = 0.1 * image.max() + image
            variance *= sigma**2 / variance.mean()
        for draw in range(1 if noise == "none" else draws):
            random = np.random.default_rng((case.seed, draw, noise == "photon", polarity == "dark"))
            scale = 0.05 if noise == "none" else 1.0
            frame = Frame(image + scale * np.sqrt(variance) * random.normal(size=image.shape), 255.0)
            options = BlurredOptions(polarity, psf_px=PSF, psf_log_sigma=0.5)
            result = measure_blurred(frame, placed, ["1"], [plane], options)
            error = result.xy[0] - at
            covariance = result.cov[0] if result.ok[0] else np.full((2, 2), np.nan)
            open_part = float(np.mean(camera.open_part(centre[None], _RIM, WAVELENGTHS[REFERENCE])[1]))
            found.append({
                "lens": f"{design.name}, {'air' if view.water is None else 'water'}",
                "ring": case.ring, "noise": noise, "polarity": polarity, "measured": bool(result.ok[0]),
                "open": open_part, "blur": float(result.blur_px[0]), "radial": float(error @ outward),
                "ratio2": float(error @ np.linalg.solve(covariance, error)) / 2,
                "noted": bool(result.notes),
            })  # fmt: skip
    return found


_RIM = np.stack([np.cos(np.arange(180) * np.pi / 90), np.sin(np.arange(180) * np.pi / 90)], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--targets", type=int, default=4, help="in each ring, for each lens and medium")
    parser.add_argument("--draws", type=int, default=10, help="of each noise")
    parser.add_argument("--rays", type=int, default=4000, help="for each pixel and wavelength")
    parser.add_argument("--rings", nargs="+", choices=RINGS, default=list(RINGS), help="of the field")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    add_options(parser)
    chosen = parser.parse_args()
    seeds = range(chosen.first, chosen.first + chosen.targets)
    cases = [Case(view, ring, seed) for view, ring, seed in product(views(), chosen.rings, seeds)]
    with executor_of(chosen) as executor:
        work = partial(of_case, chosen.draws, chosen.rays)
        rows = [row for found in outcomes(executor, work, cases) for row in found]
    _report(rows)


def _report(rows: list[dict[str, object]]) -> None:
    def line(name: str, chosen: list[dict[str, object]]) -> None:
        clean = [row for row in chosen if row["noise"] == "none" and row["measured"]]
        bias = np.array([row["radial"] for row in clean], dtype=float)
        ratios: Array = np.array(
            [
                np.sqrt(np.nanmean([row["ratio2"] for row in chosen if row["noise"] == noise] or [np.nan]))
                for noise in ("even", "photon")
            ]
        )
        missing = sum(not row["measured"] for row in chosen)
        noted = np.mean([row["noted"] for row in chosen if row["noise"] == "photon"])
        print(
            f"{name:34} {np.mean([row['open'] for row in chosen]):5.0%} "
            f"{np.mean([row['blur'] for row in chosen]):5.1f}  {bias.mean():+.4f} ± "
            f"{bias.std() / np.sqrt(max(len(bias) - 1, 1)):.4f}  {np.abs(bias).max():.4f}  {ratios[0]:.2f} "
            f"{ratios[1]:.2f}  {missing}/{len(chosen)}  {noted:.0%}"
        )

    rings = list(dict.fromkeys(str(row["ring"]) for row in rows))
    print(f"{'':34} open  blur  bias (px)          largest even photon declined noted")
    for lens in dict.fromkeys(str(row["lens"]) for row in rows):
        for ring, polarity in product(rings, ("dark", "bright")):
            line(
                f"{lens}, {ring}, {polarity}",
                [
                    row
                    for row in rows
                    if (row["lens"], row["ring"], row["polarity"]) == (lens, ring, polarity)
                ],
            )
    for ring in rings:
        chosen = [row for row in rows if row["ring"] == ring]
        line(f"all, {ring}", chosen)
        bias = np.abs([float(str(row["radial"])) for row in chosen if row["noise"] == "none"])
        record(f"vignetted, {ring}", "bias", bias, "px", table=ORIGIN)


if __name__ == "__main__":
    main_of(__file__)
