"""The table driver × transport × fault: right or a typed error, in time, and nothing left open.

Every cell is one test: a fault befalls an answer, and what the driver does is either right in the end or an
error of the tree that names the instrument; not long after its deadline; and the next call works.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from typing import ClassVar

import pytest

from reseau.core.errors import InstrumentError
from reseau_sims.serving import Fault, FaultScript, Kind

from .rigs import LATE_S, Rig, rig


def befall(
    driver: str, transport: str, kind: Kind, at: int, record_property: Callable[[str, object], None]
) -> None:
    """Let a fault befall an answer; the result is right, or an error in time."""
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


def _endure(driver: str, transport: str, exchanges: int, rate: float) -> dict[str, float]:
    """Exchange so often, with faults at random; what happened, in numbers."""
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


class Battery:
    """What every rig is put through; `rigs` are the keys of those of a file, which one process tests."""

    rigs: ClassVar[Sequence[tuple[str, str]]]

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        if "driver" in metafunc.fixturenames:
            metafunc.parametrize(("driver", "transport"), self.rigs)

    def test_random_faults_never_give_a_wrong_answer(self, driver: str, transport: str) -> None:
        _endure(driver, transport, exchanges=120, rate=0.03)

    @pytest.mark.slow
    @pytest.mark.timeout(1800)
    def test_endurance(
        self, driver: str, transport: str, record_property: Callable[[str, object], None]
    ) -> None:
        exchanges = int(os.environ.get("RESEAU_EXCHANGES", "10000"))
        found = _endure(driver, transport, exchanges=exchanges, rate=0.01)
        for key, value in {"driver": driver, "transport": transport, **found}.items():
            record_property(key, value)
