"""The photograph that would help most, beside the best that can be taken (benchmarks/next_photograph.py)."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from next_photograph import Row, judged


@pytest.mark.slow
@pytest.mark.parametrize("target", ["free", "flat"])
@pytest.mark.parametrize("seed", [1, 2, 4, 7])
def test_the_proposed_photograph_helps_nearly_as_much_as_the_best(seed: int, target: str) -> None:
    row = judged(target, seed)
    assert isinstance(row, Row)
    assert row.can
    assert row.share > 0.7
    assert row.predicted == pytest.approx(row.after, rel=0.15)
