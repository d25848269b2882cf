"""What the virtual laboratory is made of: a kernel, busybox and udev, unpacked from Debian's packages."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Parts", "fetched", "missing"]

_NEEDED = {
    "qemu-system-x86_64": "qemu-system-x86",
    "apt-get": "apt",
    "apt-cache": "apt",
    "dpkg-deb": "dpkg",
}
"""Programs, and the Debian packages that hold them."""
_UNUSED = ("sound", "arch", "crypto", "drivers/gpu", "drivers/net", "drivers/infiniband", "drivers/scsi")
"""Trees of modules that nothing here needs."""


@dataclass(frozen=True)
class Parts:
    """Where they lie.

    Parameters
    ----------
    vmlinuz, modules : Path
        The kernel, and the folder of its modules.
    busybox : Path
        Statically linked.
    layer : Path
        udev, to be laid over the root.
    """

    vmlinuz: Path
    modules: Path
    busybox: Path
    layer: Path

    @property
    def release(self) -> str:
        """Of the kernel."""
        return self.modules.name


def missing() -> str:
    """What this machine lacks, with what would help; empty when nothing."""
    absent = sorted({package for program, package in _NEEDED.items() if shutil.which(program) is None})
    if absent:
        return f"the virtual laboratory needs {', '.join(absent)}: apt-get install {' '.join(absent)}"
    if not list(Path("/usr/lib").glob("*/libusb-1.0.so.0")):
        return "the virtual laboratory needs libusb-1.0-0: apt-get install libusb-1.0-0"
    return ""


def cache() -> Path:
    """Folder that is kept from run to run; RESEAU_RIG names another one."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get("RESEAU_RIG") or home / "reseau" / "rig")


def fetched() -> Parts:
    """The parts, downloaded when they are not there yet; nothing is installed, and no rights are needed.

    Raises
    ------
    RuntimeError
        When they cannot be downloaded or unpacked.
    """
    root = cache()
    root.mkdir(parents=True, exist_ok=True)
    whole = root / "parts"
    if not whole.exists():
        with tempfile.TemporaryDirectory(dir=root) as draft:
            _unpack_all(Path(draft))
            Path(draft, "done").mkdir()
            for name in ("kernel", "layer", "tools"):
                shutil.move(Path(draft, name), Path(draft, "done", name))
            Path(draft, "done").replace(whole)
    vmlinuz = max((whole / "kernel/boot").glob("vmlinuz-*"))
    release = vmlinuz.name.removeprefix("vmlinuz-")
    # Debian 13 packages are laid out with a merged /usr.
    folders = [whole / "kernel" / lib / "modules" / release for lib in ("lib", "usr/lib")]
    modules = next(folder for folder in folders if folder.is_dir())
    return Parts(vmlinuz, modules, whole / "tools/usr/bin/busybox", whole / "layer")


def _unpack_all(draft: Path) -> None:
    (draft / "debs").mkdir()
    depends = _said(["apt-cache", "depends", "linux-image-amd64"], draft).splitlines()
    kernel = next((line.split()[-1] for line in depends if "Depends:" in line), "")
    if not kernel:
        raise RuntimeError("apt knows no linux-image-amd64: run apt-get update")
    _said(["apt-get", "download", "-q", kernel, "busybox-static", "udev"], draft / "debs")
    for pattern, target in (("linux-image-*", "kernel"), ("udev_*", "layer"), ("busybox-*", "tools")):
        package = next((draft / "debs").glob(pattern))
        _said(["dpkg-deb", "-x", str(package), str(draft / target)], draft)
        if target != "kernel":
            _merge_usr(draft / target)
    for modules in (draft / "kernel").glob("**/modules/*/kernel"):
        for name in _UNUSED:
            shutil.rmtree(modules / name, ignore_errors=True)


def _merge_usr(tree: Path) -> None:
    """Move bin, sbin and lib below usr: laid over the root they would hide its links of these names."""
    for name in ("bin", "sbin", "lib", "lib64"):
        if (tree / name).is_dir():
            shutil.copytree(tree / name, tree / "usr" / name, symlinks=True, dirs_exist_ok=True)
            shutil.rmtree(tree / name)


def _said(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[:2])} failed: {done.stderr.strip()[-300:]}")
    return done.stdout
