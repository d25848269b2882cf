"""Provenance of a result: hashes of its inputs, options, surroundings, version of the software."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from .files import readable, split_frame
from .version import __version__


def sha256_of(source: bytes | Path) -> str:
    """SHA-256 of bytes, or of a file read in pieces; of ``loop.dcm#3``, a frame of a file, that of the file.

    Raises
    ------
    InputError
        When the file cannot be read.

    Examples
    --------
    >>> sha256_of(b"reseau")[:8]
    'f669f700'
    """
    if isinstance(source, bytes):
        return hashlib.sha256(source).hexdigest()
    with readable(source), split_frame(source)[0].open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def canonical_json(value: Any) -> str:
    """Render JSON with reproducible bytes, with a newline at its end; times by ISO 8601.

    Examples
    --------
    >>> canonical_json({"sigma": 0.5})
    '{\\n "sigma": 0.5\\n}\\n'
    """
    return json.dumps(value, ensure_ascii=False, allow_nan=False, indent=1, default=datetime.isoformat) + "\n"


@dataclass(frozen=True)
class Provenance:
    """Inputs, options and software version of a result.

    Parameters
    ----------
    inputs : dict
        SHA-256 by the role or the name of each input.
    options : dict
        The options that influence the result, JSON values.
    environment : dict
        Conditions of its frames; see :meth:`~reseau.core.environment.Surroundings.summary`.

    Examples
    --------
    >>> Provenance({"left.png": "00"}, {"alpha": 0.05}).to_dict()["options"]
    {'alpha': 0.05}
    """

    inputs: dict[str, str] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    software: str = f"reseau {__version__}"
    environment: dict[str, dict[str, Any]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Dictionary for a document, with sorted keys."""
        known = {"environment": self.environment} if self.environment else {}
        return {
            "inputs": dict(sorted(self.inputs.items())),
            "options": dict(sorted(self.options.items())),
            "software": self.software,
            **known,
        }
