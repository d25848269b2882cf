"""A bench file for the instruments that a search has found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..core.errors import ReseauError

_DRIVERS = {
    "aravis": ("camera", "aravis"),
    "video": ("camera", "v4l2"),
    "visa": ("oscilloscope", "oscilloscope"),
}
"""Name and driver of what a kind of search finds. What is behind a serial port does not tell its protocol."""
_SERIAL = "zaber, smc100, ping360 or compactpulser"


def bench_text(found: Mapping[str, Sequence[str] | ReseauError], name: str = "bench") -> str:
    """Return a bench file for the results of :func:`~reseau.capture.found_instruments`.

    Instruments whose driver is not known, and a rig of several cameras, are in comments, to be completed.

    Examples
    --------
    >>> text = bench_text({"aravis": ["192.0.2.30", "192.0.2.31"], "serial": ["/dev/ttyUSB0"]})
    >>> from reseau.capture import BenchFile
    >>> list(BenchFile.parse_toml(text, where="bench.toml").instruments)
    ['camera', 'camera_2']
    >>> "/dev/ttyUSB0" in text
    True
    """
    lines = ['schema = "reseau-bench/1"', f"name = {_quoted(name)}", ""]
    counts: dict[str, int] = {}
    cameras = []
    for way, addresses in found.items():
        if isinstance(addresses, ReseauError):
            lines += [f"# {way}: {addresses}", ""]
            continue
        for address in addresses:
            if way not in _DRIVERS:
                lines += [
                    f"# [instruments.{way}_{_next(counts, way)}]", f'# driver = ""  # {_SERIAL}',
                    f"# address = {_quoted(address)}", "",
                ]  # fmt: skip
                continue
            kind, driver = _DRIVERS[way]
            number = _next(counts, kind)
            own = kind if number == 1 else f"{kind}_{number}"
            if driver == "aravis":
                cameras.append(own)
            lines += [f"[instruments.{own}]", f'driver = "{driver}"', f"address = {_quoted(address)}", ""]
    if len(cameras) > 1:
        lines += [
            "# Cameras that expose at once; each of them needs the same trigger in its settings.",
            "# [instruments.rig]", '# driver = "rig"', f"# address = {_quoted(', '.join(cameras))}",
            '# settings = {trigger = "software"}', "",
        ]  # fmt: skip
    if not counts:
        lines += ["# Nothing was found.", "[instruments]", ""]
    elif not any(line.startswith("[") for line in lines):
        lines += ["[instruments]", ""]
    return "\n".join(lines)


def _next(counts: dict[str, int], kind: str) -> int:
    counts[kind] = counts.get(kind, 0) + 1
    return counts[kind]


def _quoted(text: str) -> str:
    """A text as TOML."""
    escaped = "".join(f"\\u{ord(c):04x}" if ord(c) < 32 else f"\\{c}" if c in '"\\' else c for c in text)
    return f'"{escaped}"'
