"""A frame resampled into the corrected system: which raster, and the file, band by band."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array
from ..core.errors import ImageError, InputError, UsageError
from ..io.images import MAX_PIXELS, write_image
from ..optics.resampling import resample
from .camera import CameraCorrection

__all__ = ["CorrectedImage", "write_corrected"]

_BAND = 256
_BEYOND = 0.08
"""How far beyond the marks the corrected image reaches, as a part of their extent: a polynomial runs wild."""


@dataclass(frozen=True, eq=False)
class CorrectedImage:
    """The raster of a corrected image.

    Parameters
    ----------
    correction : CameraCorrection
        From pixels of the frame to the corrected system.
    origin : (float, float)
        Coordinates of the centre of its first pixel.
    scale : float
        Pixels per unit of the corrected system.
    width, height : int
        Columns and rows.
    up : bool
        Whether y grows upwards in the image; rows then run against y.
    """

    correction: CameraCorrection
    origin: tuple[float, float]
    scale: float
    width: int
    height: int
    up: bool

    @classmethod
    def plan(
        cls,
        correction: CameraCorrection,
        size: tuple[int, int],
        extent: Sequence[float] | None = None,
        scale: float | None = None,
    ) -> CorrectedImage:
        """The raster that shows what the frame shows, as far as the correction holds.

        Parameters
        ----------
        size : (int, int)
            Width and height of the frame.
        extent : sequence of float, optional
            Left, low, right and high end of the marks the correction was fitted to.
        scale : float, optional
            Pixels per unit; by default that of the frame.

        Raises
        ------
        UsageError
            When the raster would be larger than images may be, or nothing of the frame lies in it.
        """
        scale = 1 / correction.photo_system.scale if scale is None else scale
        along = np.linspace(0, 1, 33)
        edge = np.concatenate([np.stack([along, 0 * along + k], 1) for k in (0, 1)])
        border = np.concatenate([edge, edge[:, ::-1]]) * (np.array(size) - 1.0)
        photo = correction.photo_system(border)
        corrected = correction.model(photo)
        corrected = corrected[correction.model.one_to_one(photo)]
        low, high = np.array([[-np.inf] * 2, [np.inf] * 2])
        if len(corrected):
            low, high = corrected.min(axis=0), corrected.max(axis=0)
        if extent is not None and len(extent) == 4:
            marks = np.array(extent, dtype=np.float64).reshape(2, 2)
            reach = _BEYOND * (marks[1] - marks[0])
            low, high = np.maximum(low, marks[0] - reach), np.minimum(high, marks[1] + reach)
        counts = (high - low) * scale
        if not (np.isfinite(counts).all() and (counts >= 1).all()):
            raise UsageError("shows nothing of the region the calibration holds for", where="frame")
        width, height = (int(n) + 1 for n in counts)
        if width * height > MAX_PIXELS:
            raise UsageError(f"asks for {width}×{height} pixels", where="scale", do="choose a smaller one")
        up = correction.photo_system.mirrored
        return cls(
            correction, (float(low[0]), float(high[1] if up else low[1])), float(scale), width, height, up
        )

    @property
    def bands(self) -> int:
        """Number of bands in which it is made."""
        return -(-self.height // _BAND)

    def to_source(self, xy: Array) -> Array:
        """Pixels of the frame (n, 2) of pixels of this image (n, 2)."""
        direction = np.array([1.0, -1.0 if self.up else 1.0])
        return self.correction.to_pixels(np.array(self.origin) + xy * direction / self.scale)

    def to_dict(self) -> dict[str, Any]:
        """The raster as JSON-ready data."""
        return {
            "width": self.width,
            "height": self.height,
            "first_pixel": list(self.origin),
            "px_per_unit": self.scale,
            "unit": self.correction.unit,
            "y": "up" if self.up else "down",
        }


def write_corrected(
    path: Path,
    pixels: NDArray[Any],
    plan: CorrectedImage,
    step: Callable[[], None] = lambda: None,
) -> None:
    """Resample a frame into a file, whole or not at all.

    A TIFF is written band by band; other kinds are held whole, in the type of the frame.

    Parameters
    ----------
    path : Path
        File; its suffix says the kind.
    pixels : ndarray (h, w)
        The frame.
    plan : CorrectedImage
        The raster.
    step : callable
        Called after each band.

    Raises
    ------
    ImageError
        When the kind of file cannot hold the grey values.
    InputError
        When the file cannot be written.
    """
    suffix = path.suffix.lower()
    deepest = {".png": 2, ".jpg": 1, ".jpeg": 1}.get(suffix, 8)
    if deepest < 8 and (pixels.dtype.kind != "u" or pixels.dtype.itemsize > deepest):
        raise ImageError(f"cannot hold grey values of type {pixels.dtype}", where=path, do="use .tif")

    def bands() -> Iterator[NDArray[Any]]:
        for band in resample(pixels, plan.to_source, (plan.height, plan.width), band=_BAND):
            yield band
            step()

    if suffix in (".tif", ".tiff"):
        _write_tiff(path, bands(), plan, pixels.dtype)
        return
    whole = np.empty((plan.height, plan.width), dtype=pixels.dtype)
    for k, band in enumerate(bands()):
        whole[k * _BAND : k * _BAND + len(band)] = band
    write_image(path, whole)


def _write_tiff(
    path: Path, bands: Iterator[NDArray[Any]], plan: CorrectedImage, dtype: np.dtype[Any]
) -> None:
    import tifffile

    draft = path.with_name(f".{path.name}.{os.getpid()}")
    per_cm = plan.scale * {"mm": 10.0, "cm": 1.0, "m": 0.01}.get(plan.correction.unit, 0.0)
    try:
        with tifffile.TiffWriter(draft, bigtiff=plan.width * plan.height * dtype.itemsize > 3e9) as tiff:
            tiff.write(
                bands,
                shape=(plan.height, plan.width),
                dtype=dtype,
                photometric="minisblack",
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
