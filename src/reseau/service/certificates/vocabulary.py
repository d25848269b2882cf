"""Our vocabulary of `refType` in digital calibration certificates, declared in ``vocabulary.json``."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

NAMESPACE = "reseau"


@cache
def vocabulary_text() -> str:
    """Return the document.

    Examples
    --------
    >>> '"namespace": "reseau"' in vocabulary_text()
    True
    """
    return files(__package__).joinpath("vocabulary.json").read_text("utf-8")


@cache
def vocabulary() -> dict[str, Any]:
    """Return its content.

    Examples
    --------
    >>> vocabulary()["release"]
    'v1.0.0'
    """
    found: dict[str, Any] = json.loads(vocabulary_text())
    return found
