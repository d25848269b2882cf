"""What is known of families of instruments: TOML files, each line with its public source.

Those of oscilloscopes (``reseau-instrument-profile/1``) are read by
:mod:`reseau_drivers.oscilloscope.dialects`, those of controllers
(``reseau-controller-profile/1``) and of pixels by the codecs.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

__all__ = ["CONTROLLERS", "FOLDER", "known"]

FOLDER = Path(__file__).parent
CONTROLLERS = ("grbl", "smc100", "zaber")


def known(name: str) -> dict[str, Any]:
    """Return what is known of a controller (banners, codes, flags), or of formats of pixels.

    Examples
    --------
    >>> known("grbl")["alarms"]["1"]
    'a limit switch was reached'
    """
    return tomllib.loads((FOLDER / f"{name}.toml").read_text("utf-8"))
