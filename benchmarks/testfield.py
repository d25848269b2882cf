"""The coded testfield: lines, recognition and precision in the paper's recordings, compared with known truth.

Run from the checkout: ``python benchmarks/testfield.py [--seeds N] [--jobs N] [--freed]``. The 36
recordings of Vosselman and Förstner (φ = 0, 30, 45°), and 16 more with φ = 60°, are simulated and measured.
In the Cramér–Rao bound, position, sharpness, contrast, background (level and slopes) and size are unknown,
and all simulated noise is included, also row jitter. The figures refer to the 256 targets of the central
4 × 4 squares. ``--freed`` measures photographs whose blur, light, print, board and processing the measurement
does not model as they are, instead; see :class:`reseau_sims.Photograph`. ``--speed`` prints only processor
times, also for one megapixel with 1000 targets (:mod:`worlds.boards`), ``--small`` measures fields that are
small in the frame.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from figures import ORIGIN, record
from parts import main_of, outcomes
from scipy.optimize import linear_sum_assignment
from shared import of_the_tests
from worlds.boards import OPENCV, Pose, picture

from reseau.core.data import Array, Frame
from reseau.core.tone import ToneCurve
from reseau.designs import HIDDEN, coded_testfield
from reseau.execution import Processes
from reseau.io import SHAPES
from reseau.measure import measure_testfield
from reseau.measure.testfield.measure import FORMED_PX, TestfieldOptions, TestfieldResult
from reseau.measure.testfield.recognition import read_clusters
from reseau.optics.formation import PixelResponse
from reseau_sims import FieldBench, Photograph, Stain, Station, paper_stations
from reseau_sims.testfield import DISTANCE_MM, JITTER_PX

DESIGN = coded_testfield()
OPTIONS = TestfieldOptions(row_jitter_px=JITTER_PX, fill=0.8)
CENTRAL = np.abs(DESIGN.xy).max(axis=1) < 250
FINGERS = tuple(
    Stain(60 + 45 * k, 95 + 8 * k, 14, 90.0, end=(20 + 45 * k, 250), texture=12.0) for k in range(4)
)
SRGB = ToneCurve(None, source="sRGB tag")
FREED: dict[str, dict[str, Any]] = {
    "disk out of focus, 2 px": {"photograph": Photograph(defocus_px=2.0)},
    "motion to and fro, 4 px": {"photograph": Photograph(motion_px=4.0, motion_bend=0.2, motion_speed=0.4)},
    "curve of 2.2": {"photograph": Photograph(gamma=2.2)},
    "curve of 2.2, file says sRGB": {"photograph": Photograph(gamma=2.2), "stated": SRGB},
    "curve of 1.6, file says sRGB": {"photograph": Photograph(gamma=1.6), "stated": SRGB},
    "straight, file says sRGB": {"stated": SRGB},
    "sharpened": {"photograph": Photograph(sharpening=1.2)},
    "JPEG of quality 60": {"photograph": Photograph(jpeg=60)},
    "curve, sharpened, JPEG 85": {"photograph": Photograph(gamma=2.2, sharpening=0.6, jpeg=85)},
    "uneven light": {"gradient": (0.25, -0.15), "photograph": Photograph(curvature=(-0.15, 0.1, -0.1))},
    "ink 0.4 mm wider": {"ink_mm": 0.4},
    "waves of 1 mm": {"waves_mm": 1.0},
    "fingers": {"stains": FINGERS},
    "glare to saturation": {"stains": (Stain(150, 100, 25, 120.0, opaque=False),)},
}
"""Benches by condition, and the curve that the file states."""
ROUGH = {
    "motion to and fro, 4 px",
    "sharpened",
    "curve, sharpened, JPEG 85",
    "JPEG of quality 60",
    "glare to saturation",
}
PAPER = {
    ("square", False): 0.040,
    ("triangle", False): 0.056,
    ("cross", False): 0.044,
    ("circle", False): 0.041,
    ("square", True): 0.034,
    ("triangle", True): 0.050,
    ("cross", True): 0.030,
    ("circle", True): 0.033,
}


@dataclass
class Recording:
    """A measured recording with its truth."""

    station: Station
    frame: Frame
    result: TestfieldResult
    error: Array
    bound: Array
    truth: Any


def measure(frame: Frame) -> Any:
    return measure_testfield(frame, DESIGN, OPTIONS)


def recordings(fields: ModuleType, seed: int, tilts: tuple[float, ...]) -> Iterator[Recording]:
    """Simulated, measured one after the other."""
    bench = FieldBench(seed=seed)
    for station in paper_stations(tilts):
        frame, truth = bench.record(station), bench.truth(station)
        result = measure(frame)
        assert result, result.reason
        bound = fields.bounds(bench, station, result.ok & CENTRAL)
        yield Recording(station, frame, result, result.xy - truth.xy, bound, truth)


def lines(recording: Recording) -> Array:
    """Distances of lines, by the mapping through all targets, from the truth at points 15 mm apart."""
    lattice = recording.result.lattice
    found = []
    for axis, (numbers, others) in enumerate(
        ((lattice.across, lattice.along), (lattice.along, lattice.across))
    ):
        for number in numbers:
            at = np.full((8 * int(np.ptp(others)) + 1, 2), float(number))
            at[:, 1 - axis] = np.linspace(others.min(), others.max(), len(at))
            xy = lattice.mapping(at)
            inside = ((xy > 0) & (xy < 239)).all(axis=1)
            found.append(true_distance(recording, xy[inside]))
    return np.concatenate(found)


def true_distance(recording: Recording, xy: Array) -> Array:
    """Distance (n,) in the image of points from the nearest true line."""
    # Points of the board under the image points, by Newton's method from the nearest targets.
    near = np.argmin(np.hypot(*(xy[:, None] - recording.truth.xy).transpose(2, 0, 1)), axis=1)
    board = DESIGN.xy[near].copy()
    for _ in range(8):
        seen, slope = recording.truth.view(board)
        board += np.linalg.solve(slope, (xy - seen)[..., None])[..., 0]
    off = board - np.rint(board / DESIGN.pitch) * DESIGN.pitch
    axis = np.abs(off).argmin(axis=1)
    rows = np.arange(len(xy))
    gradient = np.linalg.inv(slope)[rows, axis]
    return np.asarray(off[rows, axis] / np.hypot(*gradient.T))


def misread(recording: Recording, contours: bool = False) -> Array:
    """Misclassified targets of the central squares: individually, by cluster, by contours (3,)."""
    pixels, lattice = recording.frame.pixels.astype(np.float32), recording.result.lattice
    # By the mapping through all targets, in pixels of the frame.
    reading = read_clusters(pixels, lattice, DESIGN, OPTIONS.psf_px, PixelResponse(OPTIONS.fill))
    assert reading
    places = reading.xy.reshape(-1, 2)
    distance = np.hypot(*(places[:, None] - recording.truth.xy[CENTRAL]).transpose(2, 0, 1))
    near = distance.argmin(axis=1)
    true = np.where(distance.min(axis=1) < 3, DESIGN.symbols[CENTRAL][near], HIDDEN).reshape(-1, 16)
    counts = [((taken != true) & (true != HIDDEN)).sum() for taken in (reading.alone, reading.joint)]
    if not contours:
        return np.array([*counts, 0])
    by_contour = np.array([by_contours(recording.frame, each) for each in reading.xy])
    return np.array([*counts, ((by_contour != true) & (true != HIDDEN)).sum()])


def by_contours(frame: Frame, xy: Array) -> Array:
    """Symbols (16,) of a cluster by the contours of its targets, four times enlarged: what is compared with.

    Large and small by the area, and two of each shape among those of a size, by the area of the contour over
    those of its hull, of its least rectangle and of its least triangle.
    """
    features, areas = np.zeros((16, 3)), np.zeros(16)
    for k, at in enumerate(xy):
        patch = cv2.getRectSubPix(frame.pixels, (15, 15), (float(at[0]), float(at[1])))
        patch = cv2.resize(patch, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
        middle = (float(patch[24:36, 24:36].min()) + float(np.percentile(patch, 90))) / 2
        parts, labels, stats, _ = cv2.connectedComponentsWithStats((patch < middle).astype(np.uint8))
        part = labels[30, 30] or (1 + stats[1:, cv2.CC_STAT_AREA].argmax() if parts > 1 else 0)
        found, _ = cv2.findContours(
            (labels == part).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        contour = max(found, key=cv2.contourArea)
        areas[k] = cv2.contourArea(contour)
        hull = cv2.convexHull(contour)
        (_, (a, b), _), (triangle, _) = cv2.minAreaRect(contour), cv2.minEnclosingTriangle(contour)
        features[k] = areas[k] / np.maximum([cv2.contourArea(hull), a * b, triangle], 1.0)
    symbols = np.zeros(16, dtype=int)
    order = np.argsort(areas)
    # Squares, triangles, crosses, circles, blurred.
    ideal = np.array([[1.0, 0.95, 0.55], [0.97, 0.58, 0.88], [0.82, 0.68, 0.5], [1.0, 0.8, 0.62]])
    for large, rows in ((0, order[:8]), (1, order[8:])):
        cost = ((features[rows][:, None] - np.repeat(ideal, 2, axis=0)) ** 2).sum(axis=2)
        row, column = linear_sum_assignment(cost)
        symbols[rows[row]] = 2 * (column // 2) + large
    return symbols


def binary_centroids(recording: Recording) -> Array:
    """Errors (n, 2) of the centroids of the targets in the binary image, enlarged by two as in the paper."""
    frame, result = recording.frame, recording.result
    error = np.full(result.xy.shape, np.nan)
    twice = cv2.resize(frame.pixels, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    _, labels, stats, centres = cv2.connectedComponentsWithStats((twice < 115).astype(np.uint8))
    for k in np.flatnonzero(result.ok & CENTRAL):
        # A pixel's centre x lies at 2x + 0.5 of the enlarged image.
        x, y = np.rint(2 * result.xy[k] + 0.5).astype(int)
        part = labels[y, x]
        if part and stats[part, cv2.CC_STAT_AREA] < 1000:
            error[k] = (centres[part] - 0.5) / 2 - recording.truth.xy[k]
    return error


def table(done: list[Recording]) -> bool:
    """Print rms and bound for each kind of target; return whether all satisfy the limits."""
    error = np.stack([r.error[CENTRAL] for r in done])
    bound = np.stack([np.diagonal(r.bound[CENTRAL], axis1=1, axis2=2) for r in done])
    # What formation by other programs may add is not in pictures of the own simulator.
    cov = np.stack([np.diagonal(r.result.cov[CENTRAL], axis1=1, axis2=2) for r in done]) - FORMED_PX**2
    shape, large = np.array(DESIGN.targets.shape)[CENTRAL], DESIGN.large[CENTRAL]
    binary = np.stack([binary_centroids(r)[CENTRAL] for r in done])
    print(
        f"\n{'targets':<16} {'number':>6} {'paper px':>9} {'rms x/y px':>15} {'rms/bound x/y':>14} "
        f"{'all':>6} {'predicted/empirical':>20} {'bias x/y 1e-3 px':>17} {'binary/matching':>16}"
    )
    kept, tilt = True, max(r.station.phi for r in done)
    for big in (True, False):
        for name in SHAPES:
            of = (shape == name) & (large == big)
            e, b, c, n = error[:, of], bound[:, of], cov[:, of], binary[:, of]
            measured = np.isfinite(e[..., 0])
            e, b, c = e[measured], b[measured], c[measured]
            rms, least = np.sqrt((e**2).mean(axis=0)), np.sqrt(b.mean(axis=0))
            ratio = float(np.sqrt((e**2).mean() / b.mean()))
            predicted = float(np.sqrt(c.mean() / (e**2).mean()))
            coarse = np.nanmedian(np.abs(n)) / np.median(np.abs(e))
            good = ratio <= (1.15 if big else 1.2) and 0.9 <= predicted <= 1.1
            kept &= good
            bias = 1e3 * e.mean(axis=0)
            label = f"{'large' if big else 'small'} {name}s, φ up to {tilt:.0f}°"
            record(label, "measured", len(e), of=measured.size)
            record(label, "rms", np.sqrt((e**2).mean()), "px")
            record(label, "rms ÷ bound", ratio)
            record(label, "predicted ÷ empirical", predicted)
            print(
                f"{('large ' if big else 'small ') + name:<16} {len(e):>6} {PAPER[name, big]:>9.3f} "
                f"{rms[0]:>7.4f}/{rms[1]:.4f} {rms[0] / least[0]:>8.3f}/{rms[1] / least[1]:.3f} "
                f"{ratio:>6.3f} {predicted:>20.3f} {bias[0]:>10.2f}/{bias[1]:.2f} {coarse:>16.1f}  "
                f"{'ok' if good else 'MISSED'}"
            )
    return kept


def counts(label: str, done: list[Recording]) -> bool:
    """Print numbers of targets found and misclassified."""
    wrong = sum(misread(r, contours=True) for r in done)
    expected = [r.truth for r in done]
    inside = sum(int((CENTRAL & ((t.xy > 8) & (t.xy < 231)).all(axis=1)).sum()) for t in expected)
    measured = sum(int((r.result.ok & CENTRAL).sum()) for r in done)
    every = sum(r.result.found for r in done)
    misnumbered = sum(int((np.hypot(*r.error.T) > 1.0).sum()) for r in done)
    record(label, "measured", measured, of=inside)
    record(label, "misclassified in their cluster", int(wrong[1]))
    record(label, "misnumbered", misnumbered)
    off = np.concatenate([lines(r) for r in done])
    worst = max(float(np.sqrt((lines(r) ** 2).mean())) for r in done)
    print(f"\n{label}: {len(done)} recordings")
    print(f"  lines: rms {np.sqrt((off**2).mean()):.4f} px from the truth, worst recording {worst:.4f} px")
    print(f"  central targets in the frames {inside}, measured {measured}; targets measured in total {every}")
    print(
        f"  misclassified: alone {wrong[0]}, in their cluster {wrong[1]} (by contours {wrong[2]}); "
        f"misnumbered {misnumbered}"
    )
    return worst <= 0.03 and wrong[1] == 0 and misnumbered == 0


def keep(done: list[Recording]) -> None:
    """Record what is recorded of images of independent origin, too; each value is that of one recording."""
    ratios, what = [], "coded testfield"
    for r in done:
        of = r.result.ok & CENTRAL
        # What formation by other programs may add is not in pictures of the own simulator.
        variance = np.diagonal(r.result.cov[of], axis1=1, axis2=2) - FORMED_PX**2
        ratios.append(np.sqrt((r.error[of] ** 2 / variance).mean()))
    measured = sum(int((r.result.ok & CENTRAL).sum()) for r in done)
    record(what, "simulator, found", measured, of=int(CENTRAL.sum()) * len(done), table=ORIGIN)
    record(what, "simulator, errors ÷ sigmas", ratios, table=ORIGIN)


def timed(frame: Frame) -> tuple[float, float]:
    """Processor and wall time for one image (s)."""
    cpu, clock = time.process_time(), time.perf_counter()
    measure(frame)
    return time.process_time() - cpu, time.perf_counter() - clock


def speed(done: list[Recording], jobs: int) -> None:
    """Print the time for one image and for all, on one core and on several."""
    frames = [r.frame for r in done]
    for frame in frames[:3]:
        measure(frame)
    clock = time.perf_counter()
    cpu, wall = np.array([timed(frame) for frame in frames]).T
    total = time.perf_counter() - clock
    print(
        f"\none image: processor median {np.median(cpu) * 1e3:.0f} ms, least {cpu.min() * 1e3:.0f} ms; "
        f"wall median {np.median(wall) * 1e3:.0f} ms, least {wall.min() * 1e3:.0f} ms"
    )
    print(f"{len(frames)} images on one core: processor {cpu.sum():.2f} s, wall {total:.2f} s")
    with Processes(jobs) as executor:
        list(outcomes(executor, timed, frames[: 4 * jobs]))  # the workers have started
        clock = time.perf_counter()
        cpu, _ = np.array(list(outcomes(executor, timed, frames))).T
        total = time.perf_counter() - clock
    print(f"{len(frames)} images on {jobs} cores: processor {cpu.sum():.2f} s, wall {total:.2f} s")


def freed(seeds: int, conditions: list[str]) -> bool:
    """Print what is found, errors and sigmas for each of the conditions `FREED`."""
    print(f"{'condition':28} {'measured':>13}  rms     worst px, sigma  wrong  error/sigma")
    kept = True
    for name in conditions:
        changes = dict(FREED[name])
        stated = changes.pop("stated", None)
        parts, found, inside = [], 0, 0
        for seed in range(seeds):
            sensor = replace(FieldBench().sensor, row_jitter_px=0.0)
            bench = FieldBench(seed=seed, sensor=sensor, **changes)
            for station in (Station(0.0), Station(30.0, 90.0, 90.0), Station(45.0, 180.0, 270.0)):
                truth = bench.truth(station)
                frame = replace(bench.record(station), curve=stated)
                result = measure_testfield(frame, DESIGN, TestfieldOptions(fill=0.8))
                clear = bench.inside(truth, 8.0)
                for stain in bench.stains if name == "fingers" else ():
                    a, b = np.array([stain.x, stain.y]), np.array(stain.end)
                    part = np.clip((truth.xy - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
                    clear &= np.hypot(*(truth.xy - a - part[:, None] * (b - a)).T) > stain.radius + 8
                inside += int(clear.sum())
                if not result:
                    print(f"{name:28} {station.name}: {result.reason}")
                    continue
                sigma = np.sqrt(np.diagonal(result.cov, axis1=1, axis2=2))[result.ok]
                parts.append(np.stack([(result.xy - truth.xy)[result.ok], sigma]))
                found += int((result.ok & clear).sum())
        if not parts:
            kept = False
            continue
        error, sigma = np.concatenate(parts, axis=1)
        off, scaled = np.hypot(*error.T), np.abs(error / sigma).max(axis=1)
        wrong = int(((off > 0.15) & (scaled > 5)).sum())
        ratio = float(np.sqrt(((error / sigma) ** 2).mean()))
        low, high = (0.7, 1.25) if name in ROUGH else (0.85, 1.2)
        good = found >= 0.95 * inside and wrong == 0 and low <= ratio <= high
        kept &= good
        print(
            f"{name:28} {found:5} of {inside:4}  {np.sqrt((error**2).mean()):.4f}  {off.max():.3f}  "
            f"{scaled.max():5.1f}      {wrong:5}  {ratio:11.2f}  {'ok' if good else 'MISSED'}",
            flush=True,
        )
    return kept


def megapixel() -> None:
    """Print the processor time for a picture of one megapixel with 1000 targets, of independent formation."""
    camera = replace(OPENCV, fx=1260.0, fy=1262.0, cx=578.8, cy=426.1, width=1154, height=868)
    pose = Pose.towards(25.0, 40.0, 10.0, 1700.0, (0.0, 0.0))
    pixels, xy = picture(json.loads(DESIGN.to_json()), camera, pose, seed=1)
    frame = Frame(pixels.astype(np.uint8), 255.0)
    found, seconds = measure_testfield(frame, DESIGN), []
    if not found:
        print(f"{frame.width} x {frame.height} pixels: {found.reason}")
        return
    for _ in range(9):
        start = time.process_time()
        measure_testfield(frame, DESIGN)
        seconds.append(time.process_time() - start)
    error = (found.xy - xy)[found.ok]
    print(
        f"{frame.width} x {frame.height} pixels, {found.found} targets, "
        f"rms {np.sqrt((error**2).mean()):.4f} px: "
        f"processor time median {np.median(seconds) * 1e3:.0f} ms, least {min(seconds) * 1e3:.0f} ms"
    )


def first_pictures() -> None:
    """Print the processor time for the first picture of this process, and for those after it."""
    bench = FieldBench(seed=0)
    frames = [bench.record(station) for station in paper_stations()[::6]]
    first, _ = timed(frames[0])
    cpu = [min(timed(frame)[0] for _ in range(3)) for frame in frames]
    print(
        f"240 x 240 pixels, processor time: first picture after import {first * 1e3:.0f} ms, "
        f"then median {np.median(cpu) * 1e3:.0f} ms, least {min(cpu) * 1e3:.0f} ms"
    )


def small() -> bool:
    """Print what is found of fields that are small in the frame."""
    good = True
    for times in (1.4, 1.8, 2.2, 2.6):
        bench, station = FieldBench(seed=3, distance_mm=times * DISTANCE_MM), Station(30)
        truth, found = bench.truth(station).xy, measure(bench.record(station))
        wide, high = np.ptp(truth, axis=0)
        if not found:
            print(f"field of {wide:.0f} x {high:.0f} px: {found.reason}")
            good &= wide < 150
            continue
        error = (found.xy - truth)[found.ok]
        scaled = error / np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))[found.ok]
        print(
            f"field of {wide:.0f} x {high:.0f} px: {found.found} of {len(truth)} targets, "
            f"rms {np.sqrt((error**2).mean()):.4f} px, error/sigma {np.sqrt((scaled**2).mean()):.2f}"
        )
    return good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1, help="sets of recordings")
    parser.add_argument("--jobs", type=int, default=2, help="processes that are timed")
    parser.add_argument("--condition", nargs="+", default=list(FREED), help="only these, with --freed")
    parser.add_argument("--freed", action="store_true", help="only photographs of freer formation")
    parser.add_argument("--speed", action="store_true", help="only the first picture, and those after it")
    parser.add_argument("--small", action="store_true", help="only fields that are small in the frame")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.speed:
        first_pictures()
        megapixel()
        return 0
    if arguments.small:
        return 0 if small() else 1
    if arguments.freed:
        return 0 if freed(arguments.seeds, arguments.condition) else 1
    fields = of_the_tests("measure/fields.py")
    paper = [r for seed in range(arguments.seeds) for r in recordings(fields, seed, (0.0, 30.0, 45.0))]
    steep = [r for seed in range(arguments.seeds) for r in recordings(fields, seed, (60.0,))]
    kept = [counts("φ = 0, 30, 45°", paper), counts("φ = 60°", steep)]
    kept.append(table(paper))
    print("\nφ = 60°:", end="")
    kept.append(table(steep))
    keep(paper + steep)
    speed(paper[:36], arguments.jobs)
    return 0 if all(kept) else 1


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
