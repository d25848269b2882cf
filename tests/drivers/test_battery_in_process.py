"""The table driver × transport × fault in process; see :mod:`.battery`."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from reseau_sims.serving import KINDS, Kind

from .battery import Battery, befall
from .rigs import RIGS

pytestmark = pytest.mark.usefixtures("nothing_is_left_open")


class TestInProcess(Battery):
    rigs = tuple(key for key in RIGS if key[1] == "in process")

    @pytest.mark.parametrize(
        "at", [0, pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(4, marks=pytest.mark.slow)]
    )
    @pytest.mark.parametrize("kind", KINDS)
    def test_a_fault_gives_the_right_result_or_an_error_in_time(
        self, driver: str, transport: str, kind: Kind, at: int, record_property: Callable[[str, object], None]
    ) -> None:
        befall(driver, transport, kind, at, record_property)
