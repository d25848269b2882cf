"""Kept pictures: drawn again whenever anything differs that they are drawn from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from reseau.core.data import Array

from . import kept


@dataclass(frozen=True, eq=False)
class View:
    marks: tuple[Array, ...]
    seed: int = 0
    drawn: ClassVar[list[str]] = []

    def picture(self) -> Array:
        self.drawn.append(type(self).__name__)
        return self.marks[-1] + self.seed


class Wide(View):
    pass


def test_a_picture_is_drawn_once_for_each_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "FOLDER", tmp_path)
    large = np.zeros(5000)
    changed = large.copy()
    changed[2500] = 1e-12  # beyond what a printed array shows
    views = [View((large,)), View((large,), 1), View((changed,)), View((large, large)), Wide((large,))]
    first = [kept.picture(view) for view in views]
    assert View.drawn == 4 * ["View"] + ["Wide"]
    for view, picture in zip(views, first, strict=True):
        np.testing.assert_array_equal(kept.picture(replace(view)), picture)
    assert len(View.drawn) == len(views)


def test_a_result_is_computed_once_for_each_content() -> None:
    asked: list[View] = []

    def shown(view: View, factor: float) -> float:
        asked.append(view)
        return float(view.marks[0].sum()) * factor

    for _ in range(2):
        assert [kept.once(shown, View((np.full(3, k),)), 2.0) for k in (1.0, 2.0)] == [6.0, 12.0]
        assert kept.once(shown, View((np.full(3, 1.0),)), 3.0) == 9.0
    assert len(asked) == 3
