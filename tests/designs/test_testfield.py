"""The coded testfield: the dimensions of the paper, a strict document, and refused designs."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import FormatError, UsageError
from reseau.designs import coded_testfield
from reseau.io import TestfieldDesign


def test_the_testfield_has_the_dimensions_of_the_paper() -> None:
    field = coded_testfield()
    assert (field.squares, field.pitch, field.lines.width) == ((8, 8), 125.0, 2.0)
    assert len(field.ids) == 1024
    small, large = (
        {size for size, big in zip(field.targets.size, field.large, strict=True) if big == which}
        for which in (False, True)
    )
    assert (min(small), max(small), min(large), max(large)) == (9.0, 15.0, 17.0, 25.0)
    kinds = Counter(zip(field.targets.square, field.targets.shape, field.large.tolist(), strict=True))
    assert len(kinds) == 64 * 8
    assert set(kinds.values()) == {2}


def test_squares_are_numbered_in_rows_from_the_upper_left_and_so_are_their_targets() -> None:
    field = coded_testfield(3, 2, 100.0, spread=24.0, large=(15, 20, 20, 19))
    at = dict(zip(field.ids, field.xy.tolist(), strict=True))
    assert at["1.01"] == [-136.0, 86.0]
    assert at["3.04"] == [136.0, 86.0]
    assert at["6.16"] == [136.0, -86.0]
    np.testing.assert_allclose(field.xy.mean(axis=0), 0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(field.centres[[0, 5]], [[-100, 50], [100, -50]], rtol=0, atol=0)


def test_a_testfield_is_read_back_unchanged(tmp_path: Path) -> None:
    field = coded_testfield(2, 3, turn_seed=4)
    field.write(tmp_path / "field.json")
    assert TestfieldDesign.read(tmp_path / "field.json") == field
    text = (tmp_path / "field.json").read_text()
    assert text == field.to_json()
    assert next(iter(json.loads(text))) == "schema"
    assert len(set(field.targets.angle)) > 90


def broken(change: str) -> str:
    content: dict[str, Any] = coded_testfield(2, 1).to_dict()
    content = json.loads(json.dumps(content))
    match change:
        case "unknown":
            content["lines"]["colour"] = 1
        case "missing":
            del content["pitch"]
        case "twice":
            content["targets"]["id"][1] = "1.01"
        case "short":
            content["targets"]["size"].pop()
        case "shape":
            content["targets"]["shape"][0] = "star"
        case "size":
            content["targets"]["size"][0] = 0.0
        case "lines":
            content["lines"]["vertical_x"].pop(1)
        case "order":
            content["lines"]["vertical_x"].reverse()
        case "extent":
            content["lines"]["extent"][0] = 0.0
        case "square":
            content["targets"]["square"][0] = 3
    return json.dumps(content)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("unknown", "unknown key `lines.colour`"),
        ("missing", "missing key `pitch`"),
        ("twice", "duplicate id '1.01'"),
        ("short", "column `size` has 31 entries, the first 32"),
        ("shape", r"`targets.shape\[0\]`"),
        ("size", r"`targets.size\[0\]`.*greater than 0"),
        ("lines", "bound 1 × 1 squares, not 2 × 1"),
        ("order", "`vertical_x` must ascend"),
        ("extent", "`extent` must include"),
        ("square", "square 3 does not exist in 2 × 1"),
    ],
)
def test_an_invalid_testfield_is_refused_with_the_key(change: str, complaint: str) -> None:
    with pytest.raises(FormatError, match=complaint):
        TestfieldDesign.parse(broken(change), where="field.json")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"columns": 0}, "0 × 8 squares"),
        ({"columns": 13, "rows": 13}, "168 words, not 169"),
        ({"pitch": 100.0, "spread": 30.0}, "do not fit squares of 100 mm"),
        ({"spread": 25.0}, "do not fit 25 mm"),
        ({"small": (9, 13, 15)}, "a size for each of four shapes"),
        ({"small": (18, 13, 15, 12)}, "the large ones above the small"),
    ],
)
def test_impossible_testfields_are_refused(options: dict[str, Any], complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        coded_testfield(**options)
