"""Base of all camera drivers: complete frames, exposed after the request, and a count of lost frames."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Frame, filters_of
from reseau.core.errors import DeadlineError, InstrumentError, RefusedError, StateError
from reseau.core.provenance import sha256_of
from reseau.instruments import Deadline, Device, Identity, Limits, Settings, quantity

from .clocks import TimeInterval, utc
from .features import Feature, differences, matching

_SLICE_S = 0.05
"""Time to wait for a frame before checking for a stop request (s)."""
Ready = Callable[[], tuple[int, bool]]
"""Since when all cameras of a rig wait (monotonic clock, ns), and whether they are triggered for it."""
_CHECKED = 12
"""Number of frames from which :meth:`CameraDriver.check` computes the frame rate."""


class Together(Protocol):
    """What the cameras of a rig wait in for each other."""

    def wait(self) -> tuple[int, bool]:
        """Wait until all cameras wait for their trigger, before a software trigger is sent.

        Returns
        -------
        int, bool
            Since when all wait (monotonic clock, ns), and whether this, or what follows, triggers the camera.
        """

    def agrees(self, began: TimeInterval, before: TimeInterval | None) -> bool:
        """Wait until all cameras have a frame; return whether this one was exposed with those of the others.

        Parameters
        ----------
        began : TimeInterval
            Start of its exposure.
        before : TimeInterval, optional
            That of the last frame before it, which had begun too early.
        """


@dataclass(frozen=True)
class CameraSettings(Settings):
    """Settings of all cameras; 0, or a gain below 0, keeps the value that the camera had when it was opened.

    Exposure time in µs, frame rate in 1/s, region in pixels, number of frame buffers.

    Examples
    --------
    >>> CameraSettings(exposure_us=5000.0).units["exposure_us"]
    'µs'
    """

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
    """Complete frame as a camera delivered it.

    Parameters
    ----------
    pixels : ndarray (height, width)
        Grey values without conversion; of a colour mosaic, all raw pixels.
    full_scale : float
        Grey value at saturation.
    pattern : str
        Colour pattern; empty for grey.
    raw : bytes
        Original frame if the grey values do not contain all of it (YUYV, UYVY, NV12, MJPEG).
    sequence : int
        Frame number, counted without wrapping.
    began : TimeInterval
        Interval that contains the start of the exposure (ns).
    exposure_us, gain : float
        Exposure time (µs) and gain as reported by the camera; NaN if it does not report them.

    Examples
    --------
    >>> from reseau_drivers.camera.clocks import TimeInterval
    >>> frame = RawFrame(np.zeros((2, 3), np.uint8), 255.0, "", b"", 7, TimeInterval(100, 120), 5000.0, 0.0)
    >>> frame.sequence, frame.began.latest - frame.began.earliest
    (7, 20)
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
    """Values that a camera had before the driver changed them, so that they can be restored.

    Examples
    --------
    >>> original, gain = OriginalValues(), 7
    >>> original.keep("gain", True, lambda: gain)
    7
    >>> gain = 3
    >>> original.keep("gain", True, lambda: gain), original.keep("gain", False), original.keep("gain", False)
    (7, 7, None)
    """

    def __init__(self) -> None:
        self._values: dict[Hashable, Any] = {}

    def keep(self, name: Hashable, given: bool, now: Callable[[], Any] | None = None) -> Any:
        """Return the value before the first change; None if the setting was not changed.

        Parameters
        ----------
        name : hashable
            Name of the setting.
        given : bool
            Whether the setting is changed now. If not, the original value is returned once, to be restored.
        now : callable, optional
            Reads the current value; called before the first change.
        """
        if not given:
            return self._values.pop(name, None)
        if name not in self._values and now is not None:
            self._values[name] = now()
        return self._values.get(name)


class CameraInterface(Protocol[S]):
    """Operations of a camera on its own interface (Video4Linux, GenICam).

    Examples
    --------
    >>> from reseau_drivers.camera import Aravis
    >>> all(hasattr(Aravis, name) for name in ("open", "apply", "start", "take", "halt"))
    True
    """

    @property
    def dropped(self) -> int:
        """Number of exposed frames that were lost or damaged since the camera was opened."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the frames (px)."""

    def open(self, deadline: Deadline) -> None:
        """Open the camera; an open one is closed before."""

    def close(self) -> None:
        """Close the camera if it is open; may be called from another thread."""

    def identify(self, deadline: Deadline) -> Identity:
        """Return the identity."""

    def apply(self, settings: S, deadline: Deadline) -> None:
        """Stop the acquisition and apply settings."""

    def dark(self, settings: S) -> S:
        """Return the settings with the shortest possible exposure."""

    def start(self, deadline: Deadline) -> None:
        """Start the acquisition if it is not running."""

    def request(self, deadline: Deadline, ready: Ready | None = None) -> int:
        """Send a software trigger if configured; frames exposed before are discarded.

        Parameters
        ----------
        deadline : Deadline
            Time limit.
        ready : callable, optional
            Called when the camera waits for its trigger; see :meth:`CameraDriver.expose`.

        Returns
        -------
        int
            Time of the monotonic clock (ns); an exposure that started at it or later is fresh.
        """

    def take(self, deadline: Deadline) -> RawFrame | None:
        """Return the next complete frame that is newer than the last; None if none arrives in time."""

    def halt(self) -> None:
        """Stop the acquisition."""

    def clock(self, deadline: Deadline) -> str:
        """Describe the relation of the camera's clock to that of the computer."""


@dataclass(frozen=True, eq=False)
class CameraExposure:
    """Frame with its time and settings; implements :class:`reseau.instruments.Exposure`.

    Examples
    --------
    >>> from datetime import UTC
    >>> pixels = np.zeros((2, 3), np.uint8)
    >>> at = datetime(2026, 1, 1, tzinfo=UTC)
    >>> shot = CameraExposure(at, 1e-3, True, 7, 0, 5000.0, 0.0, "", pixels, 255.0, b"", "camera-7")
    >>> shot.frame.width, shot.frame.name
    (3, 'camera-7')
    """

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
        """Image; its hash is that of the original frame if there is one."""
        digest = sha256_of(self.raw or self.pixels.tobytes())
        return Frame(self.pixels, self.full_scale, self.name, digest, filters=filters_of(self.pattern))


class CameraDriver(Device[S]):
    """Driver of a camera.

    Parameters
    ----------
    name : str
        Name on the bench.
    source : CameraInterface
        Interface of the camera.
    settings : CameraSettings
        Sent on every connection.
    seconds : float
        Time limit of calls that do not specify one (s).
    limits : mapping, optional
        Limits of settings.

    Attributes
    ----------
    skipped : int
        Number of frames not returned because their exposure started before the request.

    Examples
    --------
    >>> from reseau_drivers.camera import v4l2
    >>> camera = v4l2("eye", "/dev/video0")
    >>> type(camera).__name__, camera.name, camera.skipped
    ('CameraDriver', 'eye', 0)
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

    @property
    def host(self) -> str:
        """IP address of a connected GigE Vision camera.

        Raises
        ------
        RefusedError
            If it is another camera.
        """
        host = getattr(self._source, "host", None)
        if not isinstance(host, str):
            raise RefusedError("has no IP address", where=self.name)
        return host

    def _genicam(self, ask: Callable[[Any], Any], command: str) -> Any:
        """The answer of a GenICam camera."""
        if not hasattr(self._source, "user_sets"):
            raise RefusedError("has no GenICam features", where=self.name, command=command)
        with self._exchange(command):
            return ask(self._source)

    def features(self, search: str = "") -> list[Feature]:
        """Return the features of a GenICam camera, with ranges, units and present values.

        Parameters
        ----------
        search : str
            Only those whose name, category, unit, entries or description contain this text.

        Raises
        ------
        RefusedError
            If the camera has no GenICam features.
        InstrumentError
            If the connection is lost.
        """
        found: list[Feature] = self._genicam(lambda source: source.features(), "features")
        return matching(found, search)

    def set_features(self, wanted: Mapping[str, str]) -> None:
        """Set features of a GenICam camera; the settings of this driver are not changed by it.

        Raises
        ------
        RefusedError
            If a feature does not exist, is read only, or a value is outside its range.
        """
        self._genicam(lambda source: source.set_features(wanted), "set features")

    def user_sets(self) -> tuple[str, ...]:
        """Return the names of the sets of values that a GenICam camera keeps without power."""
        found: tuple[str, ...] = self._genicam(lambda source: source.user_sets(), "user sets")
        return found

    def save_user_set(self, name: str) -> None:
        """Keep the present values of all features in a user set of the camera; raises as :meth:`features`."""
        self._genicam(lambda source: source.save_user_set(name), "save user set")

    def user_set(self, name: str) -> dict[str, str]:
        """Return the values of a user set; the present values of the camera are set again afterwards.

        The set is loaded for it: what was not saved, and is not among the settings, is read before.
        """

        def values(source: Any) -> dict[str, str]:
            before = _writable(source.features())
            source.load_user_set(name)
            found = _writable(source.features())
            changed = {key: value for key, value in before.items() if found.get(key) != value}
            source.set_features(changed)
            return found

        loaded: dict[str, str] = self._genicam(values, "user set")
        return loaded

    def compare_user_sets(self, one: str, other: str = "") -> dict[str, tuple[str, str]]:
        """Return the features with different values in two user sets, or in one and at present.

        Raises
        ------
        RefusedError
            If there is no such user set.
        """
        present = _writable(self.features())
        return differences(self.user_set(one), self.user_set(other) if other else present)

    def _open(self, deadline: Deadline) -> None:
        self._source.open(deadline)

    def _disconnect(self) -> None:
        self._source.close()

    def _push(self, settings: S, deadline: Deadline) -> None:
        try:
            self._source.apply(settings, deadline)
        except RefusedError:
            # The camera may have accepted some of the settings: restore the previous ones.
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

    def expose(self, seconds: float | None = None, *, together: Together | None = None) -> CameraExposure:
        """Return a frame whose exposure started after this call.

        Parameters
        ----------
        seconds : float, optional
            Time limit (s).
        together : Together, optional
            What cameras of a rig wait in for each other, and choose their frames by.

        Raises
        ------
        DeadlineError
            If no frame arrives in time, or only frames whose exposure started before the call.
        RefusedError
            If another program uses the camera.
        StateError
            If the camera was stopped.
        InstrumentError
            If the connection is lost or the data are not a valid frame.
        """
        self._begin("expose")
        with self._exchange("expose", seconds) as deadline:
            return self._next(deadline, stale=False, together=together)

    def frames(self, count: int, seconds: float | None = None) -> Iterator[CameraExposure]:
        """Yield consecutive frames as the camera delivers them; each states whether it is fresh.

        Parameters
        ----------
        count : int
            Number of frames.
        seconds : float, optional
            Time limit of each frame (s).

        Raises
        ------
        InstrumentError
            As :meth:`expose`.
        """
        self._begin("frames")
        for _ in range(count):
            with self._exchange("frames", seconds) as deadline:
                shot = self._next(deadline, stale=True)
            yield shot

    def _next(self, deadline: Deadline, *, stale: bool, together: Together | None = None) -> CameraExposure:
        self._source.start(deadline)
        asked, passed = self._source.request(deadline, None if together is None else together.wait), 0
        before: TimeInterval | None = None
        while True:
            if self._stopping.is_set():
                raise StateError("was stopped")
            taken = self._source.take(deadline.part(_SLICE_S))
            if taken is not None:
                fresh = taken.began.earliest >= asked
                if fresh and together is not None and not together.agrees(taken.began, before):
                    fresh, together = False, None
                if fresh or stale:
                    return self._shot(taken, fresh)
                before = taken.began
                self.skipped += 1
                passed += 1
            if deadline.expired:
                seen = f"; {passed} frames may have started before the request" if passed else ""
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
        """Test the camera: identity, frame rate, lost frames, clock, and noise at the shortest exposure.

        The noise is the standard deviation of the difference of two frames, divided by √2, so that fixed
        patterns cancel. Cover the lens to measure the dark noise. Where no time is given, each frame may take
        as long as the exposure of one.
        """
        deadline = None if seconds is None else Deadline(seconds)

        def left() -> float | None:
            return None if deadline is None else deadline.left

        found = {"identity": str(self.connect(left()))}
        shots = list(self.frames(_CHECKED, left()))
        elapsed = (shots[-1].taken - shots[0].taken).total_seconds()
        steps = shots[-1].sequence - shots[0].sequence
        height, width = shots[0].pixels.shape
        found["frames"] = f"{width} × {height}, {steps / elapsed if elapsed > 0 else np.nan:.4g} 1/s"
        found["dropped"] = f"{shots[-1].dropped - shots[0].dropped} of {steps + 1}"
        with self._exchange("clock", left()) as part:
            clock = self._source.clock(part)
        found["clock"] = f"start of exposure within ± {shots[-1].taken_within_s * 1e3:.3g} ms; {clock}"
        before, shortest = self.settings, self._source.dark(self.settings)
        try:
            self.configure(**_differences(before, shortest))
            one, two = (self.expose(left()).pixels.astype(np.float64) for _ in range(2))
        finally:
            self.configure(**_differences(shortest, before))
        noise = (one - two).std() / np.sqrt(2)
        found["dark"] = f"mean {(one + two).mean() / 2:.3g}, noise {noise:.3g} at the shortest exposure"
        return found


def _writable(features: list[Feature]) -> dict[str, str]:
    """Values of the features that can be set again."""
    skipped = ("UserSetSelector", "TLParamsLocked")
    return {
        each.name: each.value
        for each in features
        if each.writable
        and each.value
        and each.kind not in ("command", "register")
        and each.name not in skipped
        and not each.name.startswith("Gev")
    }


def _differences(old: CameraSettings, new: CameraSettings) -> dict[str, Any]:
    before = old.to_dict()
    return {name: value for name, value in new.to_dict().items() if value != before[name]}
