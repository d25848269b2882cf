"""Provenance: hashes of inputs, and JSON that is reproducible to the byte."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from reseau import __version__
from reseau.core.errors import InputError
from reseau.core.provenance import Provenance, canonical_json, sha256_of


def test_hashes_are_those_of_the_bytes(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"\0\1" * 100_000)
    assert sha256_of(path) == sha256_of(b"\0\1" * 100_000) == hashlib.sha256(b"\0\1" * 100_000).hexdigest()
    with pytest.raises(InputError, match=r"none\.bin: cannot be read"):
        sha256_of(tmp_path / "none.bin")


def test_json_has_no_nan_and_ends_in_a_newline() -> None:
    assert canonical_json({"ä": [1, 0.1]}) == '{\n "ä": [\n  1,\n  0.1\n ]\n}\n'
    with pytest.raises(ValueError, match="JSON compliant"):
        canonical_json(float("nan"))


def test_the_order_of_inputs_and_options_does_not_matter() -> None:
    one = Provenance({"b": "2", "a": "1"}, {"z": 1, "y": 2}).to_dict()
    other = Provenance({"a": "1", "b": "2"}, {"y": 2, "z": 1}).to_dict()
    assert canonical_json(one) == canonical_json(other)
    assert one["software"] == f"reseau {__version__}"
