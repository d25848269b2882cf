"""Frames of 2048 × 2048 pixels over GigE Vision: our driver compared with Aravis's own client.

    python benchmarks/gige.py [--frames 300] [--rounds 5] [--cameras 2]

In each round both receive from the same simulated cameras, each in a process of its own, which send as fast
as they can; rates of complete frames, of all cameras together, and CPU seconds per frame are compared. Of two
cameras, Aravis's client is started twice; our driver receives from both in threads of one process. Then our
driver receives a long series in blocks from one camera: CPU time and memory must not grow, and every frame
must be identical to the one sent or be counted as lost.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np
import psutil
from figures import record

from reseau_drivers.camera import CameraDriver, aravis
from reseau_sims.serving import GigeCamera, GigeVisionCamera, SimulatedCamera, View, loopback_addresses

SIZE = 2048
SECONDS = 8.0
RATE = 120.0
PACKET = 8192
BLOCKS = 10


class Numbered:
    """A noisy picture whose first pixels contain its number."""

    def __init__(self) -> None:
        self.number = 0
        self.noise = np.random.default_rng(1).integers(0, 256, (SIZE, SIZE), np.uint8)

    def __call__(self, view: View) -> np.ndarray:
        """The picture."""
        self.number += 1
        picture = self.noise[: view.height, : view.width]
        picture[0, :4] = np.frombuffer(self.number.to_bytes(4, "little"), np.uint8)
        return picture


def serve(ready: Connection, address: str) -> None:
    """The simulated camera in a separate process, so that it does not use the client's time.

    One camera is the fake camera of the library, several have the protocol of this project.
    """
    body = SimulatedCamera(Numbered(), SIZE, SIZE)
    made = GigeVisionCamera(body, address=address) if address else GigeCamera(body, wait_s=120.0)
    with made as simulated:
        ready.send(simulated.address)
        ready.recv()


@contextmanager
def simulated_camera(at: str = "") -> Iterator[str]:
    """Its address."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=serve, args=(theirs, at))
    process.start()
    try:
        yield ours.recv()
    finally:
        ours.send("end")
        process.join(20.0)


@dataclass(frozen=True)
class Received:
    """Frames received by a client."""

    rate: float
    cpu_ms: float
    whole: int
    lost: int


def peer(address: str) -> Received:
    """Aravis's own client."""
    client = shutil.which("arv-camera-test-0.8")
    if client is None:
        sys.exit("no arv-camera-test-0.8: apt-get install aravis-tools")
    options = ["-n", address, "-w", str(SIZE), "-h", str(SIZE), "-f", str(RATE), "-i", str(PACKET)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.monotonic()
    running = subprocess.Popen(
        [client, *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    time.sleep(SECONDS + 1.0)
    running.send_signal(signal.SIGINT)
    said = running.communicate(timeout=60)[0]
    elapsed = time.monotonic() - began
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    # It tells its rate every second; the first and the last of them are not of whole seconds.
    rates = [float(found) for found in re.findall(r"([\d.]+) frames/s", said)][1:-1]
    whole = int(re.findall(r"n_completed_buffers\s*=\s*(\d+)", said)[0])
    failed = int(re.findall(r"n_failures\s*=\s*(\d+)", said)[0])
    rate = float(np.mean(rates)) if rates else whole / elapsed
    return Received(rate, 1000 * cpu / max(1, whole), whole, failed)


def together(received: Sequence[Received]) -> Received:
    """What several clients received at the same time."""
    whole = sum(each.whole for each in received)
    cpu = sum(each.cpu_ms * each.whole for each in received) / max(1, whole)
    return Received(sum(each.rate for each in received), cpu, whole, sum(each.lost for each in received))


def ours(camera: CameraDriver) -> Received:
    """Our driver, for the same time."""
    first = camera.expose(20.0)
    began, cpu, whole = time.monotonic(), time.process_time(), 0
    last = first
    while time.monotonic() - began < SECONDS:
        for shot in camera.frames(10, 20.0):
            last, whole = shot, whole + 1
    elapsed, used = time.monotonic() - began, time.process_time() - cpu
    camera.stop()
    return Received(whole / elapsed, 1000 * used / whole, whole, last.dropped - first.dropped)


def long_series(camera: CameraDriver, sight: Numbered, frames: int) -> tuple[list[float], list[float], int]:
    """CPU milliseconds of a frame and megabytes of this process, block by block; and frames lost."""
    me = psutil.Process()
    cpu, memory, dropped = [], [], 0
    for _ in range(BLOCKS):
        began = time.process_time()
        for shot in camera.frames(frames // BLOCKS, 20.0):
            # What was sent is the noise, but for the number.
            if not (shot.pixels[1:] == sight.noise[1:]).all():
                sys.exit(f"frame {shot.sequence} is damaged")
            dropped = shot.dropped
        cpu.append(1000 * (time.process_time() - began) / (frames // BLOCKS))
        memory.append(me.memory_info().rss / 1e6)
    return cpu, memory, dropped


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the clients, and check for growth of time and memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=int(os.environ.get("RESEAU_FRAMES", "300")))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cameras", type=int, default=1)
    options = parser.parse_args(arguments)
    sight = Numbered()
    settings = {"width": SIZE, "height": SIZE, "rate": RATE, "packet_size": PACKET, "buffers": 10}
    with ExitStack() as stack, ThreadPoolExecutor(options.cameras) as pool:
        wanted = loopback_addresses(options.cameras) if options.cameras > 1 else ("",)
        addresses, rounds = [stack.enter_context(simulated_camera(each)) for each in wanted], []
        address, ratios = addresses[0], []
        for number in range(options.rounds):
            theirs = together(list(pool.map(peer, addresses)))
            with ExitStack() as opened:
                cameras = [
                    opened.enter_context(aravis(f"camera {k}", each, settings=settings, seconds=20.0))
                    for k, each in enumerate(addresses)
                ]
                own = together(list(pool.map(ours, cameras)))
            ratios.append(own.rate / theirs.rate)
            rounds.append({"reseau": own, "Aravis": theirs})
            print(
                f"round {number + 1}: Aravis {theirs.rate:6.1f} 1/s ({theirs.lost} failed), "
                f"ours {own.rate:6.1f} 1/s ({own.lost} lost), ratio {ratios[-1]:.2f}; "
                f"CPU {theirs.cpu_ms:.1f} and {own.cpu_ms:.1f} ms a frame"
            )
        with aravis("camera", address, settings=settings, seconds=20.0) as camera:
            cpu, memory, dropped = long_series(camera, sight, options.frames)
    for who in ("reseau", "Aravis"):
        received = [each[who] for each in rounds]
        record("frames a second", who, [each.rate for each in received])
        record("processor time of a frame", who, [each.cpu_ms for each in received], "ms")
        record("frames lost", who, sum(each.lost for each in received))
    print(f"{options.frames} frames, {dropped} lost, none damaged")
    print("CPU, ms a frame: " + " ".join(f"{value:.1f}" for value in cpu))
    print("memory, MB:      " + " ".join(f"{value:.0f}" for value in memory))
    grown, slower = memory[-1] - memory[1], np.median(cpu[-3:]) / np.median(cpu[:3])
    print(f"median ratio {np.median(ratios):.2f}; memory grew by {grown:+.1f} MB, CPU by × {slower:.2f}")
    return 0 if np.median(ratios) >= 0.9 and grown < 10 and slower < 1.3 else 1


if __name__ == "__main__":
    sys.exit(main())
