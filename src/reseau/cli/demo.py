"""`reseau demo`: the whole oscilloscope procedure on a simulated bench, and what it is worth."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from .common import AsJson, points_csv, progress, required, say

if TYPE_CHECKING:
    from ..data import Frame
    from ..formats import ReseauDesign, ReseauMeasurement
    from ..optics import PlaneMapping
    from ..procedures.oscilloscope import PhotoI, PhotoII, PhotoIII
    from ..provenance import Provenance
    from ..report.truth import Comparison, KnownPoints

__all__ = ["demo"]

_BENCH = "simulated-bench"


class Bench(Protocol):
    """What the demo needs of a simulated bench; see the entry point ``simulated-bench``."""

    @property
    def design(self) -> ReseauDesign:
        """The reseau in front of the screen."""

    @property
    def test_object(self) -> ReseauDesign:
        """The rods of the test object, as designed."""

    def photo_i(self) -> Frame:
        """PHOTO I."""

    def photo_ii(self) -> Frame:
        """PHOTO II."""

    def photo_iii(self) -> Frame:
        """PHOTO III, of a body that nobody has measured."""

    def check_marks(self) -> tuple[str, ...]:
        """Marks to hold out."""

    def view(self) -> PlaneMapping:
        """The truth: from the plane of the reseau to the image."""

    def truth_ii(self) -> KnownPoints:
        """The truth: the rods as they were made, and where PHOTO II shows them."""

    def truth_iii(self) -> KnownPoints:
        """The truth: the points of the body."""


@dataclass(frozen=True, eq=False)
class _Done:
    """The three photographs and what came out."""

    frames: tuple[Frame, Frame, Frame]
    first: PhotoI
    second: PhotoII
    third: PhotoIII


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path("out"),
    seed: Annotated[int, typer.Option(min=0, help="Of all that is random; same seed, same bytes.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Refine the photographs of a simulated bench factor by factor, and compare with the truth."""
    from ..adjust.threads import one_thread
    from ..errors import InputError
    from ..provenance import canonical_json
    from ..report.comparison import compare_with_truth
    from ..report.summary import comparison_table
    from ..report.truth import Known

    if out.exists() and not out.is_dir():
        raise InputError("is a file", where=out, do="name a folder")
    if not out.absolute().parent.is_dir():
        raise InputError("has no such folder", where=out.parent, do="create it first")
    # Small matrices throughout, from drawing the wires on: several threads only wait for one another.
    with one_thread(), progress("photographing", 6) as step:
        bench = _bench(seed)
        done = _refined(bench, step)
        step("comparing with the truth")
        known = Known(bench.view(), bench.truth_ii(), (bench.truth_iii(),))
        truth = compare_with_truth(
            known, done.first, bench.design, done.second, bench.test_object, (done.third,)
        )
        step("writing the report")
        _write_folder(out, done.frames, _documents(bench, done, truth, seed))
        step()
    if as_json:
        say(canonical_json(truth.to_dict()))
    else:
        say(comparison_table(truth))
        say(f"\nopen {out / 'report.html'}\n")


def _bench(seed: int) -> Bench:
    """The simulated bench, found by its entry point.

    Raises
    ------
    UsageError
        When no installed package offers one.
    """
    from importlib.metadata import entry_points

    from ..errors import UsageError

    found = list(entry_points(group="reseau.instruments", name=_BENCH))
    if not found:
        raise UsageError(f"no installed package offers {_BENCH!r}", do="install reseau anew")
    bench: Bench = found[0].load()(seed)
    return bench


def _refined(bench: Bench, step: Any) -> _Done:
    """PHOTO I, II and III, one after the other."""
    from ..procedures.oscilloscope import photo_i, photo_ii, photo_iii

    one = bench.photo_i()
    step("PHOTO I: the camera")
    first = required(photo_i(one, bench.design, check=bench.check_marks()), one.name)
    two = bench.photo_ii()
    step("PHOTO II: the ultrasonic instrument")
    second = required(photo_ii(two, bench.design, bench.test_object, first.camera), two.name)
    three = bench.photo_iii()
    step("PHOTO III: the body")
    third = required(photo_iii(three, second.instrument, bench.design), three.name)
    return _Done((one, two, three), first, second, third)


def _documents(bench: Bench, done: _Done, truth: Comparison, seed: int) -> dict[str, str | bytes]:
    """All that is written beside the photographs, by the names of the files."""
    from ..provenance import canonical_json
    from ..report import oscilloscope_report
    from ..report.overview import overview_png

    provenance = _provenance(bench, done, seed)
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
    )
    overview = overview_png(done.first, done.second, bench.test_object, done.third, done.frames, truth)
    return {
        "report.html": page,
        "overview.png": overview,
        "calibration.json": calibration.to_json(),
        "reseau.json": bench.design.to_json(),
        "rods.json": bench.test_object.to_json(),
        "true.csv": points_csv(done.third.true),
        "comparison.json": canonical_json(truth.to_dict()),
        **{f"{name}.json": document.to_json() for name, document in _measurements(done).items()},
    }


def _measurements(done: _Done) -> dict[str, ReseauMeasurement]:
    """Image coordinates of the marks in PHOTO I, the rods in PHOTO II and the points in PHOTO III."""
    import numpy as np

    from ..formats import ReseauMeasurement

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


def _provenance(bench: Bench, done: _Done, seed: int) -> Provenance:
    from ..provenance import Provenance, sha256_of

    inputs = {frame.name: frame.sha256 for frame in done.frames}
    inputs |= {
        design.name: sha256_of(design.to_json().encode()) for design in (bench.design, bench.test_object)
    }
    return Provenance(inputs, {"seed": seed, "check": list(bench.check_marks()), "alpha": 0.05})


def _write_folder(out: Path, frames: tuple[Frame, ...], documents: dict[str, str | bytes]) -> None:
    """Write all files beside their place first, then move them there: an error leaves what was before.

    Raises
    ------
    InputError
        When the place cannot be written to.
    """
    from ..errors import InputError
    from ..formats import write_whole
    from ..images import write_image

    try:
        draft = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.absolute().parent))
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=out) from None
    try:
        for number, frame in zip(("i", "ii", "iii"), frames, strict=True):
            write_image(draft / f"photo_{number}.png", frame.pixels)
        for name, content in documents.items():
            write_whole(draft / name, content)
        draft.chmod(0o755)
        if not out.exists():
            draft.replace(out)
            return
        for path in sorted(draft.iterdir()):
            os.replace(path, out / path.name)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=out) from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)
