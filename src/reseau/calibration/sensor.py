"""The correction of a sensor: dark signal, non-linearity, response and defective pixels of its frames."""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Frame, Mask
from ..core.errors import FormatError, UsageError
from .document import Calibration, SensorModel, readable_as
from .mapping import CalibratedMapping, Target

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_STEPS = 65535

Image32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Fields:
    """Properties of each pixel.

    Parameters
    ----------
    bias : ndarray (height, width)
        Grey value in the dark at no exposure.
    dark_current : ndarray (height, width)
        Grey values that a microsecond of exposure adds in the dark.
    response : ndarray (height, width)
        Response to light, relative to the mean of the good pixels.
    defects : ndarray (height, width) of bool
        Pixels that are not to be used.

    Examples
    --------
    >>> flat = np.ones((2, 3), dtype=np.float32)
    >>> float(Fields(8 * flat, 0.001 * flat, flat, flat == 0).dark(5000.0)[0, 0])
    13.0
    """

    bias: Image32
    dark_current: Image32
    response: Image32
    defects: Mask

    def dark(self, exposure_us: float) -> Image32:
        """Grey values in the dark at an exposure time in microseconds, (height, width)."""
        return (self.bias + self.dark_current * np.float32(exposure_us)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class SensorCorrection(CalibratedMapping):
    """Subtract the dark signal, linearise, divide by the response, replace defective pixels.

    Parameters
    ----------
    fields : Fields
        Properties of each pixel.
    b2, b3 : float
        Coefficients of the non-linearity; see :class:`~reseau.sensor.Linearity`.
    full_scale : float
        Grey value at which the frames saturate.
    exposure_us : float
        Exposure time of frames that are given without one, microseconds.

    Examples
    --------
    >>> flat = np.ones((2, 3), dtype=np.float32)
    >>> correction = SensorCorrection(Fields(8 * flat, 0 * flat, 2 * flat, flat == 0), 0.0, 0.0, 255.0, 1e4)
    >>> float(correction.correct(Frame(np.full((2, 3), 108, np.uint8), 255.0)).pixels[0, 0])
    50.0
    """

    applies_to: ClassVar[tuple[Target, ...]] = ("frames",)
    system: ClassVar[str] = "pixels"
    unit: ClassVar[str] = "DN"

    fields: Fields
    b2: float
    b3: float
    full_scale: float
    exposure_us: float

    def plot(self, axes: Axes | None = None, across: int = 0) -> Axes:
        """Draw the response of the pixels with matplotlib; defective ones are at the median."""
        from ..core.figures import draw_picture, image_axes, new_axes

        axes = new_axes(axes)
        response, good = self.fields.response, ~self.fields.defects
        draw_picture(axes, np.where(good, response, np.median(response[good])))
        image_axes(axes, *self.size, f"response, {int(self.fields.defects.sum())} defective pixels")
        return axes

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the sensor's frames."""
        height, width = self.fields.bias.shape
        return width, height

    def correct(self, frame: Frame, exposure_us: float | None = None) -> Frame:
        """Correct a frame.

        Parameters
        ----------
        frame : Frame
            As read from the sensor.
        exposure_us : float, optional
            Its exposure time; by default `exposure_us` of the calibration.

        Returns
        -------
        Frame
            Grey values above the dark signal, as floats; of the same name and source.

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

    def derivatives(self, xy: Array) -> tuple[Array, Array, Array]:
        """Points stay where they are: a sensor's correction changes grey values alone."""
        return xy.copy(), np.tile(np.eye(2), (len(xy), 1, 1)), np.zeros((len(xy), 2, 0))

    @property
    def parameter_covariance(self) -> Array:
        """Empty: no parameter moves a point."""
        return np.zeros((0, 0))

    def to_pixels(self, xy: Array) -> Array:
        """The same points."""
        return xy.copy()

    def _why(self, xy: Array, mapped: Array) -> list[str]:
        inside: Mask = np.asarray(((xy >= -0.5) & (xy <= np.array(self.size) - 0.5)).all(axis=1))
        return ["" if here else "lies outside the frame" for here in inside.tolist()]

    def to_model(self) -> SensorModel:
        """The model of the calibration file; fields are stored in steps of 1/65535 of their range."""
        return {
            "type": "sensor",
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
        """Read a correction back from its file.

        Raises
        ------
        FormatError
            When the calibration is of another kind, or its fields are damaged.
        """
        model = cast(dict[str, Any], calibration.model)
        if not isinstance(model, dict) or model.get("type") != "sensor":
            raise FormatError(calibration.not_of("sensor"), where=f"calibration {calibration.name}")
        try:
            fields = {name: unpacked(model["fields"][name]) for name in ("bias", "dark_current", "response")}
            defects = np.zeros(fields["bias"].size, dtype=bool)
            defects[np.array(model["fields"]["defects"], dtype=np.intp)] = True
            whole = Fields(**fields, defects=defects.reshape(fields["bias"].shape))
            return cls(whole, *(float(model[name]) for name in ("b2", "b3", "full_scale", "exposure_us")))
        except (KeyError, ValueError, TypeError, IndexError, zlib.error) as error:
            raise FormatError(f"has damaged fields ({error})", where=calibration.name) from None


def packed(values: NDArray[np.float32], good: Mask) -> dict[str, Any]:
    """Pack a field as text: steps of 16 bits, deflated, base64; pixels that are not good get the median."""
    middle = float(np.median(values[good]))
    filled = np.where(good, values, middle).astype(np.float64)
    low, high = float(filled.min()), float(filled.max())
    step = (high - low) / _STEPS or 1.0
    steps = np.rint((filled - low) / step).astype("<u2")
    data = base64.b64encode(zlib.compress(steps.tobytes(), 6)).decode("ascii")
    return {"shape": list(values.shape), "low": low, "step": step, "deflated": data}


def unpacked(field: dict[str, Any]) -> NDArray[np.float32]:
    """Unpack a field; raises ValueError when it is damaged."""
    height, width = (int(size) for size in field["shape"])
    if not 0 < height * width <= 1 << 28:
        raise ValueError(f"{height}×{width} pixels")
    inflated = zlib.decompressobj().decompress(base64.b64decode(field["deflated"]), height * width * 2)
    steps = np.frombuffer(inflated, "<u2").reshape(height, width)
    return (float(field["low"]) + float(field["step"]) * steps).astype(np.float32)


def _mended(signal: NDArray[np.float32], defects: Mask) -> NDArray[np.float32]:
    """Replace defective pixels by the mean of the good ones around them, a cluster from its rim."""
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


readable_as("sensor")(SensorCorrection.from_calibration)
