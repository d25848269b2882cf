"""Blurred targets in photographs drawn with rays of batoid: errors beside bound, sigmas and other methods.

Run from the checkout: ``python benchmarks/blurred.py [--count N] [--first K] [--draws M] [--keep FOLDER |
--speed]``; needs batoid (`pip install batoid`). Each photograph shows twelve targets, disks and squares of
10 to 60 px, tilted to 40°, in three zones of the field of a double Gauss; its focus gives a blur of about 0,
3, 6, 10 or 15 px (diameter of 80 % of the energy), and it is measured with noise of 30, 40 and 50 dB below
the contrast. Ten photographs have each of the 8 targets at each blur and place once. The truth is batoid's
principal ray of 546.1 nm. Nothing is shared with what draws (``benchmarks/worlds/blurred.py``).

Reported is the rms error over the rms of the Cramér–Rao bound over all estimated parameters for each cell of
blur, target, noise and place. For the margins: targets, declined, mean error (bias) along the direction to
the axis, errors over sigmas; the rms errors of a centre of gravity, of an ellipse fitted to the edge, and of
ordinary least-squares matching; and whether any is wrong (beyond 5 sigma and 0.15 px).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from figures import BOUND, ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes, timed
from scipy.stats import chi2
from worlds.blurred import (
    ROWS,
    SCALE,
    WAVELENGTHS,
    WEIGHTS,
    Array,
    Lens,
    Target,
    energy_diameter,
    light,
    noisy,
)

from reseau.core.data import Frame
from reseau.measure.blurred import BlurredOptions, measure_blurred
from reseau.measure.blurred.measure import BlurredResult
from reseau.measure.matching import match
from reseau.measure.matching.patches import MatchOptions
from reseau.measure.matching.shapes import GrownOutline, Window
from reseau.optics.formation import Outline, PixelResponse, mark_outline
from reseau.optics.lenses import AIR, Prescription, PupilElements, RayMap, glass, in_order, ray_image
from reseau.optics.lenses.images import PlaneTarget
from reseau.optics.lenses.ray_maps import LensCamera, SensorPlane

PITCH = 0.006
SIZE = (1600, 1200)
PRINCIPAL = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
PSF = 0.45
DISTANCE = 500.0
BRIGHT, DARK = 200.0, 50.0
DECIBELS = (30.0, 40.0, 50.0)
BLURS = (0.0, 3.0, 6.0, 10.0, 15.0)
SIZES = (10.0, 20.0, 35.0, 60.0)
SHAPES = ("disk", "square")
ZONES = {"centre": (0.0, 0.33), "middle": (0.33, 0.66), "rim": (0.66, 1.0)}
"""Distance from the axis in half diagonals of the photograph."""
STOP = 3.963
"""Radius of the full stop, f/2, mm."""


@dataclass(frozen=True)
class World:
    """One drawn photograph without noise, its targets, and where their corresponding rays arrive."""

    image: Array
    targets: list[Target]
    truth: Array
    blurs: Array
    stop: float
    image_z: float
    centre: Array


def world(seed: int) -> World:
    """The photograph of a seed; seeds run through the blurs."""
    rng = np.random.default_rng(10_000 + seed)
    wanted = BLURS[seed % len(BLURS)]
    stop = STOP * (0.25 if wanted < 2 else rng.uniform(0.4, 0.6) if wanted < 8 else rng.uniform(0.5, 0.9))
    sharp = sum(row[1] for row in ROWS[:-1]) * SCALE + _image_distance()
    lens = Lens(stop, sharp, PITCH, PRINCIPAL)
    middle = np.array([0.08, 0.06, 1.0]) * DISTANCE
    z, side = sharp, rng.choice([-1.0, 1.0])
    if wanted > 2:
        low, high = 0.0, 2.5
        for _ in range(12):
            half = (low + high) / 2
            wide = energy_diameter(Lens(stop, sharp + side * half, PITCH, PRINCIPAL), middle)
            low, high = (half, high) if wide < wanted else (low, half)
        z = sharp + side * low
        lens = Lens(stop, z, PITCH, PRINCIPAL)
    image = np.full(SIZE[::-1], BRIGHT)
    targets, truth, blurs = [], [], []
    for at, shape, pixels in _layout(seed, rng, wanted):
        depth = DISTANCE * rng.uniform(0.985, 1.015)
        slope = (at - PRINCIPAL) * PITCH / 25.7
        centre = np.array([*slope, 1.0]) * depth
        target = Target(shape, pixels * PITCH * depth / 25.7, centre, _axes(rng))
        point = lens.principal_ray(centre, WAVELENGTHS[1])
        half = int(0.75 * pixels + 1.2 * wanted) + 12
        columns, rows = (np.arange(-half, half + 1) + round(v) for v in point)
        share = light(
            lens, target, columns.astype(float), rows.astype(float), PSF, 3000 + round(800 * wanted)
        )
        inside = (rows[:, None] >= 0) & (rows[:, None] < SIZE[1]) & (columns >= 0) & (columns < SIZE[0])
        y, x = np.broadcast_arrays(rows[:, None], columns[None])
        image[y[inside], x[inside]] -= (BRIGHT - DARK) * share[inside]
        targets.append(target)
        truth.append(point)
        blurs.append(energy_diameter(lens, centre))
    return World(image, targets, np.array(truth), np.array(blurs), stop, z, np.array([0, 0, lens.pupil_z]))


def _layout(seed: int, rng: np.random.Generator, blur: float) -> list[tuple[Array, str, float]]:
    """Places, shapes and sizes of the targets: two photographs of a blur have all kinds in all zones."""
    kinds = [(shape, pixels) for shape in SHAPES for pixels in SIZES]
    pair, second = divmod(seed // len(BLURS), 2)
    found: list[tuple[Array, str, float]] = []
    for zone, (low, high) in enumerate(ZONES.values()):
        order = np.random.default_rng((pair, seed % len(BLURS), zone)).permutation(len(kinds))
        for shape, pixels in (kinds[k] for k in order[4 * second : 4 * second + 4]):
            while True:
                at = rng.uniform([70, 70], np.array(SIZE) - 70)
                away = [
                    np.hypot(*(at - other)) > 0.75 * (pixels + size) + 2 * blur + 40
                    for other, _, size in found
                ]
                if low <= _from_axis(at) < high and all(away):
                    break
            found.append((at, shape, pixels))
    return found


def _from_axis(at: Array) -> float:
    """Distance from the axis in half diagonals of the photograph."""
    return float(np.hypot(*(at - PRINCIPAL)) / np.hypot(*PRINCIPAL))


def _image_distance() -> float:
    from reseau.optics.lenses import Paraxial

    return Paraxial(_prescription(1.0, 0.0)).image_distance(DISTANCE)


def _axes(rng: np.random.Generator) -> Array:
    tilt, towards, turn = rng.uniform(0, np.deg2rad(40)), rng.uniform(0, 2 * np.pi), rng.uniform(0, np.pi)
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    rotation = cv2.Rodrigues(tilt * axis)[0] @ cv2.Rodrigues(np.array([0, 0, turn]))[0]
    return np.asarray(rotation[:, :2])


def _prescription(stop: float, image_z: float) -> Prescription:
    """The same lens for the project."""
    rows = [(c / SCALE, d * SCALE, glass(g) if g not in ("", "stop") else AIR) for c, d, g in ROWS]
    surfaces = list(in_order(rows))
    surfaces[5] = replace(surfaces[5], kind="plain")
    surfaces[-1] = replace(surfaces[-1], vertex=np.array([0.0, 0.0, image_z]))
    return Prescription(
        tuple(surfaces), stop=5, stop_radius=stop, wavelengths_nm=WAVELENGTHS, weights=WEIGHTS, reference=1
    )


def camera_of(drawn: World) -> LensCamera:
    """The camera of a world for the project: the true lens, its focus and its projection centre."""
    sensor = SensorPlane((PITCH, PITCH), PRINCIPAL)
    return LensCamera(_prescription(drawn.stop, drawn.image_z), sensor, centre=drawn.centre)


def plane_targets(drawn: World) -> list[PlaneTarget]:
    """The targets of a world for the project."""
    spacing = 0.6 * PITCH * DISTANCE / 25.7
    return [
        PlaneTarget(t.centre, t.axes, mark_outline(t.shape, t.size, None, spacing)) for t in drawn.targets
    ]


def bounds(camera: LensCamera, target: PlaneTarget, sigmas: list[float]) -> Array:
    """Cramér–Rao bounds (n, 2) of the position, over position, width, contrast and background, by noise."""
    image = ray_image(camera, target, PupilElements.gauss(8))
    half = int(np.abs(image.outline.xy).max()) + 6
    pixels = np.rint(image.point) + np.arange(-half, half + 1.0)[:, None]
    nodes = Outline(image.outline.xy[None], image.outline.dxy[None])
    window = Window(pixels[None, :, 0], pixels[None, :, 1], PixelResponse())
    at = image.point[None], np.array([PSF]), np.zeros((1, 0)), np.zeros(1, np.intp), window
    share, slopes = GrownOutline(nodes.single(), np.zeros((0, 2, 2))).derivatives(*at)
    u = np.broadcast_to(np.linspace(-1, 1, 2 * half + 1), share[0].shape)
    contrast, rest = 1 - DARK / BRIGHT, BRIGHT * (1 - (1 - DARK / BRIGHT) * share[0])
    grey = [-BRIGHT * contrast * slopes[0, k] for k in range(3)] + [-BRIGHT * share[0]]
    grey[2] = grey[2] * PSF  # by the logarithm of the width
    design = np.stack([*grey, rest / BRIGHT, rest * u / BRIGHT, rest * u.T / BRIGHT], axis=-1).reshape(-1, 7)
    known = np.zeros((7, 7))
    known[2, 2] = 1 / BlurredOptions().psf_log_sigma ** 2
    covariances = [np.linalg.inv(design.T @ design / sigma**2 + known) for sigma in sigmas]
    return np.sqrt([np.diagonal(covariance)[:2] for covariance in covariances])


def others(pixels: Array, drawn: World, k: int) -> dict[str, Array]:
    """Positions of a target by other methods, in the window around it."""
    target, at = drawn.targets[k], drawn.truth[k]
    half = int(0.75 * target.size / DISTANCE * 25.7 / PITCH + 1.2 * drawn.blurs[k]) + 9
    left, top = (round(v) - half for v in at)
    patch = pixels[max(top, 0) : top + 2 * half + 1, max(left, 0) : left + 2 * half + 1].astype(float)
    corner = np.array([max(left, 0), max(top, 0)])
    ring = np.concatenate(
        [patch[:3].ravel(), patch[-3:].ravel(), patch[:, :3].ravel(), patch[:, -3:].ravel()]
    )
    depth = np.median(ring) - patch
    found = {}
    weight = np.where(depth > 0.15 * depth.max(), depth, 0)
    y, x = np.indices(patch.shape)
    found["gravity"] = np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum() + corner
    mask = (depth > 0.5 * depth.max()).astype(np.uint8)
    outline = max(cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0], key=len, default=None)
    if outline is not None and len(outline) >= 5:
        edge = _refined(depth, outline[:, 0].astype(float))
        found["ellipse"] = np.array(cv2.fitEllipse(edge.astype(np.float32))[0]) + corner
    # Ordinary matching: the outline in the projection of the principal rays, and one Gaussian blur.
    camera = camera_of(drawn)
    plane = plane_targets(drawn)[k]
    sharp = camera.corresponding(plane.points(plane.outline.xy)) - drawn.truth[k]
    ends = [
        camera.corresponding(plane.points(plane.outline.xy + s * 1e-4 * plane.outline.dxy)) for s in (1, -1)
    ]
    nodes = Outline(sharp[None], (ends[0] - ends[1])[None] / 2e-4).oriented().single()
    psf = float(np.hypot(PSF, drawn.blurs[k] / 3.6))
    options = MatchOptions(half_px=half, psf_px=psf, psf_log_sigma=0.5)
    ordinary = match(pixels.astype(np.float32), pixels >= 0, nodes, at[None], options, noise=1.0)
    found["matching"] = ordinary.xy[0]
    return found


def _refined(depth: Array, outline: Array) -> Array:
    """Places at which the profiles across an outline (n, 2) cross half the depth."""
    middle = outline.mean(axis=0)
    away = outline - middle
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    t = np.linspace(-3, 3, 25)
    at = outline[:, None] + t[:, None] * away[:, None]
    values = cv2.remap(
        depth.astype(np.float32), at[..., 0].astype(np.float32), at[..., 1].astype(np.float32), 1
    )
    below = values < 0.5 * depth.max()
    first = np.maximum(below.argmax(axis=1), 1)
    each = np.arange(len(outline))
    a, b = values[each, first - 1], values[each, first]
    share = np.clip((a - 0.5 * depth.max()) / np.where(a == b, 1, a - b), 0, 1)
    return np.asarray(outline + (t[first - 1] + share * (t[1] - t[0]))[:, None] * away)


def kept(seed: int, folder: Path | None) -> World:
    """A world, drawn or read."""
    if folder is None:
        return world(seed)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"blurred{seed:04d}.npy"
    if not file.exists():
        np.save(file, np.array([vars(world(seed))], dtype=object), allow_pickle=True)
    return World(**np.load(file, allow_pickle=True)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=57, help="photographs, each measured with three noises")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--draws", type=int, default=4, help="of each noise")
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="drawn photographs are kept and reused there"
    )
    parser.add_argument("--speed", action="store_true", help="time and exactness of one image only")
    add_options(parser)
    chosen = parser.parse_args()
    if chosen.speed:
        speed()
        return
    rows: list[dict[str, object]] = []
    seconds = 0.0
    seeds = range(chosen.first, chosen.first + chosen.count)
    with executor_of(chosen) as executor:
        for found, spent in outcomes(executor, partial(of_photograph, chosen.keep, chosen.draws), seeds):
            rows += found
            seconds += spent
    _report(rows, seconds)


def of_photograph(keep: Path | None, draws: int, seed: int) -> tuple[list[dict[str, object]], float]:
    """Rows of the targets of a photograph with each noise, and the processor time (s) to measure them."""
    drawn = kept(seed, keep)
    camera, planes = camera_of(drawn), plane_targets(drawn)
    names = [str(k) for k in range(len(planes))]
    sigmas = [(BRIGHT - DARK) * 10 ** (-decibels / 20) for decibels in DECIBELS]
    least = np.array([bounds(camera, plane, sigmas) for plane in planes])
    rows, seconds = list[dict[str, object]](), 0.0
    for (level, decibels), draw in product(enumerate(DECIBELS), range(draws)):
        noise = np.random.default_rng((seed, int(decibels), draw))
        pixels = noisy(drawn.image, BRIGHT - DARK, decibels, noise)
        frame = Frame(pixels, 255.0, f"world {seed}")
        found, spent = timed(partial(measure_blurred, frame, camera, names, planes), "blurred")
        seconds += spent
        rows += _rows(seed, decibels, drawn, found, pixels, least[:, level])
    return rows, seconds


def speed() -> None:
    """Time of an image of few rays, and its shift against many rays, over the field."""
    lens = _prescription(0.6 * STOP, _image_distance() + sum(row[1] for row in ROWS[:-1]) * SCALE + 0.1)
    camera = LensCamera(lens, SensorPlane((PITCH, PITCH), PRINCIPAL))
    elements = PupilElements.gauss(4)
    rng = np.random.default_rng(0)

    def formed(view: RayMap, target: PlaneTarget, elements: PupilElements, at: Array, half: int) -> Array:
        pixels = np.arange(-half, half + 1.0)
        image = ray_image(view, target, elements)
        return image.formed(image.point, PSF, at[0] + pixels, at[1] + pixels, PixelResponse())

    for size in (10.0, 20.0, 35.0, 60.0):
        outline = mark_outline("disk", size * PITCH * DISTANCE / 25.7, None, 0.8 * PITCH * DISTANCE / 25.7)
        seconds, shifts, blurs, half = [], [], [], int(0.6 * size) + 12
        for x, y in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 0), (0, 1), (1, -1), (1, 0), (1, 1)):
            target = PlaneTarget(np.array([0.17 * x, 0.125 * y, 1.0]) * DISTANCE, _axes(rng), outline)
            at = np.rint(camera.corresponding(target.centre[None])[0])
            for _ in range(5):
                start = time.process_time()
                one = formed(camera, target, elements, at, half)
                seconds.append(time.process_time() - start)
            many = formed(camera, target, PupilElements.gauss(16), at, half)
            down, right = np.gradient(many)
            design = np.stack([right.ravel(), down.ravel(), many.ravel(), np.ones(many.size)], axis=1)
            shifts.append(np.linalg.lstsq(design, (many - one).ravel(), rcond=None)[0][:2])
            blurs.append(ray_image(camera, target, elements).blur)
        print(
            f"{size:g} px, blurred by {min(blurs):.1f}-{max(blurs):.1f} px (rms radius): "
            f"{1e3 * np.median(seconds):.1f} ms, shift at most {np.abs(shifts).max():.4f} px"
        )


def _rows(
    seed: int,
    decibels: float,
    drawn: World,
    found: BlurredResult,
    pixels: Array,
    least: Array,
) -> list[dict[str, object]]:
    rows = []
    for k, target in enumerate(drawn.targets):
        row: dict[str, object] = {
            "blur": float(BLURS[seed % len(BLURS)]),
            "decibels": decibels,
            "shape": target.shape,
            "pixels": round(target.size / target.centre[2] * 25.7 / PITCH),
            "place": list(ZONES)[k // 4],
            "ok": bool(found.ok[k]),
        }
        if found.ok[k]:
            error = found.xy[k] - drawn.truth[k]
            s = np.sqrt(np.diagonal(found.cov[k]))
            row |= {"error": error, "sigma": s, "bound": least[k]}
            outwards = drawn.truth[k] - PRINCIPAL
            outwards /= np.hypot(*outwards)
            row["radial"] = float(error @ outwards)
            row["others"] = {n: p - drawn.truth[k] for n, p in others(pixels, drawn, k).items()}
            if (np.abs(error) > np.maximum(5 * s, 0.15)).any():
                name = f"world {seed}, {decibels:g} dB, target {k}"
                print(f"wrong: {name}: {error.round(3)} px, sigma {s.round(4)}")
        else:
            print(f"declined: world {seed}, {decibels:g} dB, target {k} ({row['pixels']} px): {found.why[k]}")
        rows.append(row)
    return rows


def _report(rows: list[dict[str, object]], seconds: float) -> None:
    print(
        f"\n{'':24s} {'n':>5s} {'declined':>8s} {'rms px':>8s} {'/ bound':>8s} {'radial':>8s} {'err/sig':>8s}"
        f" {'gravity':>8s} {'ellipse':>8s} {'matching':>8s}"
    )
    for name, values in (
        ("blur", BLURS),
        ("decibels", DECIBELS),
        ("pixels", SIZES),
        ("shape", SHAPES),
        ("place", tuple(ZONES)),
    ):
        for value in values:
            _line(f"{name} {value}", [row for row in rows if row[name] == value])
    for value in BLURS:
        for decibels in DECIBELS:
            those = [row for row in rows if row["blur"] == value and row["decibels"] == decibels]
            _line(f"blur {value:g}, {decibels:g} dB", those)
    _line("all", rows)
    good = [row for row in rows if row["ok"]]
    record("blurred targets", "independent, found", len(good), of=len(rows), table=ORIGIN)
    if good:
        error, least, sigma = (np.array([row[key] for row in good]) for key in ("error", "bound", "sigma"))
        record("blurred target", "reseau", np.sqrt((error**2).mean()), table=BOUND)
        record("blurred target", "bound", np.sqrt((least**2).mean()), table=BOUND)
        for method, name in (("gravity", "centre of gravity"), ("ellipse", "ellipse"),
                             ("matching", "ordinary matching")):  # fmt: skip
            record("blurred target", name, np.sqrt((_errors_of(good, method) ** 2).mean()), table=BOUND)
        levels = [np.array([row["decibels"] == each for row in good]) for each in DECIBELS]
        ratios = [np.sqrt(((error[of] / sigma[of]) ** 2).mean()) for of in levels]
        record("blurred targets", "independent, errors ÷ sigmas", ratios, table=ORIGIN)
    _cells(rows)
    print(f"{1e3 * seconds / max(len(rows), 1):.1f} ms of processor time per target")


def _cells(rows: list[dict[str, object]]) -> None:
    """The table of all cells, and how far they scatter about what all have in common."""
    columns = list(product(DECIBELS, ZONES))
    print("\nrms error over bound" + "".join(f"{f'{d:g} dB ' + z:>14s}" for d, z in columns))
    ratios, all_ = [], [_squares(row) for row in rows if row["ok"]]
    usual = float(np.sqrt(np.mean(all_)))
    for blur, shape, pixels in product(BLURS, SHAPES, SIZES):
        line = f"blur {blur:2g}, {shape:>6s} {pixels:2g}"
        for decibels, place in columns:
            cell = {"blur": blur, "shape": shape, "pixels": pixels, "decibels": decibels, "place": place}
            those = [_squares(row) for row in rows if row["ok"] and cell.items() <= row.items()]
            if not those:
                line += f"{'-':>14s}"
                continue
            ratios.append((float(np.sqrt(np.mean(those))), 2 * len(those)))
            line += f"{ratios[-1][0]:14.2f}"
        print(line)
    ratio, count = np.array(ratios).T
    # All cells together: none of equally good ones is above this with 99 %.
    limit = 1.15 * np.sqrt(chi2.ppf(0.99 ** (1 / len(ratio)), count) / count)
    print(
        f"{len(ratio)} cells of {count.min() / 2:g} to {count.max() / 2:g} targets: all {usual:.3f}, largest "
        f"{ratio.max():.2f}, above 1.15 {(ratio > 1.15).sum()}, significantly (99 %) {(ratio > limit).sum()}"
    )


def _squares(row: dict[str, object]) -> float:
    """Mean square of the errors of a target over its bounds."""
    return float(np.mean((np.asarray(row["error"]) / np.asarray(row["bound"])) ** 2))


def _line(name: str, rows: list[dict[str, object]]) -> None:
    good = [row for row in rows if row["ok"]]
    if not good:
        return
    error, sigma, least = (np.array([row[key] for row in good]) for key in ("error", "sigma", "bound"))
    rms = float(np.sqrt((error**2).mean()))
    record(name, "measured", len(good), of=len(rows))
    record(name, "rms", rms, "px")
    record(name, "rms ÷ bound", np.sqrt(((error / least) ** 2).mean()))
    record(name, "errors ÷ sigmas", np.sqrt(((error / sigma) ** 2).mean()))
    line = (
        f"{name:24s} {len(rows):5d} {len(rows) - len(good):8d} {rms:8.4f} "
        f"{np.sqrt(((error / least) ** 2).mean()):8.2f} {np.mean([row['radial'] for row in good]):8.4f} "
        f"{np.sqrt(((error / sigma) ** 2).mean()):8.2f}"
    )
    for method in ("gravity", "ellipse", "matching"):
        off = np.sqrt((_errors_of(good, method) ** 2).mean())
        record(name, f"{method}, rms", off, "px")
        line += f" {off:8.3f}"
    print(line)


def _errors_of(good: list[dict[str, object]], method: str) -> Array:
    """Errors (n, 2) of another method."""
    return np.array([row["others"][method] for row in good if method in row["others"]])  # type: ignore[index, operator]


if __name__ == "__main__":
    main_of(__file__)
