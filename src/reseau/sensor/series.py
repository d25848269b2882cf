"""Series of frames of a sensor: mean and variance of every pixel at each exposure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import UsageError

__all__ = ["Image32", "Level", "LevelSums", "SensorSeries"]

Image32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Level:
    """Frames of one exposure.

    Parameters
    ----------
    exposure_us : float
        Exposure time.
    count : int
        Number of frames, at least two.
    mean, variance : ndarray (height, width)
        Mean and variance of each pixel over the frames, corrected for changes of whole frames (lamp flicker).

    Examples
    --------
    >>> frames = [np.full((2, 3), 10) + step for step in (np.eye(2, 3), -np.eye(2, 3))]
    >>> level = Level.of(1000.0, frames)
    >>> level.count, level.mean.shape, float(level.mean.mean()) > 10.0
    (2, (2, 3), True)
    """

    exposure_us: float
    count: int
    mean: Image32
    variance: Image32

    @classmethod
    def of(cls, exposure_us: float, frames: Iterable[NDArray[Any]]) -> Level:
        """The level of frames, which are read one by one and not stored.

        Raises
        ------
        UsageError
            When there are fewer than two, or they differ in size.
        """
        sums = LevelSums(exposure_us)
        for frame in frames:
            sums.add(frame)
        return sums.level()


class LevelSums:
    """Accumulator of a level; frames are not stored.

    Parameters
    ----------
    exposure_us : float
        Exposure time.

    Examples
    --------
    >>> sums = LevelSums(1000.0)
    >>> for grey in (9, 11, 10):
    ...     sums.add(np.array([[grey, 10], [10, 20 - grey]]))
    >>> level = sums.level()
    >>> level.count, round(float(level.variance[0, 0]), 2)
    (3, 1.33)
    """

    def __init__(self, exposure_us: float) -> None:
        self.exposure_us, self.count = exposure_us, 0
        self._first = 0.0
        self._mean: NDArray[np.float64] = np.zeros((0, 0))
        self._scatter: NDArray[np.float64] = np.zeros((0, 0))

    def add(self, frame: NDArray[Any]) -> None:
        """Add a frame.

        Raises
        ------
        UsageError
            When its size differs from that of the first.
        """
        values = frame.astype(np.float64)
        if not self.count:
            self.count, self._first = 1, float(values.mean())
            self._mean, self._scatter = values, np.zeros_like(values)
            return
        if values.shape != self._mean.shape:
            raise UsageError(f"frames of {self._mean.shape} and {values.shape}", where="sensor series")
        # Adjust the frame's mean to that of the first; then Welford's recurrence.
        self.count += 1
        values -= values.mean() - self._first
        step = values - self._mean
        self._mean = self._mean + step / self.count
        self._scatter += step * (values - self._mean)

    def level(self) -> Level:
        """The level of the frames added so far.

        Raises
        ------
        UsageError
            When there are fewer than two frames.
        """
        if self.count < 2:
            raise UsageError("needs at least two frames of each exposure", where="sensor series")
        # One degree of freedom of all pixels together is used for each frame's mean.
        variance = self._scatter / (self.count - 1) * (self._mean.size / (self._mean.size - 1))
        mean = self._mean.astype(np.float32)
        return Level(self.exposure_us, self.count, mean, variance.astype(np.float32))


@dataclass(frozen=True, eq=False)
class SensorSeries:
    """Frames in the dark, and of even light, at increasing exposures.

    Parameters
    ----------
    dark, bright : tuple of Level
        With the lens covered; and with constant even light on the sensor.
    full_scale : float
        Grey value at which the converter saturates.

    Raises
    ------
    UsageError
        When either is missing, or frames differ in size.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> def level(exposure_us, signal):
    ...     return Level.of(exposure_us, 10 + signal + rng.poisson(signal, (4, 8, 8)) - signal)
    >>> series = SensorSeries((level(10, 0),), tuple(level(t, t) for t in (40, 10, 20)), full_scale=255.0)
    >>> series.shape, [each.exposure_us for each in series.bright]
    ((8, 8), [10, 20, 40])
    """

    dark: tuple[Level, ...]
    bright: tuple[Level, ...]
    full_scale: float

    def __post_init__(self) -> None:
        if not self.dark or len(self.bright) < 3:
            raise UsageError(
                f"{len(self.dark)} dark and {len(self.bright)} bright exposures", where="sensor series",
                do="take at least one dark and three bright ones",
            )  # fmt: skip
        shapes = {level.mean.shape for level in (*self.dark, *self.bright)}
        if len(shapes) > 1:
            raise UsageError("its frames differ in size", where="sensor series")
        object.__setattr__(self, "bright", tuple(sorted(self.bright, key=lambda each: each.exposure_us)))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self.dark[0].mean.shape
        return int(height), int(width)
