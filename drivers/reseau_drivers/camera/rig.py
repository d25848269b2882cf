"""Several cameras that expose at once: by software triggers, a hardware line, or one action command.

Every camera is first made to wait for its trigger, with all earlier frames discarded; then all are triggered.
The skew of the exposures is measured by the cameras' clocks, which are read before (see
:mod:`~reseau_drivers.camera.clocks`).
"""

from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from reseau.core.errors import InstrumentError, RefusedError, SettingError, StateError
from reseau.instruments import (
    Camera,
    Deadline,
    Device,
    ExposureSet,
    Identity,
    Instrument,
    Settings,
    choice,
    quantity,
    text,
)

from .camera import CameraExposure
from .clocks import TimeInterval
from .gvcp import send_action


@dataclass(frozen=True)
class RigSettings(Settings):
    """How the cameras of a rig are triggered, and the largest skew of a usable set of frames; 0: no limit.

    ``software``: each camera by its own software trigger, or the next frame of one that runs freely.
    ``action``: one action command of GigE Vision to all. ``hardware``: a line to all cameras; with `lead`,
    the named camera drives it, and is exposed as its own settings say.

    Examples
    --------
    >>> RigSettings(trigger="hardware", lead="left").skew_us
    0.0
    """

    trigger: str = choice("software", "software", "hardware", "action")
    lead: str = text("")
    skew_us: float = quantity(0.0, "µs", 0.0, 1e9)


class Rig(Device[RigSettings]):
    """Cameras of a bench that expose at once.

    Parameters
    ----------
    name : str
        Name on the bench.
    cameras : sequence of str
        Names of the cameras, at least two. The first is the reference of the others in calibrations.
    settings : RigSettings, optional
        How they are triggered.
    seconds : float
        Time limit of calls that do not specify one (s).

    Raises
    ------
    SettingError
        If there are fewer than two cameras, or one is named twice.

    Examples
    --------
    >>> rig = Rig("rig", ["left", "right"])
    >>> rig.cameras, rig.uses
    (('left', 'right'), ('left', 'right'))
    """

    composed = True
    """It consists of other instruments of the bench: its address is that of none."""

    def __init__(
        self,
        name: str,
        cameras: tuple[str, ...] | list[str],
        settings: RigSettings | None = None,
        *,
        seconds: float = 10.0,
        limits: Any = None,
    ) -> None:
        super().__init__(name, settings or RigSettings(), seconds=seconds, limits=limits)
        self.cameras = tuple(cameras)
        if len(self.cameras) < 2 or len(set(self.cameras)) < len(self.cameras):
            raise SettingError(
                f"{', '.join(self.cameras) or 'nothing'}: two or more cameras are needed, each once",
                where=name, do='write their names, as address = "left, right"',
            )  # fmt: skip
        self._members: dict[str, Any] = {}

    @property
    def uses(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self.cameras

    @property
    def largest_skew_s(self) -> float:
        """Largest skew of a usable set of frames (s); infinite without a limit."""
        return self._settings.skew_us * 1e-6 or float("inf")

    def combine(self, instruments: Mapping[str, Instrument]) -> None:
        """Find the cameras among the instruments of the bench.

        Raises
        ------
        SettingError
            If one is missing, is no camera, or cannot be triggered as the rig is.
        """
        for each in self.cameras:
            found: Any = instruments.get(each)
            if not isinstance(found, Camera):
                raise SettingError(f"{each!r} is not a camera on this bench", where=self.name)
            if "together" not in inspect.signature(found.expose).parameters:
                raise SettingError(f"the driver of {each!r} cannot be part of a rig", where=self.name)
            self._members[each] = found
        self._require_triggers(self._settings)

    def _require_triggers(self, settings: RigSettings) -> None:
        """Raise if a camera is not set to the trigger of the rig."""
        lead = settings.lead
        if lead and (settings.trigger != "hardware" or lead not in self.cameras):
            raise SettingError(
                f"lead {lead!r} is not one of {', '.join(self.cameras)} on a hardware line", where=self.name
            )
        for name, camera in self._members.items():
            own = camera.settings.to_dict().get("trigger", "off")
            if settings.trigger == "hardware":
                fits = own != "hardware" if name == lead else own == "hardware"
                needed = "software" if name == lead else "hardware"
            elif settings.trigger == "action":
                fits, needed = own == "action", "action"
            else:
                fits, needed = own in ("off", "software"), "software"
            if not fits:
                raise SettingError(
                    f"camera {name} has trigger = {own!r}", where=self.name,
                    do=f"set trigger = {needed!r} in its settings: the rig triggers by {settings.trigger}",
                )  # fmt: skip
        if settings.trigger == "action":
            keys = {
                (c.settings.action.device_key, c.settings.action.group_key) for c in self._members.values()
            }
            if len(keys) > 1:
                raise SettingError(
                    "its cameras have different action keys", where=self.name, do="use the same"
                )

    def expose_all(self, seconds: float | None = None) -> ExposureSet:
        """Return a frame of each camera, of one exposure that started after this call.

        Parameters
        ----------
        seconds : float, optional
            Time limit (s).

        Raises
        ------
        InstrumentError
            If a camera fails, or delivers no frame in time; the frames of the others are discarded.
        """
        self._begin("expose")
        with self._exchange("expose", seconds) as deadline:
            return self._exposed(deadline)

    def _exposed(self, deadline: Deadline) -> ExposureSet:
        fired = self._settings.trigger == "action" or self._leads_by_software()
        exposure = _OneExposure(len(self._members), deadline, self._fire, fired)

        def expose(name: str) -> CameraExposure:
            member = _Member(name, exposure)
            try:
                shot: CameraExposure = self._members[name].expose(deadline.left, together=member)
            except threading.BrokenBarrierError:
                raise _Unready("was not triggered: another camera was not ready", where=name) from None
            finally:
                member.leave()
            return shot

        with ThreadPoolExecutor(len(self._members), self.name) as pool:
            tasks = {name: pool.submit(expose, name) for name in self._members}
            errors = [error for task in tasks.values() if (error := task.exception()) is not None]
        for error in sorted(errors, key=lambda each: isinstance(each, _Unready)):
            raise error
        return ExposureSet({name: task.result() for name, task in tasks.items()})

    def _leads_by_software(self) -> bool:
        """Whether a camera that is triggered with the others drives the line to them."""
        lead = self._members.get(self._settings.lead)
        return lead is not None and lead.settings.to_dict().get("trigger") == "software"

    def _fire(self) -> None:
        """Trigger the cameras that do not trigger themselves; all of them wait."""
        if self._settings.trigger == "action":
            first = next(iter(self._members.values()))
            send_action([each.host for each in self._members.values()], first.settings.action)

    def _open(self, deadline: Deadline) -> None:
        """Nothing: each camera has its own connection."""

    def _disconnect(self) -> None:
        """Nothing: each camera has its own connection."""

    def _push(self, settings: RigSettings, deadline: Deadline) -> None:
        try:
            self._require_triggers(settings)
        except SettingError as error:
            raise RefusedError(error.what, do=error.do) from None

    def _identify(self, deadline: Deadline) -> Identity:
        return Identity("rig of", ", ".join(self.cameras))

    def _halt(self, deadline: Deadline) -> None:
        failures = []
        for each in self._members.values():
            try:
                each.stop()
            except InstrumentError as error:
                failures.append(error)
        if failures:
            raise failures[0]

    def _test(self, deadline: Deadline) -> dict[str, str]:
        """Expose, and report the skew."""
        skew, within = self.expose_all(deadline.left).skew
        return {"trigger": self._settings.trigger, "skew": f"{1e3 * skew:.3g} ± {1e3 * within:.2g} ms"}

    def _acquire(self) -> dict[str, Any]:
        taken = self.expose_all()
        images = {f"{self.name}_{name}_image": each.frame.pixels for name, each in taken.exposures.items()}
        skew, within = taken.skew
        return images | {f"{self.name}_skew_s": skew, f"{self.name}_skew_within_s": within}

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        images = {
            f"{self.name}_{name}_image": each.describe()[f"{name}_image"]
            for name, each in self._members.items()
        }
        number = {"dtype": "number", "shape": [], "units": "s"}
        shapes = {key: {"dtype": "array", "shape": list(each["shape"][1:])} for key, each in images.items()}
        return {**shapes, f"{self.name}_skew_s": number, f"{self.name}_skew_within_s": number}


class _Unready(StateError):
    """A camera that was not triggered, because another one failed."""


class _OneExposure:
    """Where the cameras of a rig wait for each other, and the starts of their exposures."""

    def __init__(self, count: int, deadline: Deadline, fire: Callable[[], None], fired: bool) -> None:
        self.deadline, self.fired, self.since = deadline, fired, 0
        self.starts = dict[str, tuple[TimeInterval, TimeInterval | None]]()
        self._fire = fire
        self.ready, self.seen = threading.Barrier(count, self._all_wait), threading.Barrier(count)

    def _all_wait(self) -> None:
        self.since = time.monotonic_ns()
        self._fire()


class _Member:
    """A camera of a rig during an exposure; implements :class:`~reseau_drivers.camera.camera.Together`."""

    def __init__(self, name: str, exposure: _OneExposure) -> None:
        self._name, self._exposure = name, exposure
        self._ahead = [exposure.ready, exposure.seen]

    def _pass(self) -> None:
        self._ahead[0].wait(self._exposure.deadline.left)
        del self._ahead[0]

    def wait(self) -> tuple[int, bool]:
        self._pass()
        return self._exposure.since, self._exposure.fired

    def agrees(self, began: TimeInterval, before: TimeInterval | None) -> bool:
        # A pulse of others may have come when only some cameras waited, or while delays of triggers differ:
        # where a frame is nearer to one that another camera passed over, it belongs to the pulse before.
        if self._exposure.fired:
            return True
        starts = self._exposure.starts
        starts[self._name] = began, before
        self._pass()
        return all(
            passed is None or abs(began.middle - own.middle) <= abs(began.middle - passed.middle)
            for name, (own, passed) in starts.items()
            if name != self._name
        )

    def leave(self) -> None:
        """Let nobody wait for this camera."""
        for each in self._ahead:
            each.abort()
