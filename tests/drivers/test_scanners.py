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
    return bk_oem("bk", InProcess(lambda: Wire(machine, Script())), settings={"gain": 60.0}), machine


def test_a_frame_comes_with_its_millimetres() -> None:
    device, machine = bk_pair()
    with device:
        assert isinstance(device, UltrasonicScanner)
        scan = device.scan()
        assert (scan.pixels == machine.section()).all()
        assert scan.mm_per_px == pytest.approx((0.2, 0.25))
        assert scan.gain == 60.0
        assert device.describe()["bk_section"]["shape"] == [60, 80]
        device.trigger().wait(5.0)
        assert device.read()["bk_mm_per_px"]["value"] == pytest.approx([0.2, 0.25])
    assert machine.violations == []


@pytest.mark.parametrize(
    "stated",
    [
        b"DATA:B_GEOMETRY_PIXEL:A 0,0,200,60;",
        b"DATA:B_GEOMETRY_PIXEL:A -5,0,80,60;",
        b"DATA:B_GEOMETRY_PIXEL:A 10,0,10,60;",
    ],
)
def test_a_window_outside_the_frame_gives_pixels_and_never_wrong_millimetres(stated: bytes) -> None:
    device, machine = bk_pair()
    answer = machine._answer
    machine._answer = lambda m: stated if b"PIXEL" in m else answer(m)  # type: ignore[method-assign]
    with device:
        scan = device.scan()
        assert scan.mm_per_px is None
        assert scan.pixels.shape == (60, 80)


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
    answer = machine._answer
    short = bk.encode_frame(bk.GrabbedFrame(1, bytes(100), 104))
    machine._answer = lambda m: short if b'"ON"' in m else answer(m)  # type: ignore[method-assign]
    with pytest.raises(ProtocolError, match="100 bytes"):
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
        assert (machine.values["P"], machine.values["G"]) == (20.0, 30.0)
        line = device.line()
        depth = device.depths_mm(line)
        assert np.diff(depth) == pytest.approx(np.full(len(depth) - 1, 1480e3 * 1e-6 / 2))
        device.stop()
        assert machine.values["P"] == 0.0
    assert machine.violations == shown.violations == []


def test_a_knob_that_was_turned_is_found() -> None:
    device, machine = pulser()
    with device:
        assert device.check()["settings"] == "as pushed"
        machine.values["G"] = 12.0
        with pytest.raises(StateError, match="G = 12 and not 0"):
            device.verify()
        with pytest.raises(StateError, match="give it an oscilloscope"):
            device.line()
        with pytest.raises(SettingError, match="300 V"):
            device.configure(voltage=500.0)
    assert machine.violations == []
