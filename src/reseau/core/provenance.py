"""How a result came about: its inputs by hash, the options, the version of the software."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .errors import InputError
from .version import __version__

__all__ = ["Provenance", "canonical_json", "sha256_of"]


def sha256_of(source: bytes | Path) -> str:
    """SHA-256 of bytes, or of a file read in pieces.

    Raises
    ------
    InputError
        When the file cannot be read.
    """
    if isinstance(source, bytes):
        return hashlib.sha256(source).hexdigest()
    try:
        with source.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=source) from None


def canonical_json(value: Any) -> str:
    """Render JSON that is the same to the byte for the same content, with a newline at its end."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False, indent=1) + "\n"


@dataclass(frozen=True)
class Provenance:
    """What a result was computed from, with what options, by which version.

    Parameters
    ----------
    inputs : dict
        SHA-256 by the role or the name of each input.
    options : dict
        The options that influenced the result, JSON values.
    """

    inputs: dict[str, str] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    software: str = f"reseau {__version__}"

    def to_dict(self) -> dict[str, Any]:
        """As it stands in a document; keys sorted, so that their order says nothing."""
        return {
            "inputs": dict(sorted(self.inputs.items())),
            "options": dict(sorted(self.options.items())),
            "software": self.software,
        }
