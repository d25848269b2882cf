"""What is safe with any camera: whole frames, begun after they were asked for, and the lost ones counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Frame
from reseau.core.errors import DeadlineError, InstrumentError, RefusedError, StateError
from reseau.core.provenance import sha256_of
from reseau.instruments import Deadline, Device, Identity, Limits, Settings, quantity

from .clocks import TimeInterval, utc

__all__ = ["CameraDriver", "CameraExposure", "CameraInterface", "CameraSettings", "RawFrame"]

_SLICE_S = 0.05
"""How long one waits for a frame before looking whether one was told to stop."""
_CHECKED = 12
"""Frames of which :meth:`Camera.check` tells the rate."""


@dataclass(frozen=True)
class CameraSettings(Settings):
    """What all cameras have; 0, or a gain below 0, leaves it to the camera, as it was found."""

    exposure_us: float = quantity(0.0, "µs", 0.0, 1e8)
    gain: float = quantity(-1.0, "", -1.0, 1e6)
    rate: float = quantity(0.0, "1/s", 0.0, 1e5)
    left: int = quantity(0, "px", 0, 65535)
    top: int = quantity(0, "px", 0, 65535)
    width: int = quantity(0, "px", 0, 65535)
    height: int = quantity(0, "px", 0, 65535)
    buffers: int = quantity(4, "", 2, 64)


S = TypeVar("S", bound=CameraSettings)


@dataclass(frozen=True, eq=False)
class RawFrame:
    """A whole frame as a camera delivered it.

    Parameters
    ----------
    pixels : ndarray (height, width)
        Grey values, never converted; of a mosaic, all of them.
    full_scale : float
        At which they saturate.
    pattern : str
        Of colour, empty for grey.
    raw : bytes
        The frame where the grey values are not all of it.
    sequence : int
        Counted on without wrapping.
    began : TimeInterval
        When its exposure began.
    exposure_us, gain : float
        As the camera says; NaN where it does not.
    """

    pixels: NDArray[Any]
    full_scale: float
    pattern: str
    raw: bytes
    sequence: int
    began: TimeInterval
    exposure_us: float
    gain: float


class OriginalValues:
    """Values as they were found, by name.

    Examples
    --------
    >>> found, gain = OriginalValues(), 7
    >>> found.keep("gain", True, lambda: gain)
    7
    >>> gain = 3
    >>> found.keep("gain", True, lambda: gain), found.keep("gain", False), found.keep("gain", False)
    (7, 7, None)
    """

    def __init__(self) -> None:
        self._values: dict[Hashable, Any] = {}

    def keep(self, name: Hashable, given: bool, now: Callable[[], Any] | None = None) -> Any:
        """What there was before it was changed; None where it was not.

        Parameters
        ----------
        name : hashable
            Of the setting.
        given : bool
            Whether it is changed now; otherwise what there was is to be brought back, and forgotten.
        now : callable, optional
            Asks for what there is, when it is changed for the first time.
        """
        if not given:
            return self._values.pop(name, None)
        if name not in self._values and now is not None:
            self._values[name] = now()
        return self._values.get(name)


class CameraInterface(Protocol[S]):
    """What a camera does on its own interface."""

    @property
    def dropped(self) -> int:
        """Frames that were exposed, and lost or damaged on the way, since the camera was opened."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of its frames."""

    def open(self, deadline: Deadline) -> None:
        """Open it anew."""

    def close(self) -> None:
        """Close it, if it is open; may be called from another thread."""

    def identify(self, deadline: Deadline) -> Identity:
        """Who it is."""

    def apply(self, settings: S, deadline: Deadline) -> None:
        """Have it set so; it stops for that."""

    def dark(self, settings: S) -> S:
        """Settings with the shortest exposure that it can."""

    def start(self, deadline: Deadline) -> None:
        """Have it deliver frames, if it does not yet."""

    def request(self, deadline: Deadline) -> None:
        """Trigger it by software, where it is set to be; frames of before are let go."""

    def take(self, deadline: Deadline) -> RawFrame | None:
        """The next whole frame that is newer than the last; None when there is none by then."""

    def halt(self) -> None:
        """Have it stop."""

    def clock(self, deadline: Deadline) -> str:
        """How its clock stands to that of this machine."""


@dataclass(frozen=True, eq=False)
class CameraExposure:
    """A frame with what is known of it; see :class:`reseau.instruments.Exposure`."""

    taken: datetime
    taken_within_s: float
    fresh: bool
    sequence: int
    dropped: int
    exposure_us: float
    gain: float
    pattern: str
    pixels: NDArray[Any]
    full_scale: float
    raw: bytes
    name: str

    @cached_property
    def frame(self) -> Frame:
        """The image; its hash is that of the raw frame where there is one."""
        return Frame(self.pixels, self.full_scale, self.name, sha256_of(self.raw or self.pixels.tobytes()))


class CameraDriver(Device[S]):
    """A camera.

    Parameters
    ----------
    name : str
        On the bench.
    source : CameraInterface
        Its interface.
    settings : CameraSettings
        Pushed on every connection.
    seconds : float
        Deadline of calls that name none.
    limits : mapping, optional
        Of settings.

    Attributes
    ----------
    skipped : int
        Frames that had begun before they were asked for, and were not handed out.
    """

    def __init__(
        self,
        name: str,
        source: CameraInterface[S],
        settings: S,
        *,
        seconds: float = 5.0,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(name, settings, seconds=seconds, limits=limits)
        self._source = source
        self.skipped = 0

    def _open(self, deadline: Deadline) -> None:
        self._source.open(deadline)

    def _disconnect(self) -> None:
        self._source.close()

    def _push(self, settings: S, deadline: Deadline) -> None:
        try:
            self._source.apply(settings, deadline)
        except RefusedError:
            # A part of them it may have taken: as it was before, or not at all.
            if self._connected:
                with suppress(InstrumentError):
                    self._source.apply(self._settings, deadline)
            raise

    def _identify(self, deadline: Deadline) -> Identity:
        return self._source.identify(deadline)

    def _halt(self, deadline: Deadline) -> None:
        self._source.halt()

    def _acquire(self) -> dict[str, Any]:
        shot = self.expose()
        return {
            f"{self.name}_image": shot.pixels,
            f"{self.name}_sequence": shot.sequence,
            f"{self.name}_dropped": shot.dropped,
        }

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        return {
            f"{self.name}_image": {"dtype": "array", "shape": list(self._source.shape)},
            f"{self.name}_sequence": {"dtype": "integer", "shape": []},
            f"{self.name}_dropped": {"dtype": "integer", "shape": []},
        }

    def expose(self, seconds: float | None = None) -> CameraExposure:
        """A frame whose exposure began after this call.

        Raises
        ------
        DeadlineError
            When none came in time, or none but such that had begun before.
        RefusedError
            When the camera is another's.
        StateError
            When it was stopped.
        InstrumentError
            When it went away, or sends what is no frame.
        """
        self._stopping.clear()
        with self._exchange("expose", seconds) as deadline:
            return self._next(deadline, stale=False)

    def frames(self, count: int, seconds: float | None = None) -> Iterator[CameraExposure]:
        """Frames one after the other, as the camera delivers them; each says whether it is fresh.

        Parameters
        ----------
        count : int
            How many.
        seconds : float, optional
            Deadline of each.

        Raises
        ------
        InstrumentError
            As :meth:`expose`.
        """
        self._stopping.clear()
        for _ in range(count):
            with self._exchange("frames", seconds) as deadline:
                shot = self._next(deadline, stale=True)
            yield shot

    def _next(self, deadline: Deadline, *, stale: bool) -> CameraExposure:
        self._source.start(deadline)
        asked, passed = time.monotonic_ns(), 0
        self._source.request(deadline)
        while True:
            if self._stopping.is_set():
                raise StateError("was stopped")
            taken = self._source.take(deadline.part(_SLICE_S))
            if taken is not None:
                fresh = taken.began.earliest >= asked
                if fresh or stale:
                    return self._shot(taken, fresh)
                self.skipped += 1
                passed += 1
            if deadline.expired:
                seen = f"; {passed} came that may have begun before it was asked for" if passed else ""
                raise DeadlineError(
                    f"delivered no new frame within {deadline.seconds:g} s{seen}",
                    do="is it triggered, and the exposure shorter than that?",
                )

    def _shot(self, taken: RawFrame, fresh: bool) -> CameraExposure:
        at, within = utc(taken.began)
        return CameraExposure(
            at,
            within,
            fresh,
            taken.sequence,
            self._source.dropped,
            taken.exposure_us,
            taken.gain,
            taken.pattern,
            taken.pixels,
            taken.full_scale,
            taken.raw,
            f"{self.name}-{taken.sequence}",
        )

    def check(self, seconds: float | None = None) -> dict[str, str]:
        """Who it is; frame rate, lost frames, clock; noise of frames at the shortest exposure.

        The noise is that of the difference of two frames, over √2: no pattern that stays is in it. For that
        of the dark the lens is to be covered.
        """
        deadline = Deadline(self._seconds if seconds is None else seconds)
        found = {"identity": str(self.connect(deadline.left or 1e-3))}
        shots = list(self.frames(_CHECKED, deadline.left or 1e-3))
        elapsed = (shots[-1].taken - shots[0].taken).total_seconds()
        steps = shots[-1].sequence - shots[0].sequence
        height, width = shots[0].pixels.shape
        found["frames"] = f"{width} × {height}, {steps / elapsed if elapsed > 0 else np.nan:.4g} 1/s"
        found["dropped"] = f"{shots[-1].dropped - shots[0].dropped} of {steps + 1}"
        found["clock"] = (
            f"start of exposure within ± {shots[-1].taken_within_s * 1e3:.3g} ms; "
            + self._exchanged(self._source.clock, "clock", deadline)
        )
        before, shortest = self.settings, self._source.dark(self.settings)
        try:
            self.configure(**_differences(before, shortest))
            one, two = (self.expose(deadline.left or 1e-3).pixels.astype(np.float64) for _ in range(2))
        finally:
            self.configure(**_differences(shortest, before))
        noise = (one - two).std() / np.sqrt(2)
        found["dark"] = f"mean {(one + two).mean() / 2:.3g}, noise {noise:.3g} at the shortest exposure"
        return found

    def _exchanged(self, ask: Callable[[Deadline], str], command: str, deadline: Deadline) -> str:
        with self._exchange(command, deadline.left or 1e-3) as part:
            return ask(part)


def _differences(old: CameraSettings, new: CameraSettings) -> dict[str, Any]:
    before = old.to_dict()
    return {name: value for name, value in new.to_dict().items() if value != before[name]}
