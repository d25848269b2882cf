"""What the other scanners state in millimetres, and what they do not; the pulser with its oscilloscope."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.errors import ProtocolError, SettingError, StateError
from reseau.instruments import UltrasonicScanner
from reseau_drivers.codecs import bk
from reseau_drivers.oscilloscope import oscilloscope
from reseau_drivers.scanner import BkScanner, CompactPulser, bk_oem, compact_pulser
from reseau_sims import serving
from reseau_sims.serving import InProcess, Script, Wire


def bk_pair() -> tuple[BkScanner, serving.BkScanner]:
    machine = serving.BkScanner()
    return bk_oem("bk", InProcess(lambda: Wire(machine, Script()))), machine


def test_a_frame_comes_with_its_millimetres() -> None:
    device, machine = bk_pair()
    with device:
        assert isinstance(device, UltrasonicScanner)
        scan = device.scan()
        assert (scan.pixels == machine.section()).all()
        assert scan.mm_per_px == pytest.approx((0.2, 0.25))
        assert scan.gain == 57.0
        assert device.describe()["bk_section"]["shape"] == [60, 80]
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
def test_a_window_outside_the_frame_gives_pixels_and_never_wrong_millimetres(stated: bytes) -> None:
    device, machine = bk_pair()
    answer = machine._answer
    machine._answer = lambda m: stated if b"FRAME_GRAB:A" in m else answer(m)  # type: ignore[method-assign]
    with device:
        scan = device.scan()
        assert scan.mm_per_px is None
        assert scan.pixels.shape == (60, 80)


def test_a_box_of_the_whole_screen_gives_no_millimetres_either() -> None:
    machine = serving.BkScanner()
    with bk_oem("bk", InProcess(lambda: Wire(machine, Script())), box="B_GEOMETRY_PIXEL") as device:
        assert device.scan().mm_per_px is None
    with pytest.raises(SettingError, match="B_GEOMETRY_US_FRAME_GRAB"):
        bk_oem("bk", "tcp://127.0.0.1:1", box="B_GEOMETRY")


def test_a_window_that_changes_while_a_frame_is_taken_is_found() -> None:
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
def test_a_size_that_no_scanner_has_is_refused(size: bytes) -> None:
    device, machine = bk_pair()
    answer = machine._answer
    machine._answer = lambda m: (  # type: ignore[method-assign]
        b"DATA:US_WIN_SIZE " + size + b";" if b"WIN_SIZE" in m else answer(m)
    )
    with pytest.raises(ProtocolError):
        device.scan()
    device.close()


def test_a_frame_of_another_size_is_refused() -> None:
    device, machine = bk_pair()
    machine._frame = lambda: bk.encode_frame(bk.GrabbedFrame(1, bytes(100), 104))  # type: ignore[method-assign]
    with pytest.raises(ProtocolError, match="101 bytes for 4800 pixels"):
        device.scan()
    device.close()


def pulser(**options: object) -> tuple[CompactPulser, serving.CompactPulser]:
    machine = serving.CompactPulser()
    return compact_pulser("pulser", InProcess(lambda: Wire(machine, Script())), **options), machine  # type: ignore[arg-type]


def test_echoes_of_the_pulser_come_from_its_oscilloscope() -> None:
    shown = serving.Oscilloscope("rigol-1000z")
    scope = oscilloscope("scope", InProcess(lambda: Wire(shown, Script())))
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


def test_where_the_gain_alone_is_told_it_vouches_for_the_rest() -> None:
    machine = serving.CompactPulser(tells="G")
    device = compact_pulser("pulser", InProcess(lambda: Wire(machine, Script())), answer_s=0.05)
    with device:
        assert machine.values == {"P": 0, "W": 220, "V": 300, "D": 0, "M": 0, "T": 0, "G": 0}
        device.configure(gain_db=84.0, width_ns=100.0)
        assert (machine.values["G"], machine.values["W"]) == (840, 100)
        assert "tells no other" in device.check()["settings"]
        machine.afflict("power-cycled")
        with pytest.raises(StateError, match="G = 5"):
            device.verify()
        # In local mode it takes nothing: that is found though the gain is asked for as it was.
        machine.receive = lambda data: [b"G=840\r"] if data == b"G?\r" else []  # type: ignore[method-assign]
        with pytest.raises(StateError, match="local mode"):
            device.configure(width_ns=90.0)
    assert machine.violations == []


def test_a_knob_that_was_turned_is_found() -> None:
    device, machine = pulser()
    with device:
        assert device.check()["settings"] == "as pushed"
        machine.values["G"] = 12
        with pytest.raises(StateError, match="G = 12 and not 0"):
            device.verify()
        with pytest.raises(StateError, match="give it an oscilloscope"):
            device.line()
        with pytest.raises(SettingError, match="300 V"):
            device.configure(voltage=500.0)
    assert machine.violations == []
