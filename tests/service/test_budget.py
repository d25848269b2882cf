"""Sources of the uncertainty of a calibration: their sum is its covariance."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from reseau.adjust import Contribution
from reseau.bundle.diagnostics.shared import Uncertainty
from reseau.calibration import Calibration
from reseau.core.data import Array
from reseau.service.certificates.budget import uncertainty_of

from .test_inforce import camera

BEGUN = datetime(2026, 3, 2, 8, tzinfo=UTC)


def calibration(covariance: Array, formal: Array, degrees: float, **more: object) -> Calibration:
    """A calibration of 12 images with a covariance and formal standard deviations."""
    made = camera(begun=BEGUN)
    validity = made.validity | {"degrees_of_freedom": degrees, "images": 12} | more
    validity["sigma_formal"] = dict(zip(made.covariance.names, formal.tolist(), strict=True))
    matrix = tuple(tuple(row) for row in covariance.tolist())
    found = made.covariance.model_copy(update={"matrix": matrix})
    return made.model_copy(update={"validity": validity, "redundancy": 500, "covariance": found})


def drawn() -> tuple[Array, Array]:
    """A covariance with correlations, and formal standard deviations."""
    covariance = camera(begun=BEGUN).matrix()[:4, :4] * (1 + 0.4 * (1 - np.eye(4)))
    return covariance, np.sqrt(np.diag(covariance)) * [0.3, 0.8, 1.0, 0.5]


def shared(made: Calibration) -> Contribution:
    """What images have in common."""
    return next(
        c for c in uncertainty_of(made).contributions if c.name.endswith("what images have in common")
    )


@pytest.mark.parametrize("targets", [False, True])
def test_the_parts_of_a_covariance_with_what_images_share_have_it_as_their_sum(targets: bool) -> None:
    covariance, formal = drawn()
    more = {"covariance_of_targets": (0.05 * covariance).tolist()} if targets else {}
    found = uncertainty_of(calibration(covariance, formal, 20.0, **more))
    sigma = np.sqrt(np.diag(covariance))
    total = sum(each.covariance for each in found.contributions)
    assert np.allclose(total, covariance, rtol=1e-10, atol=0)
    for each in found.contributions:
        assert (np.linalg.eigvalsh(each.covariance / np.outer(sigma, sigma)) > -1e-10).all()
    common = dict(zip(found.sources, found.contributions, strict=True))["model"]
    assert common.name == "model: what images have in common"
    left = np.sqrt(np.diag(covariance - common.covariance))
    assert (left <= formal * (1 + 1e-9)).all()
    assert found.budget().joint_degrees < 60


def test_coefficients_that_were_not_chosen_leave_what_images_share_its_degrees_of_freedom() -> None:
    covariance, formal = drawn()
    before = shared(calibration(covariance, formal, 20.0))
    direction = np.sqrt(np.diag(covariance)) * [0.1, 0.1, 3.0, -5.0]
    held = np.outer(direction, direction)
    known = Uncertainty(covariance, covariance - before.covariance, np.full(4, 20.0), 20.0).with_errors(held)
    assert known.degrees > 200  # together with an error of known size
    made = calibration(covariance + held, formal, known.degrees, covariance_of_held=held.tolist())
    after = shared(made)
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-6, atol=1e-15)
    assert after.degrees == pytest.approx(before.degrees, rel=1e-6)
