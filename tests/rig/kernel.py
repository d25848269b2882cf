"""What a kernel needs to begin: its image, the modules in their order, and the first files."""

from __future__ import annotations

import lzma
import shutil
import struct
import subprocess
from collections.abc import Iterable
from pathlib import Path

from .parts import Parts

__all__ = ["BOOT", "LATER", "PARAMETERS", "bootable", "first_files"]

BOOT = (
    "virtio_pci", "9pnet_virtio", "9p", "overlay",
    "dummy_hcd", "libcomposite", "usb_f_acm", "usb_f_fs", "cdc_acm", "vivid",
)  # fmt: skip
"""Modules that are loaded at once, besides those that they depend on."""
LATER = ("usbtmc",)
"""Modules that a test loads; in the guest they lie in ``/run/modules``."""
PARAMETERS = {
    "dummy_hcd": "num=2",
    # One capture node and one output node, both HDMI, to be looped; no cropping and no scaling.
    "vivid": "n_devs=1,node_types=0x101,num_inputs=1,input_types=3,num_outputs=1,output_types=1,"
    "ccs_cap_mode=0,ccs_out_mode=0",
}
_ELF, _XZ, _ZSTD = b"\x7fELF", b"\xfd7zXZ\0", b"\x28\xb5\x2f\xfd"


def bootable(parts: Parts, folder: Path) -> Path:
    """The kernel unpacked, once; in emulation that takes longer than everything else.

    QEMU starts an ELF image by itself. What cannot be unpacked here is booted packed.
    """
    unpacked = folder / f"vmlinux-{parts.release}"
    if unpacked.exists():
        return unpacked
    data = parts.vmlinuz.read_bytes()
    # Documentation/arch/x86/boot.rst: number of setup sectors, offset and length of the payload.
    sectors = data[0x1F1] or 4
    offset, length = struct.unpack_from("<II", data, 0x248)
    payload = data[(sectors + 1) * 512 + offset :][:length]
    image = b""
    if payload.startswith(_XZ):
        image = lzma.LZMADecompressor(lzma.FORMAT_XZ).decompress(payload)
    elif payload.startswith(_ZSTD) and shutil.which("zstd"):
        image = subprocess.run(["zstd", "-dcq"], input=payload, capture_output=True).stdout
    if not image.startswith(_ELF):
        return parts.vmlinuz
    unpacked.write_bytes(image)
    return unpacked


def _ordered(modules: Path, names: Iterable[str]) -> list[Path]:
    """Files of modules, each behind those that it depends on, as their own ``.modinfo`` says."""
    paths = {path.name.split(".ko")[0].replace("-", "_"): path for path in modules.rglob("*.ko*")}
    found: list[Path] = []
    seen: set[str] = set()

    def add(name: str) -> None:
        name = name.replace("-", "_")
        if name in seen or name not in paths:  # what is not there is built in
            return
        seen.add(name)
        for needed in _depends(_content(paths[name])):
            add(needed)
        found.append(paths[name])

    for name in names:
        add(name)
    return found


def _content(path: Path) -> bytes:
    data = path.read_bytes()
    return lzma.decompress(data) if path.suffix == ".xz" else data


def _depends(module: bytes) -> list[str]:
    """Names in the section ``.modinfo`` of an ELF file of 64 bits."""
    (table,) = struct.unpack_from("<Q", module, 0x28)
    size, count, names_at = struct.unpack_from("<HHH", module, 0x3A)
    sections = [struct.unpack_from("<IIQQQQ", module, table + i * size) for i in range(count)]
    for name, _, _, _, offset, length in sections:
        if module.startswith(b".modinfo\0", sections[names_at][4] + name):
            for item in module[offset : offset + length].split(b"\0"):
                if item.startswith(b"depends="):
                    return [each for each in item[8:].decode().split(",") if each]
    return []


def first_files(parts: Parts, init: bytes) -> bytes:
    """The initial file system: busybox, the modules with their order, and what is run first."""
    folder, program, plain, console = 0o040755, 0o100755, 0o100644, 0o020600
    names = ("bin", "dev", "proc", "sys", "ro", "rw", "layer", "new", "m")
    entries: list[tuple[str, int, bytes]] = [(name, folder, b"") for name in names]
    entries += [("dev/console", console, b""), ("bin/busybox", program, parts.busybox.read_bytes())]
    entries.append(("init", program, init))
    at_once = _ordered(parts.modules, BOOT)
    for path in dict.fromkeys([*at_once, *_ordered(parts.modules, LATER)]):
        entries.append((f"m/{_name(path)}.ko", plain, _content(path)))
    entries.append(("m/order", plain, "".join(f"{_name(path)}\n" for path in at_once).encode()))
    return _cpio(entries)


def _name(path: Path) -> str:
    return path.name.split(".ko")[0]


def _cpio(entries: list[tuple[str, int, bytes]]) -> bytes:
    """An archive as the kernel takes it (newc), not compressed: emulated processors inflate slowly."""
    out = bytearray()
    for number, (name, mode, data) in enumerate([*entries, ("TRAILER!!!", 0, b"")], 1):
        raw = name.encode() + b"\0"
        head = (number, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(raw), 0)
        for piece in (b"070701" + b"".join(b"%08x" % value for value in head) + raw, data):
            out += piece
            out += bytes(-len(out) % 4)
    return bytes(out)
