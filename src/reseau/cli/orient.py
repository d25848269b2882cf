"""`reseau orient`: the inner orientation of scanned film frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.errors import InputError, ReseauError, UsageError
from ..core.options import Option
from .common import Computing, overlay_files, progress, required, say, say_files_left_out

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..execution import Executor
    from ..io import FrameOrientation, FrameOutcome, RollSummary
    from ..procedures.film_frame import FrameOptions, FrameResult, Roll

__all__ = ["orient"]


@dataclass(frozen=True)
class _Job:
    """One image and its options, for another process."""

    image: Path
    name: str
    format_mm: tuple[float, float] | None
    dpi: float | None
    near: tuple[float, ...] | None
    corners: Path | None
    transform: str
    out: Path | None
    marked: bool
    overlay: Path | None = None
    roll: Any = None


@dataclass(frozen=True)
class _Done:
    """Result of one image; files that another machine has made, by their SHA-256 in the store."""

    documents: list[FrameOrientation]
    results: list[FrameResult]
    failed: str = ""
    notes: tuple[str, ...] = ()
    files: dict[str, str] = field(default_factory=dict)


def orient(
    images: Annotated[
        list[Path], typer.Argument(help="Scans of film frames, or folders of them: TIFF, PNG, JPEG, BMP.")
    ],
    computing: Computing,
    format_mm: v.FormatMm | None = None,
    corners: v.Corners | None = None,
    transform: v.Transform = "affine",
    dpi: v.Dpi | None = None,
    near: Annotated[
        tuple[float, float, float, float] | None,
        Option("Approximate position of the frame (px).", value="LEFT,TOP,RIGHT,BOTTOM"),
    ] = None,
    out: v.Out | None = None,
    marked: Annotated[
        bool, typer.Option(help="Write copies of the scans with marked corners.", rich_help_panel="Files")
    ] = True,
    roll: Annotated[bool, typer.Option(help="Use the common shape of the frames of a roll.")] = True,
    overlay: Annotated[v.Overlay | None, "Here a folder, for each scan; FILE.png for a single one."] = None,
    as_json: v.AsJson = False,
) -> int:
    """Orient scanned film frames by their four edges.

    The JSON document of a frame is the calibration of its scan for `reseau apply`.
    """
    from ..io import FrameCorners, RollSummary, write_whole
    from ..procedures.exposures import photographs_named
    from ..report.frames import roll_page

    say_files_left_out(images)
    images = photographs_named(images)
    if corners is not None:
        FrameCorners.read(corners)  # an invalid file is reported before the computation
    if near is not None and not (near[0] < near[2] and near[1] < near[3]):
        raise UsageError(f"is empty: {near}", where="--near", do="write left,top,right,bottom in pixels")
    if format_mm is not None and not 1 < min(format_mm) <= max(format_mm) < 400:
        raise UsageError(f"is {format_mm}, not between 1 and 400 mm", where="--format-mm")
    if out is not None:
        _prepare(out)
    drawn = {} if overlay is None else overlay_files(overlay, images)
    work = [
        _Job(
            path,
            name,
            format_mm,
            dpi,
            near,
            corners,
            transform,
            out,
            marked and out is not None,
            drawn.get(path),
        )
        for path, name in zip(images, _names(images), strict=True)
    ]
    modules = ["reseau.cli.orient", "reseau.procedures.film_frame"]
    with computing.executor(modules, len(work)) as executor:
        if not executor.local and overlay is not None:
            raise UsageError("is drawn by this machine only", where="--overlay", do="leave out --cluster")
        done = dict(zip((job.name for job in work), _all(work, executor, computing.store), strict=True))
    found = _common(done) if roll else None
    if found is not None:
        _again(work, done, found)
    if out is not None:
        _sheet(out, done, work)
        if found is not None:
            found.corners.write(out / "corners.json")
    summary = RollSummary.of(_outcomes(work, done)) if len(work) > 1 else None
    if out is not None and summary is not None:
        summary.write(out / "summary.json")
        write_whole(out / "summary.html", roll_page(summary, lambda name: _tile(out, name)))
    _report(work, done, found, summary, as_json)
    oriented = any(d.status != "declined" for item in done.values() for d in item.documents)
    return 0 if oriented and not any(item.failed for item in done.values()) else 1


def _names(images: list[Path]) -> list[str]:
    """Stems of the outputs: those of the input files, numbered if several are equal."""
    stems = [path.stem for path in images]
    return [
        stem if stems.count(stem) == 1 else f"{stem}-{stems[: i + 1].count(stem)}"
        for i, stem in enumerate(stems)
    ]


def _prepare(out: Path) -> None:
    try:
        (out / "provenance").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be written to ({error.strerror})", where=out) from None


def _options(job: _Job) -> FrameOptions:
    import numpy as np

    from ..procedures.film_frame import FrameOptions

    size = job.format_mm
    near = None
    if job.near is not None:
        x0, y0, x1, y1 = job.near
        near = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    common = FrameOptions(dpi=job.dpi, near=near)
    return common if size is None else FrameOptions(formats=(size,), dpi=job.dpi, near=near)


def _run(job: _Job, before: _Done | None = None) -> _Done:
    """Orient the frames of one image and write the results, in a worker process."""
    from ..io import FrameCorners
    from ..io.images import open_scan
    from ..procedures.film_frame import orient_scan, orientation_of, reorient_scan
    from ..report.frames import scan_overlay

    try:
        scan = open_scan(job.image)
        if job.roll is None or before is None:
            results = orient_scan(scan, _options(job))
        else:
            results = reorient_scan(scan, job.roll, before.results, _options(job))
        calibrated: FrameCorners | None = FrameCorners.read(job.corners) if job.corners else None
        documents = [
            required(orientation_of(result, calibrated, job.transform), job.image)  # type: ignore[arg-type]
            for result in results
        ]
        if job.out is not None:
            _write(job, scan, documents)
        if job.overlay is not None:
            scan_overlay(job.overlay, scan, results)
    except ReseauError as error:
        return _Done([], [], str(error))
    return _Done(documents, results, notes=tuple(f"{job.image.name}: {note}" for note in scan.notes))


def _write(job: _Job, scan: Any, documents: list[FrameOrientation]) -> None:
    """Write JSON, CSV, picture and marked copy; write the provenance last: it marks the image as done."""
    from ..core.provenance import canonical_json
    from ..io import write_whole
    from ..io.images import write_image
    from ..report.frames import frame_tile, write_marked

    assert job.out is not None
    for i, document in enumerate(documents):
        stem = job.name if len(documents) == 1 else f"{job.name}-{i + 1}"
        document.write(job.out / f"{stem}.json")
        write_whole(job.out / f"{stem}.csv", _csv(document))
        write_image(job.out / "provenance" / f"{stem}.png", frame_tile(scan, document))
    if job.marked:
        corners = [d.image_points().xy for d in documents if d.corners is not None]
        if corners:
            write_marked(job.out / f"{job.name}-marked.tif", scan, corners)
    content = _provenance(job) | {"frames": len(documents)}
    write_whole(job.out / "provenance" / f"{job.name}.json", canonical_json(content))


def _provenance(job: _Job) -> dict[str, Any]:
    from ..core.provenance import Provenance, sha256_of

    inputs = {"image": sha256_of(job.image)}
    if job.corners is not None:
        inputs["corners"] = sha256_of(job.corners)
    options = {"format_mm": job.format_mm, "dpi": job.dpi, "near": job.near, "transform": job.transform}
    return Provenance(inputs, options | {"marked": job.marked}).to_dict()


def _csv(document: FrameOrientation) -> str:
    points = document.image_points()
    lines = ["id,x,y,sx,sy,rho"]
    for name, (x, y), (sx, sy), cov in zip(points.names, points.xy, points.sigma, points.cov, strict=True):
        lines.append(f"{name},{x:.4f},{y:.4f},{sx:.4f},{sy:.4f},{cov[0, 1] / max(sx * sy, 1e-12):.4f}")
    return "\n".join(lines) + "\n"


def _earlier(job: _Job) -> _Done | None:
    """Result of an earlier run for the same image with the same options."""
    import json

    from ..io import FrameOrientation
    from ..procedures.film_frame import result_of

    if job.out is None or job.overlay is not None:
        return None
    path = job.out / "provenance" / f"{job.name}.json"
    try:
        content = json.loads(path.read_text("utf-8"))
        count = content.pop("frames")
        if json.loads(json.dumps(_provenance(job))) != content:
            return None
        stems = [job.name] if count == 1 else [f"{job.name}-{i + 1}" for i in range(count)]
        documents = [FrameOrientation.read(job.out / f"{stem}.json") for stem in stems]
        return _Done(documents, [result_of(document) for document in documents])
    except (OSError, ValueError, KeyError, AttributeError, ReseauError):
        return None


def _all(work: list[_Job], executor: Executor, store: str) -> Iterator[_Done]:
    """Orient all images in parallel; yield the results in their order."""
    from ..core.failure import Failure

    kept = [_earlier(job) for job in work]
    rest = [job for job, done in zip(work, kept, strict=True) if done is None]
    if executor.local:
        fresh = executor.outcomes(_run, ((job.name, job) for job in rest))
    else:
        fresh = executor.outcomes(partial(_run_apart, store), ((job.name, _sent(job, store)) for job in rest))
    with progress("orienting frames", len(work)) as step:
        for job, done in zip(work, kept, strict=True):
            if done is None:
                _, found = next(fresh)
                done = _Done([], [], f"{job.image}: {found.reason}") if isinstance(found, Failure) else found
                _receive(job, done, store)
            step()
            yield done


def _sent(job: _Job, store: str) -> tuple[_Job, dict[str, str]]:
    """A job for another machine: its files by their SHA-256 in the store."""
    from ..archive import objects_at

    objects, files = objects_at(store, durable=False), {}
    for path in (job.image, job.corners):
        if path is not None:
            try:
                files[str(path)] = objects.put(path.read_bytes(), path.suffix)
            except OSError as error:
                raise InputError(f"cannot be read ({error.strerror})", where=path) from None
    return job, files


def _run_apart(store: str, sent: tuple[_Job, dict[str, str]]) -> _Done:
    """Orient the frames of an image from the store; the files that are to be written go there."""
    from tempfile import TemporaryDirectory

    from ..archive import objects_at

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


def _receive(job: _Job, done: _Done, store: str) -> None:
    """Write the files that another machine has made; the provenance last: it marks the image as done."""
    from ..archive import objects_at
    from ..io import write_whole

    if job.out is not None and done.files:
        objects = objects_at(store)
        last = f"provenance/{job.name}.json"
        for path in sorted(done.files, key=lambda each: each == last):
            write_whole(job.out / path, objects.get(done.files[path], Path(path).suffix))


def _common(done: dict[str, _Done]) -> Roll | None:
    """Common shape of the frames, or None if there are too few."""
    from ..core.failure import Failure
    from ..procedures.film_frame import roll_of

    found = roll_of([result for item in done.values() for result in item.results])
    return None if isinstance(found, Failure) else found


def _again(work: list[_Job], done: dict[str, _Done], roll: Roll) -> None:
    """Orient frames that were not fully oriented again, with the shape of the roll."""
    for job in work:
        item = done[job.name]
        if item.results and any(result.status != "oriented" for result in item.results):
            done[job.name] = _run(replace(job, roll=roll), item)


def _tile(out: Path, stem: str) -> NDArray[np.uint8] | None:
    """The picture of a frame, if it was written."""
    import cv2

    tile: Any = cv2.imread(str(out / "provenance" / f"{stem}.png"))
    return None if tile is None else tile[:, :, ::-1]


def _sheet(out: Path, done: dict[str, _Done], work: list[_Job]) -> None:
    from ..report.frames import contact_sheet

    tiles: list[NDArray[np.uint8]] = []
    for job in work:
        count = len(done[job.name].documents)
        for i in range(count):
            stem = job.name if count == 1 else f"{job.name}-{i + 1}"
            tile = _tile(out, stem)
            if tile is not None:
                tiles.append(tile)
    contact_sheet(out / "overview.png", tiles)


def _outcomes(work: list[_Job], done: dict[str, _Done]) -> list[FrameOutcome]:
    """What became of each frame and of each file that could not be read, in the order of the files."""
    from ..io import FrameOutcome

    rows = []
    for job in work:
        item = done[job.name]
        if item.failed:
            rows.append(FrameOutcome(image=job.image.name, name=job.name, status="failed", why=item.failed))
        for i, d in enumerate(item.documents):
            name = job.name if len(item.documents) == 1 else f"{job.name}-{i + 1}"
            rows.append(FrameOutcome.of(d, name))
    return rows


def _report(
    work: list[_Job], done: dict[str, _Done], roll: Roll | None, summary: RollSummary | None, as_json: bool
) -> None:
    from ..core.provenance import canonical_json

    failed = [item.failed for item in done.values() if item.failed]
    if as_json:
        content = [d.to_dict() for job in work for d in done[job.name].documents]
        say(canonical_json(content[0] if len(work) == len(content) == 1 else content))
    else:
        for job in work:
            for document in done[job.name].documents:
                say(_line(document))
        if roll is not None:
            sx, sy = roll.corners.sigma or (0.0, 0.0)
            x, y = (1000 * scatter for scatter in roll.scatter_mm)
            say(f"roll: {roll.frames} frames, scatter of corners {x:.2g} µm in x, {y:.2g} µm in y, ")
            say(f"calibrated corners ± {1000 * max(sx, sy):.2g} µm\n")
        if summary is not None:
            _print_summary(summary)
    for note in (note for item in done.values() for note in item.notes):
        typer.echo(f"reseau: {note}", err=True)
    if failed and len(failed) == len(work):
        raise InputError(failed[0] if len(failed) == 1 else f"{failed[0]} (and {len(failed) - 1} more)")
    for line in failed:
        typer.echo(f"reseau: {line}", err=True)


def _print_summary(summary: RollSummary) -> None:
    """Print how many frames were oriented, with and without the roll, and which were not and why."""
    rows = summary.frames
    say(f"{len(rows)} frames: " + ", ".join(f"{count} {what}" for what, count in summary.counts() if count))
    say("\n")
    for row in rows:
        if row.status in ("declined", "failed"):
            say(f"  {row.image}: {row.status}: {row.why.removeprefix(row.image + ': ')}\n")


def _line(document: FrameOrientation) -> str:
    """Describe a frame in one line."""
    from ..core.numbers import measured

    if document.corners is None or document.principal_point is None:
        return f"{document.image}: declined: {document.why}\n"
    largest = max(max(c.sx, c.sy) for c in document.corners.values())
    pp = document.principal_point
    text = f"{document.image}: {document.status}, principal point x {measured(pp.x, pp.sx, 'px')}, "
    text += f"y {measured(pp.y, pp.sy, 'px')}, "
    text += f"angle {measured(document.angle_deg or 0.0, document.angle_sigma_deg, 'deg')}"
    text += f", corners ± {largest:.2g} px at most"
    if document.transform is not None and document.transform.sigma_mm is not None:
        sx, sy = document.transform.sigma_mm
        text += f", {document.transform.kind}: residuals {sx:.2g} mm in X, {sy:.2g} mm in Y"
    elif document.transform is not None:
        text += f", {document.transform.kind}: no residuals (8 parameters from 4 corners)"
    return text + (f" ({document.why})" if document.why else "") + "\n"
