"""Pictures of oscilloscopes' screens over VXI-11: our driver beside ``lxi`` and PyVISA with pyvisa-py.

Run from the checkout, as root: ``python benchmarks/transfer.py [--rounds N] [--family F …]``. Simulated
oscilloscopes of several makers, in a process of their own, show a picture of 800 × 480 pixels. In each round
each program connects, takes the picture and disconnects; wall times of all of it are compared, and every
picture must be equal to the screen. ``lxi`` (Debian's lxi-tools) is a program that is started each time: the
time of a start, as of ``lxi --version``, is shown, too. PyVISA asks as a script would that knows the commands
of the make, which it does only for some. Only root may open the port of the portmapper, which both ask.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import record

from reseau_drivers.oscilloscope import oscilloscope
from reseau_sims import World, serving
from reseau_sims.laboratory import Laboratory
from reseau_sims.serving import FaultScript, PortmapperSession, TcpServer, Vxi11Session

ADDRESS = "TCPIP::127.0.0.1::inst0::INSTR"
SIZE = (800, 480)
PLUGINS = {
    "keysight": "keysight-ivx",
    "rigol-1000z": "rigol-1000z",
    "rigol-2000": "rigol-2000",
    "siglent": "siglent-sds",
    "rohde": "rs-hmo-rtb",
    "tektronix": "tektronix-2000",
    "lecroy": "lecroy-wp",
}
"""Families of simulated oscilloscopes, and lxi's plugins for them."""
ASKED = {
    "keysight": (":DISPlay:DATA? PNG, COLor",),
    "rigol-2000": (":DISPlay:DATA?",),
    "rohde": ("HCOP:FORM PNG", "HCOP:DATA?"),
}
"""What a script asks the families that answer with a block of IEEE 488.2."""


def serve(ready: Connection, family: str) -> None:
    """The simulated oscilloscope in a separate process, so that it does not use the client's time."""
    laboratory = Laboratory(World.standard(seed=4))
    picture = laboratory.picture(*SIZE)
    machine = serving.Oscilloscope(family, lambda: picture)
    with TcpServer(partial(Vxi11Session, machine, machine.execute, FaultScript())) as core:
        port = core.port
        with TcpServer(lambda: PortmapperSession(port), 111):
            ready.send(picture)
            ready.recv()


@contextmanager
def simulated(family: str) -> Iterator[Any]:
    """The picture on the screen of a simulated oscilloscope, while it serves."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=serve, args=(theirs, family))
    process.start()
    theirs.close()
    try:
        yield ours.recv()
    finally:
        with contextlib.suppress(OSError):
            ours.send("end")
        process.join(20.0)


def by_us(family: str) -> Any:
    with oscilloscope("scope", ADDRESS) as device:
        return device.screen().frame().pixels


def by_lxi(family: str) -> Any:
    with tempfile.TemporaryDirectory() as name:
        subprocess.run(
            ["lxi", "screenshot", "-a", "127.0.0.1", "-p", PLUGINS[family], "screen.png"],
            capture_output=True, timeout=60, check=True, cwd=name,
        )  # fmt: skip
        (file,) = Path(name).iterdir()
        return decoded(file.read_bytes())


def by_pyvisa(family: str) -> Any:
    import pyvisa

    manager = pyvisa.ResourceManager("@py")
    with manager.open_resource(ADDRESS, timeout=20_000) as device:
        *before, asked = ASKED[family]
        for each in before:
            device.write(each)  # type: ignore[attr-defined]
        data = device.query_binary_values(asked, datatype="B", container=bytes)  # type: ignore[attr-defined]
    return decoded(data)


def decoded(data: bytes) -> Any:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


def compare(family: str, rounds: int) -> bool:
    """Take the picture by all programs in turns; whether ours is always right."""
    programs: dict[str, Callable[[str], Any]] = {"reseau": by_us}
    if shutil.which("lxi"):
        programs["lxi"] = by_lxi
    if family in ASKED and importlib.util.find_spec("pyvisa_py") is not None:
        programs["pyvisa-py"] = by_pyvisa
    taken: dict[str, list[float]] = {program: [] for program in programs}
    wrong = dict.fromkeys(programs, 0)
    with simulated(family) as screen:
        for number in range(rounds + 1):
            for program, take in programs.items():
                began = time.perf_counter()
                try:
                    right = np.array_equal(take(family), screen)
                except Exception as error:
                    right = False
                    print(f"  {family}, {program}: {str(error).splitlines()[0][:90]}")
                if number:  # the first time loads code
                    taken[program].append(1e3 * (time.perf_counter() - began))
                    wrong[program] += not right
    for program, times in taken.items():
        record(family, program, times, "ms")
        record(family, program, wrong[program], of=rounds, table="unlike the screen")
        print(
            f"{family:14} {program:10} {np.median(times):7.1f} ms ({min(times):.1f} to {max(times):.1f}); "
            f"{wrong[program]} of {rounds} unlike the screen",
            flush=True,
        )
    return not wrong["reseau"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--family", nargs="+", default=list(PLUGINS), choices=list(PLUGINS))
    given = parser.parse_args()
    if os.geteuid() != 0:
        print("only root may open the portmapper's port 111: nothing to compare")
        return 0
    right = [compare(family, given.rounds) for family in given.family]
    if shutil.which("lxi") is None:
        print("no lxi: apt-get install lxi-tools")
    else:
        times = []
        for _ in range(given.rounds):
            began = time.perf_counter()
            subprocess.run(["lxi", "--version"], capture_output=True, check=False)
            times.append(1e3 * (time.perf_counter() - began))
        record("starting the program alone", "lxi", times, "ms")
        print(f"lxi, its start alone: {np.median(times):.1f} ms")
    return 0 if all(right) else 1


if __name__ == "__main__":
    sys.exit(main())
