"""The list of errors that tests must notice is one of lines that are there (benchmarks/mutations.py)."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from mutations import ROOT, Mutation, mutations

EVERY = mutations()


@pytest.mark.parametrize("mutation", EVERY, ids=lambda each: each.file)
def test_a_change_is_of_a_line_that_is_there_once_and_its_tests_exist(mutation: Mutation) -> None:
    source = (ROOT / "src" / "reseau" / mutation.file).read_text("utf-8")
    assert source.count(mutation.was) == 1, "replace it in benchmarks/mutations.toml by one of the same core"
    assert mutation.becomes != mutation.was
    assert all((ROOT / test).is_file() for test in mutation.tests)


def test_there_are_sixty_and_one_says_the_words_that_differ() -> None:
    assert len(EVERY) >= 60
    assert len({each.key for each in EVERY}) == len(EVERY)
    assert Mutation("a.py", "x = p + q", "x = p - q", ()).change == "`p + q` → `p - q`"
