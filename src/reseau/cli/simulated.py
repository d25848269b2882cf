"""Sessions on the simulated bench, over its real protocols: what `reseau demo` captures."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from ..core.errors import EstimationError
from .sessions import oscilloscope_of, testfield_of

if TYPE_CHECKING:
    from ..archive import Archive, Session
    from ..capture import InstrumentEntry, Plan, Procedure
    from ..core.data import Frame
    from ..instruments import Instrument
    from ..io import ReseauDesign
    from ..optics import PlaneMapping
    from ..procedures.calibration import Calibrated
    from ..procedures.oscilloscope import PhotoI, PhotoII, PhotoIII
    from ..report.truth import KnownPoints

__all__ = ["OscilloscopeSession", "TestfieldSession", "World", "captured_oscilloscope", "captured_testfield"]

_POSES = 12
_SETTINGS: dict[str, dict[str, Any]] = {"scanner": {"half_sector": 100}, "table": {"speed": 1000.0}}
"""The head sweeps over all that is in the tank; the table loses no time."""
_CAMERA = {"pitch": 0.027, "free": ["c", "x0", "y0", "K1"], "row_jitter": 0.0086, "fill": 0.8}
"""Before the testfield: the paper's."""


class World(Protocol):
    """What a simulated world knows; see the entry point ``bench`` of ``reseau.simulators``."""

    @property
    def design(self) -> ReseauDesign:
        """The reseau in front of the screen."""

    @property
    def test_object(self) -> ReseauDesign:
        """The rods of the test object, as designed."""

    def check_marks(self) -> tuple[str, ...]:
        """Marks to hold out."""

    def view(self) -> PlaneMapping:
        """The truth: from the plane of the reseau to the image."""

    def truth_ii(self) -> KnownPoints:
        """The truth: the rods as they were made, and where PHOTO II shows them."""

    def truth_iii(self) -> KnownPoints:
        """The truth: the points of the body."""


@dataclass(frozen=True, eq=False)
class OscilloscopeSession:
    """The three photographs, and what came out."""

    world: World
    frames: tuple[Frame, ...]
    first: PhotoI
    second: PhotoII
    third: PhotoIII
    way: str


@dataclass(frozen=True, eq=False)
class TestfieldSession:
    """The calibration of the camera before the testfield, its files, and what its parameters truly are."""

    calibrated: Calibrated
    true: dict[str, float]
    documents: dict[str, str]
    poses: int


def _carried_out(
    simulated: Any,
    kept: Session,
    procedure: Procedure,
    planned: Callable[[Any], Plan],
    names: tuple[str, ...],
    watch: Callable[[str, dict[str, Any]], None],
) -> None:
    """Carry a plan out with some instruments of a simulated bench; its tank is filled as the plan asks."""
    from ..capture import Acquisition, Bench, BenchFile, BenchLock, carry_out

    laboratory = simulated.laboratory
    tanks = {"test object": lambda: laboratory.world.rods, "body": laboratory.world.body}

    def operator(what: str) -> None:
        for word, filled in tanks.items():
            if word in what:
                laboratory.tank = filled()

    file = BenchFile.parse_toml(simulated.toml + _in_process(simulated), where="simulated bench")
    entries = {name: file.instruments[name] for name in names}
    with BenchLock([entry.address for entry in entries.values()], "the demo"):
        bench = Bench(file.model_copy(update={"instruments": entries}), _builder(simulated))
        try:
            for name, changes in _SETTINGS.items():
                if name in names:
                    bench[name].configure(**changes)
            run = Acquisition(bench, kept, procedure, watch=watch, operator=operator)
            carry_out(run, planned(run))
        finally:
            bench.close()


def _in_process(simulated: Any) -> str:
    """The camera's entry where it cannot be reached from outside this process."""
    if simulated.video is None:
        return ""
    return '\n[instruments.camera]\ndriver = "v4l2"\naddress = "in this process"\n'


def _builder(simulated: Any) -> Callable[[str, InstrumentEntry], Instrument] | None:
    """What makes the instruments: drivers by their entry points, the camera at its node in this process."""
    from ..capture import plugin
    from ..capture.bench import INSTRUMENTS, built

    if simulated.video is None:
        return None

    def build(name: str, entry: InstrumentEntry) -> Instrument:
        if name != "camera":
            return built(name, entry)
        settings = {"exposure_us": 10_000.0}  # as the other door has it
        made: Instrument = plugin(INSTRUMENTS, "v4l2")(
            name, simulated.video.open, settings=settings, seconds=30.0
        )
        return made

    return build


def captured_oscilloscope(
    archive: Archive, seed: int, watch: Callable[[str, dict[str, Any]], None]
) -> OscilloscopeSession:
    """PHOTO I, II and III of the simulated bench, taken over its protocols and refined as they came.

    Raises
    ------
    EstimationError
        When a photograph could not be refined.
    """
    from ..capture import plans, plugin

    options = {"camera": "screen", "repeatable": True, "in_process": not _speaks_gige()}
    with plugin("reseau.simulators", "bench")(seed, **options) as simulated:
        world: World = simulated.laboratory.world
        inputs = {"reseau.json": world.design.to_json(), "object.json": world.test_object.to_json()}
        given = {"seed": seed, "check": list(world.check_marks())}
        kept = archive.begin("oscilloscope", "oscilloscope", given, simulated.toml, inputs)
        live = oscilloscope_of(kept)
        names = ("scanner", "oscilloscope", "camera")
        _carried_out(simulated, kept, live, plans.oscilloscope, names, watch)
        way = _way(simulated)
    frames = tuple(kept.picture(f) for f in kept.frames(kind="frame") if f.verdict and f.verdict.ok)
    if live.first is None or live.second is None or live.third is None:
        raise EstimationError("the photographs could not all be refined", where="demo")
    return OscilloscopeSession(world, frames, live.first, live.second, live.third, way)


def captured_testfield(
    archive: Archive, seed: int, watch: Callable[[str, dict[str, Any]], None]
) -> TestfieldSession:
    """A camera calibrated by recordings of the simulated testfield, taken over the bench's protocols.

    Raises
    ------
    EstimationError
        When the calibration fails.
    """
    from ..capture import paper_steps, plans, plugin, spread

    steps = spread(paper_steps(), _POSES)
    given = {"seed": seed, "steps": [[step.name, dict(step.position)] for step in steps], **_CAMERA}
    options = {"camera": "testfield", "repeatable": True, "flat": True, "in_process": not _speaks_gige()}
    with plugin("reseau.simulators", "bench")(seed, **options) as simulated:
        field = simulated.laboratory.field
        inputs = {"design.json": field.design.to_json()}
        kept = archive.begin("testfield", "testfield", given, simulated.toml, inputs)
        procedure = testfield_of(kept)

        def planned(run: Any) -> Plan:
            return plans.homed(run, plans.poses(run, steps))

        _carried_out(simulated, kept, procedure, planned, ("table", "camera"), watch)
        true = dict(zip(field.camera.names, field.camera.values.tolist(), strict=True))
    made = {result.name: kept.content(result).decode("utf-8") for result in kept.results()}
    found = procedure.live.calibrated().required()
    return TestfieldSession(found, true, made, len(kept.frames(kind="frame")))


def _speaks_gige() -> bool:
    """Whether the driver of GigE Vision has what it needs: PyGObject."""
    return importlib.util.find_spec("gi") is not None


def _way(simulated: Any) -> str:
    """How frames came."""
    if simulated.video is None:
        return "GigE Vision"
    return "Video4Linux, simulated in process (Aravis or PyGObject is not installed)"
