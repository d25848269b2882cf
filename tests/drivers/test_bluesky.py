"""bluesky's own plans drive every instrument as it is: count, scan, grids, moves; paused and aborted."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

import numpy as np
import pytest
import tifffile

from reseau.core.errors import SettingError, StateError, UsageError
from reseau_drivers.camera import Burst, v4l2
from reseau_drivers.oscilloscope import oscilloscope
from reseau_drivers.scanner import bk_oem, compact_pulser, dicom_files, ping360
from reseau_drivers.turntable import smc100, zaber
from reseau_sims import serving
from reseau_sims.serving import (
    FaultyConnection,
    InProcess,
    Machine,
    SimulatedCamera,
    Smc100Line,
    VideoCamera,
    ZaberChain,
)

bluesky: Any = pytest.importorskip("bluesky", reason="bluesky is not installed")
import bluesky.plan_stubs as bps  # noqa: E402
import bluesky.plans as bp  # noqa: E402
import bluesky.preprocessors as bpp  # noqa: E402
import event_model  # noqa: E402
from bluesky import protocols  # noqa: E402

EVERY = (
    "Readable", "Triggerable", "Stageable", "Stoppable", "Configurable", "Pausable", "Subscribable",
    "HasHints", "WritesStreamAssets",
)  # fmt: skip
Pair = tuple[Any, Machine | None]


def linked(machine: Machine) -> InProcess:
    return InProcess(lambda: FaultyConnection(machine))


def zaber_table() -> Pair:
    chain = ZaberChain([2], low=-100_000.0)
    axes = {
        "tilt": {"per_unit": 1000.0, "high": 90.0, "backlash": 0.5},
        "roll": {"axis": 2, "per_unit": 1000.0, "low": -90.0, "high": 90.0},
    }
    return zaber("table", linked(chain), axes=axes, settings={"speed": 900.0}), chain


def smc100_table() -> Pair:
    line = Smc100Line(2, low=-10.0, high=100.0)
    axes = {
        "tilt": {"device": 1, "high": 90.0, "backlash": 0.5},
        "roll": {"device": 2, "low": -9.0, "high": 90.0},
    }
    return smc100("table", linked(line), axes=axes, settings={"speed": 900.0}), line


def ping360_scanner(tmp_path: Path) -> Pair:
    head = serving.Ping360()
    return ping360("sonar", linked(head), settings={"half_sector": 3}), head


def keysight_oscilloscope(tmp_path: Path) -> Pair:
    machine = serving.Oscilloscope("keysight")
    return oscilloscope("scope", linked(machine)), machine


def bk_scanner(tmp_path: Path) -> Pair:
    machine = serving.BkScanner()
    return bk_oem("bk", linked(machine)), machine


def pulser_scanner(tmp_path: Path) -> Pair:
    machine = serving.CompactPulser()
    scope = oscilloscope("scope", linked(serving.Oscilloscope("rigol-1000z")))
    return compact_pulser(
        "pulser", linked(machine), digitiser=scope, settings={"repetition_hz": 100.0}
    ), machine


def dicom_folder(tmp_path: Path) -> Pair:
    pytest.importorskip("pydicom", reason="pydicom is not installed")
    from .test_dicom import PICTURE, file, region

    file(tmp_path / "a.dcm", region(), pixels=np.stack([PICTURE] * 9), NumberOfFrames=9)
    return dicom_files("files", str(tmp_path)), None


DETECTORS: list[Callable[[Path], Pair]] = [
    ping360_scanner, keysight_oscilloscope, bk_scanner, pulser_scanner, dicom_folder
]  # fmt: skip
TABLES: list[Callable[[], Pair]] = [zaber_table, smc100_table]


@pytest.fixture
def engine() -> Any:
    return bluesky.RunEngine(context_managers=[], call_returns_result=True)


@pytest.mark.parametrize("make_table", TABLES)
@pytest.mark.parametrize("make", DETECTORS)
def test_count_and_scan_with_every_detector_on_every_table(
    make: Callable[[Path], Pair], make_table: Callable[[], Pair], tmp_path: Path, engine: Any
) -> None:
    (detector, machine), (table, controller) = make(tmp_path), make_table()
    for expected in EVERY:
        assert isinstance(detector, getattr(protocols, expected)), expected
    documents: list[tuple[str, dict[str, Any]]] = []
    with table, detector:
        table.home("tilt")
        engine(bp.count([detector, table], 2), lambda *d: documents.append(d))
        engine(bp.scan([detector], table.axes["tilt"], 10.0, 30.0, 3), lambda *d: documents.append(d))
    events = [document["data"] for kind, document in documents if kind == "event"]
    assert [event.get("table_tilt") for event in events[2:]] == pytest.approx([10.0, 20.0, 30.0])
    described = [document for kind, document in documents if kind == "descriptor"]
    for event, keys in zip(events[1::3], (described[0]["data_keys"], described[1]["data_keys"]), strict=True):
        assert set(event) == {name for name, kind in keys.items() if "external" not in kind}
        for name, value in event.items():
            shape = keys[name]["shape"]
            assert list(np.shape(value)) == list(shape), name
    assert detector.name in described[0]["configuration"]
    assert [d["exit_status"] for kind, d in documents if kind == "stop"] == ["success", "success"]
    assert controller is not None
    assert controller.violations == []
    assert machine is None or machine.violations == []


@pytest.mark.parametrize("make_table", TABLES)
def test_moves_grids_and_settings_of_a_table(make_table: Callable[[], Pair], engine: Any) -> None:
    table, controller = make_table()
    tilt, roll = table.axes["tilt"], table.axes["roll"]
    for expected in ("Readable", "Movable", "Stoppable", "Checkable", "NamedMovable", "Locatable",
                     "Subscribable", "HasHints"):  # fmt: skip
        assert isinstance(tilt, getattr(protocols, expected)), expected
    for expected in EVERY:
        assert isinstance(table, getattr(protocols, expected)), expected
    events: list[dict[str, Any]] = []

    def store(kind: str, document: dict[str, Any]) -> None:
        if kind == "event":
            events.append(document["data"])

    with table:
        for axis in table.axes:
            table.home(axis)
        engine(bps.mv(tilt, 12.0, roll, -5.0))
        assert (tilt.position, roll.position) == pytest.approx((12.0, -5.0), abs=2e-3)
        table.configure(speed=500.0)
        engine(bp.grid_scan([], tilt, 5.0, 15.0, 2, roll, 0.0, 10.0, 2), store)
        engine(bps.mv(tilt, 20.0))
        engine(bp.rel_scan([], tilt, -5.0, 5.0, 3), store)
        assert tilt.position == pytest.approx(20.0, abs=2e-3)
        assert [event["table_tilt"] for event in events[4:]] == pytest.approx([15, 20, 25], abs=2e-3)
        with pytest.raises(SettingError, match=r"axis tilt of table.*outside"):
            engine(bps.mv(tilt, 91.0))
        with pytest.raises(SettingError):
            tilt.check_value(-1.0)
    assert [(e["table_tilt"], e["table_roll"]) for e in events[:4]] == [
        pytest.approx(where, abs=2e-3) for where in ((5, 0), (5, 10), (15, 0), (15, 10))
    ]
    assert controller is not None
    assert controller.violations == []


@pytest.mark.parametrize("make_table", TABLES)
def test_an_aborted_plan_stops_the_table(make_table: Callable[[], Pair], engine: Any) -> None:
    table, controller = make_table()
    with table:
        table.home("tilt")
        table.configure(speed=5.0)

        def moving() -> Any:
            yield from bps.open_run()
            yield from bps.abs_set(table.axes["tilt"], 80.0, group="move")
            yield from bps.wait("move")

        # The engine runs in this thread: another one asks it to pause.
        threading.Timer(0.5, engine.request_pause).start()
        with pytest.raises(bluesky.utils.RunEngineInterrupted):
            engine(moving())
        # The engine may see the failure of the stopped move before the abort ends, depending on timing.
        with contextlib.suppress(bluesky.utils.FailedStatus):
            engine.abort("enough")
        state = table.state("tilt")
        assert not state.moving
        assert state.position < 40.0
    assert controller is not None
    assert controller.violations == []


def test_a_failure_of_an_instrument_ends_the_plan_with_its_name(engine: Any) -> None:
    table, chain = zaber_table()
    with table:
        table.home("tilt")
        assert isinstance(chain, ZaberChain)
        chain.motors[1, 1].cut_power()
        with pytest.raises(
            bluesky.utils.FailedStatus, match=r"table \(move tilt to 10 deg\): is not homed"
        ) as caught:
            engine(bp.scan([], table.axes["tilt"], 10.0, 20.0, 2))
    assert isinstance(caught.value.__cause__, StateError)


@pytest.fixture
def eye() -> Iterator[Any]:
    body = SimulatedCamera()
    device = VideoCamera(body)
    with v4l2("eye", device.open, settings={"exposure_us": 2000.0}, seconds=5.0) as camera:
        yield camera
    assert body.violations == []


def images_of(documents: list[tuple[str, dict[str, Any]]]) -> list[np.ndarray]:
    """The images to which documents refer, read from their files."""
    found = []
    for kind, document in documents:
        if kind == "stream_resource":
            folder = Path(unquote(urlparse(document["uri"]).path))
            template = document["parameters"]["template"]
        elif kind == "resource":
            folder = Path(document["root"]) / document["resource_path"]
            template = document["resource_kwargs"]["template"].lstrip("/")
        elif kind == "stream_datum":
            indices = range(document["indices"]["start"], document["indices"]["stop"])
            found += [tifffile.imread(folder / template.format(k)) for k in indices]
        elif kind == "datum":
            found.append(tifffile.imread(folder / template.format(document["datum_kwargs"]["point_number"])))
    return found


def test_images_are_files_to_which_documents_refer(eye: Any, engine: Any) -> None:
    (table, controller), documents = zaber_table(), []
    with table:
        table.home("tilt")
        plan = bp.scan([eye], table.axes["tilt"], 10.0, 30.0, 3)
        engine(bpp.monitor_during_wrapper(plan, [table.axes["tilt"]]), lambda *d: documents.append(d))
        at = table.axes["tilt"].locate()
        assert (at["setpoint"], round(at["readback"], 3)) == (30.0, 30.0)
    drawn = images_of(documents)
    assert [picture.shape for picture in drawn] == 3 * [(64, 96)]
    assert all(any((picture == each).all() for each in eye_drawn(eye)) for picture in drawn)
    names = {d["uid"]: d["name"] for kind, d in documents if kind == "descriptor"}
    events = [(names[d["descriptor"]], d["data"]) for kind, d in documents if kind == "event"]
    assert all(np.size(value) == 1 for _, data in events for value in data.values())
    watched = [data["table_tilt"] for name, data in events if name != "primary"]
    assert min(watched) < 10.0 < max(watched)
    for kind, document in documents:
        event_model.schema_validators[event_model.DocumentNames[kind]].validate(document)
    assert controller is not None
    assert controller.violations == []


def eye_drawn(eye: Any) -> list[np.ndarray]:
    """Images that the simulated camera has drawn."""
    return list(eye._source._open_node.__self__.body.drawn)


def test_settings_are_configured_as_bluesky_passes_them(eye: Any, engine: Any) -> None:
    engine(bps.configure(eye, {"exposure_us": 4000.0}))
    assert eye.settings.exposure_us == 4000.0
    eye.configure({"exposure_us": 3000.0}, rate=50.0)
    assert (eye.settings.exposure_us, eye.settings.rate) == (3000.0, 50.0)


def test_bluesky_flies_a_burst_of_frames_at_the_rate_of_the_camera(eye: Any, engine: Any) -> None:
    burst, documents = Burst(eye, 3), []
    for expected in ("Flyable", "Preparable", "Collectable", "EventCollectable", "Stoppable"):
        assert isinstance(burst, getattr(protocols, expected)), expected
    engine(bps.prepare(burst, {"frames": 8, "rate": 100.0}, wait=True))
    engine(bp.fly([burst]), lambda *d: documents.append(d))
    assert [picture.shape for picture in images_of(documents)] == 8 * [(64, 96)]
    (page,) = [d for kind, d in documents if kind == "event_page"]
    sequence = np.array(page["data"]["eye_burst_sequence"])
    assert (np.diff(sequence) == 1).all()
    with pytest.raises(UsageError, match="0 is not a number of frames"):
        burst.prepare(0)


def test_a_paused_plan_stops_its_instruments_and_goes_on(engine: Any) -> None:
    table, controller = zaber_table()
    stops: list[str] = []
    with table:
        table.home("tilt")
        halt = table._halt
        table._halt = lambda deadline: (stops.append("stopped"), halt(deadline))[1]

        def plan() -> Any:
            yield from bps.open_run()
            yield from bps.trigger_and_read([table])
            yield from bps.checkpoint()
            yield from bps.pause()
            yield from bps.mv(table.axes["tilt"], 12.0)
            yield from bps.close_run()

        with pytest.raises(bluesky.utils.RunEngineInterrupted):
            engine(plan())
        assert stops == ["stopped"]
        engine.resume()
        assert table.state("tilt").position == pytest.approx(12.0, abs=2e-3)
    assert controller is not None
    assert controller.violations == []


@pytest.mark.filterwarnings("ignore")  # of the packages that tiled uses
def test_images_are_read_back_through_tiled(eye: Any, engine: Any, tmp_path: Path) -> None:
    pytest.importorskip("tiled", reason="tiled is not installed")
    from bluesky.callbacks.tiled_writer import TiledWriter
    from tiled.catalog import in_memory
    from tiled.client import Context, from_context
    from tiled.server.app import build_app

    catalog = in_memory(
        readable_storage=[str(eye.images.folder.parent)],
        writable_storage=[str(tmp_path), f"duckdb:///{tmp_path}/tables.db"],
    )
    with Context.from_app(build_app(catalog)) as context:
        client = from_context(context)
        engine.subscribe(TiledWriter(client))
        (uid,) = engine(bp.count([eye], 3)).run_start_uids
        stored = client[uid]["primary"]["eye_image"].read()
    assert stored.shape == (3, 64, 96)
    assert all(any((picture == each).all() for each in eye_drawn(eye)) for picture in stored)
