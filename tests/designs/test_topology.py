"""The code of the testfield: its distance over all words, and the errors it corrects."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reseau.core.errors import UsageError
from reseau.core.failure import Code
from reseau.designs import HIDDEN, TopologicalCode, coded_testfield
from reseau.designs.topology import Symbols, places, words

CODE = TopologicalCode.of(coded_testfield())


def every_appearance(count: int) -> tuple[Symbols, list[tuple[int, int, bool]]]:
    """All words rotated as pictures with numpy: (8·count, 16), and the identity of each."""
    seen, what = [], []
    for square, word in enumerate(words(count)):
        for mirrored in (False, True):
            grid = np.fliplr(word.reshape(4, 4)) if mirrored else word.reshape(4, 4)
            for quarters in range(4):
                seen.append(np.rot90(grid, quarters).ravel())
                what.append((square + 1, quarters, mirrored))
    return np.array(seen), what


@pytest.mark.parametrize("count", [64, 168])
def test_any_two_appearances_of_clusters_differ_in_twelve_targets(count: int) -> None:
    seen, _ = every_appearance(count)
    differ = np.array([(seen != one).sum(axis=1) for one in seen])
    np.fill_diagonal(differ, 16)
    assert differ.min() == 12
    assert TopologicalCode(words(count)).distance == 12


def test_among_the_64_squares_shapes_alone_differ_in_eight_targets() -> None:
    seen, what = every_appearance(64)
    square = np.array([w[0] for w in what])
    differ = np.array([((seen >> 1) != (one >> 1)).sum(axis=1) for one in seen])
    assert differ[square[:, None] != square].min() == 8


def test_every_cluster_contains_two_targets_of_each_kind() -> None:
    for word in words(168):
        np.testing.assert_array_equal(np.bincount(word, minlength=8), 2)


def test_every_cluster_is_decoded_at_any_rotation_and_mirrored() -> None:
    for seen, (square, quarters, mirrored) in zip(*every_appearance(64), strict=True):
        found = CODE.decode(seen)
        assert (found.square, found.quarter_turns, found.mirrored, found.corrections) == (
            square,
            quarters,
            mirrored,
            0,
        )


def test_any_single_misclassified_target_is_corrected() -> None:
    # All 64 clusters × 4 rotations × 16 targets × 7 wrong kinds; at once, as decode() would be slow here.
    every, what = every_appearance(64)
    for seen, (square, quarters, mirrored) in zip(every, what, strict=True):
        if mirrored:
            continue
        wrong = np.tile(seen, (16 * 7, 1))
        row = np.arange(16 * 7)
        wrong[row, row // 7] = (wrong[row, row // 7] + 1 + row % 7) % 8
        differ = (CODE.appearances.reshape(1, -1, 16) != wrong[:, None]).sum(axis=2)
        assert (differ.argmin(axis=1) == quarters * 64 + square - 1).all()
        assert (np.sort(differ, axis=1)[:, :2] @ [0, 1] >= 11).all()


@settings(max_examples=200)
@given(
    square=st.integers(1, 64),
    quarters=st.integers(0, 3),
    order=st.permutations(range(16)),
    hidden=st.integers(0, 16),
    wrong=st.integers(0, 8),
    shift=st.lists(st.integers(1, 7), min_size=8, max_size=8),
)
def test_decoding_is_correct_or_refused(
    square: int, quarters: int, order: list[int], hidden: int, wrong: int, shift: list[int]
) -> None:
    seen = np.rot90(CODE.clusters[square - 1].reshape(4, 4), quarters).ravel().copy()
    wrong = min(wrong, 16 - hidden)
    for place, by in zip(order[:wrong], shift[:wrong], strict=True):
        seen[place] = (seen[place] + by) % 8
    seen[order[wrong : wrong + hidden]] = HIDDEN
    found = CODE.decode(seen)
    within = 2 * wrong + hidden < 12
    if within:
        assert (found.square, found.quarter_turns, found.mirrored) == (square, quarters, False)
        assert (found.corrections, found.hidden) == (wrong, hidden)
    elif wrong < 12 - hidden - wrong:
        assert not found
        assert found.why


def test_a_cluster_that_matches_no_square_is_declined_with_the_reason() -> None:
    nothing = CODE.decode(np.full(16, HIDDEN))
    assert not nothing
    assert nothing.code is Code.HIDDEN
    assert nothing.why == "16 of its targets are hidden"
    other = CODE.decode(np.arange(16) % 8)
    assert not other
    assert other.code is Code.INCONSISTENT


def test_a_design_is_decoded_independently_of_the_order_of_its_targets() -> None:
    field = coded_testfield(3, 2)
    order = np.random.default_rng(0).permutation(len(field.ids))
    columns = {
        name: tuple(getattr(field.targets, name)[i] for i in order)
        for name in type(field.targets).model_fields
    }
    shuffled = field.model_copy(update={"targets": field.targets.model_copy(update=columns)})
    np.testing.assert_array_equal(TopologicalCode.of(shuffled).clusters, TopologicalCode.of(field).clusters)
    assert shuffled.ids[places(shuffled)[4, 6]] == "5.07"


def test_squares_without_four_by_four_targets_have_no_code() -> None:
    field = coded_testfield(2, 1)
    fewer = {name: getattr(field.targets, name)[:-1] for name in type(field.targets).model_fields}
    with pytest.raises(UsageError, match="sixteen targets"):
        TopologicalCode.of(field.model_copy(update={"targets": field.targets.model_copy(update=fewer)}))
    moved = (field.targets.x[0] + 1.0, *field.targets.x[1:])
    with pytest.raises(UsageError, match="grid of four by four"):
        TopologicalCode.of(
            field.model_copy(update={"targets": field.targets.model_copy(update={"x": moved})})
        )
    with pytest.raises(UsageError, match="168 words"):
        words(169)
