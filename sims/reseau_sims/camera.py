"""A non-metric film camera: its pose, its lens, its film, and the scan of the film."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from reseau.core.data import Array
from reseau.optics import (
    Brown,
    PixelGrid,
    Pose,
    RationalPolynomial,
    Sensor,
    matrix_to_vector,
    rotation_matrix,
)
from reseau.optics.composition import Chain, Inverted
from reseau.optics.formation import PixelResponse
from reseau.optics.mapping import PlaneMapping

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
    """Deformation of a film: maps a point on the deformed film (mm) to its position before the deformation.

    Parameters
    ----------
    **deformation : float
        `ax`, `ay` stretch the axes (their difference is the affinity), `bx` shears them, `d1`, `d2` (mm⁻¹) on
        xy, `h1`, `h2` (mm⁻³) on x⁴ and y⁴ as Wishahy found on Polaroid film, eq. (4, 5).

    Examples
    --------
    >>> film(ax=-2e-3)(np.array([[10.0, 5.0]]))
    array([[9.98, 5.  ]])
    """
    return RationalPolynomial(_FILM, fixed={"X": "x", "Y": "y"}).with_values(deformation)


@dataclass(frozen=True)
class FilmCamera:
    """A camera that photographs a plane on film, and the scan of that film.

    Parameters
    ----------
    pose : Pose
        Pose of the camera in the system of the plane (mm, z towards the camera).
    lens : Brown
        From ideal directions to photo-coordinates (mm).
    film : RationalPolynomial
        From the deformed film to photo-coordinates; see :func:`film`.
    scan : PixelGrid
        Pixels on the film.
    sensor : Sensor
        Sensor of the scanner.
    psf_px : float
        Width (one sigma) of the point-spread function of lens, film and scan.
    response : PixelResponse
        Response of the scan's pixels.

    Examples
    --------
    >>> from reseau_sims import World
    >>> camera = World.standard(seed=7).camera
    >>> camera.shape, camera.view(np.zeros((1, 2))).round(0)[0].shape
    ((1200, 1600), (2,))
    """

    pose: Pose
    lens: Brown
    film: RationalPolynomial
    scan: PixelGrid
    sensor: Sensor
    psf_px: float = 0.9
    response: PixelResponse = field(default_factory=PixelResponse)

    def moved(self, shift: Array, turn: float) -> FilmCamera:
        """The camera after a displacement.

        Parameters
        ----------
        shift : ndarray (3,)
            Displacement of the projection centre (mm).
        turn : float
            Rotation about the axis of the camera (rad).
        """
        matrix = rotation_matrix(np.array([0.0, 0.0, turn])) @ self.pose.matrix
        return replace(self, pose=Pose(matrix_to_vector(matrix), self.pose.x0 + shift))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of a frame."""
        return self.sensor.height, self.sensor.width

    @cached_property
    def view(self) -> PlaneMapping:
        """True mapping from the plane z = 0 (mm) to the pixels of a frame."""
        return self.view_at(0.0)

    def view_at(self, z: float) -> PlaneMapping:
        """True mapping from the plane at a height z (mm, towards the camera) to the pixels of a frame.

        Points behind the reseau, z < 0, are imaged nearer to the point below the camera: the parallax.
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
