"""Targets on a space frame on the turntable, photographed by a lens of known design, blurred at the rims.

Their images are formed by rays through the lens and, under water, through the port (:mod:`reseau.optics`):
of the port its distance, thickness, tilt and dispersion, but not the bend and wedge of its surfaces.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from reseau.core.data import Array
from reseau.core.failure import Failure
from reseau.designs import space_frame
from reseau.io import LensDocument, LensSensor
from reseau.io.refraction import RefractionEntry
from reseau.io.targets import SpaceTargets
from reseau.optics import Pose
from reseau.optics.formation import PixelResponse
from reseau.optics.lenses import AIR, Paraxial, Prescription, PupilElements, glass, in_order
from reseau.optics.lenses.images import PlaneTarget, ray_images
from reseau.optics.lenses.ray_maps import LensCamera, SensorPlane
from reseau.optics.lenses.windows import behind_windows
from reseau.optics.poses import matrix_to_vector

from .water import Water

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
                formed = image.formed(image.point, psf_px, x, y, response)
                share[np.ix_(y.astype(int), x.astype(int))] += formed
        # Where images overlap, targets hide each other.
        return np.minimum(share, 1.0)


PROJECT_POSES: Mapping[str, Mapping[str, float]] = {
    "left": {"tilt": 30.0, "roll": 0.0, "camera_roll": 0.0},
    "right": {"tilt": 30.0, "roll": 180.0, "camera_roll": 180.0},
    "below": {"tilt": 35.0, "roll": 90.0, "camera_roll": 0.0},
}
"""Positions of the table for a project of three images."""
_CONTROL, _PROJECT_SIGMA_PX = 8, 0.3


def project(frame: SpaceFrame, poses: Mapping[str, Pose], water: Water | None) -> str:
    """Return a network as it is known before its photographs are taken, ``reseau-network/1``.

    Poses are known to some millimetres, image coordinates to the pixel, and the coordinates of eight targets.

    Parameters
    ----------
    frame : SpaceFrame
        The targets.
    poses : mapping of str to Pose
        True pose of each image, by its name.
    water : Water, optional
        Port and water as designed, not as made.
    """
    rng = np.random.default_rng(3)
    names, targets = tuple(poses), frame.targets.targets.id
    places, known = frame.xyz, np.arange(len(targets)) < _CONTROL
    turns, centres, image_of, point_of, xy = [], [], [], [], []
    for i, pose in enumerate(poses.values()):
        turns.append(matrix_to_vector(pose.matrix) + rng.normal(0, 2e-3, 3))
        centres.append(pose.x0 + rng.normal(0, 3.0, 3))
        seen = frame.seen_by(water).corresponding(pose(places))
        inside = ((seen > 20) & (seen < np.array(SIZE) - 21)).all(axis=1)
        xy.append(np.rint(seen[inside]))
        image_of.append(np.full(int(inside.sum()), i))
        point_of.append(np.flatnonzero(inside))
    near = frame.lens.corresponding(np.array([[0.0, 0.0, 1e5], [1e3, 0.0, 1e5]]))
    c = float(near[1, 0] - near[0, 0]) * PITCH_MM * 100.0
    n = sum(map(len, xy))
    document: dict[str, Any] = {
        "schema": "reseau-network/1",
        "unit": "mm",
        "cameras": [{
            "id": "camera", "width": SIZE[0], "height": SIZE[1], "pitch_mm": [PITCH_MM, PITCH_MM],
            "model": "brown", "side": "object", "parameters": {"c": c}, "free": ["c", "K1", "K2"],
        }],
        "images": {
            "id": names, "camera": len(names) * ["camera"], "X0": [each.tolist() for each in centres],
            "rotation": [each.tolist() for each in turns],
        },
        "points": {
            "id": targets,
            "xyz": [each.tolist() if k else None for each, k in zip(places, known, strict=True)],
            "sigma": [[0.0, 0.0, 0.0] if k else None for k in known],
            "role": ["control" if k else "tie" for k in known],
        },
        "observations": {
            "image": [names[i] for i in np.concatenate(image_of)],
            "point": [targets[k] for k in np.concatenate(point_of)],
            "x": np.concatenate(xy)[:, 0].tolist(), "y": np.concatenate(xy)[:, 1].tolist(),
            "sx": n * [_PROJECT_SIGMA_PX], "sy": n * [_PROJECT_SIGMA_PX],
        },
        "datum": "control",
    }  # fmt: skip
    if water is not None:
        x, y = np.tan(np.deg2rad(water.tilt_deg))
        document["refraction"] = {
            "media": {
                "air": 1.0,
                "glass": {"medium": "N-BK7", "wavelength_nm": 546.1},
                "water": {
                    "medium": {"water": {"temperature_c": water.temperature_c}}, "wavelength_nm": 546.1
                },
            },
            "windows": [{
                "id": "port", "shape": "plane", "on": "camera", "media": ["air", "glass", "water"],
                "parameters": {
                    "tilt_X": y, "tilt_Y": -x, "distance": water.distance_mm, "thickness": water.thickness_mm
                },
                "free": ["tilt_X", "tilt_Y", "distance"],
                "sigma": {"tilt_X": 0.005, "tilt_Y": 0.005, "distance": 0.5},
            }],
        }  # fmt: skip
    return json.dumps(document, indent=1)
