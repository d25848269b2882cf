"""The demonstration: two sessions on a simulated bench over its real protocols, compared with the truth.

`reseau demo` is :func:`run_demo` with a progress bar.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..archive import Archive, Session
from ..capture import (
    Acquisition,
    Bench,
    BenchFile,
    InstrumentEntry,
    carry_out,
    paper_steps,
    plans,
    plugin,
    spread,
)
from ..capture.acquisition import Plan
from ..capture.bench import IN_PROCESS, built
from ..capture.judging import Watch
from ..core.data import Frame
from ..core.errors import EstimationError, InputError
from ..core.plugins import INSTRUMENTS
from ..core.provenance import Provenance, canonical_json, sha256_of
from ..core.threads import one_thread
from ..instruments import Instrument
from ..io import ReseauMeasurement, write_whole
from .conducting import begin, procedure_of

if TYPE_CHECKING:
    from ..io import ReseauDesign
    from ..optics.mapping import PlaneMapping
    from ..procedures.calibrated import Calibrated
    from ..procedures.oscilloscope import PhotoI, PhotoII, PhotoIII
    from ..report.truth import Comparison, KnownPoints


STEPS = 18
"""Calls of the callback `step`: fifteen frames, comparison, report, and end."""
_POSES = 12
_SETTINGS: dict[str, dict[str, Any]] = {"scanner": {"half_sector": 100}, "table": {"speed": 1000.0}}
"""The head sweeps over the whole tank; the table is fast."""
_CAMERA = {"pitch_mm": 0.027, "free": ["c", "x0", "y0", "K1"], "row_jitter_px": 0.0086, "fill": 0.8}
"""Camera of the testfield: that of the paper."""


class World(Protocol):
    """Truth of a simulated bench; see the entry point ``bench`` of ``reseau.simulators``."""

    @property
    def design(self) -> ReseauDesign:
        """The reseau in front of the screen."""

    @property
    def test_object(self) -> ReseauDesign:
        """The rods of the test object, as designed."""

    def check_marks(self) -> tuple[str, ...]:
        """Return the marks to use as check points only."""

    def view(self) -> PlaneMapping:
        """Return the true mapping from the plane of the reseau to the image."""

    def truth_ii(self) -> KnownPoints:
        """Return the rods as made, and their true images in PHOTO II."""

    def truth_iii(self) -> KnownPoints:
        """Return the true points of the body."""


@dataclass(frozen=True, eq=False)
class OscilloscopeSession:
    """The three photographs and their corrections.

    Parameters
    ----------
    world : World
        The truth.
    frames : tuple of Frame
        PHOTO I, II and III.
    first, second, third : PhotoI, PhotoII, PhotoIII
        Their corrections.
    way : str
        Protocol by which the frames were taken.
    """

    world: World
    frames: tuple[Frame, ...]
    first: PhotoI
    second: PhotoII
    third: PhotoIII
    way: str


@dataclass(frozen=True, eq=False)
class TestfieldSession:
    """The calibration of the camera in front of the testfield.

    Parameters
    ----------
    calibrated : Calibrated
        The calibration.
    true : dict of str to float
        True parameters of the camera.
    documents : dict of str to str
        Results of the session.
    poses : int
        Number of images.
    """

    calibrated: Calibrated
    true: dict[str, float]
    documents: dict[str, str]
    poses: int

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters of the camera with their true values."""
        result = self.calibrated.result
        names, _, values = result.camera_columns(0)
        sigma = np.sqrt(np.diag(result.camera_covariance(0)))
        rows = zip(names, values.tolist(), sigma.tolist(), strict=True)
        return {
            "poses": self.poses,
            "sigma0": result.sigma0,
            "parameters": {n: {"value": v, "sigma": s, "true": self.true[n]} for n, v, s in rows},
        }


@dataclass(frozen=True, eq=False)
class Demo:
    """Results of the demonstration.

    Parameters
    ----------
    oscilloscope, testfield
        The two sessions.
    comparison : Comparison
        Errors against the truth.
    """

    oscilloscope: OscilloscopeSession
    testfield: TestfieldSession
    comparison: Comparison

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison with the truth, of both sessions."""
        return self.comparison.to_dict() | {"testfield": self.testfield.to_dict()}


def run_demo(out: Path, seed: int = 1, step: Callable[[str | None], None] = lambda text: None) -> Demo:
    """Capture, correct and adjust on a simulated bench, and write frames, documents and report.

    Parameters
    ----------
    out : path
        Folder to write. Existing files of other names stay; after an error all files stay as they were.
    seed : int
        Seed of all randomness; the same seed gives the same bytes, times apart.
    step : callable
        Called :data:`STEPS` times, with a text that says what is done next.

    Raises
    ------
    InputError
        If the folder cannot be written.
    EstimationError
        If an estimate failed.
    """
    if out.exists() and not out.is_dir():
        raise InputError("is a file", where=out, do="name a folder")
    if not out.absolute().parent.is_dir():
        raise InputError("has no such folder", where=out.parent, do="create it first")
    # Small matrices throughout: several threads would only wait for one another.
    with one_thread(), _draft_of(out) as draft:
        done, field = _captured(draft, seed, step)
        step("comparing with the truth")
        found = Demo(done, field, _compared(done))
        step("writing the report")
        _write_draft(draft, done.frames, _documents(found, seed))
        step(None)
        _move(draft, out)
    return found


def _captured(
    draft: Path, seed: int, step: Callable[[str | None], None]
) -> tuple[OscilloscopeSession, TestfieldSession]:
    """Both sessions, in an archive in the folder."""

    def watch(kind: str, facts: dict[str, Any]) -> None:
        if kind == "frame":
            step(f"{facts['step']}: {facts.get('points', 0)} points")

    with Archive.open(draft / "archive", create=True) as archive:
        return capture_oscilloscope(archive, seed, watch), capture_testfield(archive, seed, watch)


def capture_oscilloscope(archive: Archive, seed: int, watch: Watch) -> OscilloscopeSession:
    """Take PHOTO I, II and III on the simulated bench, over its protocols, and correct them.

    Raises
    ------
    EstimationError
        If a photograph could not be corrected.
    """
    options = {"camera": "screen", "repeatable": True, "in_process": not _gige_available()}
    with plugin("reseau.simulators", "bench")(seed, **options) as simulated:
        world: World = simulated.laboratory.world
        inputs = {"reseau.json": world.design.to_json(), "object.json": world.test_object.to_json()}
        given = {"seed": seed, "check": list(world.check_marks())}
        session = begin(archive, "oscilloscope", "oscilloscope", given, inputs, bench=simulated.toml)
        reported: Any = procedure_of(session)
        live = reported.procedure
        _carry_out(
            simulated, session, reported, plans.oscilloscope, ("scanner", "oscilloscope", "camera"), watch
        )
        way = _way(simulated)
    frames = tuple(session.picture(f) for f in session.frames(kind="frame") if f.verdict and f.verdict.ok)
    if live.first is None or live.second is None or live.third is None:
        raise EstimationError("not all photographs could be corrected", where="demo")
    return OscilloscopeSession(world, frames, live.first, live.second, live.third, way)


def capture_testfield(archive: Archive, seed: int, watch: Watch) -> TestfieldSession:
    """Calibrate a camera with the simulated testfield, over the protocols of the bench.

    Raises
    ------
    EstimationError
        If the calibration fails.
    """
    steps = spread(paper_steps(), _POSES)
    given = {"seed": seed, "steps": [[step.name, dict(step.position)] for step in steps], **_CAMERA}
    options = {"camera": "testfield", "repeatable": True, "flat": True, "in_process": not _gige_available()}
    with plugin("reseau.simulators", "bench")(seed, **options) as simulated:
        field = simulated.laboratory.field
        inputs = {"design.json": field.design.to_json()}
        session = begin(archive, "testfield", "testfield", given, inputs, bench=simulated.toml)
        reported: Any = procedure_of(session)

        def plan(run: Acquisition) -> Plan:
            return plans.homed(run, plans.poses(run, steps))

        _carry_out(simulated, session, reported, plan, ("table", "camera"), watch)
        true = dict(zip(field.camera.names, field.camera.values.tolist(), strict=True))
    documents = {result.name: session.content(result).decode("utf-8") for result in session.results()}
    found = reported.procedure.calibrated().required()
    return TestfieldSession(found, true, documents, len(session.frames(kind="frame")))


def _carry_out(
    simulated: Any,
    session: Session,
    procedure: Any,
    plan: Callable[[Acquisition], Plan],
    names: tuple[str, ...],
    watch: Watch,
) -> None:
    """Carry out a plan with some instruments of a simulated bench; its tank is filled as the plan asks."""
    laboratory = simulated.laboratory
    tanks = {"test object": lambda: laboratory.world.rods, "body": laboratory.world.body}

    def operator(request: str) -> None:
        for word, content in tanks.items():
            if word in request:
                laboratory.tank = content()

    file = BenchFile.parse_toml(simulated.toml + _in_process(simulated), where="simulated bench")
    entries = {name: file.instruments[name] for name in names}
    # This process has started the simulators and nobody else knows their addresses: nothing to lock.
    bench = Bench(file.model_copy(update={"instruments": entries}), _builder(simulated))
    try:
        for name, changes in _SETTINGS.items():
            if name in names:
                bench[name].configure(**changes)
        run = Acquisition(bench, session, procedure, watch=watch, operator=operator)
        carry_out(run, plan(run))
    finally:
        bench.close()


def _in_process(simulated: Any) -> str:
    """The entry of a camera that cannot be reached from other processes."""
    if simulated.video is None:
        return ""
    return f'\n[instruments.camera]\ndriver = "v4l2"\naddress = "{IN_PROCESS}"\n'


def _builder(simulated: Any) -> Callable[[str, InstrumentEntry], Instrument] | None:
    """Makes the instruments: by their drivers, and the camera of this process at its node."""
    if simulated.video is None:
        return None

    def build(name: str, entry: InstrumentEntry) -> Instrument:
        if entry.address != IN_PROCESS:
            return built(name, entry)
        settings = {"exposure_us": 10_000.0}  # the same as with GigE Vision
        made: Instrument = plugin(INSTRUMENTS, entry.driver)(
            name, simulated.video.open, settings=settings, seconds=30.0
        )
        return made

    return build


def _gige_available() -> bool:
    """Whether PyGObject, which the driver of GigE Vision needs, is installed."""
    return importlib.util.find_spec("gi") is not None


def _way(simulated: Any) -> str:
    """The protocol of the camera."""
    if simulated.video is None:
        return "GigE Vision"
    return "Video4Linux, simulated in process (Aravis or PyGObject is not installed)"


def _compared(done: OscilloscopeSession) -> Comparison:
    from ..report.comparison import compare_with_truth
    from ..report.truth import Known

    world = done.world
    known = Known(world.view(), world.truth_ii(), (world.truth_iii(),))
    return compare_with_truth(known, done.first, world.design, done.second, world.test_object, (done.third,))


def _documents(demo: Demo, seed: int) -> dict[str, str | bytes]:
    """All files besides the photographs, by name."""
    from ..report import oscilloscope_report
    from ..report.camera import camera_section
    from ..report.overview import overview_png

    done, field, truth = demo.oscilloscope, demo.testfield, demo.comparison
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
        "comparison.json": canonical_json(demo.to_dict()),
        **{f"{name}.json": document.to_json() for name, document in _measurements(done).items()},
    }


def _measurements(done: OscilloscopeSession) -> dict[str, ReseauMeasurement]:
    """Image coordinates of the marks in PHOTO I, the rods in PHOTO II and the points in PHOTO III."""
    marks, rods, body = done.first.measured, done.second.measured, done.third.measured
    # They were measured in frames.
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
    bench = done.world
    inputs = {frame.name: frame.sha256 for frame in done.frames}
    inputs |= {
        design.name: sha256_of(design.to_json().encode()) for design in (bench.design, bench.test_object)
    }
    return Provenance(inputs, {"seed": seed, "check": list(bench.check_marks()), "alpha": 0.05})


@contextmanager
def _draft_of(out: Path) -> Iterator[Path]:
    """A temporary folder beside the place, so that an error changes nothing."""
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
    from ..io.images import write_image

    for number, frame in zip(("i", "ii", "iii"), frames, strict=True):
        write_image(draft / f"photo_{number}.png", frame.pixels)
    for name, content in documents.items():
        write_whole(draft / name, content)
    draft.chmod(0o755)


def _move(draft: Path, out: Path) -> None:
    """Move all files of the draft to their place."""
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
