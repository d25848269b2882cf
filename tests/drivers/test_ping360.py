"""Sections by ultrasound: reflectors where they are, in millimetres; what is swept is seen on the screen."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import center_of_mass

from reseau.core.errors import InstrumentError, ProtocolError, SettingError, StateError
from reseau.instruments import UltrasonicScanner
from reseau_drivers.scanner import Ping360, ping360
from reseau_sims import Reflectors, World, serving
from reseau_sims.laboratory import Laboratory
from reseau_sims.serving import FaultyConnection, InProcess, UdpServer


def sonar(laboratory: Laboratory | None = None, **settings: float) -> tuple[Ping360, serving.Ping360]:
    machine = serving.Ping360(laboratory.line) if laboratory else serving.Ping360()
    return ping360("sonar", InProcess(lambda: FaultyConnection(machine)), settings=settings), machine


def test_a_section_shows_reflectors_at_their_millimetres() -> None:
    laboratory = Laboratory(World.standard(seed=3))
    where = np.array([[-40.0, -60.0], [0.0, -100.0], [35.0, -80.0]])
    laboratory.tank = Reflectors(("a", "b", "c"), where, np.ones(3))
    device, machine = sonar(laboratory, range_mm=150.0, half_sector=60)
    with device:
        assert isinstance(device, UltrasonicScanner)
        scan = device.scan()
    assert scan.mm_per_px is not None
    assert (1, *scan.frame().pixels.shape) == tuple(device.describe()["sonar_section"]["shape"])
    for x, y in where:
        column, row = scan.origin_px[0] + x / scan.mm_per_px[0], scan.origin_px[1] - y / scan.mm_per_px[1]
        reach = round(14 / scan.mm_per_px[0])
        window = np.s_[
            round(row) - reach : round(row) + reach + 1, round(column) - reach : round(column) + reach + 1
        ]
        patch = np.where(scan.pixels[window] > 60, scan.pixels[window], 0)
        found = np.array(center_of_mass(patch)) - reach
        # Pixels are 0.77 mm, and a point is an arc: half a millimetre sideways, a millimetre in depth.
        assert abs(found[1] * scan.mm_per_px[0]) < 1.0
        assert abs(found[0] * scan.mm_per_px[1]) < 1.5
    assert machine.violations == []


@pytest.mark.slow
def test_the_screen_shows_the_echoes_of_the_scanner() -> None:
    laboratory = Laboratory(World.standard(seed=3))
    dark = laboratory.picture(400, 300).copy()
    device, _ = sonar(laboratory, middle=170, half_sector=29)
    with device:
        device.scan()
    left = laboratory.picture(400, 300).astype(float)
    device, _ = sonar(laboratory, middle=230, half_sector=29)
    with device:
        device.scan()
    both = laboratory.picture(400, 300).astype(float)
    changed = np.abs(both - left)
    assert np.abs(left - dark).max() > 50
    assert changed[:, 220:].max() > 50
    assert changed[:, :180].max() < 20


@pytest.mark.slow
def test_the_camera_images_the_echoes_of_the_scanner() -> None:
    laboratory = Laboratory(World.standard(seed=3))
    before = laboratory.photograph("PHOTO I").pixels.astype(float)
    device, _ = sonar(laboratory, half_sector=60)
    with device:
        device.scan()
    after = laboratory.photograph("PHOTO II")
    assert after.pixels.shape == (1200, 1600)
    assert np.abs(after.pixels - before).mean() > 20


def test_stop_ends_a_scan_from_another_thread_and_the_motor_is_off() -> None:
    device, machine = sonar(half_sector=100)
    echo = machine._echo

    def slow(*line: Any) -> Any:
        time.sleep(0.005)
        return echo(*line)

    machine._echo = slow
    with device:
        caught: list[Exception] = []

        def scan() -> None:
            try:
                device.scan()
            except StateError as error:
                caught.append(error)

        thread = threading.Thread(target=scan)
        thread.start()
        time.sleep(0.1)
        device.stop()
        thread.join(5.0)
        assert "was stopped" in str(caught[0])
        device.stop()
        assert not machine.motor_on


def test_settings_are_checked_before_anything_is_sent() -> None:
    device, machine = sonar()
    for wrong in ({"gain": 3}, {"range_mm": 1e9}, {"samples": 100}, {"step": 0}, {"frequency_khz": 740.5}):
        with pytest.raises(SettingError):
            device.configure(**wrong)
    assert device.settings.changed({"range_mm": 60_000, "speed_m_s": 1000}).period <= 40_000
    assert machine.violations == []
    device.close()


def test_a_lost_udp_peer_raises_and_is_found_again() -> None:
    machine = serving.Ping360()
    with UdpServer(lambda: FaultyConnection(machine)) as server:
        device = ping360("sonar", server.address, seconds=0.5)
        device.connect()
        port = server.port
    with pytest.raises(InstrumentError, match="sonar"):
        device.line(3)
    with UdpServer(lambda: FaultyConnection(machine), port):
        assert set(device.line(3)) == {203}
        # Another client does not get between: each is answered at its own port.
        with ping360("other", f"udp://127.0.0.1:{port}", seconds=0.5) as other:
            for angle in range(5):
                assert set(other.line(-angle)) == {200 - angle}
                assert set(device.line(angle)) == {200 + angle}
    device.close()
    assert machine.violations == []


def test_another_device_at_the_address_is_named() -> None:
    device, machine = sonar()
    machine._tell = lambda id_: (
        __import__("reseau_drivers.codecs.ping").codecs.ping.Information(1, 1, (1, 0, 0)).frame()
    )  # type: ignore[method-assign]
    with pytest.raises(ProtocolError, match="not a Ping360"):
        device.connect()
    device.close()
