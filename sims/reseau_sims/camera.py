"""A non-metric camera: where it stands, its lens, its film, and the device that scans the film."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from reseau.core.data import Array
from reseau.optics import (
    Brown,
    Chain,
    Inverted,
    PixelGrid,
    PlaneMapping,
    Pose,
    RationalPolynomial,
    Sensor,
    matrix_to_vector,
    rotation_matrix,
)
from reseau.optics.formation import PixelResponse

__all__ = ["Camera", "film"]

_FILM = {
    "ax": {"X": "x"},
    "ay": {"Y": "y"},
    "bx": {"X": "y"},
    "d1": {"X": "xy"},
    "d2": {"Y": "xy"},
    "h1": {"X": "x4"},
    "h2": {"Y": "y4"},
}


def film(**deformation: float) -> RationalPolynomial:
    """Deformation of a film: from where a point lies on the deformed film (mm) to where light had put it.

    Parameters
    ----------
    **deformation : float
        `ax`, `ay` stretch the axes (their difference is the affinity), `bx` shears them, `d1`, `d2` (mm⁻¹) on
        xy, `h1`, `h2` (mm⁻³) on x⁴ and y⁴ as Wishahy found on Polaroid film, eq. (4, 5).
    """
    return RationalPolynomial(_FILM, fixed={"X": "x", "Y": "y"}).with_values(deformation)


@dataclass(frozen=True)
class Camera:
    """A camera that photographs a plane, and what becomes of its film.

    Parameters
    ----------
    pose : Pose
        Of the camera in the system of the plane (mm, z towards the camera).
    lens : Brown
        From ideal directions to photo-coordinates (mm).
    film : RationalPolynomial
        From the deformed film to photo-coordinates; see :func:`film`.
    scan : PixelGrid
        Pixels on the film.
    sensor : Sensor
        What scans it.
    psf_px : float
        Width (one sigma) of the point-spread function of lens, film and scan.
    response : PixelResponse
        Of the scan's pixels.
    """

    pose: Pose
    lens: Brown
    film: RationalPolynomial
    scan: PixelGrid
    sensor: Sensor
    psf_px: float = 0.9
    response: PixelResponse = field(default_factory=PixelResponse)

    def moved(self, shift: Array, turn: float) -> Camera:
        """The camera after someone has pushed it.

        Parameters
        ----------
        shift : ndarray (3,)
            Of the projection centre (mm).
        turn : float
            About the axis of the camera (rad).
        """
        matrix = rotation_matrix(np.array([0.0, 0.0, turn])) @ self.pose.matrix
        return replace(self, pose=Pose(matrix_to_vector(matrix), self.pose.x0 + shift))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of a frame."""
        return self.sensor.height, self.sensor.width

    @cached_property
    def view(self) -> PlaneMapping:
        """From the plane z = 0 (mm) to the pixels of a frame: the truth about this camera."""
        return self.view_at(0.0)

    def view_at(self, z: float) -> PlaneMapping:
        """From the plane at a height z (mm, towards the camera) to the pixels of a frame.

        What lies behind the reseau, z < 0, is seen nearer to the point under the camera: the parallax.
        """
        (px, py), (cx, cy) = self.scan.pixels_per_mm, self.scan.centre
        scan = RationalPolynomial.affine().with_values([px, 0.0, cx, 0.0, py, cy])
        photo = Chain(_perspective(self.pose, z), self.lens, ("pose.", "lens."))
        deformed = Chain(photo, Inverted(self.film), ("", "film."))
        return Chain(deformed, scan, ("", "scan."))


def _perspective(pose: Pose, z: float) -> RationalPolynomial:
    """From points of a plane of height z to their ideal directions; the collinearity equations of a plane."""
    matrix = pose.matrix
    down = np.array([0.0, 0.0, z]) - pose.x0
    homography: Array = np.stack([matrix[:, 0], matrix[:, 1], matrix @ down], axis=1)
    homography = homography / homography[2, 2]
    (a1, b1, c1), (a2, b2, c2), (a0, b0, _) = homography.tolist()
    return RationalPolynomial.projective().with_values([a1, b1, c1, a2, b2, c2, a0, b0])
