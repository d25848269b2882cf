"""The part of the covariance that observed target coordinates cause, against perturbed adjustments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reseau.bundle import adjust_network, example_network
from reseau.bundle.diagnostics.target_part import covariance_by_targets


def test_it_is_what_errors_of_the_coordinates_do_to_the_camera() -> None:
    """Each coordinate is moved by its sigma, and the network adjusted again."""
    network = example_network()
    observed = np.zeros((20, 3), bool)
    observed[[0, 4, 9, 15, 19]] = True
    sigma = np.where(observed, 1e-3, np.nan)
    role = tuple("control" if any(row) else "tie" for row in observed)
    network = replace(network, sigma=sigma, role=role, datum="control", datum_points=observed.any(axis=1))
    result = adjust_network(network)
    names, _, values = result.camera_columns(0)
    moved = []
    for j, axis in np.argwhere(observed):
        xyz = network.xyz.copy()
        xyz[j, axis] += 1e-3
        moved.append(adjust_network(replace(network, xyz=xyz)).camera_columns(0)[2] - values)
    expected = np.array(moved).T @ np.array(moved) * result.fit.variance
    found = covariance_by_targets(result, 0)
    assert found is not None
    scale = np.sqrt(np.diag(expected))
    assert np.abs((found - expected) / np.outer(scale, scale)).max() < 0.01  # not linear to 1 %
    total = result.formal_camera_covariance(0)
    assert np.linalg.eigvalsh((total - found) / np.outer(scale, scale)).min() > 0.0
    assert names == ("c", "x0", "y0", "K1")
