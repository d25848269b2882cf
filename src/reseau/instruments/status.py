"""Outcome of an operation in the background, compatible with bluesky's ``Status``."""

from __future__ import annotations

import threading
from collections.abc import Callable

from ..core.errors import DeadlineError


class Status:
    """Operation that runs in a thread of its own.

    Parameters
    ----------
    work : callable
        Operation without arguments; an exception means failure.
    name : str
        Name of the thread.

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
        # bluesky's FailedStatus shows only this text.
        how = "done" if self.success else f"failed: {self._error}" if self.done else "under way"
        return f"<{self._thread.name}: {how}>"

    @property
    def done(self) -> bool:
        """Whether the operation has finished."""
        return self._finished.is_set()

    @property
    def success(self) -> bool:
        """Whether the operation has finished without an exception."""
        return self.done and self._error is None

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """Wait for the end of the operation and return its exception, or None.

        Parameters
        ----------
        timeout : float, optional
            Longest time to wait (s); None waits without limit.

        Raises
        ------
        DeadlineError
            If the operation has not finished by then.
        """
        if not self._finished.wait(timeout):
            raise DeadlineError("has not finished", where=self._thread.name)
        return self._error

    def wait(self, timeout: float | None = None) -> None:
        """Wait for the end of the operation and raise its exception, if any."""
        error = self.exception(timeout)
        self._thread.join()
        if error is not None:
            raise error

    def add_callback(self, callback: Callable[[Status], None]) -> None:
        """Call a function at the end of the operation; at once if it has already ended."""
        with self._lock:
            if not self._finished.is_set():
                self._callbacks.append(callback)
                return
        callback(self)
