"""Stand-ins for a lens whose design is not known: what they cost in accuracy against the true design.

Run from the checkout: ``python benchmarks/stand_ins.py [--count N] [--keep FOLDER]``; needs batoid
(`pip install batoid`). The photographs are those of ``benchmarks/blurred.py``, at 40 dB: drawn with the rays
of batoid through a double Gauss, blurred by 3 to 15 px (80 % of the energy). Each is measured

- with the true design;
- with a thin lens of the right principal distance and aperture, as calibrated;
- with a thin lens whose focus, stated wrong by 0.05 mm, is estimated from the twelve targets;
- with pupil and aberrations as parameters, fitted to rays of the design: what the form of the model costs;
- with the same parameters, focus and four aberrations estimated from the twelve targets alone;
- with the true design, its focus stated wrong by 0.05 mm and estimated.

Stand-ins have neither the distortion nor the orientation of the lens: each target is taken from where its
centre of gravity lies in the photograph. Reported are errors against batoid's principal ray; the mean along
the direction from the axis is the error that coma leaves.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from blurred import (
    BLURS,
    BRIGHT,
    DARK,
    PRINCIPAL,
    WAVELENGTHS,
    WEIGHTS,
    Array,
    World,
    camera_of,
    kept,
    noisy,
    others,
    plane_targets,
)
from parts import add_options, executor_of, main_of, outcomes
from scipy.optimize import least_squares

from reseau.core.data import Frame
from reseau.measure.blurred import BlurredOptions, estimate_optics, measure_blurred
from reseau.measure.blurred.measure import BlurredResult, Varied
from reseau.optics.lenses import Paraxial, PupilElements, RayMap, ThinLens
from reseau.optics.lenses.images import PlaneTarget
from reseau.optics.lenses.stand_ins import AberratedLens

DECIBELS = 40.0
WRONG_FOCUS = 0.05
OPTIONS = BlurredOptions(search_px=4.0)
FORM = ("spherical", "coma", "astigmatism", "curvature", "spherical_5", "narrowing", "colour")
"""What is fitted to the rays of the design, besides the focus."""
ESTIMATED = {"spherical": 0.03, "coma": 0.02, "astigmatism": 0.03, "curvature": 0.05}
"""What is estimated from the photograph, besides the focus: prior standard deviations, mm."""
NAMES = ("design", "design, focus", "thin", "thin, focus", "aberrations", "estimated")


def stand_in(drawn: World) -> AberratedLens:
    """A thin lens with the principal distance, focus and aperture of the true one; without aberrations."""
    true = camera_of(drawn)
    first = Paraxial(true.lens)
    near = true.corresponding(np.array([[0.0, 0, 500.0], [1.0, 0, 500.0]]))
    principal = float(np.hypot(*(near[1] - near[0]))) * true.sensor.pitch_mm[0] * 500.0
    # The distance from the entrance pupil at which points are sharp, in first order.
    low, high = 50.0, 1e5
    behind = true.lens.surfaces[-1].vertex[2] - true.lens.surfaces[-2].vertex[2]
    for _ in range(60):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if first.image_distance(middle) > behind else (low, middle)
    focal = 1 / (1 / principal + 1 / (low + first.entrance_pupil[0]))
    colours = tuple(zip(WAVELENGTHS, WEIGHTS, strict=True))
    return AberratedLens(
        focal, 2 * first.entrance_pupil_radius, principal, true.sensor, (colours[1], colours[0], colours[2])
    )


def refocused(lens: AberratedLens, by: float) -> AberratedLens:
    """The stand-in with its sensor farther away from it, at the same principal distance."""
    return replace(lens, focal_length=1 / (1 / lens.focal_length - by / lens.image_distance**2))


def seen_at(camera: RayMap, targets: list[PlaneTarget], xy: list[Array]) -> list[PlaneTarget]:
    """Targets moved parallel to the image to where a camera sees them at given pixels."""
    found = []
    for target, at in zip(targets, xy, strict=True):
        centre = target.centre.copy()
        for _ in range(4):
            steps = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]])
            here = camera.corresponding(centre + steps)
            centre[:2] += np.linalg.solve((here[1:] - here[0]).T, at - here[0])
        found.append(replace(target, centre=centre))
    return found


def methods(drawn: World, frame: Frame, xy: list[Array]) -> Iterator[tuple[str, BlurredResult | None]]:
    """Names and results; None where the optics could not be estimated."""
    truth, planes = camera_of(drawn), plane_targets(drawn)
    names = [str(k) for k in range(len(planes))]
    lens = stand_in(drawn)
    wrong = refocused(lens, WRONG_FOCUS)

    def measured(camera: RayMap) -> BlurredResult:
        return measure_blurred(frame, camera, names, seen_at(camera, planes, xy), OPTIONS)

    def estimated(start: RayMap, varied: Varied) -> BlurredResult | None:
        optics = estimate_optics(frame, seen_at(start, planes, xy), varied, OPTIONS)
        return measured(optics.camera) if optics else None

    def moved(by: Array) -> RayMap:
        shift = np.array([0.0, 0.0, WRONG_FOCUS + by[0]])
        return replace(truth, lens=truth.lens.moved(shift))

    def thin(lens: AberratedLens) -> ThinLens:
        return ThinLens(lens.focal_length, lens.diameter, lens.image_distance, lens.sensor, lens.colours)

    focus: Callable[[Array], RayMap] = lambda by: thin(refocused(wrong, by[0]))  # noqa: E731
    yield "design", measured(truth)
    yield "design, focus", estimated(moved(np.zeros(1)), Varied(("focus_mm",), (0.1,), moved))
    yield "thin", measured(thin(lens))
    yield "thin, focus", estimated(thin(wrong), Varied(("focus_mm",), (0.1,), focus))
    yield "aberrations", measured(fitted(drawn, lens))
    first = estimate_optics(frame, seen_at(wrong, planes, xy), Varied(("focus_mm",), (0.1,), focus), OPTIONS)
    start = refocused(wrong, float(first.values[0])) if first else wrong

    def aberrated(by: Array) -> RayMap:
        return refocused(replace(start, **dict(zip(ESTIMATED, by[1:], strict=True))), by[0])

    varied = Varied(("focus_mm", *ESTIMATED), (0.05, *ESTIMATED.values()), aberrated)
    yield "estimated", estimated(start, varied)


def fitted(drawn: World, lens: AberratedLens) -> AberratedLens:
    """The stand-in whose rays from the targets are most like those of the design."""
    true, elements = camera_of(drawn), PupilElements.gauss(4)
    points = np.repeat([target.centre for target in drawn.targets], len(elements.xy), axis=0)
    pupil = np.tile(elements.xy, (len(drawn.targets), 1))

    def spots(camera: RayMap) -> Array:
        beside = camera.corresponding(points)
        return np.stack([camera.rays(points, pupil, w)[0] - beside for w in WAVELENGTHS])  # type: ignore[attr-defined]

    def model(values: Array) -> AberratedLens:
        return refocused(replace(lens, **dict(zip(FORM, values[1:], strict=True))), values[0])

    wanted = spots(true)
    scale = np.full(1 + len(FORM), 0.01)
    found = least_squares(
        lambda x: (spots(model(x)) - wanted).ravel(), np.zeros(1 + len(FORM)), x_scale=scale
    )
    return model(found.x)


Method = tuple[str, int, str, list[tuple[Array, Array, float]]]
"""Its name, the number of targets, what became of them, and of each error, sigmas, error outwards."""


def of_photograph(keep: Path | None, seed: int) -> list[Method]:
    """Measure a photograph by each method."""
    drawn = kept(seed, keep)
    pixels = noisy(drawn.image, BRIGHT - DARK, DECIBELS, np.random.default_rng((seed, int(DECIBELS))))
    xy = [others(pixels, drawn, k)["gravity"] for k in range(len(drawn.targets))]
    done: list[Method] = []
    for name, found in methods(drawn, Frame(pixels, 255.0, f"world {seed}"), xy):
        errors = []
        for k in np.flatnonzero(found.ok) if found is not None else ():
            assert found is not None
            outwards = (drawn.truth[k] - PRINCIPAL) / np.hypot(*(drawn.truth[k] - PRINCIPAL))
            error, sigma = found.xy[k] - drawn.truth[k], np.sqrt(np.diagonal(found.cov[k]))
            errors.append((error, sigma, float(error @ outwards)))
        state = "none" if found is None else f"{found.found} measured, {len(found.notes)} notes"
        done.append((name, len(drawn.targets), state, errors))
    gravity = [(at - drawn.truth[k], np.full(2, np.nan), 0.0) for k, at in enumerate(xy)]
    return [*done, ("gravity", len(xy), "", gravity)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=12, help="photographs")
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="drawn photographs are kept and reused there"
    )
    add_options(parser)
    chosen = parser.parse_args()
    rows: dict[tuple[str, float], list[tuple[Array, Array, float]]] = {}
    counts: dict[tuple[str, float], int] = {}
    seeds = [seed for seed in range(10 * chosen.count) if seed % len(BLURS)][: chosen.count]
    with executor_of(chosen) as executor:
        done = outcomes(executor, partial(of_photograph, chosen.keep), seeds)
        for seed, found in zip(seeds, done, strict=True):
            for name, targets, state, errors in found:
                key = name, BLURS[seed % len(BLURS)]
                counts[key] = counts.get(key, 0) + targets
                rows.setdefault(key, []).extend(errors)
                if state:
                    print(f"world {seed}, {name}: {state}", flush=True)
    print(
        f"{'':16s} {'blur px':>8s} {'n':>5s} {'measured':>8s} {'rms px':>8s} {'median':>8s} {'radial':>8s}"
        f" {'err/sig':>8s}"
    )
    for name in (*NAMES, "gravity"):
        for blur in (*BLURS[1:], 0.0):
            keys = [key for key in counts if key[0] == name and blur in (0.0, key[1])]
            those = [row for key in keys for row in rows.get(key, [])]
            if not those:
                continue
            error, sigma = (np.array([row[k] for row in those]) for k in (0, 1))
            radial = np.mean([row[2] for row in those])
            print(
                f"{name:16s} {blur or 'all':>8} {sum(counts[k] for k in keys):5d} {len(those):8d} "
                f"{np.sqrt((error**2).mean()):8.4f} "
                f"{np.median(np.hypot(*error.T)):8.4f} {radial:8.4f} "
                f"{np.sqrt(((error / sigma) ** 2).mean()):8.2f}"
            )


if __name__ == "__main__":
    main_of(__file__)
