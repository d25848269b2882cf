"""Results that are kept by what they were computed from: what exists is not computed again.

An output is kept in the store by its SHA-256. A record beside it, named by the SHA-256 of all that the output
depends on (the inputs by their hashes, the parameters, the version of the program), says which output it is.
A record is written after its output; so a computation that is interrupted leaves either a whole result or
none that counts, and a file that was damaged since is replaced.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..archive.objects import Objects, objects_at
from ..core.errors import ArchiveError
from ..core.provenance import canonical_json, sha256_of
from ..core.version import __version__

_SCHEMA = "reseau-output/1"


@dataclass(frozen=True)
class Outputs:
    """Where the outputs of a computation are kept, and what they depend on besides their inputs.

    Parameters
    ----------
    place : str
        Folder or URL of the store.
    about : mapping
        Name of the computation and its parameters, JSON values.
    suffix : str
        Suffix of the files.

    Examples
    --------
    >>> outputs = Outputs("memory://outputs", {"compute": "length"})
    >>> outputs.read(outputs.made({"text": "3f"}, lambda: b"3"))
    b'3'
    >>> outputs.read(outputs.made({"text": "3f"}, lambda: b"not computed again"))
    b'3'
    """

    place: str
    about: Mapping[str, Any]
    suffix: str = ".json"

    @cached_property
    def _store(self) -> Objects:
        # What is lost in a power failure is computed again.
        return objects_at(self.place, durable=False)

    def made(self, inputs: Mapping[str, str], compute: Callable[[], bytes]) -> str:
        """Return the SHA-256 of an output; compute and keep it unless it exists and is whole.

        Parameters
        ----------
        inputs : mapping of str to str
            SHA-256 of each input, by its role.
        compute : callable
            Returns the output; deterministic.

        Raises
        ------
        ArchiveError
            If the store cannot be used.
        Exception
            What `compute` raises.
        """
        depends = {"about": dict(self.about), "inputs": dict(inputs), "software": __version__}
        key = sha256_of(json.dumps(depends, sort_keys=True).encode())
        sha256 = self._whole(key)
        if not sha256:
            sha256 = self._store.put(compute(), self.suffix)
            record = {"schema": _SCHEMA, "sha256": sha256, **depends}
            self._store.write_record(key, canonical_json(record).encode())
        return sha256

    def read(self, sha256: str) -> bytes:
        """Return an output.

        Raises
        ------
        ArchiveError
            If it is missing or damaged.
        """
        return self._store.get(sha256, self.suffix)

    def _whole(self, key: str) -> str:
        try:
            sha256 = str(json.loads(self._store.record(key) or b"{}")["sha256"])
            self.read(sha256)
        except (ValueError, KeyError, TypeError, ArchiveError):
            return ""
        return sha256
