"""Frames freed of what their sensor did to them, before anything is measured in them."""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from ..calibration.document import Calibration
from ..core.data import Frame, Mask
from ..core.errors import FormatError, UsageError
from .fields import Fields

__all__ = ["SensorCorrection", "packed", "unpacked"]

TYPE = "sensor"
"""Of a calibration's model."""
_STEPS = 65535


@dataclass(frozen=True, eq=False)
class SensorCorrection:
    """Dark subtracted, linearised, divided by the response, defective pixels replaced.

    Parameters
    ----------
    fields : Fields
        Of each pixel.
    b2, b3 : float
        See :class:`~reseau.sensor.Linearity`.
    full_scale : float
        Of the frames.
    exposure_us : float
        That frames are taken to have whose own is not told.
    """

    fields: Fields
    b2: float
    b3: float
    full_scale: float
    exposure_us: float

    def apply(self, frame: Frame, exposure_us: float | None = None) -> Frame:
        """The corrected frame: grey values above the dark, as floats; of the same name and source.

        Raises
        ------
        UsageError
            When the frame has another size, or another scale of grey values, than the calibrated ones.
        """
        shape = self.fields.bias.shape
        if frame.pixels.shape != shape or frame.full_scale != self.full_scale:
            raise UsageError(
                f"has {frame.width}×{frame.height} pixels up to {frame.full_scale:g}, the calibrated sensor "
                f"{shape[1]}×{shape[0]} up to {self.full_scale:g}",
                where=frame.name,
                do="calibrate the sensor with the region and format in use",
            )
        dark = self.fields.dark(self.exposure_us if exposure_us is None else exposure_us)
        signal = frame.pixels.astype(np.float32) - dark
        u = signal / np.float32(self.full_scale)
        signal *= 1 + np.float32(self.b2) * u + np.float32(self.b3) * u**2
        signal /= self.fields.response
        top = self.full_scale - float(np.median(dark))
        share = top / self.full_scale
        top *= 1 + self.b2 * share + self.b3 * share**2
        return Frame(_mended(signal, self.fields.defects), top, frame.name, frame.sha256)

    def to_model(self) -> dict[str, Any]:
        """For a calibration file; fields in steps of 1/65535 of their range."""
        return {
            "type": TYPE,
            "b2": self.b2,
            "b3": self.b3,
            "full_scale": self.full_scale,
            "exposure_us": self.exposure_us,
            "fields": {
                "bias": packed(self.fields.bias, ~self.fields.defects),
                "dark_current": packed(self.fields.dark_current, ~self.fields.defects),
                "response": packed(self.fields.response, ~self.fields.defects),
                "defects": [int(at) for at in np.flatnonzero(self.fields.defects)],
            },
        }

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> Self:
        """The correction of a calibration file.

        Raises
        ------
        FormatError
            When it is none of a sensor, or its fields are damaged.
        """
        model = calibration.model
        if not isinstance(model, dict) or model.get("type") != TYPE:
            raise FormatError("is no calibration of a sensor", where=calibration.name)
        try:
            fields = {name: unpacked(model["fields"][name]) for name in ("bias", "dark_current", "response")}
            defects = np.zeros(fields["bias"].size, dtype=bool)
            defects[np.array(model["fields"]["defects"], dtype=np.intp)] = True
            whole = Fields(**fields, defects=defects.reshape(fields["bias"].shape))
            return cls(whole, *(float(model[name]) for name in ("b2", "b3", "full_scale", "exposure_us")))
        except (KeyError, ValueError, TypeError, IndexError, zlib.error) as error:
            raise FormatError(f"its fields are damaged ({error})", where=calibration.name) from None


def packed(values: NDArray[np.float32], good: Mask) -> dict[str, Any]:
    """A field as text: whole steps of 16 bits, deflated, base64; pixels that are not good at the median."""
    middle = float(np.median(values[good]))
    filled = np.where(good, values, middle).astype(np.float64)
    low, high = float(filled.min()), float(filled.max())
    step = (high - low) / _STEPS or 1.0
    steps = np.rint((filled - low) / step).astype("<u2")
    data = base64.b64encode(zlib.compress(steps.tobytes(), 6)).decode("ascii")
    return {"shape": list(values.shape), "low": low, "step": step, "deflated": data}


def unpacked(field: dict[str, Any]) -> NDArray[np.float32]:
    """The field of a text; raises ValueError when it is damaged."""
    height, width = (int(size) for size in field["shape"])
    if not 0 < height * width <= 1 << 28:
        raise ValueError(f"{height}×{width} pixels")
    inflated = zlib.decompressobj().decompress(base64.b64decode(field["deflated"]), height * width * 2)
    steps = np.frombuffer(inflated, "<u2").reshape(height, width)
    values: NDArray[np.float32] = (float(field["low"]) + float(field["step"]) * steps).astype(np.float32)
    return values


def _mended(signal: NDArray[np.float32], defects: Mask) -> NDArray[np.float32]:
    """Defective pixels get the mean of the good ones around them, from the rim of a cluster inwards."""
    if not defects.any():
        return signal
    mended, good = np.where(defects, np.float32(0), signal), (~defects).astype(np.float32)
    ring = np.ones((3, 3), dtype=np.float32)
    while not good.all():
        total = cv2.filter2D(mended * good, -1, ring, borderType=cv2.BORDER_CONSTANT)
        count = cv2.filter2D(good, -1, ring, borderType=cv2.BORDER_CONSTANT)
        now = (good == 0) & (count > 0.5)
        if not now.any():
            break
        mended[now] = total[now] / count[now]
        good[now] = 1.0
    return mended
