"""Pins in real B-mode frames compared with PLUS: wires found, differences in pixels, and deviations in mm.

Run from the checkout: ``python benchmarks/pins.py [DATA] [--overlay DIR] [--jobs N]``. DATA contains the
folder ultrasound_nwire; the default is $RESEAU_DATA or ../shared/data. PLUS computes a centroid, we the
middle of the line: for an echo with a tail (a reverberation below it), the two differ by the weight of the
tail.

In the frames of DATA/independent/pins designs are laid over the echoes: four parallel wires, and with two
slanted ones between them. Few wires prove little; they are right within 3 px, or declined.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes, timed

from reseau.core.data import Array, Frame, ImagePoints
from reseau.core.failure import Failure
from reseau.execution import Executor
from reseau.io import ReseauDesign
from reseau.io.images import read_image, write_image
from reseau.measure import PinDetections, find_pins, measure_pins
from reseau.measure.fitting import fit_mapping
from reseau.measure.pins.detection import PinOptions
from reseau.measure.pins.wires import Wires, lay_wires
from reseau.optics import RationalPolynomial

SAME_PX = 10.0
"""Largest distance between a reflector and the same wire of PLUS; wires are at least 50 px apart."""
LIMITS_PX = np.array([1.5, 0.7])
MOST_FURTHER = 2
WITHIN_PX = 3.0
TOLERANCE_MM = 0.25
PLUS_MM = "0.48 ± 0.23"


@dataclass
class Tally:
    """Totals over the frames of a sequence."""

    wires: int = 0
    missed: list[str] = field(default_factory=list)
    deviation: list[Array] = field(default_factory=list)
    centroid: list[Array] = field(default_factory=list)
    sigma: list[Array] = field(default_factory=list)
    further: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    numbered: int = 0
    wrong: int = 0
    residual_mm: dict[str, list[Array]] = field(default_factory=dict)
    askew_mm: list[float] = field(default_factory=list)


def rms(values: list[Array]) -> Array:
    return np.sqrt(np.mean(np.square(values), axis=0))


def compare(name: str, seen: PinDetections, wires: Array, candidates: Array, tally: Tally) -> None:
    """Add one frame to the tally."""
    xy = seen.xy[seen.ok]
    tally.wires += len(wires)
    for wire in wires:
        distance = np.hypot(*(xy - wire).T) if len(xy) else np.array([np.inf])
        nearest = int(distance.argmin())
        if distance[nearest] > SAME_PX:
            k = int(np.hypot(*(seen.xy - wire).T).argmin())
            tally.missed.append(f"{name} ({wire[0]:.0f}, {wire[1]:.0f}): {seen.why[k]}")
            continue
        tally.deviation.append(xy[nearest] - wire)
        tally.centroid.append(seen.centroid[seen.ok][nearest] - wire)
        tally.sigma.append(seen.points.sigma[nearest])
    known = np.concatenate([wires.reshape(-1, 2), candidates.reshape(-1, 2)])
    apart = np.hypot(*np.moveaxis(xy[:, None] - known[None], -1, 0))
    tally.further.append(int((apart.min(axis=1, initial=np.inf) > SAME_PX).sum()))


def number(seen: PinDetections, reference: dict[str, Any], phantom: dict[str, Any], tally: Tally) -> None:
    """Identify the wires of the phantom, and map the parallel ones to its millimetres by an affinity."""
    ids = tuple(phantom)
    ends = np.array([phantom[name] for name in ids], dtype=float)
    wires = Wires(ids, ends[:, 0][:, [0, 2]], ends[:, 1][:, [0, 2]])  # the plane across the wires
    points = seen.points
    layout = lay_wires(wires, points.xy)
    if not layout:
        tally.wrong += len(ids)
        return
    for name, row in zip(ids, layout.row, strict=True):
        right = row >= 0 and np.hypot(*(points.xy[row] - reference[name])) < SAME_PX
        tally.numbered += int(right)
        tally.wrong += int(row >= 0 and not right)
    parallel = np.flatnonzero(wires.fixed & (layout.row >= 0))
    rows = layout.row[parallel]
    chosen = ImagePoints(tuple(ids[i] for i in parallel), points.xy[rows], points.cov[rows])
    inverse = np.linalg.inv(layout.matrix)
    for kind, start in (
        ("affine", RationalPolynomial.affine()),
        ("similarity", RationalPolynomial.similarity()),
    ):
        first = linear(start, inverse, -inverse @ layout.shift)
        fit = fit_mapping(first, chosen, wires.start[parallel], TOLERANCE_MM)
        if not fit:
            raise SystemExit(f"{seen.image}: {kind}: {fit.reason}")
        mapping = first.with_values(fit.values)
        tally.residual_mm.setdefault(kind, []).extend(mapping(chosen.xy) - wires.start[parallel])
        if kind == "affine":
            # Of a slanted wire only the depth is known, and that it lies between its ends.
            askew = np.flatnonzero(~wires.fixed & (layout.row >= 0))
            at = mapping(points.xy[layout.row[askew]])
            tally.askew_mm.extend(at[:, 1] - wires.start[askew, 1])


def linear(model: RationalPolynomial, matrix: Array, shift: Array) -> RationalPolynomial:
    """The model closest to a linear map, as approximate values."""
    grid = np.array([[0.0, 0.0], [500.0, 0.0], [0.0, 500.0], [500.0, 500.0]])
    design = model.derivatives(grid).d_parameters.reshape(8, -1)
    values = np.linalg.lstsq(design, (grid @ matrix.T + shift).ravel(), rcond=None)[0]
    return model.with_values(values)


def picture(frame: Frame, seen: PinDetections, wires: Array) -> Array:
    """The frame, three times as large, with the middle line of every arc; PLUS's wires as circles."""
    zoom = 3
    stretched = 255 * np.sqrt(np.clip(frame.pixels / frame.full_scale, 0, 1))
    large = cv2.resize(stretched.astype(np.uint8), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    canvas = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)

    def place(xy: Array) -> Array:
        return np.rint((xy + 0.5) * zoom - 0.5).astype(np.int32)

    for k in range(len(seen)):
        colour = (80, 220, 80) if seen.ok[k] else (230, 60, 60)
        cv2.drawMarker(canvas, place(seen.xy[k]).tolist(), colour, cv2.MARKER_TILTED_CROSS, 9, 1)
        if not np.isfinite(seen.length[k]):
            continue
        u = np.linspace(-0.5, 0.5, 33) * seen.length[k]
        v = 0.5 * seen.curvature[k] * u**2
        c, s = np.cos(seen.tilt[k]), np.sin(seen.tilt[k])
        line = seen.xy[k] + np.stack([c * u - s * v, s * u + c * v], axis=1)
        cv2.polylines(canvas, [place(line)], False, colour, 1, cv2.LINE_AA)
    for wire in wires:
        cv2.circle(canvas, place(wire).tolist(), 3, (255, 190, 0), 1, cv2.LINE_AA)
    return canvas


def seen_in(folder: Path, names: list[str], others: int, k: int) -> tuple[PinDetections, float]:
    """What is found in a frame of a sequence, and the processor time (s)."""
    apart = [names[(k + step * len(names) // (others + 1)) % len(names)] for step in range(1, others + 1)]
    frames = tuple(read_image(folder / each) for each in apart)
    return timed(partial(find_pins, read_image(folder / names[k]), others=frames), "pins")


def sequence(executor: Executor, folder: Path, name: str, overlay: Path | None, others: int) -> Tally:
    """Measure all frames of a sequence."""
    reference = json.loads((folder / f"{name}.reference.json").read_text("utf-8"))
    tally = Tally()
    names = [each["image"] for each in reference["frames"]]
    done = outcomes(executor, partial(seen_in, folder.resolve(), names, others), range(len(names)))
    for k, (each, (seen, seconds)) in enumerate(zip(reference["frames"], done, strict=True)):
        tally.seconds.append(seconds)
        points = each["points"]
        wires = np.array(list(points.values()) if isinstance(points, dict) else points, float).reshape(-1, 2)
        candidates = np.array(each.get("candidates", []), float).reshape(-1, 3)[:, :2]
        compare(each["image"], seen, wires, candidates, tally)
        if "phantom_wires" in reference:
            number(seen, points, reference["phantom_wires"], tally)
        if overlay is not None and k == len(names) // 3:
            write_image(overlay / f"{name}.png", picture(read_image(folder / names[k]), seen, wires))
    return tally


def report(name: str, tally: Tally) -> None:
    """Print the totals of a sequence."""
    away, centre, sigma = rms(tally.deviation), rms(tally.centroid), np.median(tally.sigma, axis=0)
    print(
        f"{name:20} {len(tally.seconds):6} {len(tally.deviation):4}/{tally.wires:<4}"
        f" {away[0]:6.2f} {away[1]:5.2f}   {centre[0]:6.2f} {centre[1]:5.2f}"
        f"   {sigma[0]:6.3f} {sigma[1]:5.3f}"
        f" {max(tally.further):8} {sum(tally.further):6} {np.mean(tally.seconds):8.2f}"
    )
    record(name, "found", len(tally.deviation), of=tally.wires)
    for axis in (0, 1):
        record(name, f"from PLUS in {'xy'[axis]}, rms", away[axis], "px")
    record(name, "processor time", tally.seconds, "s")
    for line in tally.missed:
        print(f"    missed: {line}")
    if not tally.residual_mm:
        return
    print(f"    numbered as PLUS numbers them: {tally.numbered} of {tally.wires}, otherwise: {tally.wrong}")
    for kind, residuals in tally.residual_mm.items():
        length = np.hypot(*np.array(residuals).T)
        print(
            f"    parallel wires, {kind} of each frame: reprojection"
            f" {length.mean():.2f} ± {length.std():.2f} mm"
            f" (PLUS, in space, one calibration for all frames: {PLUS_MM} mm)"
        )
    depth = np.array(tally.askew_mm)
    print(f"    slanted wires, used in no fit: depth rms {np.sqrt((depth**2).mean()):.2f} mm")


def laid_over(folder: Path, job: tuple[str, ReseauDesign, PinOptions]) -> ImagePoints | None:
    """The points of a design that is laid over the echoes of a frame; nothing if it is declined."""
    found = measure_pins(read_image(folder / job[0]), *job[1:])
    if isinstance(found, Failure):
        return None
    return ImagePoints(tuple(np.array(found.ids)[found.ok].tolist()), found.xy[found.ok], found.cov[found.ok])


def laid(executor: Executor, folder: Path) -> int:
    """Lay two designs over the echoes of each frame, with what a user may know; number of wrong answers."""
    reference = json.loads((folder / "reference.json").read_text("utf-8"))
    parallel = json.loads((folder / "wires.design.json").read_text("utf-8"))
    at = {point["id"]: (point["x"], point["y"]) for point in parallel["points"]}
    between = [{"id": f"N{k}", "x": at[f"L{k}"][0], "y": at[f"L{k}"][1], "end": at[f"R{k}"]} for k in (1, 2)]
    slanted = parallel | {"points": parallel["points"] + between}
    designs = [ReseauDesign.parse(json.dumps(each), where="wires") for each in (parallel, slanted)]
    known = (PinOptions(), PinOptions(mirrored=False), PinOptions(mirrored=False, max_rotation_deg=30))
    jobs = [
        (each["image"], design, options)
        for each in reference["frames"]
        for design in designs
        for options in known
    ]
    true = {
        each["image"]: dict(zip(("R1", "N1", "L1", "R2", "N2", "L2"), np.array(each["points"]), strict=True))
        for each in reference["frames"]
    }
    wrong = 0
    print(f"\n{'frame':30} {'wires':>5}  {'mirrored':8} {'rotation':>8}  largest difference from PLUS, px")
    done = outcomes(executor, partial(laid_over, folder.resolve()), jobs)
    for (name, design, options), found in zip(jobs, done, strict=True):
        print(f"{name:30} {len(design.ids):5}  {options.mirrored!s:8}", end="")
        print(f" {options.max_rotation_deg:8.0f}  ", end="")
        if found is None:
            print("declined")
            continue
        off = max(
            np.hypot(*(xy - true[name][point])) for point, xy in zip(found.names, found.xy, strict=True)
        )
        wrong += int(off > WITHIN_PX)
        print(f"{off:.1f}{' WRONG' if off > WITHIN_PX else ''}")
    record("designs of four and six wires", "wrong", wrong)
    return wrong


def main() -> None:
    """Print the table; exit status 1 if a value exceeds its limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(os.environ.get("RESEAU_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    parser.add_argument("data", nargs="?", type=Path, default=default)
    parser.add_argument("--laid", action="store_true", help="designs of few wires only")
    parser.add_argument("--overlay", type=Path, help="folder for one picture of each sequence")
    parser.add_argument("--others", type=int, default=0, help="further frames that show what stands still")
    add_options(parser)
    arguments = parser.parse_args()
    with executor_of(arguments) as executor:
        raise SystemExit(0 if held(executor, arguments) else 1)


def held(executor: Executor, arguments: argparse.Namespace) -> bool:
    """Print the tables; whether all values are within their limits."""
    of_few = arguments.data / "independent" / "pins"
    if arguments.laid:
        return not laid(executor, of_few)
    folder = arguments.data / "ultrasound_nwire"
    names = sorted(path.name.removesuffix(".reference.json") for path in folder.glob("*.reference.json"))
    if not names:
        raise SystemExit(f"no reference data in {folder}; set RESEAU_DATA")
    if arguments.overlay is not None:
        arguments.overlay.mkdir(parents=True, exist_ok=True)
    print(
        f"{'':20} {'':6} {'':9} {'ours − PLUS':>12}   {'centroid':>12}   {'own sigma':>12} {'reflectors':>15}"
    )
    print(
        f"{'sequence':20} {'frames':>6} {'found':>9}"
        f" {'x':>6} {'y':>5}   {'x':>6} {'y':>5}   {'x':>6} {'y':>5}"
        f" {'most':>8} {'all':>6} {'s/frame':>8}"
    )
    tallies = [sequence(executor, folder, name, arguments.overlay, arguments.others) for name in names]
    for name, tally in zip(names, tallies, strict=True):
        report(name, tally)
    away = rms([deviation for tally in tallies for deviation in tally.deviation])
    missed, wrong = (sum(len(t.missed) for t in tallies), sum(t.wrong for t in tallies))
    further = max(max(t.further) for t in tallies)
    astray = laid(executor, of_few)
    within = (
        not astray
        and bool((away <= LIMITS_PX).all())
        and not missed
        and not wrong
        and further <= MOST_FURTHER
    )
    print(
        f"over all: rms {away[0]:.2f} px in x (limit {LIMITS_PX[0]}), {away[1]:.2f} px in y"
        f" (limit {LIMITS_PX[1]});"
        f" {missed} missed, {wrong} misnumbered, at most {further} further reflectors a frame (limit"
        f" {MOST_FURTHER}): {'held' if within else 'NOT HELD'}"
    )
    wires = sum(t.wires for t in tallies)
    record(
        "wires in B-mode frames, beside PLUS", "independent, found", wires - missed, of=wires, table=ORIGIN
    )
    return within


if __name__ == "__main__":
    main_of(__file__)
