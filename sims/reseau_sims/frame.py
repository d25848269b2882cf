"""Targets on a space frame on the turntable, photographed by a lens of known design, blurred at the rims.

Their images are formed by rays through the lens and, under water, through the port (:mod:`reseau.optics`):
of the port its distance, thickness, tilt and dispersion, but not the bend and wedge of its surfaces.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass, field, replace

import numpy as np

from reseau.core.data import Array
from reseau.core.failure import Failure
from reseau.designs import space_frame
from reseau.io import LensDocument, LensSensor
from reseau.io.refraction import RefractionEntry
from reseau.io.targets import SpaceTargets
from reseau.optics import Pose
from reseau.optics.formation import PixelResponse
from reseau.optics.lenses import (
    AIR,
    LensCamera,
    Paraxial,
    PlaneTarget,
    Prescription,
    PupilElements,
    SensorPlane,
    behind_windows,
    glass,
    in_order,
    ray_images,
)

from .water import Water

__all__ = ["SpaceFrame"]

SIZE, PITCH_MM, DISTANCE_MM = (640, 480), 0.02, 1000.0
_ROWS = ((0.056, 2.5, "N-BK7"), (-0.04, 0.75, "SF2"), (-0.012, 1.5, ""))
"""Curvature (1/mm), distance to the next surface (mm) and glass of an achromat; its stop lies behind it."""
_STOP_MM, _FOCUS_MM = 2.5, 500.0
_COLOURS = (546.1, 480.0)
_BUILT_MM = 0.3
"""Standard deviation of the places of targets about their design."""
_SPACING_MM = 0.15


def _lens() -> LensCamera:
    """The lens, sharp at a distance that is nearer than the frame."""

    def rows(behind: float) -> Prescription:
        glasses = [(c, d, glass(name) if name else AIR) for c, d, name in _ROWS]
        return Prescription(
            in_order([*glasses, (0.0, behind, AIR)]), stop=3, stop_radius=_STOP_MM, wavelengths_nm=_COLOURS,
            name="achromat",
        )  # fmt: skip

    behind = Paraxial(rows(20.0)).image_distance(_FOCUS_MM) - _ROWS[-1][1]
    principal = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    return LensCamera(rows(behind), SensorPlane((PITCH_MM, PITCH_MM), principal))


@dataclass(frozen=True, eq=False)
class SpaceFrame:
    """A frame of targets as built, and the lens that photographs it.

    Parameters
    ----------
    seed : int
        Of the deviations of the targets from their design.
    targets : SpaceTargets
        The design.
    lens : LensCamera
        Lens and sensor.
    rings : int
        Rings of elements of the stop.

    Examples
    --------
    >>> from reseau.optics.formation import PixelResponse
    >>> pose = Pose.from_angles(0.0, 0.0, 0.0, [0.0, 0.0, 1000.0])
    >>> share = SpaceFrame().share(pose, None, (480, 640), 0.5, PixelResponse())
    >>> share.shape, bool(0.1 < share.max() < 1.01)
    ((480, 640), True)
    """

    seed: int = 0
    targets: SpaceTargets = field(default_factory=lambda: space_frame((250.0, 180.0, 80.0), 28, 8.0))
    lens: LensCamera = field(default_factory=_lens)
    rings: int = 6

    @property
    def xyz(self) -> Array:
        """True coordinates (n, 3), mm."""
        nominal = np.array(self.targets.targets.xyz)
        off = np.random.default_rng((1992, self.seed)).normal(0.0, _BUILT_MM, nominal.shape)
        return np.asarray(nominal + off)

    @property
    def documents(self) -> dict[str, str]:
        """What a user knows: the design of the targets, and the lens with its sensor."""
        sensor = LensSensor(pitch_um=(1e3 * PITCH_MM, 1e3 * PITCH_MM), size_px=SIZE)
        return {
            "targets.json": self.targets.to_json(),
            "lens.toml": LensDocument.of(self.lens.lens, sensor).to_toml(),
        }

    def seen_by(self, water: Water | None) -> LensCamera:
        """Return the lens, behind the port where there is water."""
        if water is None:
            return self.lens
        described = tomllib.loads(water.toml())["instruments"]["camera"]["refraction"]
        entry = RefractionEntry.model_validate_json(json.dumps(described))
        given = entry.refraction(("image",), ("camera",))
        dispersions = {
            "glass": lambda colour: water.indices(colour)[0],
            "water": lambda colour: water.indices(colour)[1],
        }
        media = tuple(
            replace(medium, dispersion=dispersions.get(medium.name), free=False, sigma=None)
            for medium in given.media
        )
        return behind_windows(self.lens, replace(given, media=media), 0, np.eye(3), np.zeros(3))

    def share(
        self, pose: Pose, water: Water | None, shape: tuple[int, int], psf_px: float, response: PixelResponse
    ) -> Array:
        """Share (rows, columns) of each pixel's light that the targets take.

        Parameters
        ----------
        pose : Pose
            Of the camera in the system of the frame.
        water : Water, optional
            Port and water before the camera.
        shape : (int, int)
            Rows and columns of the image.
        psf_px : float
            Width (one sigma) of what blurs beside the rays.
        response : PixelResponse
            Of the pixels.
        """
        turn, places = pose.matrix, self.xyz
        outlines = [self.targets.outline(k, _SPACING_MM) for k in range(len(places))]
        planes = [
            PlaneTarget(turn @ (place - pose.x0), turn @ self.targets.axes(k), outlines[k])
            for k, place in enumerate(places)
        ]
        share, (rows, columns) = np.zeros(shape), shape
        for image in ray_images(self.seen_by(water), planes, PupilElements.gauss(self.rings)):
            if isinstance(image, Failure):
                continue
            reach = int(np.ceil(np.abs(image.outline.xy).max() + 6 * psf_px + 2))
            x, y = (np.rint(at) + np.arange(-reach, reach + 1.0) for at in image.point)
            x, y = x[(x >= 0) & (x < columns)], y[(y >= 0) & (y < rows)]
            if len(x) and len(y):
                formed = image.gridded.image(image.point, psf_px, x, y, response)
                share[np.ix_(y.astype(int), x.astype(int))] += formed
        # Where images overlap, targets hide each other.
        return np.minimum(share, 1.0)
