"""Scans of film frames: oriented in parallel or on a cluster, written to a folder, continued after a stop."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..archive.objects import objects_at
from ..core import vocabulary as v
from ..core.data import Array
from ..core.errors import EstimationError, ReseauError, UsageError
from ..core.failure import Failure
from ..core.files import made_folder, readable
from ..core.provenance import Provenance, canonical_json, sha256_of
from ..execution import Executor
from ..io import FrameCorners, FrameOrientation, write_whole
from ..io.frame import FrameOutcome, RollSummary
from ..io.images import open_scan, write_image
from ..measure.film.curves import CurveEvidence, curves_of_roll, curves_of_scan
from ..measure.film.roll import Roll, corner_files, result_of, rolls_of
from ..procedures.film_frame import FrameOptions, FrameResult, orient_scan, orientation_of, reorient_scan
from ..report.frames import contact_sheet, frame_tile, roll_page, scan_overlay, write_cut, write_marked


@dataclass(frozen=True)
class ScanJob:
    """One scan and its options, for another process."""

    image: Path
    name: str
    format_mm: v.FormatMm | None = None
    dpi: v.Dpi | None = None
    near: tuple[float, float, float, float] | None = None
    corners: v.Corners | None = None
    transform: v.Transform = "affine"
    out: v.Out | None = None
    marked: bool = True
    cut: bool = False
    overlay: v.Overlay | None = None
    rolls: tuple[Roll, ...] = ()
    curves: Array | None = None


@dataclass(frozen=True)
class ScanOutcome:
    """Result of one scan, and what it shows of its curve; whether it is that of an earlier run; files that
    another machine has made, by their SHA-256 in the store."""

    documents: list[FrameOrientation]
    results: list[FrameResult]
    failed: str = ""
    curves: CurveEvidence | None = None
    kept: bool = False
    notes: tuple[str, ...] = ()
    files: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class OrientedFiles:
    """Scans that were oriented, in the order of the files."""

    jobs: tuple[ScanJob, ...]
    outcomes: tuple[ScanOutcome, ...]
    rolls: tuple[Roll, ...]
    summary: RollSummary | None

    @property
    def documents(self) -> list[FrameOrientation]:
        """The frames of all scans."""
        return [document for each in self.outcomes for document in each.documents]

    @property
    def failed(self) -> list[str]:
        """Why scans could not be read or written."""
        return [each.failed for each in self.outcomes if each.failed]


def scan_jobs(
    images: list[Path], out: Path | None = None, overlays: dict[Path, Path] | None = None, **options: Any
) -> list[ScanJob]:
    """Return what is to be done with each scan; the options are fields of :class:`ScanJob`.

    Raises
    ------
    UsageError
        When the format or the place of the frame is impossible.
    InputError
        When the folder cannot be written to, or the file of the corners is none.
    """
    near, size, corners = options.get("near"), options.get("format_mm"), options.get("corners")
    if corners is not None:
        FrameCorners.read(corners)  # an invalid file is reported before the computation
    if near is not None and not (near[0] < near[2] and near[1] < near[3]):
        raise UsageError(f"is empty: {near}", where="--near", do="write left,top,right,bottom in pixels")
    if size is not None and not 1 < min(size) <= max(size) < 400:
        raise UsageError(f"is {size}, not between 1 and 400 mm", where="--format-mm")
    if out is not None:
        _prepare(out)
    shown = overlays or {}
    return [
        ScanJob(path, name, out=out, overlay=shown.get(path), **options)
        for path, name in zip(images, _names(images), strict=True)
    ]


def orient_files(
    jobs: list[ScanJob],
    executor: Executor,
    store: str = "",
    *,
    roll: bool = True,
    step: Callable[[], None] = lambda: None,
) -> OrientedFiles:
    """Orient scans, with what the frames of a roll have in common; write what is wanted of each and of all.

    Raises
    ------
    UsageError
        When overlays are wanted of another machine.
    """
    if not executor.local and any(job.overlay for job in jobs):
        raise UsageError("is drawn by this machine only", where="--overlay", do="leave out --cluster")
    done = dict(zip((job.name for job in jobs), _all(jobs, executor, store, step), strict=True))
    if roll:
        jobs = _of_one_curve(jobs, done, executor, store)
    found = rolls_of([result for item in done.values() for result in item.results]) if roll else ()
    if found:
        _again(jobs, done, found)
    summary = RollSummary.of(_outcomes(jobs, done)) if len(jobs) > 1 else None
    out = jobs[0].out
    if out is not None:
        _sheet(out, done, jobs)
        for name, corners in corner_files(found).items():
            corners.write(out / name)
        if summary is not None:
            summary.write(out / "summary.json")
            write_whole(out / "summary.html", roll_page(summary, lambda name: _tile(out, name)))
    return OrientedFiles(tuple(jobs), tuple(done.values()), found, summary)


def _names(images: list[Path]) -> list[str]:
    """Stems of the outputs: those of the input files, numbered if several are equal."""
    stems = [path.stem for path in images]
    return [
        stem if stems.count(stem) == 1 else f"{stem}-{stems[: i + 1].count(stem)}"
        for i, stem in enumerate(stems)
    ]


def _required(found: FrameOrientation | Failure, image: Path) -> FrameOrientation:
    if isinstance(found, Failure):
        raise EstimationError(found.reason, where=image)
    return found


def _prepare(out: Path) -> None:
    made_folder(out / "provenance")


def _options(job: ScanJob) -> FrameOptions:
    size = job.format_mm
    near = None
    if job.near is not None:
        x0, y0, x1, y1 = job.near
        near = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    common = FrameOptions(dpi=job.dpi, near=near, curves=job.curves)
    return common if size is None else replace(common, formats=(size,))


def _run(job: ScanJob, before: ScanOutcome | None = None) -> ScanOutcome:
    """Orient the frames of one image and write the results, in a worker process."""
    try:
        scan = open_scan(job.image)
        if before is None:
            results = orient_scan(scan, _options(job))
        else:
            results = reorient_scan(scan, job.rolls, before.results, _options(job))
            if results == before.results:
                return before
        calibrated: FrameCorners | None = FrameCorners.read(job.corners) if job.corners else None
        documents = [
            _required(orientation_of(result, calibrated, job.transform), job.image) for result in results
        ]
        shown = (each.curves for each in results)
        curves = curves_of_scan(scan, shown) if before is None else before.curves
        if job.out is not None:
            # A later run decides by the same results as this one about the curve, and the shapes of rolls.
            content: dict[str, Any] = {"frames": len(documents)}
            content["curves"] = None if curves is None else curves.to_dict()
            if before is not None:
                content["alone"] = [result.document().to_dict() for result in before.results]
            _write(job, scan, documents, content)
        if job.overlay is not None:
            scan_overlay(job.overlay, scan, results)
    except ReseauError as error:
        return ScanOutcome([], [], str(error))
    notes = tuple(f"{job.image.name}: {note}" for note in scan.notes)
    return ScanOutcome(documents, results, notes=notes, curves=curves)


def _write(job: ScanJob, scan: Any, documents: list[FrameOrientation], content: dict[str, Any]) -> None:
    """Write JSON, CSV, picture and marked copy; write the provenance last: it marks the image as done."""
    assert job.out is not None
    for i, document in enumerate(documents):
        stem = job.name if len(documents) == 1 else f"{job.name}-{i + 1}"
        document.write(job.out / f"{stem}.json")
        write_whole(job.out / f"{stem}.csv", document.image_points().to_csv(".4f", ".4f", ".4f"))
        write_image(job.out / "provenance" / f"{stem}.png", frame_tile(scan, document))
        if job.cut and document.corners is not None:
            write_cut(job.out / f"{stem}-frame.tif", scan, document.image_points().xy)
    if job.marked:
        corners = [d.image_points().xy for d in documents if d.corners is not None]
        if corners:
            write_marked(job.out / f"{job.name}-marked.tif", scan, corners)
    write_whole(job.out / "provenance" / f"{job.name}.json", canonical_json(_provenance(job) | content))


def _provenance(job: ScanJob) -> dict[str, Any]:
    inputs = {"image": sha256_of(job.image)}
    if job.corners is not None:
        inputs["corners"] = sha256_of(job.corners)
    options = {"format_mm": job.format_mm, "dpi": job.dpi, "near": job.near, "transform": job.transform}
    return Provenance(inputs, options | {"marked": job.marked, "cut": job.cut}).to_dict()


def _earlier(job: ScanJob) -> ScanOutcome | None:
    """Result of an earlier run for the same image with the same options."""
    if job.out is None or job.overlay is not None:
        return None
    path = job.out / "provenance" / f"{job.name}.json"
    try:
        content = json.loads(path.read_text("utf-8"))
        count = content.pop("frames")
        shown, alone = content.pop("curves", None), content.pop("alone", None)
        if json.loads(json.dumps(_provenance(job))) != content:
            return None
        stems = [job.name] if count == 1 else [f"{job.name}-{i + 1}" for i in range(count)]
        documents = [FrameOrientation.read(job.out / f"{stem}.json") for stem in stems]
        before = [FrameOrientation.from_content(each, where=path) for each in alone or ()] or documents
        curves = None if shown is None else CurveEvidence.from_dict(shown)
        return ScanOutcome(documents, [result_of(each) for each in before], curves=curves, kept=True)
    except (OSError, ValueError, KeyError, AttributeError, ReseauError):
        return None


def _all(
    work: list[ScanJob], executor: Executor, store: str, step: Callable[[], None]
) -> Iterator[ScanOutcome]:
    """Orient all images that no earlier run has oriented, in parallel; yield the results in their order."""
    kept = [_earlier(job) for job in work]
    fresh = _fresh([job for job, done in zip(work, kept, strict=True) if done is None], executor, store)
    for earlier in kept:
        done = next(fresh) if earlier is None else earlier
        step()
        yield done


def _fresh(work: list[ScanJob], executor: Executor, store: str) -> Iterator[ScanOutcome]:
    """Orient images in parallel; yield the results in their order."""
    if executor.local:
        found = executor.outcomes(_run, ((job.name, job) for job in work))
    else:
        found = executor.outcomes(partial(_run_apart, store), ((job.name, _sent(job, store)) for job in work))
    for job, (_, done) in zip(work, found, strict=True):
        if isinstance(done, Failure):
            done = ScanOutcome([], [], f"{job.image}: {done.reason}")
        _receive(job, done, store)
        yield done


def _of_one_curve(
    work: list[ScanJob], done: dict[str, ScanOutcome], executor: Executor, store: str
) -> list[ScanJob]:
    """The jobs with the curve of the grey values that all scans of the roll show together.

    What is not sure by the scans alone is oriented again with it; what an earlier run has decided stays.
    """
    own = [done[job.name] for job in work]
    jobs, again = [], []
    for job, item, curve in zip(work, own, curves_of_roll(item.curves for item in own), strict=True):
        used = item.curves if item.kept else curve
        jobs.append(replace(job, curves=None if used is None else used.share))
        if used is not None and not used.like(item.curves):
            again.append(jobs[-1])
    done.update(zip((job.name for job in again), _fresh(again, executor, store), strict=True))
    return jobs


def _sent(job: ScanJob, store: str) -> tuple[ScanJob, dict[str, str]]:
    """A job for another machine: its files by their SHA-256 in the store."""
    objects, files = objects_at(store, durable=False), {}
    for path in (job.image, job.corners):
        if path is not None:
            with readable(path):
                files[str(path)] = objects.put(path.read_bytes(), path.suffix)
    return job, files


def _run_apart(store: str, sent: tuple[ScanJob, dict[str, str]]) -> ScanOutcome:
    """Orient the frames of an image from the store; the files that are to be written go there."""
    (job, files), objects = sent, objects_at(store, durable=False)
    with TemporaryDirectory() as name:
        folder = Path(name)
        here = {}
        for number, (path, sha256) in enumerate(files.items()):
            here[path] = folder / str(number) / Path(path).name
            here[path].parent.mkdir()
            here[path].write_bytes(objects.get(sha256, Path(path).suffix))
        out = None if job.out is None else folder / "out"
        if out is not None:
            _prepare(out)
        corners = None if job.corners is None else here[str(job.corners)]
        done = _run(replace(job, image=here[str(job.image)], corners=corners, out=out))
        made = {} if out is None else {str(p.relative_to(out)): p for p in out.rglob("*") if p.is_file()}
        files = {path: objects.put(made[path].read_bytes(), made[path].suffix) for path in sorted(made)}
        # The user knows the file by its own path.
        failed = done.failed.replace(str(here[str(job.image)]), str(job.image))
        return replace(done, failed=failed, files=files)


def _receive(job: ScanJob, done: ScanOutcome, store: str) -> None:
    """Write the files that another machine has made; the provenance last: it marks the image as done."""
    if job.out is not None and done.files:
        objects = objects_at(store)
        last = f"provenance/{job.name}.json"
        for path in sorted(done.files, key=lambda each: each == last):
            write_whole(job.out / path, objects.get(done.files[path], Path(path).suffix))


def _again(work: list[ScanJob], done: dict[str, ScanOutcome], rolls: tuple[Roll, ...]) -> None:
    """Orient frames that are not fully oriented, or in doubt, again, with the shapes of the rolls."""
    for job in work:
        item = done[job.name]
        if item.results and any(result.status != "oriented" or result.why for result in item.results):
            done[job.name] = _run(replace(job, rolls=rolls), item)


def _tile(out: Path, stem: str) -> NDArray[np.uint8] | None:
    """The picture of a frame, if it was written."""
    tile: Any = cv2.imread(str(out / "provenance" / f"{stem}.png"))
    return None if tile is None else tile[:, :, ::-1]


def _sheet(out: Path, done: dict[str, ScanOutcome], work: list[ScanJob]) -> None:
    tiles: list[NDArray[np.uint8]] = []
    for job in work:
        count = len(done[job.name].documents)
        for i in range(count):
            stem = job.name if count == 1 else f"{job.name}-{i + 1}"
            tile = _tile(out, stem)
            if tile is not None:
                tiles.append(tile)
    contact_sheet(out / "overview.png", tiles)


def _outcomes(work: list[ScanJob], done: dict[str, ScanOutcome]) -> list[FrameOutcome]:
    """What became of each frame and of each file that could not be read, in the order of the files."""
    rows = []
    for job in work:
        item = done[job.name]
        if item.failed:
            rows.append(FrameOutcome(image=job.image.name, name=job.name, status="failed", why=item.failed))
        for i, d in enumerate(item.documents):
            name = job.name if len(item.documents) == 1 else f"{job.name}-{i + 1}"
            rows.append(FrameOutcome.of(d, name))
    return rows
