"""What all drivers do alike: one exchange at a time, one deadline, settings that outlive a connection."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Generic, Self, TypeVar

from ..core.errors import ConnectionLost, DeadlineError, InstrumentError, RefusedError, StateError
from .deadline import Deadline
from .settings import Limits, Settings
from .status import Status
from .values import Identity

__all__ = ["Device"]

S = TypeVar("S", bound=Settings)
T = TypeVar("T")

_GRACE_S = 1.0
"""How long an instrument that went away, or a call that is to end, is waited for."""


class Device(ABC, Generic[S]):
    """Base of drivers; a driver says how to open, to shut, to push settings, to ask who is there.

    Parameters
    ----------
    name : str
        On the bench; messages begin with it.
    settings : Settings
        Pushed on every connection.
    seconds : float
        Deadline of calls that name none.
    limits : mapping, optional
        Of settings, narrower than the instrument's own.

    Notes
    -----
    After a connection was lost, an answer was late or none, it is closed: the next call opens a new one and
    pushes the settings again, so that no answer to an earlier question can be taken for one to the next.
    """

    def __init__(
        self, name: str, settings: S, *, seconds: float = 10.0, limits: Limits | None = None
    ) -> None:
        self.name, self.parent = name, None
        self._limits = dict(limits or {})
        self._settings: S = settings.changed({}, self._limits)
        self._seconds = seconds
        self._lock, self._stopping = threading.RLock(), threading.Event()
        self._connected = False
        self._reading: dict[str, Any] = {}
        self.reconnections = 0
        """How often a connection has been made anew."""

    @abstractmethod
    def _open(self, deadline: Deadline) -> None:
        """Open the connection."""

    @abstractmethod
    def _shut(self) -> None:
        """Close the connection; may raise, and may be called when there is none."""

    @abstractmethod
    def _push(self, settings: S, deadline: Deadline) -> None:
        """Send settings."""

    @abstractmethod
    def _identify(self, deadline: Deadline) -> Identity:
        """Ask who is there."""

    @abstractmethod
    def _halt(self, deadline: Deadline) -> None:
        """Stop whatever moves, sends or records."""

    @abstractmethod
    def _acquire(self) -> dict[str, Any]:
        """Take a reading: values by name."""

    @abstractmethod
    def _kinds(self) -> dict[str, dict[str, Any]]:
        """What a reading holds: dtype, shape and units by name."""

    def _test(self, deadline: Deadline) -> dict[str, str]:
        """The test that the instrument can do of itself: what was tested, and what came out."""
        return {}

    @property
    def settings(self) -> S:
        """As they were pushed last, or will be with the next connection."""
        return self._settings

    @contextmanager
    def _exchange(self, command: str, seconds: float | None = None) -> Iterator[Deadline]:
        """The connection for oneself, opened if need be, until the deadline; names errors."""
        deadline = Deadline(self._seconds if seconds is None else seconds)
        if not self._lock.acquire(timeout=deadline.left):
            raise DeadlineError("was busy all the time", where=self.name, command=command)
        try:
            if not self._connected:
                self._establish(deadline)
            yield deadline
        except InstrumentError as error:
            # Refusals and states are answers; after anything else the connection cannot be trusted.
            if not isinstance(error, StateError | RefusedError):
                self._drop()
            raise self._named(error, command) from None
        except OSError as error:
            self._drop()
            raise ConnectionLost(
                f"the connection broke ({error})", where=self.name, command=command, do="is it switched on?"
            ) from None
        finally:
            self._lock.release()

    def _named(self, error: InstrumentError, command: str) -> InstrumentError:
        """The same error, which names the instrument and the command."""
        if error.instrument is not None:
            return error
        return type(error)(error.what, where=self.name, do=error.do, command=error.command or command)

    def _establish(self, deadline: Deadline) -> None:
        # What was there a moment ago may be back in a moment: a cable, a port that is made anew.
        grace = deadline.part(_GRACE_S) if self.reconnections else None
        try:
            while True:
                try:
                    self._open(deadline)
                    break
                except ConnectionLost:
                    if grace is None or grace.over:
                        raise
                    time.sleep(grace.at_most(0.05))
            self._push(self._settings, deadline)
        except InstrumentError:
            # Also one that is there and refuses: what is not connected is not kept from others.
            self._drop()
            raise
        self._connected = True
        self.reconnections += 1

    def _drop(self) -> None:
        self._connected = False
        with suppress(Exception):
            self._shut()

    def connect(self, seconds: float | None = None) -> Identity:
        """Connect, push the settings, and ask who it is.

        Raises
        ------
        InstrumentError
            When it cannot be reached or does not answer as it should.
        """
        with self._exchange("connect", seconds) as deadline:
            return self._identify(deadline)

    def check(self, seconds: float | None = None) -> dict[str, str]:
        """Test itself: who it is, its firmware, and what its driver adds; the deadline is of all together."""
        deadline = Deadline(self._seconds if seconds is None else seconds)
        found = self.connect(deadline.left)
        said = " ".join(part for part in (found.maker, found.model, found.serial) if part)
        told = {"identity": said or "unknown", "firmware": found.firmware or "not told"}
        return told | self._test(deadline)

    def close(self) -> None:
        """Let go of it; never raises."""
        self._stopping.set()
        # A call that goes on sees the flag; should it hang, its connection is taken from it all the same.
        got = self._lock.acquire(timeout=_GRACE_S)
        try:
            self._drop()
        finally:
            if got:
                self._lock.release()

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def stop(self, *, success: bool = False) -> None:
        """Stop whatever it does, from any thread; a call that goes on for more than a second is broken off.

        Raises
        ------
        InstrumentError
            When it could not be told so: it may still be moving.
        """
        self._stopping.set()
        if self._lock.acquire(timeout=_GRACE_S):
            self._lock.release()
        else:
            # A call hangs: its connection is taken from it, and a new one says stop.
            with suppress(Exception):
                self._shut()
        with self._exchange("stop") as deadline:
            self._halt(deadline)

    def configure(self, **changes: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Change settings.

        Returns
        -------
        (dict, dict)
            Readings of the old and of the new settings.

        Raises
        ------
        SettingError
            When there is no such setting or a value is beyond its limits; nothing was sent.
        """
        new, old = self._settings.changed(changes, self._limits), self.read_configuration()
        with self._exchange("configure") as deadline:
            self._push(new, deadline)
            self._settings = new
        return old, self.read_configuration()

    def stage(self) -> list[Any]:
        """Connect for a run."""
        self._stopping.clear()
        self.connect()
        return [self]

    def unstage(self) -> list[Any]:
        """Bring it to rest after a run; the connection stays."""
        self.stop()
        self._stopping.clear()
        return [self]

    def trigger(self) -> Status:
        """Take a reading in the background."""
        return Status(self._take, f"{self.name}.trigger")

    def _take(self) -> None:
        values, at = self._acquire(), time.time()
        self._reading = {name: {"value": value, "timestamp": at} for name, value in values.items()}

    def read(self) -> dict[str, Any]:
        """The last reading; takes one when there is none."""
        if not self._reading:
            self._take()
        return dict(self._reading)

    def describe(self) -> dict[str, Any]:
        """What a reading holds."""
        return {name: {"source": self.name, **kind} for name, kind in self._kinds().items()}

    def read_configuration(self) -> dict[str, Any]:
        """The settings as a reading."""
        at = time.time()
        return {
            f"{self.name}_{name}": {"value": value, "timestamp": at}
            for name, value in self._settings.to_dict().items()
        }

    def describe_configuration(self) -> dict[str, Any]:
        """What the reading of the settings holds."""
        units, limits = self._settings.units, self._settings.limits
        found: dict[str, Any] = {}
        for name, value in self._settings.to_dict().items():
            kind = "string" if isinstance(value, str) else "integer" if isinstance(value, int) else "number"
            found[f"{self.name}_{name}"] = {"source": self.name, "dtype": kind, "shape": []}
            if name in units:
                low, high = limits[name]
                found[f"{self.name}_{name}"] |= {
                    "units": units[name],
                    "limits": {"control": {"low": low, "high": high}},
                }
        return found

    def _until(
        self,
        ask: Callable[[], T],
        done: Callable[[T], bool],
        deadline: Deadline,
        pause_s: float,
        command: str,
    ) -> T:
        """Ask again and again until it is done; stops when told to."""
        while True:
            if self._stopping.is_set():
                raise StateError("was stopped", where=self.name, command=command)
            answer = ask()
            if done(answer):
                return answer
            if deadline.over:
                raise DeadlineError(
                    f"was not done within {deadline.seconds:g} s", where=self.name, command=command
                )
            self._stopping.wait(deadline.at_most(pause_s))
