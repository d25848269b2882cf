"""The outcome of something that goes on in the background, as bluesky's ``Status`` has it."""

from __future__ import annotations

import threading
from collections.abc import Callable

from ..core.errors import DeadlineError

__all__ = ["Status"]


class Status:
    """Something that has been begun and will be done, well or badly.

    Parameters
    ----------
    work : callable
        Runs in a thread of its own.
    name : str
        Of the thread.

    Examples
    --------
    >>> status = Status(lambda: None, "nothing")
    >>> status.wait(5.0)
    >>> status.done, status.success, status
    (True, True, <nothing: done>)
    """

    def __init__(self, work: Callable[[], object], name: str) -> None:
        self._lock, self._finished = threading.Lock(), threading.Event()
        self._callbacks: list[Callable[[Status], None]] = []
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(work,), name=name, daemon=True)
        self._thread.start()

    def _run(self, work: Callable[[], object]) -> None:
        try:
            work()
        except BaseException as error:
            self._error = error
        with self._lock:
            self._finished.set()
            callbacks = list(self._callbacks)
        for callback in callbacks:
            callback(self)

    def __repr__(self) -> str:
        # bluesky's FailedStatus says no more than this.
        how = "done" if self.success else f"failed: {self._error}" if self.done else "under way"
        return f"<{self._thread.name}: {how}>"

    @property
    def done(self) -> bool:
        """Whether it is over."""
        return self._finished.is_set()

    @property
    def success(self) -> bool:
        """Whether it is over and went well."""
        return self.done and self._error is None

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """What went wrong, if anything; waits as long as allowed.

        Raises
        ------
        DeadlineError
            When it is not over by then.
        """
        if not self._finished.wait(timeout):
            raise DeadlineError("is not done yet", where=self._thread.name)
        return self._error

    def wait(self, timeout: float | None = None) -> None:
        """Wait until it is over, and raise what went wrong."""
        error = self.exception(timeout)
        self._thread.join()
        if error is not None:
            raise error

    def add_callback(self, callback: Callable[[Status], None]) -> None:
        """Have a function called when it is over; at once when it is."""
        with self._lock:
            if not self._finished.is_set():
                self._callbacks.append(callback)
                return
        callback(self)
