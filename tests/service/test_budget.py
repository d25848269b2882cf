"""Sources of the uncertainty of a calibration: their sum is its covariance."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from reseau.service.certificates.budget import uncertainty_of

from .test_inforce import camera

BEGUN = datetime(2026, 3, 2, 8, tzinfo=UTC)


@pytest.mark.parametrize("targets", [False, True])
def test_the_parts_of_a_covariance_with_what_images_share_have_it_as_their_sum(targets: bool) -> None:
    made = camera(begun=BEGUN)
    covariance = made.matrix()[:4, :4] * (1 + 0.4 * (1 - np.eye(4)))
    sigma = np.sqrt(np.diag(covariance))
    names = made.covariance.names
    matrix = tuple(tuple(row) for row in covariance.tolist())
    formal = dict(zip(names, (sigma * [0.3, 0.8, 1.0, 0.5]).tolist(), strict=True))
    validity = made.validity | {"sigma_formal": formal, "degrees_of_freedom": 20.0, "images": 12}
    if targets:
        validity |= {"covariance_of_targets": (0.05 * covariance).tolist()}
    made = made.model_copy(
        update={
            "validity": validity,
            "redundancy": 500,
            "covariance": made.covariance.model_copy(update={"matrix": matrix}),
        }
    )
    found = uncertainty_of(made)
    total = sum(each.covariance for each in found.contributions)
    assert np.allclose(total, covariance, rtol=1e-10, atol=0)
    for each in found.contributions:
        assert (np.linalg.eigvalsh(each.covariance / np.outer(sigma, sigma)) > -1e-10).all()
    shared = dict(zip(found.sources, found.contributions, strict=True))["model"]
    assert shared.name == "model: what images have in common"
    left = np.sqrt(np.diag(covariance - shared.covariance))
    assert (left <= sigma * [0.3, 0.8, 1.0, 0.5] * (1 + 1e-9)).all()
    assert found.budget().joint_degrees < 60
