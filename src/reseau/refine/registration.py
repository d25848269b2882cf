"""Refer a photograph to PHOTO I by the reseau that both show.

The correction of the camera predicts the image position of every mark of the reseau. A similarity from the
measured to the predicted positions transforms any other measurement in the photograph to PHOTO I. If it
differs from the identity, the camera has moved. After a large shift or a rotation the camera sees the reseau
in another perspective and through other parts of its lens: where the similarity leaves more than the errors
of the marks, a smooth field through the marks replaces it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy

from ..adjust import Adjustment
from ..calibration import CameraCorrection
from ..calibration.mapping import carried
from ..core.data import Array, ImagePoints, Mask
from ..core.failure import Code, Failure
from ..io import ReseauDesign
from ..measure.fitting import fit_mapping
from ..optics import RationalPolynomial
from ..optics.composition import Similarity
from ..optics.field import SmoothField

_LEAST_PX = 0.05
"""Smaller displacements are ignored, even where they are significant."""
_UNLIKE = 2.0
"""Standard deviation of unit weight above which a similarity is not sufficient."""
_FIELD_FROM = 20
"""Least number of marks for a smooth field."""
_FAR_SQUARED, _MEDIAN_OF_TWO = 20.0, 1.386
"""Squared distance, in sigmas, beyond which a mark is rejected: 5e-5 of χ² with 2 degrees; its median."""
_MOST_REJECTED, _ROUNDS = 0.2, 10
"""Largest share of rejected marks, and number of rounds in which they are looked for."""


@dataclass(frozen=True, eq=False)
class Registration:
    """A photograph referred to PHOTO I.

    Parameters
    ----------
    system : Similarity or SmoothField
        Pixels of this photograph to pixels of PHOTO I.
    marks : int
        Number of marks that it was fitted to.
    sigma0 : float
        Standard deviation of unit weight of a similarity; far above one where the photographs differ by more.
    left_px : float
        Residuals of the marks, root mean square per axis; of a smooth field, those of the prediction of each
        mark from the others.
    displacement_px : float
        Largest displacement of a mark.
    p : float
        Probability of a difference from the identity at least as large when nothing has moved.
    moved : bool
        Whether the camera has moved: significantly at 0.001, and by more than 0.05 px.
    centre, length : ndarray (2,), float
        Pixels of PHOTO I to which the coordinates of a similarity's parameters (X0, Y0, a, b) are reduced.
    cofactor : ndarray (4, 4)
        Covariance of these parameters from the errors of the marks.
    by_camera : ndarray (4, u), optional
        Their derivatives by the coefficients of the camera, which predict the marks.
    rejected : tuple of str
        Marks that contradict the others and were not used.

    Examples
    --------
    >>> still = Registration(Similarity(), 25, 1.02, left_px=0.02, displacement_px=0.01, p=0.6, moved=False)
    >>> still.similar, still.apply(ImagePoints.with_sigma(["P"], [[100.0, 80.0]], 0.05)).xy.tolist()
    (True, [[100.0, 80.0]])
    """

    system: Similarity | SmoothField
    marks: int
    sigma0: float
    left_px: float
    displacement_px: float
    p: float
    moved: bool
    centre: Array = field(default_factory=lambda: np.zeros(2))
    length: float = 1.0
    cofactor: Array = field(default_factory=lambda: np.zeros((4, 4)))
    by_camera: Array | None = None
    rejected: tuple[str, ...] = ()

    @property
    def similar(self) -> bool:
        """Whether a similarity is sufficient; not after a large shift or a rotation of the camera."""
        return isinstance(self.system, Similarity)

    def apply(self, points: ImagePoints) -> ImagePoints:
        """Transform points of this photograph to PHOTO I; covariances contain the errors of its marks.

        The errors of the camera's coefficients move all photographs together; see `moves`.
        """
        found = self.carry(points)
        if isinstance(self.system, Similarity):
            by_parameters = self.by_parameters(found.xy)
            own = by_parameters @ self.cofactor @ np.swapaxes(by_parameters, 1, 2)
        else:
            _, sigma = self.system.leave_one_out()
            noise = self.system.noise * self.system.sigma[:, None]
            own = np.diag(np.maximum(sigma**2 - noise**2, 0.0).mean(axis=0))
        return ImagePoints(found.names, found.xy, found.cov + own)

    def carry(self, points: ImagePoints) -> ImagePoints:
        """Transform points of this photograph to PHOTO I, with their own errors alone."""
        if isinstance(self.system, Similarity):
            return carried(self.system, points)
        slope = self.system.jacobian(points.xy)
        cov = slope @ points.cov @ np.swapaxes(slope, 1, 2)
        return ImagePoints(points.names, self.system(points.xy), cov)

    def by_parameters(self, xy: Array) -> Array:
        """Derivatives (n, 2, 4) of pixels of PHOTO I by the parameters of a similarity."""
        local = (xy - self.centre) / self.length
        by_local = RationalPolynomial.similarity().derivatives(local).d_parameters
        return self.length * by_local

    def moves(self, xy: Array) -> Array | None:
        """Derivatives (n, 2, u) of pixels of PHOTO I by the coefficients of the camera; None where unknown.

        A similarity through the marks follows the camera's prediction of them: what is wrong with it moves
        the photograph as well, and largely cancels in the corrected coordinates.
        """
        if self.by_camera is None or not self.similar:
            return None
        return self.by_parameters(xy) @ self.by_camera


def register(points: ImagePoints, design: ReseauDesign, camera: CameraCorrection) -> Registration | Failure:
    """Refer a photograph to PHOTO I.

    Parameters
    ----------
    points : ImagePoints
        Marks of the reseau in the photograph, in pixels.
    design : ReseauDesign
        The reseau.
    camera : CameraCorrection
        Made from PHOTO I.

    Returns
    -------
    Registration or Failure
        A failure with fewer than four marks.

    Examples
    --------
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> from reseau.refine import correct_camera
    >>> reseau = regular_reseau(5, 4, 15.0, Mark(shape="disk", size=1.0))
    >>> seen = ImagePoints.with_sigma(reseau.ids, reseau.xy * [9.0, -9.0] + [800.0, 600.0], 0.01)
    >>> camera = correct_camera(seen, reseau, model=RationalPolynomial.affine()).required()
    >>> moved = register(ImagePoints(seen.names, seen.xy + [0.8, -0.5], seen.cov), reseau, camera)
    >>> moved.moved, round(moved.displacement_px, 2)
    (True, 0.94)
    """
    row_of = {name: i for i, name in enumerate(design.ids)}
    known = [name for name in points.names if name in row_of]
    expected = camera.to_pixels(camera.object_system(design.xy[[row_of[name] for name in known]]))
    usable = np.asarray(np.isfinite(expected).all(axis=1))
    marks, expected = points.select(known).select(usable), expected[usable]
    if len(marks) < 4:
        return Failure(
            f"{len(marks)} marks of reseau {design.name!r} were measured; four refer it to PHOTO I",
            Code.TOO_FEW_POINTS,
        )
    centre, length = expected.mean(axis=0), float(np.ptp(expected, axis=0).max())
    fit = _similarity(marks, expected, centre, length)
    if isinstance(fit, Failure):
        return fit
    kept = _consistent(marks, expected, centre, length, fit)
    rejected: tuple[str, ...] = ()
    if not kept.all():
        again = _similarity(marks.select(kept), expected[kept], centre, length)
        if isinstance(again, Adjustment) and again.sigma0 <= _UNLIKE:
            rejected = tuple(name for name, k in zip(marks.names, kept.tolist(), strict=True) if not k)
            fit, marks, expected = again, marks.select(kept), expected[kept]
    off = fit.values - [0.0, 0.0, 1.0, 0.0]
    by_camera = _by_camera(camera, marks, expected, length, fit.cofactor)
    cofactor = fit.cofactor + by_camera @ camera.cofactor @ by_camera.T
    statistic = float(off @ np.linalg.solve(cofactor, off)) / 4 / max(1.0, fit.sigma0**2)
    p = float(scipy.special.fdtrc(4, fit.redundancy, statistic))
    system: Similarity | SmoothField = _about(fit.values, centre, length)
    left = system(marks.xy) - expected
    if fit.sigma0 > _UNLIKE and len(marks) >= _FIELD_FROM:
        system = SmoothField.fit(marks.xy, expected)
        left, _ = system.leave_one_out()
    displacement = float(np.hypot(*(system(marks.xy) - marks.xy).T).max())
    moved = (fit.sigma0 > _UNLIKE or p < 0.001) and displacement > _LEAST_PX
    left_px = float(np.sqrt((left**2).mean()))
    return Registration(
        system,
        len(marks),
        float(fit.sigma0),
        left_px,
        displacement,
        p,
        moved,
        centre,
        length,
        fit.cofactor * max(1.0, fit.sigma0**2),
        by_camera,
        rejected,
    )


def _similarity(marks: ImagePoints, expected: Array, centre: Array, length: float) -> Adjustment | Failure:
    """Adjust a similarity of coordinates reduced to a centre and a length."""
    local = ImagePoints(marks.names, (marks.xy - centre) / length, marks.cov / length**2)
    return fit_mapping(RationalPolynomial.similarity(), local, (expected - centre) / length)


def _consistent(marks: ImagePoints, expected: Array, centre: Array, length: float, fit: Adjustment) -> Mask:
    """Marks (n,) that agree with a similarity; those beside an echo or a reflection may not.

    Residuals are compared with the sigmas of the marks, or with the scatter of most of them if that is
    larger. With more than a fifth of them rejected, the photograph has another shape and none is.
    """
    weights, kept = np.linalg.inv(marks.cov), np.ones(len(marks), dtype=bool)
    for _ in range(_ROUNDS):
        off = _about(fit.values, centre, length)(marks.xy) - expected
        squared = np.einsum("ni,nij,nj->n", off, weights, off)
        scale = max(1.0, float(np.median(squared)) / _MEDIAN_OF_TWO)
        now = squared <= _FAR_SQUARED * scale
        if now.mean() < 1 - _MOST_REJECTED or now.sum() < 4:
            return np.ones(len(marks), dtype=bool)
        if (now == kept).all():
            break
        kept = now
        again = _similarity(marks.select(kept), expected[kept], centre, length)
        if not isinstance(again, Adjustment):
            return np.ones(len(marks), dtype=bool)
        fit = again
    return kept


def _by_camera(
    camera: CameraCorrection, marks: ImagePoints, expected: Array, length: float, cofactor: Array
) -> Array:
    """Derivatives of the parameters of the similarity by the camera's coefficients, (4, u).

    Errors of the coefficients move the expected positions together, by −(∂X/∂x)⁻¹ ∂X/∂a.
    """
    photo, by_pixel, _ = camera.photo_system.derivatives(expected)
    _, by_photo, by_a = camera.model.derivatives(photo)
    moves = -np.linalg.solve(by_photo @ by_pixel, by_a) / length
    local = (expected - expected.mean(axis=0)) / length
    by_parameter = RationalPolynomial.similarity().derivatives(local).d_parameters
    weights = np.linalg.inv(marks.cov / length**2)
    found: Array = cofactor @ np.einsum("nip,nij,nja->pa", by_parameter, weights, moves)
    return found


def _about(values: Array, centre: Array, length: float) -> Similarity:
    """Convert a similarity of coordinates reduced to a centre and a length to one of pixels."""
    x0, y0, a, b = values
    shift = centre + length * np.array([x0, y0]) - np.array([[a, -b], [b, a]]) @ centre
    return Similarity(np.array([*shift, a, b]))
