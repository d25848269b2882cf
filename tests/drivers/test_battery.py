"""The table driver × transport × fault: right or a typed error, in time, and nothing left open.

Every cell is one test: a fault befalls an answer, and what the driver does is either right in the end or an
error of the tree that names the instrument; not long after its deadline; and the next call works.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator

import pytest

from reseau.core.errors import InstrumentError
from reseau_sims.serving import KINDS, Fault, FaultScript, Kind

from .rigs import LATE_S, RIGS, Rig, aravis_is_missing, left_open, rig

CELLS = [
    pytest.param(driver, transport, kind, at, marks=() if at in (0, 2) else pytest.mark.slow)
    for driver, transport in RIGS
    for kind in KINDS
    for at in ((0, 1, 2, 4) if transport == "in process" else (2,))
]


@pytest.fixture(scope="session")
def _libraries_are_loaded() -> None:
    """What libraries open once for the process (libusb, GLib) is not counted."""
    with rig("oscilloscope", "vxi-11"), rig("oscilloscope", "hislip"):
        pass
    if not aravis_is_missing():
        with rig("aravis", "gige"):
            pass


@pytest.fixture(autouse=True)
def _nothing_is_left_open(_libraries_are_loaded: None, request: pytest.FixtureRequest) -> Iterator[None]:
    before = left_open()
    yield
    deadline = time.monotonic() + 5.0
    while left_open() != before and time.monotonic() < deadline:
        time.sleep(0.01)
    request.node.user_properties.append(("nothing left open", left_open() == before))
    assert left_open() == before


@pytest.mark.parametrize(("driver", "transport", "kind", "at"), CELLS)
def test_a_fault_gives_the_right_result_or_an_error_in_time(
    driver: str, transport: str, kind: Kind, at: int, record_property: Callable[[str, object], None]
) -> None:
    script = FaultScript()
    for key, value in {"driver": driver, "transport": transport, "fault": kind}.items():
        record_property(key, value)
    with rig(driver, transport, script) as found:
        found.work(0)
        script.fault_at(script.count + at, Fault(kind, LATE_S if kind == "late" else 0.2))
        began = time.monotonic()
        message = None
        try:
            found.work(1)
        except InstrumentError as error:
            message = error
        took = time.monotonic() - began
        record_property("outcome", "right" if message is None else type(message).__name__)
        record_property("seconds", took)
        names = {found.device.name, *getattr(found.device, "cameras", ())}
        assert message is None or (message.instrument in names and message.command)
        assert took < 10.0
        assert [fault.kind for fault in script.happened] == [kind]
        _recovered(found)
        found.work(2)
        # A state the instrument was put into makes it reject commands; a line fault never does.
        if kind not in ("wrong state", "out of range", "stuck", "power-cycled"):
            assert found.machine.violations == []


@pytest.mark.parametrize(
    ("driver", "transport"), [key for key in RIGS if key[1] not in ("in process", "usbtmc", "udp", "request")]
)
def test_reconnection_after_a_cable_was_pulled(driver: str, transport: str) -> None:
    with rig(driver, transport) as found:
        assert found.server is not None
        found.server.hang_up()
        time.sleep(0.05)
        with pytest.raises(InstrumentError):
            found.work(1)
        found.work(2)
        assert found.device.reconnections == 2
        assert found.machine.violations == []


def test_a_usb_instrument_is_found_again_after_its_cable_was_pulled() -> None:
    with rig("oscilloscope", "usbtmc") as found:
        usb = found.extra["usb"]
        usb.present = False
        for _ in range(2):
            with pytest.raises(InstrumentError, match="scope"):
                found.work(1)
        usb.present = True
        found.work(2)
        assert usb.open_handles == 1
        assert found.machine.violations == []


@pytest.mark.parametrize(("driver", "transport"), list(RIGS))
def test_random_faults_never_give_a_wrong_answer(driver: str, transport: str) -> None:
    _endure(driver, transport, exchanges=120, rate=0.03)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("driver", "transport"), list(RIGS))
def test_endurance(driver: str, transport: str, record_property: Callable[[str, object], None]) -> None:
    found = _endure(driver, transport, exchanges=int(os.environ.get("RESEAU_EXCHANGES", "10000")), rate=0.01)
    for key, value in {"driver": driver, "transport": transport, **found}.items():
        record_property(key, value)


def _endure(driver: str, transport: str, exchanges: int, rate: float) -> dict[str, float]:
    script = FaultScript()
    with rig(driver, transport, script) as found:
        start, run, failed, longest = script.count, 0, 0, 0.0
        script.at_random(rate, seed=7, seconds=0.05)
        while script.count - start < exchanges:
            run += 1
            began = time.monotonic()
            try:
                found.work(run)
            except InstrumentError:
                failed += 1
                _recovered(found)
            longest = max(longest, time.monotonic() - began)
            assert longest < 30.0
        script.at_random(0.0)
        _recovered(found)
        found.work(run + 1)
        assert failed <= len(script.happened)
        return {
            "exchanges": script.count - start,
            "faults": len(script.happened),
            "errors": failed,
            "longest": longest,
        }


def _recovered(found: Rig) -> None:
    """Bring an instrument back that may fail again meanwhile."""
    patience = time.monotonic() + 20.0
    while True:
        try:
            found.recover()
            return
        except InstrumentError:
            assert time.monotonic() < patience
