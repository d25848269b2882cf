"""Images resampled by a calibration: the raster of the result, and the file, band by band."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array
from ..core.errors import ImageError, InputError, UsageError
from ..io.images import MAX_PIXELS, write_image
from ..io.scans import Scan
from ..optics.resampling import resample
from .camera import CameraMapping
from .document import Calibration, CameraModel, Covariance, Quantity
from .fiducials import FiducialMapping
from .film import FilmFrameMapping
from .group_a import CameraCorrection
from .mapping import BEYOND, CalibratedMapping

_BAND = 256
_ROUNDING = 1e-6
"""Share of a pixel by which an extent may be smaller than a whole number of pixels through rounding."""


@dataclass(frozen=True, eq=False)
class CorrectedImage:
    """The raster of an image that is resampled into the system of a calibration.

    Parameters
    ----------
    mapping : CalibratedMapping
        From pixels of the image to the system.
    origin : (float, float)
        Coordinates of the centre of the first pixel in the system.
    scale : (float, float)
        Pixels per unit of the system, along columns and rows.
    width, height : int
        Columns and rows.
    up : bool
        Whether y increases upwards in the image; rows then run against y.

    Examples
    --------
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5, "k1": -0.1})
    >>> camera = CameraMapping(lens, 640, 480, np.zeros(0, dtype=np.intp), np.zeros((0, 0)))
    >>> raster = CorrectedImage.undistorted(camera, "keep")
    >>> raster.to_source(np.array([[319.5, 239.5], [639.0, 479.0]])).round(2)
    array([[319.5 , 239.5 ],
           [631.04, 473.03]])
    """

    mapping: CalibratedMapping
    origin: tuple[float, float]
    scale: tuple[float, float]
    width: int
    height: int
    up: bool

    @classmethod
    def plan(
        cls,
        correction: CameraCorrection,
        size: tuple[int, int],
        scale: float | None = None,
    ) -> CorrectedImage:
        """The raster of a photograph in the common system, as far as the correction holds.

        Parameters
        ----------
        correction : CameraCorrection
            Group A.
        size : (int, int)
            Width and height of the photograph.
        scale : float, optional
            Pixels per unit; by default that of the photograph. If it is given, centres of pixels are at
            multiples of the unit over the scale: the rasters of two scans of one film are parts of one.

        Raises
        ------
        UsageError
            When the raster would be larger than images may be, or shows nothing of the photograph.
        """
        step = None if scale is None or not scale > 0 else 1 / scale
        scale = 1 / correction.photo_system.scale if scale is None else scale
        photo = correction.photo_system(_border(size))
        corrected = correction.model(photo)
        corrected = corrected[correction.model.one_to_one(photo)]
        low, high = np.array([[-np.inf] * 2, [np.inf] * 2])
        if len(corrected):
            low, high = corrected.min(axis=0), corrected.max(axis=0)
        if correction.extent is not None:
            marks = np.array(correction.extent, dtype=np.float64).reshape(2, 2)
            reach = BEYOND * (marks[1] - marks[0])
            low, high = np.maximum(low, marks[0] - reach), np.minimum(high, marks[1] + reach)
        if step is not None:
            low, high = np.ceil(low / step) * step, np.floor(high / step) * step
        up = correction.photo_system.mirrored
        return cls._over(correction, low, high, (scale, scale), up)

    @classmethod
    def undistorted(
        cls,
        camera: CameraMapping,
        fov: Literal["keep", "all"] | float = "keep",
        scale: float = 1.0,
        alpha: float | None = None,
    ) -> CorrectedImage:
        """The raster of an image without distortion, as a pinhole camera on the same axis sees it.

        Parameters
        ----------
        camera : CameraMapping
            The calibrated camera.
        fov : {"keep", "all"} or float
            Field of view. ``keep``: the size, principal point and scale on the axis stay. ``all``: every
            pixel of the image is shown. A number: horizontal field of view in degrees, about the axis; the
            image keeps its size.
        scale : float
            Pixels of the result per pixel of the image: on the axis, or for a field of view in degrees over
            the width.
        alpha : float, optional
            In place of `fov`, from 0, only pixels that the image has, to 1, every pixel of the image; the
            size stays, as with OpenCV's ``getOptimalNewCameraMatrix``.

        Raises
        ------
        UsageError
            When the raster would be larger than images may be, or the field of view is not possible.
        """
        if not scale > 0:
            raise UsageError(f"{scale:g} is not above zero", where="scale")
        axis = camera.mapping.derivatives(np.zeros((1, 2)))
        focal = np.abs(np.diagonal(axis.d_xy[0])) * scale
        if alpha is not None:
            return cls._between(camera, alpha, scale)
        if fov == "all":
            uv = camera.mapping.inverse(_border((camera.width, camera.height)))
            low, high = uv.min(axis=0), uv.max(axis=0)
            # A direction that is not finite is 90° or more off the axis, or beyond what the model describes.
            if not float(np.prod((high - low) * focal)) <= MAX_PIXELS:
                raise UsageError(
                    "`all` is more than a plane image can show of this lens", where="fov",
                    do="give an angle, such as 120",
                )  # fmt: skip
            return cls._over(camera, low, high, (focal[0], focal[1]), False)
        width, height = (max(2, round(n * scale)) for n in (camera.width, camera.height))
        if fov == "keep":
            centre = (axis.value[0] + 0.5) * scale - 0.5
        else:
            angle = float(fov)
            if not 1 <= angle <= 175:
                raise UsageError(f"{angle:g}° is not between 1° and 175°", where="fov")
            focal = focal * (width / 2 / np.tan(np.deg2rad(angle) / 2) / focal[0])
            centre = np.array([(width - 1) / 2, (height - 1) / 2])
        _affordable(width, height)
        x, y = (-centre / focal).tolist()
        return cls(camera, (x, y), (float(focal[0]), float(focal[1])), width, height, False)

    @classmethod
    def _between(cls, camera: CameraMapping, alpha: float, scale: float) -> CorrectedImage:
        """The raster between the largest rectangle inside the undistorted image and that around it."""
        if not 0 <= alpha <= 1:
            raise UsageError(f"{alpha:g} is not between 0 and 1", where="alpha")
        border = _border((camera.width, camera.height))
        uv = camera.mapping.inverse(border)
        if not np.isfinite(uv).all():
            raise UsageError("sees no direction at its border", where="camera", do="use `keep`")
        last = np.array([camera.width, camera.height]) - 1.0
        first_side, last_side = border == 0, border == last
        inner = np.array([[uv[first_side[:, k], k].max() for k in (0, 1)],
                          [uv[last_side[:, k], k].min() for k in (0, 1)]])  # fmt: skip
        outer = np.stack([uv.min(axis=0), uv.max(axis=0)])
        low, high = (1 - alpha) * inner + alpha * outer
        if not (high > low).all():
            raise UsageError("has no rectangle inside its undistorted image", where="camera", do="use `keep`")
        width, height = (max(2, round(n * scale)) for n in (camera.width, camera.height))
        _affordable(width, height)
        px = (np.array([width, height]) - 1) / (high - low)
        return cls(camera, (float(low[0]), float(low[1])), (float(px[0]), float(px[1])), width, height, False)

    @classmethod
    def of_frame(
        cls, frame: FilmFrameMapping | FiducialMapping, scale: float | None = None
    ) -> CorrectedImage:
        """The raster of a film frame, or of a photograph with fiducial marks, in photo-coordinates.

        Parameters
        ----------
        frame : FilmFrameMapping or FiducialMapping
            The orientation of the frame.
        scale : float, optional
            Pixels per millimetre; by default that of the scan.

        Raises
        ------
        UsageError
            When the raster would be larger than images may be.
        """
        scale = float(np.mean(frame.px_per_mm)) if scale is None else scale
        extent = np.array(frame.extent).reshape(2, 2)
        return cls._over(frame, extent[0], extent[1], (scale, scale), True)

    @classmethod
    def _over(
        cls, mapping: CalibratedMapping, low: Array, high: Array, scale: tuple[float, float], up: bool
    ) -> CorrectedImage:
        if not min(scale) > 0:
            raise UsageError(f"{min(scale):g} is not above zero", where="scale")
        counts = (high - low) * scale
        if not (np.isfinite(counts).all() and (counts >= 1).all()):
            raise UsageError("shows nothing of the region the calibration holds for", where="frame")
        width, height = (int(n + _ROUNDING) + 1 for n in counts)
        _affordable(width, height)
        origin = (float(low[0]), float(high[1] if up else low[1]))
        return cls(mapping, origin, (float(scale[0]), float(scale[1])), width, height, up)

    @property
    def bands(self) -> int:
        """Number of bands in which it is made."""
        return -(-self.height // _BAND)

    def to_source(self, xy: Array) -> Array:
        """Pixels of the image (n, 2) of pixels of the raster (n, 2)."""
        return self.mapping.to_pixels(self.to_system(xy))

    def to_system(self, xy: Array) -> Array:
        """Coordinates in the system of the calibration (n, 2) of pixels of the raster (n, 2)."""
        direction = np.array([1.0, -1.0 if self.up else 1.0])
        place: Array = np.array(self.origin) + xy * direction / self.scale
        return place

    def of_system(self, xy: Array) -> Array:
        """Pixels of the raster (n, 2) of coordinates in the system of the calibration (n, 2)."""
        pixels: Array = (xy - np.array(self.origin)) * self.slope
        return pixels

    @property
    def slope(self) -> Array:
        """Derivatives (2,) of the pixels of the raster by the coordinates, the diagonal."""
        return np.array(self.scale) * [1.0, -1.0 if self.up else 1.0]

    @property
    def pinhole(self) -> dict[str, float]:
        """Size, focal lengths and principal point (px) of the camera of an undistorted image."""
        fx, fy = self.scale
        cx, cy = -self.origin[0] * fx, -self.origin[1] * fy
        return {"width": self.width, "height": self.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}

    def to_dict(self) -> dict[str, Any]:
        """The raster as JSON-ready data."""
        return {
            "width": self.width,
            "height": self.height,
            "first_pixel": list(self.origin),
            "px_per_unit": self.scale[0],
            "unit": self.mapping.unit,
            "y": "up" if self.up else "down",
        }


def _border(size: tuple[int, int]) -> Array:
    """Pixels around the border of an image."""
    along = np.linspace(0, 1, 33)
    edge = np.concatenate([np.stack([along, 0 * along + k], 1) for k in (0, 1)])
    return np.concatenate([edge, edge[:, ::-1]]) * (np.array(size) - 1.0)


def _affordable(width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise UsageError(f"asks for {width}×{height} pixels", where="scale", do="choose a smaller one")


def undistorted_camera(
    raster: CorrectedImage, calibration: Calibration, provenance: dict[str, Any] | None = None
) -> Calibration:
    """The pinhole camera of an undistorted image, as a calibration.

    Its parameters are chosen, not estimated, and have no covariance; that of the distortion that was removed
    is in the calibration of the image.

    Parameters
    ----------
    raster : CorrectedImage
        By :meth:`CorrectedImage.undistorted`.
    calibration : Calibration
        The camera of the image.
    provenance : dict, optional
        Inputs and options.

    Examples
    --------
    >>> from reseau.optics import OpenCV
    >>> lens = {"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5, "k1": -0.1}
    >>> distorted = Calibration(
    ...     kind="camera", name="lens", sigma0=None, redundancy=0,
    ...     model={"model": "opencv", "width": 640, "height": 480, "pitch_mm": [1.0, 1.0]},
    ...     parameters={key: Quantity(value=value, sigma=0.0, unit="px") for key, value in lens.items()},
    ...     covariance=Covariance(names=(), matrix=()))
    >>> raster = CorrectedImage.undistorted(distorted.mapping(), "keep")
    >>> undistorted_camera(raster, distorted).values()
    {'fx': 800.0, 'fy': 800.0, 'cx': 319.5, 'cy': 239.5}
    """
    model: CameraModel = {
        "model": "opencv",
        "width": raster.width,
        "height": raster.height,
        "pitch_mm": [1.0, 1.0],
    }
    validity: dict[str, Any] = {"undistorted_from": calibration.name}
    mapping = cast(CameraMapping, raster.mapping)
    if mapping.extent is not None:
        left, top, right, bottom = mapping.extent
        along = np.linspace(0, 1, 33)[:, None]
        a, b, c, d = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        rim = np.concatenate([p + along * (q - p) for p, q in ((a, b), (b, c), (c, d), (d, a))])
        seen = raster.of_system(mapping.mapping.inverse(rim))
        seen = seen[np.isfinite(seen).all(axis=1)]
        if len(seen):
            last = np.array([raster.width, raster.height]) - 1.0
            low, high = np.clip(seen.min(axis=0), 0, last), np.clip(seen.max(axis=0), 0, last)
            validity |= {"extent": [*low.tolist(), *high.tolist()], "unit": "px"}
    values = {key: raster.pinhole[key] for key in ("fx", "fy", "cx", "cy")}
    return Calibration(
        kind="camera",
        name=f"{calibration.name}, undistorted",
        model=model,
        parameters={key: Quantity(value=float(v), sigma=0.0, unit="px") for key, v in values.items()},
        covariance=Covariance(names=(), matrix=()),
        sigma0=None,
        redundancy=0,
        validity=validity,
        # It is as accurate as that which it comes from; places and photographs are those of the other image.
        assessment=None
        if calibration.assessment is None
        else calibration.assessment.model_copy(update={"errors": None, "next_photograph": None}),
        provenance=provenance or {},
    )


class _Plane:
    """One channel of a scan, which is read window by window where it is sliced."""

    def __init__(self, scan: Scan, channel: int) -> None:
        self._scan, self._channel = scan, channel
        self.shape = (scan.height, scan.width)
        self.dtype = scan.window(0, 1, 0, 1).dtype

    def __getitem__(self, at: tuple[slice, slice]) -> NDArray[Any]:
        (top, bottom, _), (left, right, _) = (s.indices(n) for s, n in zip(at, self.shape, strict=True))
        return self._scan.window(top, bottom, left, right)[:, :, self._channel]


def planes_of(scan: Scan) -> tuple[NDArray[Any], ...]:
    """The channels of a scan as planes that :func:`write_corrected` reads window by window."""
    return tuple(cast(NDArray[Any], _Plane(scan, k)) for k in range(len(scan.channels)))


def write_corrected(
    path: Path,
    planes: Sequence[NDArray[Any]],
    raster: CorrectedImage,
    step: Callable[[], None] = lambda: None,
) -> None:
    """Resample an image into a file, which appears whole or not at all.

    A TIFF is written band by band; other formats are held in memory, in the type of the image.

    Parameters
    ----------
    path : Path
        File; its suffix gives the format.
    planes : sequence of ndarray (h, w)
        The image: one plane, or red, green and blue.
    raster : CorrectedImage
        The raster of the result.
    step : callable
        Called after each band.

    Raises
    ------
    ImageError
        When the format cannot hold the grey values.
    InputError
        When the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 80.0, "fy": 80.0, "cx": 31.5, "cy": 23.5, "k1": -0.1})
    >>> camera = CameraMapping(lens, 64, 48, np.zeros(0, dtype=np.intp), np.zeros((0, 0)))
    >>> image = np.full((48, 64), 100, np.uint8)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "undistorted.png"
    ...     write_corrected(path, [image], CorrectedImage.undistorted(camera))
    ...     path.stat().st_size > 0
    True
    """
    suffix, dtype = path.suffix.lower(), planes[0].dtype
    deepest = {".png": 2, ".jpg": 1, ".jpeg": 1}.get(suffix, 8)
    if deepest < 8 and (dtype.kind != "u" or dtype.itemsize > deepest):
        raise ImageError(f"cannot hold grey values of type {dtype}", where=path, do="use .tif")
    shape = (raster.height, raster.width)

    bands = _bands(planes, raster, step)
    if suffix in (".tif", ".tiff"):
        full = shape if len(planes) == 1 else (*shape, len(planes))
        _write_tiff(path, bands, raster, full, dtype)
    else:
        write_image(path, np.concatenate(list(bands)))


def _bands(
    planes: Sequence[NDArray[Any]], raster: CorrectedImage, step: Callable[[], None] = lambda: None
) -> Iterator[NDArray[Any]]:
    """The corrected image band by band."""
    shape = (raster.height, raster.width)
    parts = (resample(plane, raster.to_source, shape, band=_BAND) for plane in planes)
    for channels in zip(*parts, strict=True):
        yield channels[0] if len(channels) == 1 else np.stack(channels, axis=-1)
        step()


def undistort(
    image: NDArray[Any],
    calibration: Calibration,
    fov: Literal["keep", "all"] | float = "keep",
    *,
    scale: float = 1.0,
    alpha: float | None = None,
) -> NDArray[Any]:
    """Return an image without the distortion of a camera; see :meth:`reseau.Calibration.undistort`."""
    lens = calibration.mapping()
    if not isinstance(lens, CameraMapping):
        raise UsageError(calibration.not_of("camera"), where=f"calibration {calibration.name}")
    if not isinstance(image, np.ndarray):
        raise UsageError(
            f"is of type {type(image).__name__}",
            where="image",
            do="use reseau.read_image(path).pixels",
        )
    if image.ndim not in (2, 3):
        raise UsageError(
            f"has the shape {image.shape}", where="image", do="give (height, width), or with channels last"
        )
    lens.check_size(image.shape[1], image.shape[0], "image")
    planes = [image] if image.ndim == 2 else list(np.moveaxis(image, 2, 0))
    return np.concatenate(list(_bands(planes, CorrectedImage.undistorted(lens, fov, scale, alpha))))


def _write_tiff(
    path: Path,
    bands: Iterator[NDArray[Any]],
    raster: CorrectedImage,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
) -> None:
    import tifffile

    draft = path.with_name(f".{path.name}.{os.getpid()}")
    per_cm = raster.scale[0] * {"mm": 10.0, "cm": 1.0, "m": 0.01}.get(raster.mapping.unit, 0.0)
    try:
        with tifffile.TiffWriter(draft, bigtiff=int(np.prod(shape)) * dtype.itemsize > 3e9) as tiff:
            tiff.write(
                bands,
                shape=shape,
                dtype=dtype,
                photometric="minisblack" if len(shape) == 2 else "rgb",
                rowsperstrip=_BAND,
                resolution=(per_cm, per_cm) if per_cm else None,
                resolutionunit="CENTIMETER" if per_cm else None,
                software=False,
                metadata=None,
            )
        draft.replace(path)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=path) from None
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
