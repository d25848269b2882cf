"""A camera calibrated from photographs of a target: measured, oriented, adjusted.

The target is not taken at its word: the coordinates of its design are approximate, all points are unknowns,
and the network has inner constraints over them (a free network). Size and place of object space are those of
the design in the mean of its points; its unevenness comes out as heights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import cv2
import numpy as np

from ..adjust import Failure
from ..bundle import Camera, Network, Options, Result, adjust_network
from ..data import Array, Frame, ImagePoints
from ..errors import UsageError
from ..formats import ReseauDesign, TestfieldDesign
from ..formats.network import CAMERA_PARAMETERS
from ..refine import TestfieldOptions, measure_reseau, measure_testfield
from ..refine.measured import Measured

__all__ = [
    "Calibrated",
    "CameraModel",
    "Measurer",
    "calibrate_camera",
    "first_camera",
    "measurer_of",
    "network_of",
]

Measurer = Callable[[Frame], Measured | Failure]
"""What measures a target in a frame; all that this procedure knows of how that is done."""
_LEAST_POINTS = 8
_LEAST_IMAGES = 3


class PlaneDesign(Protocol):
    """A plane target: the names of its points, and where they are."""

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the points (p)."""

    @property
    def xy(self) -> Array:
        """Coordinates (p, 2), x right and y up."""


@dataclass(frozen=True)
class CameraModel:
    """What is to be estimated of a camera.

    Parameters
    ----------
    model : {"brown", "opencv"}
        See :class:`reseau.bundle.Camera`.
    free : tuple of str
        Parameters; by default principal distance and point, two or three radial terms, tangential ones, and
        for OpenCV both focal lengths.
    pitch_mm : (float, float), optional
        Size of a pixel; needed for `brown`.
    side : {"image", "object"}
        Whose coordinates Brown's distortion is a function of.
    """

    model: Literal["brown", "opencv"] = "opencv"
    free: tuple[str, ...] = ()
    pitch_mm: tuple[float, float] | None = None
    side: Literal["image", "object"] = "object"

    def __post_init__(self) -> None:
        if self.model == "brown" and self.pitch_mm is None:
            raise UsageError("needs the size of a pixel", where="brown")
        unknown = [name for name in self.free if name not in CAMERA_PARAMETERS[self.model]]
        if unknown:
            names = ", ".join(CAMERA_PARAMETERS[self.model])
            raise UsageError(f"is none of {names}", where=unknown[0])

    @property
    def chosen(self) -> tuple[str, ...]:
        """Parameters to be estimated."""
        usual = {
            "brown": ("c", "x0", "y0", "K1", "K2", "P1", "P2"),
            "opencv": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
        }
        return self.free or usual[self.model]


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A calibration with what it was made of; truthy.

    Parameters
    ----------
    result : Result
        Of the adjustment; its network has one camera, `camera`.
    measured : dict
        What was measured, by image.
    declined : dict
        Why images do not take part.
    """

    result: Result
    measured: dict[str, ImagePoints]
    declined: dict[str, str]

    def __bool__(self) -> bool:
        return True


def measurer_of(
    design: TestfieldDesign | ReseauDesign, testfield: TestfieldOptions | None = None
) -> Measurer:
    """What measures a design in a frame.

    Parameters
    ----------
    design : TestfieldDesign or ReseauDesign
        A coded testfield, or any design of marks.
    testfield : TestfieldOptions, optional
        How a testfield is measured.
    """
    if isinstance(design, TestfieldDesign):
        field = design
        return lambda frame: measure_testfield(frame, field, testfield)
    marks = design
    return lambda frame: measure_reseau(frame, marks)


def calibrate_camera(
    frames: Iterable[Frame | tuple[str, ImagePoints]],
    design: PlaneDesign,
    measure: Measurer,
    size: tuple[int, int] | None = None,
    model: CameraModel | None = None,
    options: Options | None = None,
    sigma_px: float | None = None,
) -> Calibrated | Failure:
    """Calibrate a camera from photographs of a target.

    Parameters
    ----------
    frames : iterable of Frame, or of (name, ImagePoints)
        The photographs, all of one size; or what was measured in them before.
    design : PlaneDesign
        The target.
    measure : callable
        What measures it in a frame; see :func:`measurer_of`.
    size : (int, int), optional
        Width and height in pixels, where no frame tells.
    model : CameraModel, optional
        What is to be estimated.
    options : Options, optional
        How to adjust.
    sigma_px : float, optional
        Standard deviation of all image coordinates, where those of the measurement are not what they scatter
        by: a target that is not what it was designed, a lens that the model does not follow.

    Returns
    -------
    Calibrated or Failure
        A failure where fewer than three images show the target, or the adjustment fails.

    Raises
    ------
    UsageError
        When two photographs have one name or differ in size, or no size is known.
    """
    measured, declined, size = _measured(frames, measure, size)
    if len(measured) < _LEAST_IMAGES:
        why = "".join(f"; {name}: {reason}" for name, reason in declined.items())
        return Failure(f"{len(measured)} images show the target, {_LEAST_IMAGES} are needed{why}")
    if size is None:
        raise UsageError("is not known without an image", where="size of the images")
    camera = first_camera(measured, design, size, model or CameraModel())
    network = network_of(measured, design, camera)
    if sigma_px is not None:
        network = replace(network, cov=np.tile(np.eye(2) * sigma_px**2, (len(network.xy), 1, 1)))
    result = adjust_network(network, options)
    return result if isinstance(result, Failure) else Calibrated(result, measured, declined)


def _measured(
    frames: Iterable[Frame | tuple[str, ImagePoints]], measure: Measurer, size: tuple[int, int] | None
) -> tuple[dict[str, ImagePoints], dict[str, str], tuple[int, int] | None]:
    """What is measured in each photograph, why others do not take part, and the size of all."""
    measured: dict[str, ImagePoints] = {}
    declined: dict[str, str] = {}
    for frame in frames:
        name = frame.name if isinstance(frame, Frame) else frame[0]
        if name in measured or name in declined:
            raise UsageError("is the name of two photographs", where=name)
        if isinstance(frame, Frame):
            if size is not None and size != (frame.width, frame.height):
                raise UsageError(f"is not {size[0]}×{size[1]} pixels like the others", where=name)
            size = (frame.width, frame.height)
            found = measure(frame)
            points = None if isinstance(found, Failure) else found.points
            if isinstance(found, Failure):
                declined[name] = found.reason.removeprefix(f"{name}: ")
        else:
            points = frame[1]
        if points is not None and len(points) < _LEAST_POINTS:
            declined[name] = f"{len(points)} points are too few"
        elif points is not None:
            measured[name] = points
    return measured, declined, size


def network_of(
    measured: Mapping[str, ImagePoints],
    design: PlaneDesign,
    camera: Camera,
    groups: Sequence[str] | None = None,
) -> Network:
    """The network of images of a plane target, all its points unknown, with inner constraints over them.

    Parameters
    ----------
    measured : mapping of str to ImagePoints
        Measured points of each image, named as in the design.
    design : PlaneDesign
        Approximate coordinates; heights are zero.
    camera : Camera
        Of all images.
    groups : sequence of str, optional
        Group of each image.
    """
    seen = sorted({name for points in measured.values() for name in points.names})
    known = {name: k for k, name in enumerate(design.ids)}
    names = tuple(sorted((name for name in seen if name in known), key=known.__getitem__))
    row = {name: k for k, name in enumerate(names)}
    at = [[k for k, name in enumerate(points.names) if name in row] for points in measured.values()]
    parts = list(zip(measured.values(), at, strict=True))
    xyz = np.zeros((len(names), 3))
    xyz[:, :2] = design.xy[[known[name] for name in names]]
    m, p = len(measured), len(names)
    return Network(
        cameras=(camera,),
        images=tuple(measured),
        camera_of=np.zeros(m, dtype=np.intp),
        x0=np.full((m, 3), np.nan),
        rotation=np.full((m, 3), np.nan),
        points=names,
        xyz=xyz,
        sigma=np.full((p, 3), np.nan),
        role=("tie",) * p,
        image_of=np.repeat(np.arange(m), [len(rows) for rows in at]).astype(np.intp),
        point_of=np.array([row[points.names[k]] for points, rows in parts for k in rows], dtype=np.intp),
        xy=np.concatenate([points.xy[rows] for points, rows in parts]),
        cov=np.concatenate([points.cov[rows] for points, rows in parts]),
        distance_of=np.zeros((0, 2), dtype=np.intp),
        distance=np.zeros((0, 2)),
        datum="free",
        datum_points=np.ones(p, dtype=bool),
        groups=(None,) * m if groups is None else tuple(groups),
        files=tuple(measured),
        unit="mm",
    )


def first_camera(
    measured: Mapping[str, ImagePoints], design: PlaneDesign, size: tuple[int, int], model: CameraModel
) -> Camera:
    """A camera to begin with: the principal distance from the projectivities of the images (Zhang 2000)."""
    known = dict(zip(design.ids, design.xy, strict=True))
    object_points, image_points = [], []
    for points in measured.values():
        rows = [k for k, name in enumerate(points.names) if name in known]
        plane = np.array([known[points.names[k]] for k in rows]).reshape(-1, 2)
        object_points.append(np.column_stack([plane, np.zeros(len(rows))]).astype(np.float32))
        image_points.append(points.xy[rows].astype(np.float32))
    matrix = cv2.initCameraMatrix2D(object_points, image_points, size, 1.0)
    f = float(matrix[0, 0])
    if not np.isfinite(f) or not 0.2 * max(size) < f < 100 * max(size):
        f = 1.2 * max(size)
    values = np.zeros(len(CAMERA_PARAMETERS[model.model]))
    if model.model == "opencv":
        values[:4] = f, f, (size[0] - 1) / 2, (size[1] - 1) / 2
    else:
        assert model.pitch_mm is not None
        values[0] = f * model.pitch_mm[0]
    camera = Camera("camera", *size, model.pitch_mm or (1.0, 1.0), model.model, values, model.chosen)
    return replace(camera, side=model.side)
