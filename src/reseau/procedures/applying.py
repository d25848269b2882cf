"""A calibration that is applied to points, images, videos and frames; the files that come of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ..calibration import (
    Calibration,
    CameraCorrection,
    CameraMapping,
    CorrectedImage,
    FiducialMapping,
    FilmFrameMapping,
    InstrumentCorrection,
    read_calibration,
    required_use,
    undistort_video,
    write_tables,
)
from ..calibration.mapping import CalibratedMapping
from ..calibration.raster import planes_of, undistorted_camera, write_corrected
from ..calibration.sensor import SensorCorrection
from ..core.data import ImagePoints
from ..core.errors import UsageError
from ..core.numbers import or_null
from ..core.provenance import Provenance, canonical_json, sha256_of
from ..exchange.film import film_files
from ..io import read_text
from ..io.images import open_scan, read_image, write_image
from ..io.points import POINTS, points_document, points_of
from ..io.reading import read_measurement
from .exposures import photographs_in


class View(NamedTuple):
    """Field of view of an undistorted image, and its resolution.

    Parameters
    ----------
    fov : {"keep", "all"} or float
        As for :meth:`reseau.calibration.CorrectedImage.undistorted`.
    scale : float, optional
        Pixels per unit of the system, or for a camera per pixel of the image; by default that of the image.
    alpha : float, optional
        In place of `fov`, from 0, only pixels that the image has, to 1, all of them.

    Examples
    --------
    >>> View().fov
    'keep'
    """

    fov: Literal["keep", "all"] | float = "keep"
    scale: float | None = None
    alpha: float | None = None


@dataclass(frozen=True, eq=False)
class AppliedPoints:
    """Points to which a calibration was applied.

    Parameters
    ----------
    points : ImagePoints
        In `system`, with `unit`; NaN without a place.
    why : tuple of str
        For each point why the calibration does not hold there; empty where it does.
    unit, system : str
        Their unit and system.
    camera : mapping of str to float
        The camera of the undistorted image that they belong to; empty for other systems.

    Examples
    --------
    >>> points = ImagePoints.with_sigma(["a"], [[1.0, 2.0]], 0.1)
    >>> AppliedPoints(points, ("",), "px", "image", {}).to_csv().splitlines()[0]
    'id,x,y,sx,sy'
    """

    points: ImagePoints
    why: tuple[str, ...]
    unit: str
    system: str
    camera: Mapping[str, float]

    def to_json(self) -> str:
        """Text of a JSON file, which :meth:`Application.points` reads again."""
        content = points_document(self.points, self.unit, self.system)
        content |= {"camera": dict(self.camera)} if self.camera else {}
        if any(self.why):
            table = {
                key: [or_null(v) if isinstance(v, float) else v for v in column]
                for key, column in content["points"].items()
            }
            content["points"] = table | {"ok": [not why for why in self.why], "why": list(self.why)}
        return canonical_json(content)

    def to_csv(self) -> str:
        """Text of a CSV file; with the columns ok and why where the calibration does not hold everywhere."""
        if not any(self.why):
            return self.points.to_csv()
        head, *lines = self.points.to_csv().splitlines()
        rows = [f"{line},{int(not why)},{why}" for line, why in zip(lines, self.why, strict=True)]
        return "\n".join([f"{head},ok,why", *rows]) + "\n"


class AppliedFrame(NamedTuple):
    """A frame whose grey values were corrected: its size, what a step and the full scale are, provenance."""

    width: int
    height: int
    dn_per_step: float
    full_scale: float
    provenance: Provenance


@dataclass(frozen=True, eq=False)
class Application:
    """A calibration in use; made by :meth:`of`.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    mapping : CalibratedMapping
        Its mapping.
    view : View
        Field of view and resolution of corrected images.
    origin : mapping of str to str
        Name and SHA-256 of the calibration, for the provenance of what is written.
    notes : tuple of str
        That it has no verdict, or is usable for less than measurement.
    """

    calibration: Calibration
    mapping: CalibratedMapping
    view: View
    origin: Mapping[str, str]
    notes: tuple[str, ...]

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        view: View | None = None,
        *,
        object_system: bool = False,
        origin: Mapping[str, str] | None = None,
        anyway: bool = False,
    ) -> Application:
        """Prepare a calibration of any kind.

        Parameters
        ----------
        calibration : Calibration
            The calibration.
        view : View, optional
            Field of view and resolution of corrected images.
        object_system : bool
            For an oscilloscope: whether to map to the system of the object, by groups A and B.
        origin : mapping of str to str, optional
            Name and SHA-256 of the calibration.
        anyway : bool
            Whether to go on with that of a camera that is usable for nothing.

        Raises
        ------
        UsageError
            When it is usable for nothing, unless `anyway`, or has no group B.

        Examples
        --------
        >>> from reseau.calibration.assessment import Assessment, Use
        >>> from reseau.calibration.document import Covariance, Quantity
        >>> camera = Calibration(
        ...     kind="camera", name="lens", sigma0=None, redundancy=0,
        ...     model={"model": "opencv", "width": 640, "height": 480, "pitch_mm": [1.0, 1.0]},
        ...     parameters={key: Quantity(value=value, sigma=0.0, unit="px")
        ...                 for key, value in {"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5}.items()},
        ...     covariance=Covariance(names=(), matrix=()),
        ...     assessment=Assessment(use=Use.MEASUREMENT, lines=(), centre_px=0.01, corners_px=0.02))
        >>> corner = ImagePoints.with_sigma(["corner"], [[639.5, 479.5]], 0.1)
        >>> Application.of(camera).points(corner, directions=True).points.xy
        array([[0.4, 0.3]])
        """
        notes: tuple[str, ...] = ()
        if calibration.kind == "camera":
            notes = required_use([(calibration.name, calibration.assessment)], "applied", anyway=anyway)
        mapping = calibration.mapping()
        if isinstance(mapping, InstrumentCorrection):
            mapping = mapping if object_system else mapping.camera
        elif object_system:
            raise UsageError(
                "needs a calibration with group B",
                where="--object-coordinates",
                do="calibrate with reseau refine --photo-ii and --test-object",
            )
        return cls(calibration, mapping, view or View(), origin or {}, notes)

    def about(self, source: Path) -> tuple[str, ...]:
        """What is to be said of an image: that it is not the scan which a frame was oriented in."""
        own = str(self.calibration.model.get("image") or source.name)
        if source.name == own:
            return ()
        return (f"{source}: the orientation is that of {own}; it holds for this scan alone",)

    def raster(self, size: tuple[int, int] | None = None) -> CorrectedImage:
        """The raster of the corrected image of one of this size; a camera knows that of its images."""
        fov, scale, alpha = self.view
        if isinstance(self.mapping, CameraMapping):
            return CorrectedImage.undistorted(self.mapping, fov, 1.0 if scale is None else scale, alpha)
        if isinstance(self.mapping, FilmFrameMapping | FiducialMapping):
            return CorrectedImage.of_frame(self.mapping, scale)
        if not isinstance(self.mapping, CameraCorrection) or size is None:
            raise UsageError(
                "has no corrected image of its own", where=f"calibration {self.calibration.name}"
            )
        return CorrectedImage.plan(self.mapping, size, scale)

    def points(
        self, source: ImagePoints | Path, *, inverse: bool = False, directions: bool = False
    ) -> AppliedPoints:
        """Correct points, or distort corrected ones.

        Parameters
        ----------
        source : ImagePoints or Path
            Points, or their file (JSON, CSV).
        inverse : bool
            Whether they are corrected ones, for which those of the image are wanted.
        directions : bool
            For a camera: whether corrected points are directions x/z, y/z, not pixels of the undistorted
            image.

        Raises
        ------
        UsageError
            When the calibration corrects no points, or those of a file belong to another system.
        FormatError
            When the file is incomplete.
        """
        mapping = self.mapping
        if "points" not in mapping.applies_to:
            where = source if isinstance(source, Path) else "points"
            raise UsageError(
                "a sensor calibration corrects images, not points", where=where, do="give an image"
            )
        raster = self.raster() if isinstance(mapping, CameraMapping) and not directions else None
        camera = {} if raster is None else raster.pinhole
        system = mapping.system if raster is None else "undistorted"
        if isinstance(source, Path):
            source = _read(source, system if inverse else "image", camera if inverse else {})
        if inverse:
            points = mapping.inverse(source if raster is None else _scaled(source, raster, back=True))
            return AppliedPoints(points, mapping.why_not(points), "px", "image", camera)
        points, why = mapping.apply(source), mapping.why_not(source)
        if raster is None:
            return AppliedPoints(points, why, mapping.unit, system, camera)
        return AppliedPoints(_scaled(points, raster), why, "px", system, camera)

    def image(
        self, source: Path, out: Path, step: Callable[[], None] = lambda: None
    ) -> tuple[CorrectedImage, Calibration | None, Provenance]:
        """Resample an image into a file; for a camera, write that of the undistorted image beside it.

        Parameters
        ----------
        source, out : Path
            The image, and the file to write.
        step : callable
            Called after each band.

        Returns
        -------
        raster : CorrectedImage
            Its raster.
        camera : Calibration or None
            The camera of the undistorted image.
        provenance : Provenance
            Inputs and options.

        Raises
        ------
        UsageError
            When the image is of another size.
        ImageError
            When it cannot be read, or the format cannot hold its grey values.
        InputError
            When a file cannot be written.
        """
        scan = None if self.calibration.kind == "oscilloscope" else open_scan(source)
        planes = (read_image(source).pixels,) if scan is None else planes_of(scan)
        height, width = planes[0].shape
        self.mapping.check_size(width, height, source)
        raster = self.raster((width, height))
        write_corrected(out, planes, raster, step)
        inputs = {source.name: sha256_of(source), **self.origin}
        if self.calibration.kind != "camera":
            return raster, None, Provenance(inputs, {"scale": raster.scale[0]})
        provenance = Provenance(inputs, self.view._asdict())
        camera = undistorted_camera(raster, self.calibration, provenance.to_dict())
        camera.write(out.with_suffix(".json"))
        return raster, camera, provenance

    def video(self, source: Path, out: Path, step: Callable[[], None] = lambda: None) -> int:
        """Undistort a video; return its number of frames. See :func:`reseau.calibration.undistort_video`."""
        if not isinstance(self.mapping, CameraMapping):
            raise UsageError("needs the calibration of a camera", where=source)
        return undistort_video(source, out, self.raster(), step)

    def tables(self, path: Path) -> tuple[Path, ...]:
        """Write the tables of the undistorted image. See :func:`reseau.calibration.write_tables`."""
        return write_tables(path, self.raster())

    def frame(self, source: Path, out: Path, exposure_us: float | None = None) -> AppliedFrame:
        """Correct the grey values of a frame: a TIFF of floats, or a PNG of 16 bit up to the full scale.

        Parameters
        ----------
        source, out : Path
            The frame, and the file to write.
        exposure_us : float, optional
            Exposure time; by default that of the calibration.

        Raises
        ------
        UsageError
            When the calibration is not that of a sensor, or the frame has another size.
        """
        if not isinstance(self.mapping, SensorCorrection):
            raise UsageError(self.calibration.not_of("sensor"), where=f"calibration {self.calibration.name}")
        frame = read_image(source)
        self.mapping.check_size(frame.width, frame.height, source)
        found = self.mapping.correct(frame, exposure_us)
        pixels, step = found.pixels, 1.0
        if out.suffix.lower() == ".png":
            step = found.full_scale / 65535
            pixels = np.clip(np.rint(pixels / step), 0, 65535).astype(np.uint16)
        write_image(out, pixels)
        used = self.mapping.exposure_us if exposure_us is None else exposure_us
        provenance = Provenance({source.name: frame.sha256, **self.origin}, {"exposure_us": used})
        return AppliedFrame(found.width, found.height, step, found.full_scale, provenance)


def oriented_roll(
    orientations: Path, scans: Path, view: View | None = None
) -> list[tuple[Path, list[tuple[str, Application]]]]:
    """Return the scans of a folder, each with the frames that `reseau orient` found in it.

    Parameters
    ----------
    orientations : Path
        Folder that `reseau orient` wrote.
    scans : Path
        Folder of the scans.
    view : View, optional
        Resolution of corrected images.

    Returns
    -------
    list of (Path, list)
        Each scan with the names of its frames and their orientations; without any where it was declined.

    Raises
    ------
    InputError
        When a folder has no orientation, or no photograph.
    UsageError
        When the orientations are those of other scans.

    Examples
    --------
    >>> oriented_roll(Path("docs"), Path("docs"))
    Traceback (most recent call last):
    ...
    reseau.core.errors.InputError: docs: has no oriented scan; use `reseau orient --out`
    """
    frames: dict[str, list[tuple[str, Application]]] = {}
    for file in film_files([orientations]):
        calibration = read_calibration(file)
        applied = Application.of(calibration, view, origin={file.name: sha256_of(file)})
        frames.setdefault(str(calibration.model.get("image")), []).append((file.stem, applied))
    found = [(path, frames.get(path.name, [])) for path in photographs_in(scans)]
    if not any(own for _, own in found):
        raise UsageError(f"has no scan that is oriented in {orientations}", where=scans)
    return found


def _read(source: Path, system: str, camera: Mapping[str, Any]) -> ImagePoints:
    """Read points, also those that were written here, with their covariances and their `camera`."""
    try:
        content = json.loads(read_text(source)) if source.suffix.lower() == ".json" else None
    except ValueError:
        content = None
    if not isinstance(content, dict) or content.get("schema") != POINTS:
        return read_measurement(source).image_points()
    if content.get("system") != system:
        raise UsageError(f"has points of the system {content.get('system')}, not {system}", where=source)
    own = content.get("camera") or {}
    if any(abs(own.get(name, np.inf) - value) > 1e-6 for name, value in camera.items()):
        raise UsageError(
            "has points of another undistorted image", where=source,
            do="repeat --fov, --opencv-alpha or --scale as for that one",
        )  # fmt: skip
    return points_of(content, source)


def _scaled(points: ImagePoints, raster: CorrectedImage, *, back: bool = False) -> ImagePoints:
    """Directions as pixels of the undistorted image, or `back`."""
    slope = np.diag(1 / raster.slope if back else raster.slope)
    xy = raster.to_system(points.xy) if back else raster.of_system(points.xy)
    return ImagePoints(points.names, xy, slope @ points.cov @ slope)
