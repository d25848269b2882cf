"""Drawings of the benchmarks: edges are where they are said to be, at any angle."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from worlds.pixels import Array, edge, form_at, per_sample


@pytest.mark.parametrize("angle", [0.0, 17.0, 26.565, 45.0])
def test_an_edge_is_where_it_is_with_few_samples_per_pixel(angle: float) -> None:
    """At 45° samples repeat along it: softened by its slope it was up to 0.015 px aside."""
    normal = np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))])

    def formed(off: float, oversampling: int) -> Array:
        def scene(x: Array, y: Array, spacing: float) -> Array:
            away = (x - 10) * normal[0] + (y - 10) * normal[1] - off
            return edge(away, per_sample(away))

        return form_at(scene, (0, 0), (21, 21), 0.7, oversampling=oversampling, derivatives=True)

    for off in (0.0, 0.07, 0.2, 0.45):
        fine = formed(off, 32)
        slope = fine[1] * normal[0] + fine[2] * normal[1]
        shift = ((formed(off, 4) - fine)[0] * slope).sum() / (slope**2).sum()
        assert abs(shift) < 5e-4
