"""The result as a document ``reseau-bundle/1``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array
from .diagnostics import Result, sigma_between_images
from .modelling.model_search import Searched
from .network import finite

__all__ = ["SCHEMA", "searched_document", "to_document"]

SCHEMA = "reseau-bundle/1"


def to_document(result: Result, *, covariances: bool = False) -> dict[str, Any]:
    """The result in columns, JSON values; what is not determined is null.

    Parameters
    ----------
    result : Result
        Of a bundle adjustment.
    covariances : bool
        Whether points have their full covariances.
    """
    fit = result.fit
    observations, unknowns, constraints = fit.counts
    test = result.global_test()
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "sigma0": _number(result.sigma0),
        "observations": observations,
        "unknowns": unknowns,
        "constraints": constraints,
        "redundancy": result.redundancy,
        "iterations": fit.iterations,
        "cameras": [_camera(result, c) for c in range(len(result.network.cameras))],
        "images": _images(result),
        "points": _points(result, covariances),
        "image_points": _image_points(result),
        "global_test": None if test is None else {
            "statistic": test.statistic, "redundancy": test.redundancy, "lower": test.lower,
            "upper": test.upper, "p": test.p, "passed": test.passed,
        },
        "warnings": [remark.text for remark in result.warnings],
        "warning_codes": [remark.code.value for remark in result.warnings],
    }  # fmt: skip
    if result.rejected.any():
        document["left_out"] = _left_out(result)
    if len(result.network.distance):
        document["distances"] = _distances(result)
    return document


def searched_document(searched: Searched) -> dict[str, Any]:
    """How the model of an adjustment was found, JSON values; empty where nothing was looked for."""
    found: dict[str, Any] = {}
    components = searched.components
    if components is not None:
        found["variance_components"] = {
            "names": list(components.names),
            "factors": components.factors.tolist(),
            "sigma": components.sigma.tolist(),
            "redundancy": components.redundancy.tolist(),
        }
    if searched.eliminated is not None:
        found["eliminated"] = [
            {"camera": step.camera, "name": step.test.name, "statistic": _number(step.test.statistic),
             "critical": step.test.critical, "p": step.test.p, "sigma0": _number(step.sigma0)}
            for step in searched.eliminated
        ]  # fmt: skip
    if searched.validation is not None:
        found["cross_validation"] = {"all": searched.validation[0], "kept": searched.validation[1]}
    return found


def _camera(result: Result, c: int) -> dict[str, Any]:
    camera = result.network.cameras[c]
    names, _, values = result.camera_columns(c)
    covariance = result.camera_covariance(c)
    sigma = np.sqrt(np.diag(covariance))
    held = {name: {"value": value, "sigma": 0.0} for name, value in camera.parameters.items()}
    found = {
        name: {"value": float(value), "sigma": float(s)}
        for name, value, s in zip(names, values, sigma, strict=True)
    }
    tests = {
        test.name: {"statistic": _number(test.statistic), "critical": test.critical, "p": test.p,
                    "significant": test.significant}
        for test in result.camera_tests(c)
    }  # fmt: skip
    size = np.where(sigma > 0, sigma, 1.0)
    correlation = covariance / np.outer(size, size)
    np.fill_diagonal(correlation, 1.0)
    return {
        "id": camera.id,
        "parameters": held | found,
        # By the scatter between images; null where these are too few.
        "sigma_between_images": dict(zip(names, _column(sigma_between_images(result, c)), strict=True)),
        "correlation": {"names": list(names), "matrix": correlation.tolist()},
        "tests": tests,
    }


def _images(result: Result) -> dict[str, Any]:
    sigma = np.sqrt(np.maximum(np.diagonal(result.pose_covariance, axis1=1, axis2=2), 0.0))
    network = result.network
    return {
        "id": list(network.images),
        "camera": [network.cameras[c].id for c in network.camera_of],
        "X0": _rows(result.fit.values.x0),
        "rotation": _rows(result.rotation),
        # Of X0, Y0, Z0 and the rotation vector.
        "sigma": _rows(np.hstack([sigma[:, 3:], sigma[:, :3]])),
        "angles_deg": _rows(np.degrees(result.angles)),
        "angles_sigma_deg": _rows(np.degrees(result.angle_sigma)),
        # Of the sigmas given, x and y: what they should have been multiplied with.
        "factors": _rows(result.variance_factors),
    }


def _points(result: Result, covariances: bool) -> dict[str, Any]:
    network = result.network
    table: dict[str, Any] = {
        "id": list(network.points),
        "role": list(network.role),
        "xyz": _rows(result.fit.values.xyz),
        "sigma": _rows(result.point_sigma),
        "rays": network.rays.tolist(),
    }
    if covariances:
        determined = result.fit.usable.points
        table["cov"] = [
            block.tolist() if known else None
            for block, known in zip(result.point_covariance, determined, strict=True)
        ]
    rows, difference = result.check_points
    if len(rows):
        column: list[list[float] | None] = [None] * len(network.points)
        for row, off in zip(rows, difference, strict=True):
            column[row] = off.tolist()
        table["check"] = column
    return table


def _image_points(result: Result) -> dict[str, Any]:
    network = result.network
    v, r, w = result.residuals, result.redundancy_numbers, result.test_values
    least, effect = result.minimal_detectable_errors(), result.external_reliability()
    return {
        "image": [network.images[i] for i in network.image_of],
        "point": [network.points[j] for j in network.point_of],
        "vx": _column(v[:, 0]),
        "vy": _column(v[:, 1]),
        "rx": _column(r[:, 0]),
        "ry": _column(r[:, 1]),
        "wx": _column(w[:, 0]),
        "wy": _column(w[:, 1]),
        "rejected": result.rejected.tolist(),
        # Minimal detectable errors (px), and what they do at most to any result (in its sigmas).
        "mx": _column(least[:, 0]),
        "my": _column(least[:, 1]),
        "ex": _column(effect[:, 0]),
        "ey": _column(effect[:, 1]),
    }


def _left_out(result: Result) -> dict[str, Any]:
    """What data snooping left out, with the test values at which it did."""
    rows, network = np.flatnonzero(result.rejected), result.network
    tests = result.rejected_tests[rows]
    return {
        "image": [network.images[i] for i in network.image_of[rows]],
        "point": [network.points[j] for j in network.point_of[rows]],
        "w": _column(tests[:, 0]),
        "critical": _column(tests[:, 1]),
    }


def _distances(result: Result) -> dict[str, Any]:
    network, at = result.network, 2 * len(result.network.xy)
    count = len(network.distance)
    rows = slice(at, at + count)
    sigma0 = result.sigma0 if result.redundancy > 0 and result.sigma0 > 0 else 1.0
    return {
        "from": [network.points[j] for j in network.distance_of[:, 0]],
        "to": [network.points[j] for j in network.distance_of[:, 1]],
        "v": _column(result.fit.residuals[rows]),
        "r": _column(result.fit.redundancy_numbers[rows]),
        "w": _column(np.abs(result.fit.w[rows]) / sigma0),
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _column(values: Array) -> list[float | None]:
    return [_number(value) for value in values.tolist()]


def _rows(values: NDArray[np.float64]) -> list[list[float] | None]:
    known = finite(values).tolist()
    return [row if k else None for row, k in zip(values.tolist(), known, strict=True)]
