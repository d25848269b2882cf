"""The virtual laboratory: a Debian kernel in QEMU whose own drivers show simulated instruments.

No KVM and no rights: the processor is emulated, and the root is this machine's, read-only over 9p, below a
memory file system. One command, also for those who look for what went wrong::

    python -m tests.rig.machine [arguments of pytest]
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reseau_sims import World

from . import parts as rig_parts
from .kernel import PARAMETERS, bootable, first_files

__all__ = ["Run", "run"]

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
_PATIENCE_S = 420.0
_GUEST_DIED, _TOO_LATE = 125, 124
_ROWS, _COLUMNS = slice(300, 780), slice(400, 1040)
"""What the guest's camera, which is small, shows of a photograph."""


@dataclass(frozen=True)
class Run:
    """What came out.

    Parameters
    ----------
    status : int
        Of the command in the guest; 124 it took too long, 125 the guest died, 70 its kernel complained.
    report : Path
        JUnit XML; may be missing when the status is not 0.
    console : str
        What was said.
    seconds : float
        From the start of QEMU to its end.
    """

    status: int
    report: Path
    console: str
    seconds: float


def run(folder: Path, arguments: list[str]) -> Run:
    """Boot, have the tests of the guest run against the device nodes, power off.

    Parameters
    ----------
    folder : Path
        For the report and the console.
    arguments : list of str
        Further ones of pytest.

    Raises
    ------
    RuntimeError
        When the parts cannot be had.
    """
    parts, home = rig_parts.fetched(), rig_parts.cache()
    kernel = bootable(parts, home)
    folder.mkdir(parents=True, exist_ok=True)
    report = folder / "junit.xml"
    pytest = ["-m", "pytest", "-c", str(HERE / "guest/pytest.ini"), "--rootdir", str(PROJECT)]
    pytest += ["-p", "no:cacheprovider", f"--junitxml={report}", str(HERE / "guest"), *arguments]
    python = ["env", "PYTHONDONTWRITEBYTECODE=1", sys.executable]
    command = [*python, "-m", "tests.rig.guest.lab", *python, *pytest]
    # Drawn here: in emulation that takes long.
    np.save(folder / "world.npy", World.standard(seed=5).photo_i().pixels[_ROWS, _COLUMNS])
    (folder / "command").write_text(f"#!/bin/sh\nexec {shlex.join(command)}\n")
    with tempfile.NamedTemporaryFile(dir=home, suffix=".cpio") as files:
        files.write(first_files(parts, (HERE / "guest/init").read_bytes()))
        files.flush()
        layers = _layers(folder, parts.layer)
        began = time.monotonic()
        with (folder / "console.log").open("wb") as log:
            status = _booted(_qemu(kernel, Path(files.name), folder, layers), log)
        seconds = time.monotonic() - began
    said = (folder / "console.log").read_text(errors="replace")
    if status == 0:
        told = folder / "status"
        status = int(told.read_text()) if told.exists() else _GUEST_DIED
    return Run(status, report, said, seconds)


def _layers(folder: Path, udev: Path) -> list[Path]:
    """Folders laid over the root, the first one uppermost: the project's udev rules, udev itself."""
    rules = folder / "layer/etc/udev/rules.d"
    rules.mkdir(parents=True, exist_ok=True)
    for path in (PROJECT / "drivers/reseau_drivers/udev").glob("*.rules"):
        (rules / path.name).write_bytes(path.read_bytes())
    return [folder / "layer", udev]


def _booted(qemu: list[str], log: object) -> int:
    process = subprocess.Popen(qemu, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)  # type: ignore[call-overload]
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        return _TOO_LATE
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
    return 0


def _qemu(kernel: Path, files: Path, folder: Path, layers: list[Path]) -> list[str]:
    modules = " ".join(f"rig.mod.{name}={value}" for name, value in PARAMETERS.items())
    line = (
        "console=ttyS0 panic=-1 quiet tsc=reliable no_timer_check mitigations=off audit=0 selinux=0 "
        f"apparmor=0 rig.cwd={PROJECT} rig.out={folder} rig.layers={len(layers)} {modules}"
    )
    command = ["qemu-system-x86_64", "-M", "q35", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2"]
    command += ["-m", "1024", "-nodefaults", "-no-user-config", "-display", "none", "-no-reboot"]
    command += ["-kernel", str(kernel), "-initrd", str(files), "-append", line, "-serial", "stdio"]
    command += ["-device", "isa-debug-exit,iobase=0xf4,iosize=0x04"]
    # Each layer is a share of its own: overlayfs refuses a lower folder inside another one.
    shares = [("root", Path("/"), True), ("out", folder, False)]
    shares += [(f"layer{number}", layer, True) for number, layer in enumerate(layers)]
    for name, path, read_only in shares:
        options = f"local,id={name},path={path.resolve()},security_model=none,multidevs=remap"
        command += ["-fsdev", options + (",readonly=on" if read_only else "")]
        command += ["-device", f"virtio-9p-pci,fsdev={name},mount_tag={name}"]
    return command


def main(arguments: list[str]) -> int:
    """Run it, and say what came out."""
    if lacking := rig_parts.missing():
        print(f"rig: {lacking}", file=sys.stderr)
        return 2
    folder = Path(os.environ.get("RESEAU_RIG_OUT") or tempfile.mkdtemp(prefix="reseau-rig-"))
    try:
        done = run(folder.resolve(), arguments)
    except RuntimeError as error:
        print(f"rig: {error}", file=sys.stderr)
        return 2
    print(done.console)
    print(f"rig: {done.seconds:.1f} s, status {done.status}, report {done.report}")
    return done.status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
