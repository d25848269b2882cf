"""A peer that talks without end costs every driver bounded time and memory."""

from __future__ import annotations

import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from reseau.errors import InstrumentError
from reseau_drivers.oscilloscope import oscilloscope
from reseau_drivers.scanner import bk_oem, compact_pulser, ping360
from reseau_drivers.turntable import smc100, zaber

DRIVERS: dict[str, Callable[..., Any]] = {
    "zaber": lambda name, address, seconds: zaber(name, address, axes={"tilt": {}}, seconds=seconds),
    "smc100": lambda name, address, seconds: smc100(name, address, axes={"tilt": {}}, seconds=seconds),
    "ping360": ping360,
    "bk": bk_oem,
    "compactpulser": compact_pulser,
    "oscilloscope": oscilloscope,
}
NOISE = {
    "zeros": bytes(65536),
    "newlines": b"\n" * 65536,
    "short lines": b"1TS28\r\n" * 9000,
    "one line": b"x" * 65536,
    "every byte": bytes(range(256)) * 256,
    "heads of frames": b"BR\xff\x07\x00\x00" * 10000,
    "starts of messages": b"\x01" * 65536,
    "blocks": b"#9999999999" * 6000,
}


@contextmanager
def flood(noise: bytes) -> Iterator[str]:
    """A server that sends noise as fast as it is taken."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(0.1)
    over = threading.Event()

    def serve() -> None:
        while not over.is_set():
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            with connection:
                connection.settimeout(0.1)
                while not over.is_set():
                    try:
                        connection.sendall(noise)
                    except TimeoutError:
                        continue
                    except OSError:
                        break

    thread = threading.Thread(target=serve)
    thread.start()
    yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"
    over.set()
    thread.join(5.0)
    listener.close()


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize("driver", DRIVERS)
def test_an_endless_talker_costs_bounded_time_and_memory(driver: str, noise: str) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with flood(NOISE[noise]) as address:
        device = DRIVERS[driver]("victim", address, seconds=0.2)
        began = time.monotonic()
        with pytest.raises(InstrumentError, match="victim"):
            device.connect()
        assert time.monotonic() - began < 1.5
        device.close()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000
