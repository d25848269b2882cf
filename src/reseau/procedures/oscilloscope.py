"""The oscilloscope procedure (Wishahy): images refined by successive elimination of each factor.

Two groups of factors are told apart by two photographs: PHOTO I shows the reseau alone, so that all its
distortion is that of the camera and the film (group A). The steps carry the paper's numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from ..adjust import Failure
from ..data import Frame, ImagePoints
from ..formats import ReseauDesign
from ..optics import RationalPolynomial
from ..refine import CameraCorrection, ReseauOptions, ReseauResult, correct_camera, measure_reseau

__all__ = ["PhotoI", "photo_i"]


@dataclass(frozen=True, eq=False)
class PhotoI:
    """PHOTO I refined.

    Parameters
    ----------
    points : ImagePoints
        The reseau's marks in pixels.
    camera : CameraCorrection
        Group A.
    measured : ReseauResult, optional
        How the marks were measured; None where they came from elsewhere.
    """

    points: ImagePoints
    camera: CameraCorrection
    measured: ReseauResult | None


def photo_i(
    photo: Frame | ImagePoints,
    reseau: ReseauDesign,
    *,
    options: ReseauOptions | None = None,
    model: RationalPolynomial | None = None,
    alpha: float = 0.05,
    criterion: Literal["t", "chi2", "F"] = "chi2",
    check: Iterable[str] = (),
) -> PhotoI | Failure:
    """Correct the camera's distortions by PHOTO I, steps (i) to (iii).

    Parameters
    ----------
    photo : Frame or ImagePoints
        The photograph of the reseau, or its marks measured elsewhere, in pixels.
    reseau : ReseauDesign
        The reseau.
    options : ReseauOptions, optional
        How the marks are measured.
    model, alpha, criterion, check
        As in :func:`reseau.refine.correct_camera`; by default equations (5a, b) with χ² tests at 0.05.

    Returns
    -------
    PhotoI or Failure
        A failure when the reseau is not found in the photograph, or has too few marks in it.
    """
    # (i) object and photo-coordinates of the reseau
    measured = None
    if isinstance(photo, Frame):
        found = measure_reseau(photo, reseau, options)
        if isinstance(found, Failure):
            return found
        measured, points = found, found.points
    else:
        points = photo
    # (ii) both into the common system of O and S, (iii) equations (5a, b)
    camera = correct_camera(points, reseau, model=model, alpha=alpha, criterion=criterion, check=check)
    if isinstance(camera, Failure):
        return camera
    return PhotoI(points, camera, measured)
