"""DICOM files in place of a scanner: their frames in order, with the pixel size that the files state.

Source: DICOM PS3.3, C.8.5.5 "US Region Calibration". The pixel size comes only from the regions of a file,
and only if they are plausible: a two-dimensional section, in centimetres, inside the frame. Otherwise (for
example if a frame was reduced and its regions now lie outside it) a frame has no pixel size. pydicom decodes
the transfer syntaxes that are installed: uncompressed, RLE and deflated always; JPEG (8 bits) and JPEG 2000
with Pillow; lossless JPEG, JPEG-LS, HTJ2K and video are refused with an error that names them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.errors import (
    ConnectionLost,
    DeadlineError,
    InstrumentError,
    ProtocolError,
    StateError,
    UsageError,
)
from reseau.instruments import BScan, Deadline, Device, Identity, Limits, Settings, quantity

_LARGEST_SIDE, _MOST_FRAMES, _MOST_FILES = 8192, 100_000, 100_000
_TWO_DIMENSIONS, _CENTIMETRES = 1, 3


@dataclass(frozen=True)
class DicomSettings(Settings):
    """Speed of sound, which files do not state, and the choice of the region.

    Examples
    --------
    >>> DicomSettings(region=1).speed_m_s
    1540.0
    """

    speed_m_s: float = quantity(1540.0, "m/s", 1000.0, 2500.0)
    region: int = quantity(-1, "", -1, 99)
    """Index of the region, from 0; −1 uses the scale on which all sections of a frame agree."""


@dataclass(frozen=True)
class _Scale:
    """Pixel size of a frame, or the reason why there is none."""

    mm: tuple[float, float] | None
    origin: tuple[float, float]
    region: tuple[int, int, int, int] | None = None
    frequency_khz: float = math.nan
    why: str = ""
    invalid: bool = False
    """Whether the region contradicts the frame, so that no scale of the frame can be trusted."""


class DicomFiles(Device[DicomSettings]):
    """Frames of a file, or of the files of a folder in the order of their names.

    Parameters
    ----------
    name : str
        Name on the bench.
    path : str or Path
        File or folder.
    settings : DicomSettings
        Speed of sound and region.
    seconds : float
        Time limit of calls that do not specify one (s).
    limits : mapping, optional
        Limits of settings.

    Raises
    ------
    UsageError
        If pydicom is not installed.

    Examples
    --------
    >>> with DicomFiles("loops", "recordings/") as files:  # doctest: +SKIP
    ...     files.scan().mm_per_px
    (0.2, 0.2)
    """

    def __init__(
        self,
        name: str,
        path: str | Path,
        settings: DicomSettings | None = None,
        *,
        seconds: float = 10.0,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(name, settings or DicomSettings(), seconds=seconds, limits=limits)
        try:
            import pydicom
        except ImportError:
            raise UsageError("needs pydicom", where=name, do="pip install 'reseau[dicom]'") from None
        self._pydicom: Any = pydicom
        self._path = Path(path)
        self._frames: list[tuple[Path, int]] = []
        self._next = 0

    @property
    def left(self) -> int:
        """Number of frames not read yet; 0 before the first connection."""
        return len(self._frames) - self._next

    def _open(self, deadline: Deadline) -> None:
        if not self._path.exists():
            raise ConnectionLost(
                f"{self._path} does not exist", do="give a DICOM file or a folder of DICOM files"
            )
        found = (
            sorted(p for p in self._path.iterdir() if p.is_file()) if self._path.is_dir() else [self._path]
        )
        self._frames = []
        for path in found[:_MOST_FILES]:
            if deadline.expired:
                raise DeadlineError(f"{len(found)} files were not read within {deadline.seconds:g} s")
            try:
                header = self._header(path)
            except ProtocolError:
                # In a folder, other files are skipped: DICOMDIR, reports, notes.
                if path == self._path:
                    raise
                continue
            self._frames += [(path, k) for k in range(_count(header))]
        if not self._frames:
            raise ProtocolError(f"{self._path} contains no DICOM image")

    def _disconnect(self) -> None:
        """Do nothing: files are opened for each frame."""

    def _push(self, settings: DicomSettings, deadline: Deadline) -> None:
        """Do nothing."""

    def _identify(self, deadline: Deadline) -> Identity:
        header = self._header(self._frames[0][0])
        keys = ("Manufacturer", "ManufacturerModelName", "DeviceSerialNumber", "SoftwareVersions")
        values = [header.get(key, "") or "" for key in keys]
        return Identity(*(each if isinstance(each, str) else ", ".join(map(str, each)) for each in values))

    def _halt(self, deadline: Deadline) -> None:
        """Do nothing."""

    def _acquire(self) -> dict[str, Any]:
        scan = self.scan()
        mm = scan.mm_per_px or (math.nan, math.nan)
        return {f"{self.name}_section": scan.pixels, f"{self.name}_mm_per_px": list(mm)}

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        with self._exchange("describe"):
            header = self._header(self._frames[min(self._next, len(self._frames) - 1)][0])
        return {
            f"{self.name}_section": {"dtype": "array", "shape": [int(header.Rows), int(header.Columns)]},
            f"{self.name}_mm_per_px": {"dtype": "array", "shape": [2], "units": "mm"},
        }

    def stage(self) -> list[Any]:
        """Connect and restart with the first frame."""
        staged = super().stage()
        self._next = 0
        return staged

    def _test(self, deadline: Deadline) -> dict[str, str]:
        with self._exchange("check", deadline.left):
            path, index = self._frames[0]
            scale = self._scale(self._header(path))
            self._pixels(path, index)
        mm = f"{scale.mm[0]:g} × {scale.mm[1]:g} mm" if scale.mm else f"unknown: {scale.why}"
        return {"frames": str(len(self._frames)), "pixels": mm}

    def scan(self, seconds: float | None = None) -> BScan:
        """Return the next frame.

        Raises
        ------
        StateError
            If there are no more frames.
        ProtocolError
            If the frame cannot be decoded.
        """
        with self._exchange("scan", seconds):
            if not self.left:
                raise StateError(f"has no more than {len(self._frames)} frames", do="stage it again")
            path, index = self._frames[self._next]
            header = self._header(path)
            scale, pixels = self._scale(header), self._pixels(path, index)
            self._next += 1
            speed = self.settings.speed_m_s
            return BScan(
                pixels,
                scale.mm,
                scale.origin,
                speed,
                scale.frequency_khz,
                math.nan,
                region_px=scale.region,
            )

    def _header(self, path: Path) -> Any:
        """Return the contents of a file except its pixels."""
        try:
            header = self._pydicom.dcmread(path, stop_before_pixels=True)
            rows, columns, _ = int(header.Rows), int(header.Columns), header.file_meta.TransferSyntaxUID
        except OSError as error:
            raise ConnectionLost(f"{path} cannot be read ({error.strerror or error})") from None
        except Exception as error:
            # pydicom has no common class of exceptions.
            raise ProtocolError(f"{path.name} is not a DICOM image ({error})") from None
        if not (2 <= rows <= _LARGEST_SIDE and 2 <= columns <= _LARGEST_SIDE):
            raise ProtocolError(f"{path.name} states a frame of {columns}×{rows} px")
        if not 1 <= _count(header) <= _MOST_FRAMES:
            raise ProtocolError(f"{path.name} states {header.get('NumberOfFrames')} frames")
        return header

    def _pixels(self, path: Path, index: int) -> NDArray[np.uint8]:
        """Return one frame as grey values with 8 bits."""
        header = self._header(path)
        syntax = header.file_meta.TransferSyntaxUID
        try:
            if not self._pydicom.pixels.get_decoder(syntax).is_available:
                raise NotImplementedError
        except NotImplementedError:
            raise ProtocolError(
                f"{path.name} is compressed as {syntax.name} ({syntax}), which cannot be decoded",
                do="decompress it (gdcmconv --raw), or install pylibjpeg's decoders",
            ) from None
        try:
            values = self._pydicom.pixels.pixel_array(path, index=index)
            if header.PhotometricInterpretation == "PALETTE COLOR":
                values = self._pydicom.pixels.apply_color_lut(values, header)
        except OSError as error:
            raise ConnectionLost(f"{path} cannot be read ({error.strerror or error})") from None
        except InstrumentError:
            raise
        except Exception as error:
            raise ProtocolError(f"frame {index} of {path.name} cannot be decoded ({error})") from None
        return _grey(values, header, path.name)

    def _scale(self, header: Any) -> _Scale:
        """Return the pixel size of a frame from its regions."""
        regions, wanted = list(header.get("SequenceOfUltrasoundRegions") or ()), self.settings.region
        nothing = ((int(header.Columns) - 1) / 2, 0.0)
        if wanted >= len(regions):
            return _Scale(None, nothing, why=f"region {wanted} does not exist; the frame has {len(regions)}")
        chosen = regions if wanted < 0 else [regions[wanted]]
        read = [_region(each, int(header.Columns), int(header.Rows)) for each in chosen]
        # A Doppler spectrum beside the section is valid; a section outside the frame is not.
        invalid = [each for each in read if each.invalid]
        known = [each for each in read if each.mm is not None]
        if invalid or not known:
            why = (invalid or read or [_Scale(None, nothing, why="no regions")])[0].why
            return _Scale(None, nothing, why=why)
        if any(not np.allclose(each.mm or 0, known[0].mm or 0, rtol=1e-6) for each in known):
            return _Scale(
                None, nothing, why="regions with different scales: choose one with the setting region"
            )
        return known[0] if len(known) == 1 else _united(known)


def _count(header: Any) -> int:
    """Return the number of frames of a file; 0 if it is not a valid number."""
    try:
        return int(header.get("NumberOfFrames", 1) or 1)
    except (TypeError, ValueError):
        return 0


def _region(region: Any, width: int, height: int) -> _Scale:
    """Return the scale of one region, or the reason why there is none."""
    nothing = _Scale(None, ((width - 1) / 2, 0.0))
    try:
        box = tuple(
            int(region.get(f"RegionLocation{key}", -1)) for key in ("MinX0", "MinY0", "MaxX1", "MaxY1")
        )
        delta = tuple(abs(float(region.get(f"PhysicalDelta{axis}", 0.0))) for axis in "XY")
        units = tuple(int(region.get(f"PhysicalUnits{axis}Direction", 0)) for axis in "XY")
        plane = int(region.get("RegionSpatialFormat", 0)) == _TWO_DIMENSIONS
        frequency = float(region.get("TransducerFrequency", math.nan))
    except (TypeError, ValueError, OverflowError):
        return _Scale(None, nothing.origin, why="unreadable region", invalid=True)
    left, top, right, bottom = box
    if not plane or units != (_CENTIMETRES, _CENTIMETRES):
        return _Scale(None, nothing.origin, why="not a section in centimetres")
    # Many makers write the first pixel after the region as its last one: accept it.
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        return _Scale(
            None, nothing.origin, why=f"region {box} outside the frame of {width}×{height} px", invalid=True
        )
    if not all(math.isfinite(each) and each > 0 for each in delta):
        return _Scale(None, nothing.origin, why=f"implausible pixel size {delta} cm", invalid=True)
    inside = (left, top, min(right, width - 1), min(bottom, height - 1))
    return _Scale((10 * delta[0], 10 * delta[1]), _origin(region, inside), inside, frequency)


def _origin(region: Any, box: tuple[int, int, int, int]) -> tuple[float, float]:
    """Return the pixel of the physical point (0, 0) on the transducer, or the middle of the upper edge."""
    left, top, right, _ = box
    at = []
    for axis, first in (("X", left), ("Y", top)):
        reference = region.get(f"ReferencePixel{axis}0")
        value, delta = region.get(f"ReferencePixelPhysicalValue{axis}"), region.get(f"PhysicalDelta{axis}")
        if reference is None or value is None or delta is None or not math.isfinite(float(value)):
            return ((left + right) / 2, float(top))
        at.append(first + int(reference) - float(value) / float(delta))
    return (at[0], at[1])


def _united(known: list[_Scale]) -> _Scale:
    """Combine several sections with the same scale, which is valid in all of them."""
    boxes = np.array([each.region for each in known])
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    region = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    return _Scale(known[0].mm, known[0].origin, region, known[0].frequency_khz)


def _grey(values: NDArray[Any], header: Any, name: str) -> NDArray[np.uint8]:
    """Convert pixels to grey values 0 to 255; bright is an echo."""
    kind = str(header.get("PhotometricInterpretation", ""))
    bits = 8 * values.itemsize if kind == "PALETTE COLOR" else int(header.get("BitsStored", 8))
    if values.ndim == 3 and values.shape[2] == 3:
        values = cv2.cvtColor(np.ascontiguousarray(values), cv2.COLOR_RGB2GRAY)
    if values.ndim != 2 or not kind.startswith(("MONOCHROME", "PALETTE", "RGB", "YBR")):
        raise ProtocolError(f"{name} has pixels of the kind {kind or 'unknown'}", do="convert them to grey")
    if not 1 <= bits <= 16 or values.dtype.kind != "u":
        raise ProtocolError(f"{name} has pixels of {bits} bits of the type {values.dtype}")
    scaled = values if bits == 8 else np.rint(values * (255.0 / (2**bits - 1)))
    grey = np.asarray(np.clip(scaled, 0, 255), np.uint8)
    return 255 - grey if kind == "MONOCHROME1" else grey
