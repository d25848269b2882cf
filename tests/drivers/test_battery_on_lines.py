"""The table driver × transport × fault over lines and networks; see :mod:`.battery`."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from reseau.core.errors import InstrumentError
from reseau_sims.serving import KINDS, Kind

from .battery import Battery, befall
from .rigs import RIGS, rig

pytestmark = pytest.mark.usefixtures("nothing_is_left_open")
ON_LINES = tuple(key for key in RIGS if key[1] != "in process")


class TestOnLines(Battery):
    rigs = ON_LINES

    @pytest.mark.parametrize("kind", KINDS)
    def test_a_fault_gives_the_right_result_or_an_error_in_time(
        self, driver: str, transport: str, kind: Kind, record_property: Callable[[str, object], None]
    ) -> None:
        befall(driver, transport, kind, 2, record_property)


@pytest.mark.parametrize(
    ("driver", "transport"), [key for key in ON_LINES if key[1] not in ("usbtmc", "udp", "request")]
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
