"""What the other scanners state in millimetres, and what they do not; the pulser with its oscilloscope."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from numpy.typing import NDArray

from reseau.capture import Bench, BenchFile
from reseau.core.errors import (
    BenchError,
    ConnectionLost,
    DeadlineError,
    ProtocolError,
    SettingError,
    StateError,
)
from reseau.instruments import UltrasonicScanner
from reseau_drivers.codecs import bk
from reseau_drivers.oscilloscope import oscilloscope
from reseau_drivers.scanner import BkScanner, CompactPulser, bk_oem, compact_pulser
from reseau_drivers.turntable import zaber
from reseau_sims import serving
from reseau_sims.serving import Fault, FaultScript, FaultyConnection, InProcess, Machine, ZaberChain


def linked(machine: Machine) -> InProcess:
    return InProcess(lambda: FaultyConnection(machine))


def bk_pair() -> tuple[BkScanner, serving.BkScanner]:
    machine = serving.BkScanner()
    return bk_oem("bk", InProcess(lambda: FaultyConnection(machine))), machine


def test_a_frame_has_its_pixel_size() -> None:
    device, machine = bk_pair()
    with device:
        assert isinstance(device, UltrasonicScanner)
        scan = device.scan()
        assert (scan.pixels == machine.section()).all()
        assert scan.mm_per_px == pytest.approx((0.2, 0.25))
        assert scan.gain == 57.0
        assert device.describe()["bk_section"]["shape"] == [1, 60, 80]
        device.trigger().wait(5.0)
        assert device.read()["bk_mm_per_px"]["value"] == pytest.approx([0.2, 0.25])
    assert machine.violations == []


@pytest.mark.parametrize(
    "stated",
    [
        b"DATA:B_GEOMETRY_US_FRAME_GRAB:A 0,0,200,59;",
        b"DATA:B_GEOMETRY_US_FRAME_GRAB:A -5,0,79,59;",
        b"DATA:B_GEOMETRY_US_FRAME_GRAB:A 0,0,79,60;",
        b"DATA:B_GEOMETRY_US_FRAME_GRAB:A 10,0,10,59;",
    ],
)
def test_a_window_outside_the_frame_gives_no_pixel_size(stated: bytes) -> None:
    device, machine = bk_pair()
    answer = machine._answer
    machine._answer = lambda m: stated if b"FRAME_GRAB:A" in m else answer(m)  # type: ignore[method-assign]
    with device:
        scan = device.scan()
        assert scan.mm_per_px is None
        assert scan.pixels.shape == (60, 80)


def test_a_box_of_the_whole_screen_gives_no_pixel_size() -> None:
    machine = serving.BkScanner()
    with bk_oem("bk", InProcess(lambda: FaultyConnection(machine)), box="B_GEOMETRY_PIXEL") as device:
        assert device.scan().mm_per_px is None
    with pytest.raises(SettingError, match="B_GEOMETRY_US_FRAME_GRAB"):
        bk_oem("bk", "tcp://127.0.0.1:1", box="B_GEOMETRY")


def test_a_window_that_changes_during_a_frame_is_detected() -> None:
    device, machine = bk_pair()
    answer, sizes = machine._answer, iter([b"80,60", b"80,60", b"60,80"])
    machine._answer = lambda m: (  # type: ignore[method-assign]
        b"DATA:US_WIN_SIZE " + next(sizes) + b";" if b"WIN_SIZE" in m else answer(m)
    )
    with pytest.raises(ProtocolError, match="changed its window"):
        device.scan()
    device.close()


@pytest.mark.parametrize(
    "size", [b"1e9,1e9", b"0,0", b"80.5,60", b"nan,60", b"-80,60", b"80", b"x,y", b"80,60,1", b"inf,60"]
)
def test_implausible_sizes_are_rejected(size: bytes) -> None:
    device, machine = bk_pair()
    answer = machine._answer
    machine._answer = lambda m: (  # type: ignore[method-assign]
        b"DATA:US_WIN_SIZE " + size + b";" if b"WIN_SIZE" in m else answer(m)
    )
    with pytest.raises(ProtocolError):
        device.scan()
    device.close()


def test_a_bk_frame_of_another_size_is_rejected() -> None:
    device, machine = bk_pair()
    machine._frame = lambda: bk.encode_frame(bk.GrabbedFrame(1, bytes(100), 104))  # type: ignore[method-assign]
    with pytest.raises(ProtocolError, match="101 bytes for 4800 pixels"):
        device.scan()
    device.close()


def pulser(**options: object) -> tuple[CompactPulser, serving.CompactPulser]:
    machine = serving.CompactPulser()
    return compact_pulser("pulser", InProcess(lambda: FaultyConnection(machine)), **options), machine  # type: ignore[arg-type]


def test_echoes_of_the_pulser_come_from_its_oscilloscope() -> None:
    shown = serving.Oscilloscope("rigol-1000z")
    scope = oscilloscope("scope", InProcess(lambda: FaultyConnection(shown)))
    device, machine = pulser(digitiser=scope, settings={"speed_m_s": 1480.0})
    with device, scope:
        with pytest.raises(StateError, match="sends no pulses"):
            device.line()
        device.configure(repetition_hz=200.0, gain_db=30.0)
        assert (machine.values["P"], machine.values["G"]) == (20, 300)
        line = device.line()
        depth = device.depths_mm(line)
        assert np.diff(depth) == pytest.approx(np.full(len(depth) - 1, 1480e3 * 1e-6 / 2))
        device.stop()
        assert machine.values["P"] == 0
    assert machine.violations == shown.violations == []


def test_a_readable_gain_checks_the_other_settings() -> None:
    machine = serving.CompactPulser(readable="G")
    device = compact_pulser("pulser", InProcess(lambda: FaultyConnection(machine)), answer_s=0.05)
    with device:
        assert machine.values == {"P": 0, "W": 220, "V": 300, "D": 0, "M": 0, "T": 0, "G": 0}
        device.configure(gain_db=84.0, width_ns=100.0)
        assert (machine.values["G"], machine.values["W"]) == (840, 100)
        assert "others are not readable" in device.check()["settings"]
        machine.inject_fault("power-cycled")
        with pytest.raises(StateError, match="G = 5"):
            device.verify()
        # In local mode it takes nothing: that is found though the gain is asked for as it was.
        machine.receive = lambda data: [b"G=840\r"] if data == b"G?\r" else []  # type: ignore[method-assign]
        with pytest.raises(StateError, match="local mode"):
            device.configure(width_ns=90.0)
    assert machine.violations == []


def test_a_moved_transducer_makes_sections() -> None:
    chain, shown = ZaberChain([1]), serving.Oscilloscope("keysight")
    where, speed, step_s = np.array([12.0, 300.0]), 1480.0, 1e-6

    def samples() -> NDArray[np.uint8]:
        # An oscillation of 100 kHz, as it comes back from a point at 12 mm along and 300 mm deep.
        off = chain.position(1, 1) / 1000 - where[0]
        range_mm = np.hypot(off, where[1])
        late = -5e-4 + step_s * np.arange(1000) - 2 * range_mm * 1e-3 / speed
        echo = np.exp(-0.5 * (late / 8e-6) ** 2 - 0.5 * (off / 4) ** 2) * np.cos(2 * np.pi * 1e5 * late)
        return np.asarray(np.rint(128 + 100 * echo), np.uint8)

    shown.samples = samples
    scope = oscilloscope("scope", linked(shown))
    axes = {"z": {"per_unit": 1000.0, "unit": "mm", "high": 300.0}}
    table = zaber("table", linked(chain), axes=axes, settings={"speed": 1000.0})
    expected = {"repetition_hz": 100.0, "speed_m_s": speed, "lines": 25, "full_scale_v": 5.0, "gain_db": 20.0}
    device, machine = pulser(digitiser=scope, carrier=table, settings=expected)
    with scope, table, device:
        assert isinstance(device, UltrasonicScanner)
        with pytest.raises(StateError, match="home z first"):
            device.scan()
        table.home("z")
        scan = device.scan()
        assert device.describe()["pulser_mm_per_px"]["shape"] == [2]
        with pytest.raises(DeadlineError):
            device.scan(0.05)
    assert scan.pixels.shape == (500, 25)
    assert scan.mm_per_px == pytest.approx((1.0, speed * 1e3 * step_s / 2))
    assert scan.gain == 20.0
    row, column = np.unravel_index(int(scan.pixels.argmax()), scan.pixels.shape)
    depth = (row - scan.origin_px[1]) * scan.mm_per_px[1]
    along = (column - scan.origin_px[0]) * scan.mm_per_px[0] + 12.0
    assert (along, depth) == (pytest.approx(12.0), pytest.approx(300.0, abs=0.8))
    assert scan.pixels.max() == pytest.approx(255 * 4 / 5, abs=3)
    assert machine.violations == chain.violations == shown.violations == []


def test_stop_ends_a_section_and_stops_the_carrier() -> None:
    chain, shown = ZaberChain([1]), serving.Oscilloscope("keysight")
    axes = {"z": {"per_unit": 1000.0, "unit": "mm", "high": 300.0}}
    table = zaber("table", linked(chain), axes=axes, settings={"speed": 20.0})
    scope = oscilloscope("scope", linked(shown))
    expected = {"repetition_hz": 100.0, "step_mm": 100.0, "lines": 3}
    device, machine = pulser(digitiser=scope, carrier=table, settings=expected)
    with scope, table, device:
        table.home("z")
        caught: list[Exception] = []

        def scan() -> None:
            try:
                device.scan()
            except StateError as error:
                caught.append(error)

        thread = threading.Thread(target=scan)
        thread.start()
        time.sleep(0.5)
        device.stop()
        thread.join(5.0)
        assert "was stopped" in str(caught[0])
        assert machine.values["P"] == 0
        state = table.state("z")
        assert not state.moving
        assert state.position < 90.0
    assert machine.violations == chain.violations == shown.violations == []


def test_combined_instruments_are_named_on_the_bench() -> None:
    text = """
        schema = "reseau-bench/1"
        [instruments.pulser]
        driver = "compactpulser"
        address = "tcp://127.0.0.1:1"
        options = {digitiser = "scope", carrier = "table"}
        [instruments.scope]
        driver = "oscilloscope"
        address = "tcp://127.0.0.1:1"
        [instruments.table]
        driver = "zaber"
        address = "tcp://127.0.0.1:1"
        options = {axes = {z = {unit = "mm"}}}
    """
    bench = Bench(BenchFile.parse_toml(text, where="bench.toml"))
    assert bench["pulser"]._digitiser is bench["scope"]  # type: ignore[attr-defined]
    assert bench["pulser"]._carrier is bench["table"]  # type: ignore[attr-defined]
    for wrong, message in (
        (text.replace('"scope", carrier', '"table", carrier'), "digitiser 'table' is not an oscilloscope"),
        (text.replace("axes = {z", "axes = {tilt"), "is not a table with an axis 'z'"),
        (text.replace('carrier = "table"', 'carrier = "none"'), "carrier 'none'"),
    ):
        with pytest.raises(BenchError, match=message):
            Bench(BenchFile.parse_toml(wrong, where="bench.toml"))


def test_settings_of_a_pulser_are_restored_after_power_loss() -> None:
    machine, script = serving.CompactPulser(), FaultScript()
    device = compact_pulser(
        "pulser", InProcess(lambda: FaultyConnection(machine, script)), settings={"voltage": 250.0}
    )
    with device:
        device.configure(repetition_hz=500.0, gain_db=12.5)
        before = dict(machine.values)
        machine.inject_fault("power-cycled")
        script.fault_at(script.count, Fault("disconnected"))
        with pytest.raises(ConnectionLost):
            device.verify()
        device.verify()
        assert machine.values == before
        assert device.reconnections == 2
        # A run stops the pulses at its end; the next one has them again.
        device.unstage()
        assert machine.values["P"] == 0
        device.stage()
        assert machine.values == before


def test_a_setting_changed_by_hand_is_detected() -> None:
    device, machine = pulser()
    with device:
        assert device.check()["settings"] == "as sent"
        machine.values["G"] = 12
        with pytest.raises(StateError, match="G = 12 instead of 0"):
            device.verify()
        with pytest.raises(StateError, match="set the option digitiser"):
            device.line()
        with pytest.raises(SettingError, match="300 V"):
            device.configure(voltage=500.0)
    assert machine.violations == []
