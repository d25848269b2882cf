"""Count the behaviours of instruments that are tests, and their public sources.

python -m tests.drivers.behaviours
"""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

__all__ = ["behaviours", "counted", "named"]

_HERE = Path(__file__).parent


def behaviours() -> dict[str, list[dict[str, Any]]]:
    """Rows of ``behaviours.toml`` by their kind."""
    found: dict[str, list[dict[str, Any]]] = tomllib.loads((_HERE / "behaviours.toml").read_text("utf-8"))
    return found


def named() -> list[str]:
    """Makers and models of ``models.toml``, as in answers to ``*IDN?``."""
    told = tomllib.loads((_HERE / "models.toml").read_text("utf-8"))["named"]
    whole = (f"{row['maker']},{model}" if row["maker"] else model for row in told for model in row["models"])
    return list(dict.fromkeys(whole))


def counted() -> tuple[Counter[str], set[str]]:
    """Number of distinct behaviours by kind, oscilloscopes among them, and their documents and threads."""
    screens = tomllib.loads((_HERE / "transcripts.toml").read_text("utf-8"))["instruments"]
    rows = behaviours() | {"oscilloscope": [{"says": told["identity"], **told} for told in screens]}
    number = Counter({kind: len({row["says"] for row in found}) for kind, found in rows.items()})
    # Places within a document are one source, and so is whatever else a row names.
    sources = {
        re.split(r":|;|,? \(| and |, V4L2|, Field", row["source"])[0]
        for found in rows.values()
        for row in found
    }
    return number, sources


if __name__ == "__main__":
    number, sources = counted()
    for kind, count in number.items():
        print(f"{count:5d} {kind}")
    print(f"{number.total():5d} distinct behaviours from {len(sources)} public sources")
    print(f"{len(named()):5d} models of oscilloscopes that public packages name")
