r"""Test whether stored coefficients still hold for a new photograph of the test object.

Wishahy calls the coefficients of an instrument "theoretically standard": determined once, they are valid for
every later photograph. A new image of the test object tests this. With the same rods as before, their errors
are the same, and every rod is compared with its earlier image:

.. math:: d_i = f(x_i^{new}) - f(x_i^{old}), \qquad \chi^2 = \sum_i d_i^T \Sigma_i^{-1} d_i ,

with f the stored correction and the covariances of both measurements alone. With other rods
:math:`d_i = f(x_i) - X_i`; the covariance then includes the rods' tolerance and the covariance of the
coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ..calibration import InstrumentCorrection
from ..core.data import Array, ImagePoints
from ..core.errors import UsageError
from ..core.failure import Code, Estimated, Failure
from ..io import ReseauDesign


@dataclass(frozen=True, eq=False)
class StandardTest(Estimated):
    """Test of stored coefficients by a new photograph; object coordinates in the unit of the instrument.

    Parameters
    ----------
    names : tuple of str (n,)
        The rods compared.
    change : ndarray (n, 2)
        Change of the position of each rod under the stored correction.
    sigma : ndarray (n, 2)
        Standard deviations of the changes when nothing has changed.
    statistic, degrees, critical, p : float, int, float, float
        χ² of all changes, its degrees of freedom, its critical value at level alpha, and its p-value.
    shift, shift_sigma : ndarray (2,)
        Common part of the changes, and its standard deviations.
    p_shift, p_rest : float
        Probability of a common shift at least as large, and of other changes at least as large, when nothing
        has changed.
    same_object : bool
        Whether the rods are those of the stored calibration.
    alpha : float
        Level.

    Examples
    --------
    >>> test = StandardTest(
    ...     ("R1", "R2"), np.array([[0.1, 0.0], [0.3, 0.4]]), np.full((2, 2), 0.2), 7.25, 4, 9.49, 0.12,
    ...     np.array([0.2, 0.2]), np.array([0.14, 0.14]), 0.13, 0.26, same_object=True, alpha=0.05,
    ... )
    >>> test.holds, test.largest
    (True, ('R2', 0.5))
    """

    names: tuple[str, ...]
    change: Array
    sigma: Array
    statistic: float
    degrees: int
    critical: float
    p: float
    shift: Array
    shift_sigma: Array
    p_shift: float
    p_rest: float
    same_object: bool
    alpha: float

    @property
    def holds(self) -> bool:
        """Whether the stored coefficients are not contradicted."""
        return self.p >= self.alpha

    @property
    def largest(self) -> tuple[str, float]:
        """The rod with the largest change, and its length."""
        length = np.hypot(*self.change.T)
        worst = int(length.argmax())
        return self.names[worst], float(length[worst])


def still_standard(
    stored: InstrumentCorrection,
    pins: ImagePoints,
    rods: ReseauDesign,
    *,
    same_object: bool = True,
    alpha: float = 0.05,
) -> StandardTest | Failure:
    """Test whether a stored correction still holds.

    Parameters
    ----------
    stored : InstrumentCorrection
        Groups A and B, as read from a calibration.
    pins : ImagePoints
        Images of the rods in the new photograph, referred to PHOTO I (px).
    rods : ReseauDesign
        The rods.
    same_object : bool
        Whether they are the rods of the calibration, so that their errors are the same.
    alpha : float
        Level of the tests.

    Returns
    -------
    StandardTest or Failure
        A failure with fewer than four rods in common.

    Raises
    ------
    UsageError
        When the level is not between 0 and 1.

    Examples
    --------
    >>> from reseau.calibration import CameraCorrection, ObjectPlane
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> from reseau.optics import RationalPolynomial
    >>> from reseau.optics.composition import Similarity
    >>> rods = regular_reseau(3, 3, 20.0, Mark(shape="disk", size=0.75))
    >>> model, plane = RationalPolynomial.camera(), ObjectPlane(Similarity(), np.ones(2), Similarity())
    >>> camera = CameraCorrection(model, np.zeros((13, 13)), Similarity(), Similarity(), "mm")
    >>> pins = ImagePoints.with_sigma(rods.ids, rods.xy, 0.01)
    >>> group_b = RationalPolynomial.ultrasonic()
    >>> stored = InstrumentCorrection(camera, group_b, plane, np.zeros((29, 29)), "mm", pins)
    >>> moved = ImagePoints(pins.names, pins.xy + [0.1, 0.0], pins.cov)
    >>> still_standard(stored, pins, rods).holds, still_standard(stored, moved, rods).holds
    (True, False)
    """
    if not 0 < alpha < 1:
        raise UsageError(f"{alpha:g} is not between 0 and 1", where="alpha")
    known = set(stored.pins.names) if same_object else {p.id for p in rods.points if p.x is not None}
    names = [name for name in pins.names if name in known and name in rods.ids]
    if len(names) < 4:
        return Failure(
            f"{len(names)} of {len(pins)} points are rods that can be compared; four are needed",
            Code.TOO_FEW_POINTS,
        )
    now = pins.select(names)
    change, cov = _against_before(stored, now) if same_object else _against_design(stored, now, rods)
    whole = np.linalg.inv(cov)
    d = change.ravel()
    statistic = float(d @ whole @ d)
    common = np.tile(np.eye(2), (len(names), 1))
    cofactor = np.linalg.inv(common.T @ whole @ common)
    shift = cofactor @ common.T @ whole @ d
    of_shift = float(shift @ np.linalg.solve(cofactor, shift))
    return StandardTest(
        names=tuple(names),
        change=change,
        sigma=np.sqrt(np.diagonal(cov)).reshape(-1, 2),
        statistic=statistic,
        degrees=len(d),
        critical=float(scipy.special.chdtri(len(d), alpha)),
        p=float(scipy.special.chdtrc(len(d), statistic)),
        shift=shift,
        shift_sigma=np.sqrt(np.diagonal(cofactor)),
        p_shift=float(scipy.special.chdtrc(2, of_shift)),
        p_rest=float(scipy.special.chdtrc(len(d) - 2, statistic - of_shift)),
        same_object=same_object,
        alpha=alpha,
    )


def _against_before(stored: InstrumentCorrection, now: ImagePoints) -> tuple[Array, Array]:
    """Changes (n, 2) against the images that the calibration was made with, and their covariance."""
    before = stored.pins.select(now.names)
    both = np.zeros((2 * len(now), 2 * len(now)))
    values = []
    for points in (now, before):
        value, slope, _ = stored.derivatives(points.xy)
        values.append(value)
        both += _blocks(slope @ points.cov @ np.swapaxes(slope, 1, 2))
    return values[0] - values[1], both


def _against_design(
    stored: InstrumentCorrection, now: ImagePoints, rods: ReseauDesign
) -> tuple[Array, Array]:
    """Changes (n, 2) against the design of the rods, and their covariance."""
    design = {p.id: (p.x, p.y, p.sigma or 0.0) for p in rods.points}
    table = np.array([design[name] for name in now.names], dtype=np.float64)
    value, slope, by_coefficients = stored.derivatives(now.xy)
    errors = slope @ now.cov @ np.swapaxes(slope, 1, 2) + table[:, 2, None, None] ** 2 * np.eye(2)
    moves = by_coefficients.reshape(2 * len(now), -1)
    return value - table[:, :2], _blocks(errors) + moves @ stored.covariance @ moves.T


def _blocks(cov: Array) -> Array:
    """Covariances (n, 2, 2) of independent points as one matrix (2n, 2n)."""
    whole = np.zeros((len(cov), 2, len(cov), 2))
    each = np.arange(len(cov))
    whole[each, :, each, :] = cov
    return whole.reshape(2 * len(cov), 2 * len(cov))
