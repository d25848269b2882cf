"""The bench of the virtual laboratory: simulators behind the kernel's devices, and the tests beside them.

The simulators live in this process, the tests in another: they meet at the device nodes alone. What goes
wrong is steered over a local socket: ``steer("line.gadget.unplug")``, ``value("scope.violations")``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Client, Listener
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["steer", "value"]

SOCKET, KEY = "/run/lab.sock", b"lab"
_PATIENCE_S = 60.0
_COMPLAINTS = ("BUG:", "WARNING: CPU", "Oops", "Kernel panic")
"""Of a kernel; not "Call Trace", which the virtual video driver prints on slow machines without harm."""
_KERNEL_COMPLAINED = 70


def _asked(path: str, arguments: tuple[Any, ...] | None) -> Any:
    until = time.monotonic() + _PATIENCE_S
    while not os.path.exists(SOCKET):
        if time.monotonic() > until:
            raise TimeoutError("the laboratory did not come up")
        time.sleep(0.05)
    with Client(SOCKET, authkey=KEY) as connection:
        connection.send((path, arguments))
        well, answer = connection.recv()
    if not well:
        raise RuntimeError(answer)
    return answer


def value(path: str) -> Any:
    """An attribute of the laboratory."""
    return _asked(path, None)


def steer(path: str, *arguments: Any) -> Any:
    """Call something in the laboratory."""
    return _asked(path, arguments)


class Lab:
    """Everything on the bench."""

    def __init__(self) -> None:
        # The interpreter imports slowly here: the tests' process does so meanwhile.
        from reseau_sims import serving

        from .serial_port import SerialPort
        from .usbtmc import UsbtmcDevice

        self.machines: dict[str, Callable[[], serving.Machine]] = {
            "zaber": lambda: serving.ZaberChain([2, 1]),
            "smc100": lambda: serving.Smc100Line(1, low=0.0, high=100.0, speed=800.0),
            "ping360": serving.Ping360,
            "compactpulser": serving.CompactPulser,
            "kinesis": serving.KinesisController,
            "grbl": lambda: serving.GrblController(1, low=-1.0, high=100.0, speed=800.0),
            "marlin": lambda: serving.MarlinController(1, high=100.0, speed=800.0),
            "environment_modbus": lambda: serving.ModbusSensor(serving.Air(steady=True)),
            "environment_line": lambda: serving.LineSensor(serving.Air(steady=True), every_s=0.2),
            "environment_scpi": lambda: serving.ScpiSensor(serving.Air(steady=True)),
        }
        self.script = serving.FaultScript()
        self.machine: serving.Machine = self.machines["zaber"]()
        self.line = SerialPort(serving.FaultyConnection(self.machine, self.script))
        self.scope = serving.Oscilloscope("keysight")
        self.scope_script = serving.FaultScript()
        self.usb = UsbtmcDevice(self.scope, self.scope.execute, self.scope_script)
        self.body = serving.SimulatedCamera(serving.StripeScene(640, 480), 640, 480)
        self.camera: Any = None

    def connect(self, name: str) -> None:
        """Put another instrument at the end of the line."""
        from reseau_sims.serving import FaultScript, FaultyConnection

        self.script, self.machine = FaultScript(), self.machines[name]()
        self.line.session = FaultyConnection(self.machine, self.script)

    def befall(self, which: str, kind: Any, seconds: float = 0.2) -> None:
        """Have a fault befall the next answer of the line, or of the oscilloscope."""
        from reseau_sims.serving import Fault

        script = self.scope_script if which == "scope" else self.script
        script.fault_at(script.count, Fault(kind, seconds))

    def _sight(self, shift: int) -> Any:
        """Stripes; below 0 what the host drew of the world."""
        from reseau.core.data import Frame
        from reseau_sims.serving import StillScene, StripeScene

        if shift >= 0:
            return StripeScene(640, 480, shift)
        return StillScene(Frame(np.load(Path(os.environ["RIG_OUT"], "world.npy")), 255.0))

    def point_at(self, shift: int) -> None:
        """Show the camera something else."""
        self.body.point_at(self._sight(shift))

    def picture(self, shift: int) -> Any:
        """What the camera should show of it, set as it is."""
        return self._sight(shift)(self.camera.view)

    def start_camera(self, fourcc: str) -> str:
        """Begin to feed the video loop; gives the node that captures."""
        from .loop import LoopCamera

        self.stop_camera()
        self.camera = LoopCamera(self.body, fourcc)
        return str(self.camera.node)

    def stop_camera(self) -> None:
        """End that."""
        if self.camera is not None:
            self.camera.close()
            self.camera = None

    def serve(self) -> None:
        """Be steered."""
        with Listener(SOCKET, authkey=KEY) as listener:
            while True:
                with listener.accept() as connection:
                    path, arguments = connection.recv()
                    try:
                        answer: Any = self
                        for name in path.split("."):
                            answer = getattr(answer, name)
                        if arguments is not None:
                            answer = answer(*arguments)
                        connection.send((True, answer))
                    except Exception:
                        connection.send((False, traceback.format_exc()))


def main() -> int:
    """Put the bench up, run the command beside it, and look whether the kernel complained."""
    began = time.monotonic()
    tests = subprocess.Popen(sys.argv[1:])
    lab = Lab()
    threading.Thread(target=lab.serve, daemon=True).start()
    print(f"lab: up after {time.monotonic() - began:.1f} s", flush=True)
    code = tests.wait()
    log = subprocess.run(["dmesg"], capture_output=True, text=True).stdout
    Path(os.environ["RIG_OUT"], "dmesg.txt").write_text(log)
    complaints = [line for line in log.splitlines() if any(word in line for word in _COMPLAINTS)]
    if complaints:
        print("lab: the kernel complained:", *complaints, sep="\n  ", flush=True)
        code = code or _KERNEL_COMPLAINED
    return code


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    os._exit(status)  # threads sit in calls of the kernel
