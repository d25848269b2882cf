"""The kinds of sessions: for each plan its parameters, inputs, acquisition, procedure and report."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..archive import Session, Verdict
from ..capture import Acquisition, BenchFile, Step, plans, spread
from ..capture.acquisition import Plan
from ..capture.checks import Limits
from ..capture.judging import Procedure
from ..core.data import Frame
from ..core.errors import FormatError, UsageError
from ..core.failure import Failure
from ..core.plugins import SESSIONS, plugin, plugins
from ..io import ReseauDesign, parse_design
from .parameters import (
    BlurredParameters,
    FilmParameters,
    FramesParameters,
    OscilloscopeParameters,
    OwnParameters,
    PhotographsParameters,
    ScanParameters,
    SensorParameters,
    SessionParameters,
    TestfieldParameters,
)

if TYPE_CHECKING:
    from ..io.refraction import RefractionEntry
    from ..io.scans import Scan
    from ..procedures.blurred_session import BlurredProcedure
    from ..procedures.film_roll import FilmRollProcedure
    from ..procedures.oscilloscope_acquisition import OscilloscopeProcedure
    from ..procedures.sensor import SensorProcedure
    from ..procedures.testfield import TestfieldProcedure


CORNERS = "corners.json"
"""Optional input of a session of the plan `film`: calibrated corners of the camera."""
SCENE = "scene.json"
"""Result: cameras and target in space (``reseau-scene/1``)."""
GENERATOR = "generator.py"
"""Input of a session of the plan `own`: the Python file with the generator."""


@dataclass(frozen=True)
class SessionKind:
    """What a session of one plan does, live and offline.

    Parameters
    ----------
    parameters : type
        Model of its parameters.
    acquire : callable
        Makes the plan of messages, of an acquisition and the parameters.
    inputs : tuple of str
        Names of the files that a session must be given.
    read : callable
        Reads the text of an input with a name, to check it; the third argument names it in messages. By
        default ``.json`` files are designs.
    procedure : callable, optional
        Makes the procedure, of a session and its parameters. Without one, frames are only stored.
    results : callable, optional
        Makes the results, with the report, of the procedure and the session. Default: those of the
        procedure.
    verdict : callable, optional
        Says of a complete procedure what its result is good for: ``lines``, ``warnings``, and ``tests`` that
        are not passed.
    limits : Limits, optional
        Limits of its frames.

    Examples
    --------
    >>> KINDS["testfield"].inputs
    ('design.json',)
    """

    parameters: type[SessionParameters]
    acquire: Callable[[Acquisition, Any], Plan]
    inputs: tuple[str, ...] = ()
    read: Callable[[str, str, object], object] = lambda text, name, where: _read_design(text, name, where)
    procedure: Callable[[Session, Any], Procedure] | None = None
    results: Callable[[Any, Session], dict[str, str]] | None = None
    verdict: Callable[[Any], dict[str, list[str]]] | None = None
    limits: Limits | None = None


def _read_design(text: str, name: str, where: object) -> object:
    return parse_design(text, where) if name.endswith(".json") else text


class Reported:
    """A procedure whose results include a report.

    Parameters
    ----------
    procedure : Procedure
        Measures the frames.
    finish : callable
        Returns the results with the report.

    Examples
    --------
    >>> reported = Reported(None, lambda: {"calibration.json": "{}", "report.html": "<html>"})
    >>> sorted(reported.finish())
    ['calibration.json', 'report.html']
    """

    def __init__(self, procedure: Any, finish: Callable[[], dict[str, str]]) -> None:
        self.procedure, self._finish = procedure, finish

    def on_frame(self, frame: Frame, step: Step) -> Verdict:
        """Measure a new frame."""
        verdict: Verdict = self.procedure.on_frame(frame, step)
        return verdict

    @property
    def recollection(self) -> Callable[[Step], dict[str, Any]] | None:
        """What the procedure says of a measured frame, if it can take that over when it is resumed."""
        return getattr(self.procedure, "recollection", None)

    @property
    def recall(self) -> Callable[[Step, Mapping[str, Any]], Verdict] | None:
        """How the procedure takes over a frame that was measured before."""
        return getattr(self.procedure, "recall", None)

    def progress(self) -> Mapping[str, float]:
        """Return the standard deviations reached so far."""
        reached: Mapping[str, float] = self.procedure.progress()
        return reached

    def next_pose(self, candidates: Sequence[Step], wanted: str) -> tuple[Step, float | None] | None:
        """Return the pose that lowers a standard deviation most."""
        found: tuple[Step, float | None] | None = self.procedure.next_pose(candidates, wanted)
        return found

    def finish(self) -> dict[str, str]:
        """Return the results with the report."""
        return self._finish()


def kind_of(plan: str) -> SessionKind:
    """Return the kind of the sessions of a plan: of this module, or of an installed package.

    Packages add kinds by entry points of the group ``reseau.sessions``.

    Raises
    ------
    UsageError
        If the plan is unknown.

    Examples
    --------
    >>> kind_of("sensor").parameters.__name__
    'SensorParameters'
    """
    if plan in KINDS:
        return KINDS[plan]
    added = plugins(SESSIONS)
    if plan not in added:
        raise UsageError("unknown plan", where=plan, do=f"use {', '.join([*KINDS, *added])}")
    found: SessionKind = plugin(SESSIONS, plan)
    return found


def own_plan(text: str, where: object, arguments: Mapping[str, Any] | None = None) -> Callable[..., Plan]:
    """Return the generator `plan(run, …)` of a Python file, which this function executes.

    Parameters
    ----------
    text : str
        Content of the file.
    where : object
        Names the file in messages.
    arguments : mapping, optional
        Arguments that the generator must accept.

    Raises
    ------
    FormatError
        If it is not Python, or does not define the generator.
    UsageError
        If the generator does not accept the arguments.

    Examples
    --------
    >>> own_plan("def plan(run, count):\\n    yield from ()", "own.py", {"count": 2}).__name__
    'plan'
    """
    names: dict[str, Any] = {"__name__": "plan", "__file__": str(where)}
    try:
        exec(compile(text, str(where), "exec"), names)  # the user asked for this
    except SyntaxError as error:
        raise FormatError(f"line {error.lineno} is not Python ({error.msg})", where=where) from None
    plan = names.get("plan")
    if not inspect.isgeneratorfunction(plan):
        raise FormatError("has no generator `plan(run, …)`", where=where, do="define one, with `yield from`")
    if arguments is not None:
        try:
            inspect.signature(plan).bind(None, **arguments)
        except TypeError as error:
            raise UsageError(f"does not accept the arguments ({error})", where=where) from None
    return plan


def _hashes(session: Session) -> dict[str, str]:
    """SHA-256 of the inputs of a session, by name."""
    return {name: each.sha256 for name, each in session.inputs().items()}


def _frames(run: Acquisition, given: FramesParameters) -> Plan:
    return plans.frames(run, given.count, given.average, given.checks)


def _scan(run: Acquisition, given: ScanParameters) -> Plan:
    return plans.scan(run, given.count)


def _own(run: Acquisition, given: OwnParameters) -> Plan:
    return own_plan(run.session.input(GENERATOR), GENERATOR)(run, **given.set)


def _oscilloscope(run: Acquisition, given: OscilloscopeParameters) -> Plan:
    return plans.oscilloscope(run, given.body, given.average, given.checks)


def _oscilloscope_procedure(session: Session, given: OscilloscopeParameters) -> OscilloscopeProcedure:
    from ..procedures.oscilloscope_acquisition import OscilloscopeProcedure

    reseau, rods = (
        ReseauDesign.parse(session.input(name), where=name) for name in ("reseau.json", "object.json")
    )
    return OscilloscopeProcedure(
        reseau, rods, name=session.name, options=session.parameters, inputs=_hashes(session),
        check=given.check,
    )  # fmt: skip


def _oscilloscope_results(procedure: OscilloscopeProcedure, session: Session) -> dict[str, str]:
    from ..report.page import oscilloscope_report

    results = procedure.finish()
    assert procedure.first is not None  # otherwise there are no results
    good = {
        each.step: each for each in session.frames(kind="frame") if each.verdict is None or each.verdict.ok
    }
    photos = [good.get(f"PHOTO {number}") for number in ("I", "II", "III")]
    report = oscilloscope_report(
        procedure.first, procedure.reseau, procedure.second, procedure.test_object,
        [] if procedure.third is None else [procedure.third],
        frames=[None if each is None else session.picture(each) for each in photos],
        title=f"Oscilloscope, session {session.name}", provenance=procedure.provenance,
    )  # fmt: skip
    return results | {"report.html": report}


def _testfield(run: Acquisition, given: TestfieldParameters) -> Plan:
    poses = given.poses()
    if given.goal is None:
        return plans.poses(run, poses, given.average, given.checks)
    first = spread(poses, given.first)
    return plans.until(run, given.goal, first, poses, given.average, given.checks)


def _testfield_procedure(
    session: Session, given: TestfieldParameters | PhotographsParameters
) -> TestfieldProcedure:
    from ..measure.testfield.measure import TestfieldOptions
    from ..procedures.target_measurement import measurer_of
    from ..procedures.testfield import TestfieldProcedure

    design = parse_design(session.input("design.json"), "design.json")
    # The poses and the goal have no influence on the result of given frames.
    options = {key: value for key, value in session.parameters.items() if key not in ("steps", "until")}
    measure = measurer_of(design, TestfieldOptions(row_jitter_px=given.row_jitter_px, fill=given.fill))
    return TestfieldProcedure(
        design, measure, given.camera_options(), name=session.name, options=options, inputs=_hashes(session),
        sigmas=given.sigmas, refraction=_refraction(session, given),
    )  # fmt: skip


def _refraction(session: Session, given: SessionParameters) -> RefractionEntry | None:
    """Windows and media before the camera, as the session's ``bench.toml`` describes them."""
    if not session.bench:
        return None
    file = BenchFile.parse_toml(session.bench, where=f"bench of {session.name}")
    found = {name: each.refraction for name, each in file.instruments.items() if each.refraction is not None}
    if given.camera is not None:
        return found.get(given.camera)
    if len(found) > 1:
        raise UsageError("have `refraction`", where=", ".join(found), do="name the camera of the session")
    return next(iter(found.values()), None)


def _of_files(run: Acquisition, given: SessionParameters) -> Plan:
    raise UsageError("is made of files, not on a bench", where=run.session.name)
    yield  # a generator, as all plans


def _calibration_results(procedure: TestfieldProcedure, session: Session) -> dict[str, str]:
    from ..report.scene import scene_of

    results = procedure.finish()
    found = procedure.calibrated().required()
    frames = {each.step: each for each in session.frames(kind="frame")}
    # Of a frame without enough points there is a verdict, of one that the calibration has left out a reason.
    declined = {
        step: each.verdict.why for step, each in frames.items()
        if each.verdict is not None and not each.verdict.ok
    }  # fmt: skip
    report = found.report_page(
        title=f"Calibration {session.name}", provenance=procedure.provenance, declined=declined,
        photograph=lambda name: session.picture(frames[name]),
    )  # fmt: skip
    return results | {"report.html": report, SCENE: scene_of(found.result).to_json()}


def _calibration_verdict(procedure: TestfieldProcedure) -> dict[str, list[str]]:
    found = procedure.calibrated().required()
    return {
        "lines": [line for each in found.assessments.values() for line in each.lines],
        "warnings": [str(each) for each in found.warnings],
        "tests": [str(each) for each in found.tests],
    }


def _film_procedure(session: Session, given: FilmParameters) -> FilmRollProcedure:
    from ..io import FrameCorners
    from ..procedures.film_roll import FilmRollProcedure

    def opened(name: str) -> Scan:
        found = session.find(name)
        assert found is not None  # a frame that the procedure was given
        return session.scan(found)

    calibrated = None
    if CORNERS in session.inputs():
        calibrated = FrameCorners.parse(session.input(CORNERS), where=CORNERS)
    return FilmRollProcedure(
        opened, given.options(), calibrated=calibrated, kind=given.transform,
        parameters=session.parameters, inputs=_hashes(session),
    )  # fmt: skip


def _film_results(procedure: FilmRollProcedure, session: Session) -> dict[str, str]:
    from ..report.frames import frame_tile, roll_page

    results, frames = procedure.finish(), {each.stem: each for each in procedure.frames}

    def picture(stem: str) -> Any:
        found = frames[stem]
        return frame_tile(procedure.opened(found.scan), found.document)

    return results | {"report.html": roll_page(procedure.summary(), picture)}


def _blurred(run: Acquisition, given: BlurredParameters) -> Plan:
    return plans.poses(run, given.poses(), given.average, given.checks)


def _read_blurred(text: str, name: str, where: object) -> Any:
    """An input of a session of blurred targets."""
    from ..io import LensDocument
    from ..io.network import Network1
    from ..io.targets import SpaceTargets

    reader: Any = {"network.json": Network1, "targets.json": SpaceTargets, "lens.toml": LensDocument}[name]
    return reader.parse(text, where=where)


def _blurred_procedure(session: Session, given: BlurredParameters) -> BlurredProcedure:
    from ..bundle import Network
    from ..exchange.lenses import Lens
    from ..procedures.blurred_files import BlurredImaging
    from ..procedures.blurred_network import NetworkOptions
    from ..procedures.blurred_session import BlurredProcedure

    document, targets, read = (_read_blurred(session.input(name), name, name) for name in _OF_BLURRED)
    lens = Lens(read.prescription(), read.sensor)
    imaging = BlurredImaging(lens, psf_px=given.psf_px, search_px=given.search_px)
    options = {key: value for key, value in session.parameters.items() if key != "steps"}
    return BlurredProcedure(
        document, Network.from_document(document), targets, lens,
        NetworkOptions(imaging.options(targets.polarity), given.rounds, initial=given.initial),
        name=session.name, parameters=options, inputs=_hashes(session),
    )  # fmt: skip


def _blurred_results(procedure: BlurredProcedure, session: Session) -> dict[str, str]:
    from ..report.blurred_network import blurred_network_report

    results = procedure.finish()
    found = procedure.measured()
    assert not isinstance(found, Failure)
    title = f"Blurred targets, session {session.name}"
    report = blurred_network_report(found, title=title, provenance=procedure.provenance)
    return results | {"report.html": report}


def _sensor(run: Acquisition, given: SensorParameters) -> Plan:
    return plans.sensor(run, given.series)


def _sensor_procedure(session: Session, given: SensorParameters) -> SensorProcedure:
    from ..procedures.sensor import SensorProcedure

    return SensorProcedure(name=session.name, region=given.region, options=session.parameters)


def _sensor_results(procedure: SensorProcedure, session: Session) -> dict[str, str]:
    from ..report.sensor import sensor_report

    probes = session.frames(kind="probe")
    camera = probes[0].facts["identity"] if probes else session.name
    report = sensor_report(procedure.result(), title=f"Sensor of {camera}", provenance=procedure.provenance)
    return procedure.calibrated(camera) | {"report.html": report}


_OF_BLURRED = ("network.json", "targets.json", "lens.toml")

KINDS: Mapping[str, SessionKind] = {
    "testfield": SessionKind(
        TestfieldParameters,
        _testfield,
        ("design.json",),
        procedure=_testfield_procedure,
        results=_calibration_results,
        verdict=_calibration_verdict,
    ),
    "oscilloscope": SessionKind(
        OscilloscopeParameters,
        _oscilloscope,
        ("reseau.json", "object.json"),
        procedure=_oscilloscope_procedure,
        results=_oscilloscope_results,
    ),
    "photographs": SessionKind(
        PhotographsParameters,
        _of_files,
        ("design.json",),
        procedure=_testfield_procedure,
        results=_calibration_results,
        verdict=_calibration_verdict,
    ),
    "film": SessionKind(FilmParameters, _of_files, procedure=_film_procedure, results=_film_results),
    "sensor": SessionKind(
        SensorParameters,
        _sensor,
        (),
        procedure=_sensor_procedure,
        results=_sensor_results,
        limits=plans.NO_EXPOSURE_LIMITS,
    ),
    "blurred": SessionKind(
        BlurredParameters, _blurred, _OF_BLURRED, _read_blurred, _blurred_procedure, _blurred_results
    ),
    "frames": SessionKind(FramesParameters, _frames),
    "scan": SessionKind(ScanParameters, _scan),
    "own": SessionKind(OwnParameters, _own, (GENERATOR,)),
}
"""Kinds of sessions by the name of the plan."""

OF_FILES = ("photographs", "film")
"""Plans of sessions that are made of files, not on a bench."""


def input_option(name: str) -> str:
    """Return the option of an input file of a session, which is its name but for one.

    Examples
    --------
    >>> input_option("design.json"), input_option("object.json")
    ('design', 'test_object')
    """
    return {"object.json": "test_object"}.get(name, name.rpartition(".")[0])
