"""Base class of drivers: exclusive access, one time limit per call, settings restored on reconnection."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, Generic, Self, TypeVar

import numpy as np

from ..core.errors import ConnectionLost, DeadlineError, InstrumentError, RefusedError, StateError
from .assets import ImageStore
from .deadline import Deadline
from .monitor import Monitor
from .settings import Limits, Settings
from .status import Status
from .values import Identity

S = TypeVar("S", bound=Settings)
T = TypeVar("T")

_GRACE_S = 1.0
"""Time to wait for an instrument that has disappeared, or for a call that has to end (s)."""


class Device(ABC, Generic[S]):
    """Base class of drivers.

    A driver implements how to open and close the connection, send settings, identify the instrument, stop it
    and take a reading.

    Parameters
    ----------
    name : str
        Name on the bench; error messages begin with it.
    settings : Settings
        Sent on every connection.
    seconds : float
        Time limit of calls that do not specify one (s).
    limits : mapping, optional
        Limits of settings, narrower than those of the instrument.

    Notes
    -----
    After a lost connection, a late answer or no answer, the connection is closed. The next call opens a new
    one and sends the settings again, so that an answer to an earlier query cannot be taken for the answer to
    a later one.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from reseau.instruments import quantity
    >>> @dataclass(frozen=True)
    ... class Rate(Settings):
    ...     rate: float = quantity(1.0, "1/s", 0.1, 10.0)
    >>> class Counter(Device[Rate]):
    ...     def _open(self, deadline): pass
    ...     def _disconnect(self): pass
    ...     def _push(self, settings, deadline): pass
    ...     def _identify(self, deadline): return Identity("reseau", "counter")
    ...     def _halt(self, deadline): pass
    ...     def _acquire(self): return {"count": 3}
    ...     def _reading_format(self): return {"count": {"dtype": "integer", "shape": []}}
    >>> with Counter("counter", Rate()) as counter:
    ...     counter.configure(rate=2.0)[1]["counter_rate"]["value"], counter.read()["count"]["value"]
    (2.0, 3)
    """

    def __init__(
        self, name: str, settings: S, *, seconds: float = 10.0, limits: Limits | None = None
    ) -> None:
        self.name, self.parent = name, None
        self._limits = dict(limits or {})
        self._settings: S = settings.changed({}, self._limits)
        self._seconds = seconds
        self._lock, self._stopping = threading.RLock(), threading.Event()
        self._connected = self._staged = False
        self._reading: dict[str, Any] = {}
        self._read_once = False
        self.images = ImageStore(name)
        """Files of the images among readings, to which bluesky's documents refer."""
        self._monitor = Monitor(self._read_now)
        self.reconnections = 0
        """Number of connections made, the first included."""

    @abstractmethod
    def _open(self, deadline: Deadline) -> None:
        """Open the connection."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Close the connection; may raise, and may be called without a connection."""

    @abstractmethod
    def _push(self, settings: S, deadline: Deadline) -> None:
        """Send settings."""

    @abstractmethod
    def _identify(self, deadline: Deadline) -> Identity:
        """Query the identity."""

    @abstractmethod
    def _halt(self, deadline: Deadline) -> None:
        """Stop any movement, transmission or recording."""

    @abstractmethod
    def _acquire(self) -> dict[str, Any]:
        """Take a reading and return its values by name."""

    @abstractmethod
    def _reading_format(self) -> dict[str, dict[str, Any]]:
        """Return type, shape and unit of each value of a reading, by name."""

    def _test(self, deadline: Deadline) -> dict[str, str]:
        """Run the instrument's self-test; return results by name of the test."""
        return {}

    @property
    def settings(self) -> S:
        """Settings as last sent, or as they will be sent on the next connection."""
        return self._settings

    @contextmanager
    def _exchange(self, command: str, seconds: float | None = None) -> Iterator[Deadline]:
        """Reserve the connection, open it if necessary, and add instrument and command to errors."""
        deadline = Deadline(self._seconds if seconds is None else seconds)
        if deadline.expired:  # part of a call that has used up its time
            raise DeadlineError(_late(deadline), where=self.name, command=command)
        if not self._lock.acquire(timeout=deadline.left):
            raise DeadlineError("was busy until the deadline", where=self.name, command=command)
        try:
            if not self._connected:
                self._connect_and_configure(deadline)
            yield deadline
        except InstrumentError as error:
            # Refusals and state errors are valid answers; after any other error the connection is unreliable.
            if not isinstance(error, StateError | RefusedError):
                self._drop()
            raise self._with_context(error, command) from None
        except OSError as error:
            self._drop()
            raise ConnectionLost(
                f"the connection was lost ({error})",
                where=self.name,
                command=command,
                do="is it switched on?",
            ) from None
        finally:
            self._lock.release()

    def _with_context(self, error: InstrumentError, command: str) -> InstrumentError:
        """Return the same error with the name of the instrument and the command."""
        if error.instrument is not None:
            return error
        return type(error)(error.what, where=self.name, do=error.do, command=error.command or command)

    def _connect_and_configure(self, deadline: Deadline) -> None:
        # An instrument that has just disappeared may return soon: a loose cable, a port that is recreated.
        grace = deadline.part(_GRACE_S) if self.reconnections else None
        try:
            while True:
                try:
                    self._open(deadline)
                    break
                except ConnectionLost:
                    if grace is None or grace.expired:
                        raise
                    time.sleep(grace.at_most(0.05))
            self._push(self._settings, deadline)
        except InstrumentError:
            # Also if the instrument refuses the settings: others can then use it.
            self._drop()
            raise
        self._connected = True
        self.reconnections += 1

    def _drop(self) -> None:
        self._connected = self._staged = False
        with suppress(Exception):
            self._disconnect()

    def connect(self, seconds: float | None = None) -> Identity:
        """Connect, send the settings, and return the identity.

        Raises
        ------
        InstrumentError
            If the instrument cannot be reached or its answer is not valid.
        """
        with self._exchange("connect", seconds) as deadline:
            return self._identify(deadline)

    def check(self, seconds: float | None = None) -> dict[str, str]:
        """Run the self-test: identity, firmware and the tests of the driver, within one time limit."""
        deadline = Deadline(self._seconds if seconds is None else seconds)
        found = self.connect(deadline.left)
        identity = " ".join(part for part in (found.maker, found.model, found.serial) if part)
        result = {"identity": identity or "unknown", "firmware": found.firmware or "not reported"}
        return result | self._test(deadline)

    def close(self) -> None:
        """Close the connection; never raises."""
        self._stopping.set()
        self._staged = False
        # A call in progress sees the flag; if it hangs, its connection is closed anyway.
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
        """Stop the instrument, from any thread; a call in progress is interrupted after one second.

        Between :meth:`stage` and :meth:`unstage` nothing moves or is taken until one of :meth:`stage` and
        :meth:`resume` allows it again; by hand, the next call begins anew.

        Raises
        ------
        InstrumentError
            If the command could not be sent: the instrument may still be moving.
        """
        self._stopping.set()
        if self._lock.acquire(timeout=_GRACE_S):
            self._lock.release()
        else:
            # The call in progress hangs: close its connection and send the stop command on a new one.
            with suppress(Exception):
                self._disconnect()
        with self._exchange("stop") as deadline:
            self._halt(deadline)

    def configure(
        self, settings: Mapping[str, Any] | None = None, /, **changes: Any
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Change settings.

        Parameters
        ----------
        settings : mapping, optional
            New values by name, as bluesky's ``configure`` passes them.
        **changes
            New values.

        Returns
        -------
        (dict, dict)
            Readings of the old and of the new settings.

        Raises
        ------
        SettingError
            If a setting does not exist or a value is outside its limits; nothing is sent then.
        """
        changes = {**(settings or {}), **changes}
        new, old = self._settings.changed(changes, self._limits), self.read_configuration()
        with self._exchange("configure") as deadline:
            self._push(new, deadline)
            self._settings = new
        return old, self.read_configuration()

    def stage(self) -> list[Any]:
        """Connect for a run."""
        self._staged = True
        self._stopping.clear()
        self.images.restart()
        self.connect()
        return [self]

    def unstage(self) -> list[Any]:
        """Stop the instrument after a run; the connection stays open."""
        try:
            self.stop()
        finally:
            self._staged = False
            self._stopping.clear()
        return [self]

    def pause(self) -> None:
        """Stop the instrument: the engine has paused."""
        self.stop()

    def resume(self) -> None:
        """Allow motion and recording again: the engine goes on."""
        self._stopping.clear()
        self.connect()

    def trigger(self) -> Status:
        """Take a reading in the background."""
        return Status(self._take, f"{self.name}.trigger")

    def _take(self) -> None:
        values, at = self._acquire(), time.time()
        images = {name: value for name, value in values.items() if np.ndim(value) > 1}
        for name, pixels in images.items():
            self.images.put(name, pixels)
        self._reading = {
            name: {"value": value, "timestamp": at} for name, value in values.items() if name not in images
        }
        self._read_once = True

    def _read_now(self) -> dict[str, Any]:
        self._take()
        return self.read()

    def read(self) -> dict[str, Any]:
        """Return the last reading without its images; take one if there is none."""
        if not self._read_once:
            self._take()
        return dict(self._reading)

    def describe(self) -> dict[str, Any]:
        """Return the contents of a reading: source, type, shape and unit by name; images are external."""
        found = {}
        for name, kind in self._reading_format().items():
            if kind["dtype"] == "array" and len(kind["shape"]) > 1:
                found[name] = self.images.describe(name, tuple(kind["shape"]))
            else:
                found[name] = {"source": self.name, **kind}
        return found

    @property
    def hints(self) -> dict[str, Any]:
        """Fields that bluesky shows: the single numbers of a reading."""
        numbers = ("number", "integer")
        kinds = self._reading_format().items()
        return {"fields": [n for n, kind in kinds if kind["dtype"] in numbers and not kind["shape"]]}

    def collect_asset_docs(self, index: int | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield bluesky's documents about the images taken since the last call."""
        return self.images.stream_documents(index)

    def get_index(self) -> int:
        """Return the number of images of this run."""
        return self.images.index

    def subscribe(self, function: Callable[[dict[str, Any]], None]) -> None:
        """Call a function with each new reading, ten times a second at most."""
        self._monitor.subscribe(function)

    def clear_sub(self, function: Callable[[dict[str, Any]], None]) -> None:
        """Stop calling a function."""
        self._monitor.clear(function)

    def read_configuration(self) -> dict[str, Any]:
        """Return the settings as a reading."""
        at = time.time()
        return {
            f"{self.name}_{name}": {"value": value, "timestamp": at}
            for name, value in self._settings.to_dict().items()
        }

    def describe_configuration(self) -> dict[str, Any]:
        """Return the contents of the reading of the settings."""
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

    def _begin(self, command: str) -> None:
        """Begin what a stop interrupts; raise if the run in which it is asked for was stopped."""
        if self._staged:
            self._require_unstopped(command)
        else:
            self._stopping.clear()

    def _require_unstopped(self, command: str) -> None:
        """Raise if a stop was asked for since the call began; asked before a motion, the connection held.

        A stop sets its mark first, and then waits for the connection: either it is seen here, or the motion
        has begun and is stopped.
        """
        if self._stopping.is_set():
            raise StateError("was stopped", where=self.name, command=command)

    def _wait_until(
        self,
        ask: Callable[[], T],
        done: Callable[[T], bool],
        deadline: Deadline,
        pause_s: float,
        command: str,
    ) -> T:
        """Repeat a query until a condition is met; raise if stopped or if the deadline passes."""
        while True:
            self._require_unstopped(command)
            answer = ask()
            # What is seen now may be so because of a stop.
            self._require_unstopped(command)
            if done(answer):
                return answer
            if deadline.expired:
                raise DeadlineError(_late(deadline), where=self.name, command=command)
            self._stopping.wait(deadline.at_most(pause_s))


def _late(deadline: Deadline) -> str:
    return f"did not finish within {deadline.seconds:g} s"
