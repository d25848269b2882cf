"""Photographs of a sheet of disks with coded rings: measured coordinates compared with another program.

Run from the checkout: ``python benchmarks/camcal.py [DATA] [--channel luma]``. The photographs are read from
DATA/testfield_camcal, by default in $RESEAU_DATA or ../shared/data. The other program measures centres of
ellipses; we measure the image of a disk's centre, which differs in perspective. The table shows the
difference to both.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
from parts import add_options, executor_of, main_of, outcomes
from shared import of_the_tests

from reseau.bundle import Network, adjust_network
from reseau.core.data import Array, Frame
from reseau.io import ReseauDesign
from reseau.io.images import Channel, read_image
from reseau.io.network import Network1
from reseau.measure import measure_reseau
from reseau.measure.reseau.measure import ReseauResult
from reseau.optics.formation import Outline

_LIMIT_PX = 0.03
_MISNUMBERED_PX = 5.0
EXTRA = (("P8250026.JPG", "95"), ("P8250030.JPG", "80"))
"""Marks measured by us but not by the other program, in the green channel."""


@dataclass(frozen=True)
class Photograph:
    """One photograph, our measurement, and that of others (n, 2), NaN where missing."""

    name: str
    result: ReseauResult
    theirs: Array
    ellipse: Array
    centroid: Array
    wall: float

    def off(self, ours: Array) -> Array:
        """Differences (n, 2) to the other program, without misnumbered marks."""
        difference = ours - self.theirs
        return np.where(np.hypot(*difference.T)[:, None] < _MISNUMBERED_PX, difference, np.nan)


def measure(design: ReseauDesign, channel: Channel, job: tuple[Path, dict[str, Array]]) -> Photograph:
    path, theirs = job
    cv2.setNumThreads(1)
    frame = read_image(path, channel)
    start = time.perf_counter()
    result = measure_reseau(frame, design)
    wall = time.perf_counter() - start
    if not result:
        raise SystemExit(result.reason)
    # Their origin is the corner of a pixel, ours its centre.
    marks = np.array([theirs.get(name, np.full(2, np.nan)) for name in design.ids]) - 0.5
    shift, radius = ellipses(result, design)
    centre = centroids(read_image(path), result.xy + shift, radius)
    return Photograph(path.name, result, marks, result.xy + shift, centre, wall)


def ellipses(result: ReseauResult, design: ReseauDesign) -> tuple[Array, Array]:
    """Centre of each image relative to the image of the centre (n, 2), and its radius in pixels."""
    assert design.mark.size is not None
    pitch = of_the_tests("measure/camcal.py").PITCH
    circle = Outline.circle(design.mark.size / 2, design.mark.size / 20)
    shift, radius = np.full((len(design.ids), 2), np.nan), np.full(len(design.ids), np.nan)
    for k in np.flatnonzero(result.ok):
        gap = np.abs(design.xy - design.xy[k]).max(axis=1)
        near = np.flatnonzero((gap < 2.5 * pitch) & result.ok)
        if len(near) < 6:
            continue
        # A projectivity of the neighbours: over so short a distance, lens distortion has no effect.
        h, _ = cv2.findHomography(design.xy[near] - design.xy[k], result.xy[near])
        if h is None:
            continue
        nodes = cv2.perspectiveTransform(circle.xy[None], h)[0].astype(np.float64)
        middle = cv2.perspectiveTransform(np.zeros((1, 1, 2)), h)[0, 0]
        after = np.roll(nodes, -1, axis=0)
        cross = nodes[:, 0] * after[:, 1] - nodes[:, 1] * after[:, 0]
        shift[k] = ((nodes + after) * cross[:, None]).sum(axis=0) / (3 * cross.sum()) - middle
        radius[k] = np.sqrt(abs(cross.sum()) / 2 / np.pi)
    return np.nan_to_num(shift), np.nan_to_num(radius, nan=float(np.nanmedian(radius)))


def centroids(frame: Frame, start: Array, radius: Array) -> Array:
    """Plain centroids (n, 2) of the grey values in a window around each disk."""
    grey, found = frame.pixels.astype(np.float64), np.full(start.shape, np.nan)
    for k in np.flatnonzero(np.isfinite(start[:, 0])):
        half = int(np.ceil(1.4 * radius[k] + 4))
        x, y = np.rint(start[k]).astype(int)
        if min(x, y) < half or x >= frame.width - half or y >= frame.height - half:
            continue
        patch = grey[y - half : y + half + 1, x - half : x + half + 1]
        low, high = np.percentile(patch, [2, 85])
        weight = np.clip((high - patch) / (high - low) - 0.1, 0, None)
        _, part = cv2.connectedComponents((weight > 0.05).astype(np.uint8))
        weight = weight * (part == part[half, half])
        v, u = np.mgrid[-half : half + 1, -half : half + 1]
        found[k] = np.array([x, y]) + np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
    return found


def spread(off: Array) -> Array:
    """Median absolute deviation per axis, as a standard deviation."""
    return np.asarray(1.4826 * np.nanmedian(np.abs(off - np.nanmedian(off, axis=0)), axis=0))


def table(done: list[Photograph]) -> None:
    """A row for each photograph: counts, and medians of the differences after one common shift for all."""
    kinds = [
        [p.off(xy) for p, xy in each]
        for each in (
            [(p, p.result.xy) for p in done],
            [(p, p.ellipse) for p in done],
            [(p, p.centroid) for p in done],
        )
    ]
    common = [np.nanmedian(np.concatenate(kind), axis=0) for kind in kinds]
    print(
        f"{'photograph':<14} {'theirs':>6} {'measured':>8} {'more':>4} {'wrong':>5} "
        f"{'centre median x/y':>18} {'MAD':>11} {'ellipse median':>15} {'MAD':>11} {'centroid median':>16} "
        f"{'MAD':>11} {'s':>4}"
    )
    for k, p in enumerate(done):
        has = np.isfinite(p.theirs[:, 0])
        wrong = np.hypot(*(p.result.xy - p.theirs).T) > _MISNUMBERED_PX
        columns = [
            f"{m[0]:>7.3f}/{m[1]:>6.3f} {s[0]:.3f}/{s[1]:.3f}"
            for kind, shift in zip(kinds, common, strict=True)
            for m, s in [(np.nanmedian(kind[k], axis=0) - shift, spread(kind[k]))]
        ]
        print(
            f"{p.name:<14} {has.sum():>6} {(p.result.ok & has).sum():>8} {(p.result.ok & ~has).sum():>4} "
            f"{wrong.sum():>5}   {'  '.join(columns)} {p.wall:>5.1f}"
        )
        for row in np.flatnonzero(has & ~p.result.ok):
            print(f"  {p.result.ids[row]}: {p.result.why[row]}")
    for name, kind, shift in zip(("centre", "ellipse", "centroid"), kinds, common, strict=True):
        summary(name, kind, shift, done)


def summary(name: str, kind: list[Array], shift: Array, done: list[Photograph]) -> None:
    """All photographs together: one common shift, then also a common scale about the middle."""
    off = np.concatenate(kind)
    medians = np.array([np.nanmedian(each, axis=0) - shift for each in kind])
    away = np.concatenate([p.theirs for p in done]) - np.array([1135.5, 851.5])
    known = np.isfinite(off[:, 0])
    scale = np.array([np.polyfit(away[known, axis], off[known, axis], 1)[0] for axis in (0, 1)])
    rest = [each - scale * (p.theirs - np.array([1135.5, 851.5])) for each, p in zip(kind, done, strict=True)]
    centre = np.nanmedian(np.concatenate(rest), axis=0)
    after = np.array([np.nanmedian(each, axis=0) - centre for each in rest])
    print(
        f"{name:<9} rms {np.nanstd(off):.3f} px, common shift {shift[0]:.3f}/{shift[1]:.3f}; medians within "
        f"{_LIMIT_PX} px in {(np.abs(medians) <= _LIMIT_PX).all(axis=1).sum()} of {len(done)}, largest "
        f"{np.abs(medians).max():.3f}; with a common scale of {1e6 * scale[0]:.0f}/{1e6 * scale[1]:.0f} ppm: "
        f"{(np.abs(after) <= _LIMIT_PX).all(axis=1).sum()}, largest {np.abs(after).max():.3f}"
    )


def bundles(done: list[Photograph], network: Path) -> None:
    """The same bundle adjustment with their image coordinates and with ours."""
    for name in ("theirs", "centre", "ellipse"):
        content = json.loads(network.read_text())
        at = content["observations"]
        for row, (image, point) in enumerate(zip(at["image"], at["point"], strict=True)):
            p = done[int(image) - 1]
            k = p.result.ids.index(point)
            ours = p.result.xy if name == "centre" else p.ellipse
            if name != "theirs" and p.result.ok[k]:
                at["x"][row], at["y"][row] = (float(value) for value in ours[k])
        result = adjust_network(Network.from_document(Network1.parse(json.dumps(content), where=network)))
        if not result:
            print(f"bundle, {name}: {result.reason}")
            continue
        print(
            f"bundle, {name:<8} sigma0 {result.sigma0:.4f} of 0.1 px, redundancy {result.redundancy}, "
            f"camera constant {result.camera_columns(0)[2][0]:.4f} mm"
        )


def command(paths: list[Path], camcal: ModuleType, folder: Path) -> None:
    """`reseau calibrate` from the pixels, with the marks and the redundancy of the published network."""
    theirs = dict(zip((path.name for path in paths), camcal.marks(folder), strict=True))
    with tempfile.TemporaryDirectory() as name:
        design, control, out = (Path(name) / file for file in ("design.json", "control.csv", "camera.json"))
        camcal.design(folder).write(design)
        known = [line.split(",") for line in (folder / "camcal-fixed.txt").read_text().splitlines()]
        rows = [",".join((words[0], *words[2:5])) for words in known if words[0].isdigit()]
        control.write_text("id,x,y,z\n" + "\n".join(rows) + "\n")
        words = [
            sys.executable, "-c", "from reseau.cli import main; main()", "calibrate", *paths,
            "--design", design, "--control", control, "--pitch-mm", "0.0031911032863849768",
            "--side", "image", "--free", "c,x0,y0,K1,K2,K3,P1,P2",
            "--sigma-px", "0.1", "--channel", "green", "-o", out, "--report", Path(name) / "report.html",
        ]  # fmt: skip
        for mark in EXTRA:
            assert mark[1] not in theirs[mark[0]]
            words += ["--leave-out", ":".join(mark)]
        for jobs in ("2", "1"):
            before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            subprocess.run([*words, "--jobs", jobs], check=True, capture_output=True)
            wall, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
            spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            cpu = "" if jobs == "2" else f", {spent:.1f} s of CPU"
            print(f"reseau calibrate with {jobs} processes: {wall:.1f} s{cpu}")
        found = json.loads(out.read_text())
    c = found["parameters"]["c"]
    print(
        f"its sigma0 {found['sigma0']:.4f} of 0.1 px (published 1.6890), redundancy {found['redundancy']} "
        f"(published 3726), camera constant {c['value']:.4f} ± {c['sigma']:.5f} mm"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", default=os.environ.get("RESEAU_DATA", "../shared/data"), type=Path)
    parser.add_argument("--channel", choices=["luma", "red", "green", "blue"], default="green")
    add_options(parser)
    arguments = parser.parse_args()
    folder = arguments.data / "testfield_camcal"
    if not folder.is_dir():
        raise SystemExit(f"no photographs in {folder}")
    camcal = of_the_tests("measure/camcal.py")
    paths, theirs, design = camcal.photographs(folder), camcal.marks(folder), camcal.design(folder)
    with executor_of(arguments) as executor:
        jobs = zip(paths, theirs, strict=True)
        done = list(outcomes(executor, partial(measure, design, arguments.channel), jobs))
    table(done)
    has = [np.isfinite(p.theirs[:, 0]) for p in done]
    measured = sum(int((p.result.ok & h).sum()) for p, h in zip(done, has, strict=True))
    wrong = sum(int((np.hypot(*(p.result.xy - p.theirs).T) > _MISNUMBERED_PX).sum()) for p in done)
    print(
        f"{measured} of {sum(int(h.sum()) for h in has)} measured, {wrong} misnumbered, {arguments.channel}"
    )
    bundles(done, arguments.data / "networks" / "camcal.network.json")
    command(paths, camcal, folder)
    return 0 if wrong == 0 else 1


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
