"""Series of frames of a sensor: mean and variance of every pixel at each exposure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import UsageError

Image32 = NDArray[np.float32]
_LINEAR = 0.7
"""Largest signal of the levels used, as a share of saturation (EMVA 1288)."""
_COLLAPSED = 0.5
"""A level is saturated if its variance is below this share of the expected one."""


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
    light : float, optional
        Amount of light in any unit, if not the exposure time alone varies.

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
    light: float | None = None

    @property
    def amount(self) -> float:
        """The light, in its own unit or by the exposure time."""
        return self.exposure_us if self.light is None else self.light

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
    light : float, optional
        As for :class:`Level`.

    Examples
    --------
    >>> sums = LevelSums(1000.0)
    >>> for grey in (9, 11, 10):
    ...     sums.add(np.array([[grey, 10], [10, 20 - grey]]))
    >>> level = sums.level()
    >>> level.count, round(float(level.variance[0, 0]), 2)
    (3, 1.33)
    """

    def __init__(self, exposure_us: float, light: float | None = None) -> None:
        self.exposure_us, self.light, self.count = exposure_us, light, 0
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
        return Level(self.exposure_us, self.count, mean, variance.astype(np.float32), self.light)


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
        When either is missing, frames differ in size, or the light is given for some only.

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
        if len({level.light is None for level in self.bright}) > 1:
            raise UsageError("the light is given for some of its exposures only", where="sensor series")
        object.__setattr__(self, "bright", tuple(sorted(self.bright, key=lambda each: each.amount)))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self.dark[0].mean.shape
        return int(height), int(width)


def saturation(signal: NDArray[np.float64], variance: NDArray[np.float64]) -> tuple[float | None, float]:
    """Signal of the plateau, None without one, and the signal up to which the variance increases.

    Parameters
    ----------
    signal, variance : ndarray (m,)
        Of levels with increasing light.

    Examples
    --------
    >>> saturation(np.array([50.0, 100.0, 200.0, 235.0]), np.array([5.0, 10.0, 20.0, 0.1]))
    (235.0, 200.0)
    """
    top = int(np.argmax(variance))
    for k in range(top + 1, len(signal)):
        if variance[k] < _COLLAPSED * variance[top]:
            return float(signal[k:].max()), float(signal[top])
    return None, float(signal.max()) / _LINEAR
