"""Dense matrices of an adjustment, and of what is said about it, are factored by one thread."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
import threadpoolctl  # type: ignore[import-untyped]

from reseau.bundle import adjust_network, explain
from reseau.bundle.diagnostics.patterns import by_place, common_pattern
from reseau.optics.field import SmoothField

from .rigs import drawn

_SMALL = 32
"""Rows and columns that BLAS does not divide."""


@pytest.fixture
def factored(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Functions called with matrices that are not small, and the number of threads."""
    blas = threadpoolctl.ThreadpoolController().select(user_api="blas")
    found: list[tuple[str, int]] = []

    def watched(package: Any, name: str) -> Any:
        function = getattr(package, name)

        def call(a: Any, *more: Any, **options: Any) -> Any:
            if min(np.shape(a)[-2:], default=0) > _SMALL:
                found.append((name, max(library["num_threads"] for library in blas.info())))
            return function(a, *more, **options)

        return call

    for package in (np.linalg, scipy.linalg):
        for name in ("cholesky", "eigh", "inv", "pinv", "solve", "svd"):
            monkeypatch.setattr(package, name, watched(package, name))
    return found


@pytest.mark.slow
def test_of_an_adjustment_and_its_explanation(factored: list[tuple[str, int]]) -> None:
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        result = adjust_network(drawn(cameras=3)).required()
        assert result.rig is not None
        assert explain(result).causes == ()
        result.camera(0)
        common_pattern(result, by_place(result, 0))
    assert factored
    assert {threads for _, threads in factored} == {1}, factored


def test_of_a_smooth_field(factored: list[tuple[str, int]]) -> None:
    at = np.random.default_rng(0).uniform(0, 9, (80, 2))
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        SmoothField.fit(at, at + 0.01 * np.random.default_rng(1).normal(size=at.shape))
    assert {name for name, _ in factored} >= {"eigh"}
    assert {threads for _, threads in factored} == {1}, factored
