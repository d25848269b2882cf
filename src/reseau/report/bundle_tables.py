"""Tables of a bundle adjustment: images, image points with the largest test values, model search."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..bundle import Result
from ..core.data import Array

_WORST = 20
"""Number of image points listed."""


def images_table(result: Result) -> list[tuple[str, ...]]:
    """Return a row for each image: points, residuals, factors on sigmas, reliability, orientation."""
    network = result.network
    v = np.where(result.rejected[:, None], np.nan, result.residuals)
    r, least, effect = (
        result.redundancy_numbers, result.minimal_detectable_errors(), result.external_reliability()
    )  # fmt: skip
    angle, sigma = np.degrees(result.angles), np.degrees(result.angle_sigma)
    q = np.sqrt(np.maximum(np.diagonal(result.pose_covariance, axis1=1, axis2=2), 0.0))[:, 3:]
    rows: list[tuple[str, ...]] = []
    for i, name in enumerate(network.images):
        at = network.rays_of_images[i]
        at = at[np.isfinite(v[at]).all(axis=1)]
        if not result.fit.usable.images[i]:
            rows.append((name, str(len(at)), "left out", *[""] * 7))
            continue
        rows.append(
            (
                name,
                str(len(at)),
                _pair(np.sqrt((v[at] ** 2).mean(axis=0)), ".3f"),
                _pair(result.variance_factors[i], ".2f"),
                _pair(r[at].mean(axis=0), ".2f"),
                f"{_median(least[at]):.2g}",
                f"{_largest(effect[at]):.2g}",
                " / ".join(f"{s:.2g}" for s in q[i]),
                " / ".join(f"{a:.4f}" for a in angle[i]),
                " / ".join(f"{s:.2g}" for s in sigma[i]),
            )
        )
    return rows


def worst_points(result: Result) -> list[tuple[str, ...]]:
    """Return the image points with the largest test values, with their reliability."""
    network, w = result.network, np.nan_to_num(result.test_values)
    order = np.argsort(-w.max(axis=1), kind="stable")[:_WORST]
    v, r = result.residuals, result.redundancy_numbers
    least, effect = result.minimal_detectable_errors(), result.external_reliability()
    return [
        (
            network.images[network.image_of[k]],
            network.points[network.point_of[k]],
            _pair(v[k], ".3f"),
            _pair(r[k], ".2f"),
            _pair(w[k], ".1f"),
            _pair(least[k], ".2g"),
            _pair(effect[k], ".2g"),
        )
        for k in order
        if w[k].max() > 0
    ]


def left_out_table(result: Result) -> list[tuple[str, str, str, str]]:
    """Return the image points rejected by data snooping: image, point, test value, bound."""
    return [
        (image, point, f"{value:.1f}", f"{critical:.1f}")
        for image, point, value, critical in result.rejected_points()
    ]


def components_table(result: Result) -> list[tuple[str, str, str, str]]:
    """Return variance components: name, factor, its standard deviation, redundancy."""
    found = result.components
    if found is None:
        return []
    columns = zip(found.names, found.factors, found.sigma, found.redundancy, strict=True)
    return [(name, f"{factor:.3f}", f"{sigma:.2g}", f"{r:.1f}") for name, factor, sigma, r in columns]


def dropped_table(result: Result) -> dict[str, Any] | None:
    """Return dropped parameters and the errors of prediction before and after; None without elimination."""
    if result.eliminated is None:
        return None
    before, after = result.validation or (np.nan, np.nan)
    return {
        "steps": [
            (step.camera, step.test.name, f"{step.test.statistic:.2f}", f"{step.test.critical:.2f}",
             f"{step.test.p:.2g}", f"{step.sigma0:.5g}")
            for step in result.eliminated
        ],
        "before": f"{before:.4g}",
        "after": f"{after:.4g}",
    }  # fmt: skip


def _pair(values: Array, form: str) -> str:
    return " / ".join(f"{value:{form}}" if np.isfinite(value) else "–" for value in values)


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _largest(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else float("nan")
