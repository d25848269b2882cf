"""`reseau demo`: a simulated bench over its real protocols: capture, refine, bundle, report."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .common import AsJson, progress, say

if TYPE_CHECKING:
    from ..core.data import Frame
    from ..core.provenance import Provenance
    from ..io import ReseauMeasurement
    from ..report.truth import Comparison
    from .simulated import OscilloscopeSession, TestfieldSession

__all__ = ["demo"]

_STEPS = 18
"""Fifteen frames, comparison, report, and the end."""


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path("out"),
    seed: Annotated[int, typer.Option(min=0, help="Of all that is random; same seed, same bytes.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Capture, refine and adjust on a simulated bench over its real protocols, and compare with the truth."""
    from ..core.errors import InputError
    from ..core.provenance import canonical_json
    from ..core.threads import one_thread
    from ..report.summary import comparison_table

    if out.exists() and not out.is_dir():
        raise InputError("is a file", where=out, do="name a folder")
    if not out.absolute().parent.is_dir():
        raise InputError("has no such folder", where=out.parent, do="create it first")
    # Small matrices throughout, from drawing the wires on: several threads only wait for one another.
    with one_thread(), progress("photographing", _STEPS) as step, _draft_of(out) as draft:
        done, field = _captured(draft, seed, step)
        step("comparing with the truth")
        truth = _compared(done)
        step("writing the report")
        _write_draft(draft, done.frames, _documents(done, field, truth, seed))
        step()
        _put(draft, out)
    if as_json:
        say(canonical_json(truth.to_dict() | {"testfield": _testfield(field)}))
    else:
        say(comparison_table(truth))
        say(_camera_table(field))
        say(f"\n{done.way}; every frame is in {out / 'archive'}\nopen {out / 'report.html'}\n")


def _captured(
    draft: Path, seed: int, step: Callable[[str | None], None]
) -> tuple[OscilloscopeSession, TestfieldSession]:
    """Both sessions, into an archive in the folder."""
    from ..archive import Archive
    from .simulated import captured_oscilloscope, captured_testfield

    def watch(kind: str, facts: dict[str, Any]) -> None:
        if kind == "frame":
            step(f"{facts['step']}: {facts.get('points', 0)} points")

    with Archive.open(draft / "archive", create=True) as archive:
        return captured_oscilloscope(archive, seed, watch), captured_testfield(archive, seed, watch)


def _compared(done: OscilloscopeSession) -> Comparison:
    from ..report.comparison import compare_with_truth
    from ..report.truth import Known

    world = done.world
    known = Known(world.view(), world.truth_ii(), (world.truth_iii(),))
    return compare_with_truth(known, done.first, world.design, done.second, world.test_object, (done.third,))


def _testfield(field: TestfieldSession) -> dict[str, Any]:
    """The camera's parameters beside their true values."""
    import numpy as np

    result = field.calibrated.result
    names, _, values = result.camera_columns(0)
    sigma = np.sqrt(np.diag(result.camera_covariance(0)))
    rows = zip(names, values.tolist(), sigma.tolist(), strict=True)
    return {
        "poses": field.poses,
        "sigma0": result.sigma0,
        "parameters": {n: {"value": v, "sigma": s, "true": field.true[n]} for n, v, s in rows},
    }


def _camera_table(field: TestfieldSession) -> str:
    facts = _testfield(field)
    lines = [f"\ntestfield, {facts['poses']} poses: sigma0 {facts['sigma0']:.3f}"]
    for name, row in facts["parameters"].items():
        off = (row["value"] - row["true"]) / row["sigma"]
        known = f"{row['value']:13.6g} ± {row['sigma']:<9.2g} true {row['true']:<13.6g}"
        lines.append(f"  {name:<4} {known} {off:+.1f} sigma")
    return "\n".join(lines) + "\n"


def _documents(
    done: OscilloscopeSession, field: TestfieldSession, truth: Comparison, seed: int
) -> dict[str, str | bytes]:
    """All that is written beside the photographs, by the names of the files."""
    from ..core.provenance import canonical_json
    from ..report import oscilloscope_report
    from ..report.camera import camera_section
    from ..report.overview import overview_png

    bench, provenance = done.world, _provenance(done, seed)
    calibration = done.second.instrument.calibration(
        bench.design,
        bench.test_object,
        name=f"simulated bench, seed {seed}",
        provenance=provenance.to_dict(),
        times={"computed": datetime.now(UTC).isoformat(timespec="seconds")},
    )
    page = oscilloscope_report(
        done.first,
        bench.design,
        done.second,
        bench.test_object,
        (done.third,),
        frames=done.frames,
        title=f"The simulated bench, seed {seed}",
        provenance=provenance,
        truth=truth,
        camera=camera_section(field.calibrated.result, field.poses, field.true),
    )
    overview = overview_png(done.first, done.second, bench.test_object, done.third, done.frames, truth)
    return {
        "report.html": page,
        "overview.png": overview,
        "testfield.html": field.documents["report.html"],
        "calibration.json": calibration.to_json(),
        "camera.json": field.documents["calibration.json"],
        "reseau.json": bench.design.to_json(),
        "rods.json": bench.test_object.to_json(),
        "true.csv": done.third.true.to_csv(),
        "comparison.json": canonical_json(truth.to_dict() | {"testfield": _testfield(field)}),
        **{f"{name}.json": document.to_json() for name, document in _measurements(done).items()},
    }


def _measurements(done: OscilloscopeSession) -> dict[str, ReseauMeasurement]:
    """Image coordinates of the marks in PHOTO I, the rods in PHOTO II and the points in PHOTO III."""
    import numpy as np

    from ..io import ReseauMeasurement

    marks, rods, body = done.first.measured, done.second.measured, done.third.measured
    # From frames they were measured.
    assert marks is not None
    assert rods is not None
    assert body is not None
    points = body.points
    every = np.ones(len(points), dtype=bool)
    seen = ReseauMeasurement.from_columns(
        body.image, body.sha256, points.names, points.xy, points.cov, every, [""] * len(points)
    )
    return {"marks_i": marks.measurement(), "rods_ii": rods.measurement(), "points_iii": seen}


def _provenance(done: OscilloscopeSession, seed: int) -> Provenance:
    from ..core.provenance import Provenance, sha256_of

    bench = done.world
    inputs = {frame.name: frame.sha256 for frame in done.frames}
    inputs |= {
        design.name: sha256_of(design.to_json().encode()) for design in (bench.design, bench.test_object)
    }
    return Provenance(inputs, {"seed": seed, "check": list(bench.check_marks()), "alpha": 0.05})


@contextmanager
def _draft_of(out: Path) -> Iterator[Path]:
    """A folder beside the place, gone in the end: an error leaves what was before.

    Raises
    ------
    InputError
        When the place cannot be written to.
    """
    from ..core.errors import InputError

    try:
        draft = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.absolute().parent))
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=out) from None
    try:
        yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _write_draft(draft: Path, frames: tuple[Frame, ...], documents: dict[str, str | bytes]) -> None:
    """Write all files."""
    from ..io import write_whole
    from ..io.images import write_image

    for number, frame in zip(("i", "ii", "iii"), frames, strict=True):
        write_image(draft / f"photo_{number}.png", frame.pixels)
    for name, content in documents.items():
        write_whole(draft / name, content)
    draft.chmod(0o755)


def _put(draft: Path, out: Path) -> None:
    """Move all that is in the draft to its place.

    Raises
    ------
    InputError
        When the place cannot be written to.
    """
    from ..core.errors import InputError

    try:
        if not out.exists():
            draft.replace(out)
            return
        for path in sorted(draft.iterdir()):
            if path.is_dir():
                shutil.rmtree(out / path.name, ignore_errors=True)
            os.replace(path, out / path.name)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=out) from None
