"""What is known of families of instruments: TOML files, each line with its public source.

Those of oscilloscopes (``reseau-instrument-profile/1``) are read by
:mod:`reseau_drivers.oscilloscope.dialects`, those of controllers
(``reseau-controller-profile/1``) by the codecs.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

__all__ = ["FOLDER", "controller"]

FOLDER = Path(__file__).parent


def controller(name: str) -> dict[str, Any]:
    """Return what is known of a controller: banners, codes, flags.

    Examples
    --------
    >>> controller("grbl")["alarms"]["1"]
    'a limit switch was reached'
    """
    return tomllib.loads((FOLDER / f"{name}.toml").read_text("utf-8"))
