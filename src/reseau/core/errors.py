"""The errors that leave a public call, and nothing else does.

::

    ReseauError
    ├── UsageError           arguments that cannot be meant together            exit status 2
    │   └── SettingError         … a setting beyond its limits; nothing was sent
    ├── InputError           a file or a value from outside that cannot be used exit status 2
    │   ├── ImageError       … that should be an image
    │   └── FormatError      … that should be one of the project's documents
    ├── ArchiveError         the archive cannot keep or give what was asked     exit status 1
    ├── EstimationError      an estimate that was required could not be had     exit status 1
    └── InstrumentError      an instrument did not do what was asked            exit status 1
        ├── ConnectionLost       it cannot be reached, or went away
        ├── DeadlineError        it did not answer, or was not done, in the time allowed
        ├── ProtocolError        what it sent is no answer in its protocol
        ├── RefusedError         it understood, and said no
        ├── StateError           it is not in a state to do so: not homed, stalled, at a limit, stopped
        └── BenchError           several instruments failed; names them all

Each says in one line *what* is wrong, *where*, and what to *do*. An estimator that fails does not raise: it
returns a falsy value with its reason; `EstimationError` is for those who must have the estimate.
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = [
    "ArchiveError",
    "BenchError",
    "ConnectionLost",
    "DeadlineError",
    "EstimationError",
    "FormatError",
    "ImageError",
    "InputError",
    "InstrumentError",
    "ProtocolError",
    "RefusedError",
    "ReseauError",
    "SettingError",
    "StateError",
    "UsageError",
]


class ReseauError(Exception):
    """Root of the tree; carries one line for the user.

    Parameters
    ----------
    what : str
        What is wrong.
    where : object, optional
        The file, key, mark or argument it is about; named first.
    do : str, optional
        What would help; named last.

    Examples
    --------
    >>> str(ReseauError("is all black", where="photo1.png", do="open the shutter"))
    'photo1.png: is all black; open the shutter'
    """

    exit_status = 1

    def __init__(self, what: str, *, where: object = None, do: str | None = None) -> None:
        self.what, self.where, self.do = what, where, do
        line = what if where is None else f"{where}: {what}"
        super().__init__(" ".join((line if do is None else f"{line}; {do}").split()))


class UsageError(ReseauError):
    """Arguments that cannot be meant together."""

    exit_status = 2


class InputError(ReseauError):
    """A file or a value from outside that cannot be used."""

    exit_status = 2


class ImageError(InputError):
    """A file or an array that should be an image and is none we can measure in."""


class FormatError(InputError):
    """A document that does not keep to its schema."""


class ArchiveError(ReseauError):
    """The archive cannot keep or give what was asked: full, read-only, damaged, or not there."""


class EstimationError(ReseauError):
    """An estimate that was required could not be had."""


class SettingError(UsageError):
    """A setting that an instrument does not have, or a value beyond its limits; nothing was sent."""


class InstrumentError(ReseauError):
    """An instrument did not do what was asked.

    Parameters
    ----------
    what, where, do
        As for :class:`ReseauError`; `where` is the name of the instrument.
    command : str, optional
        What it had been told when it happened.

    Examples
    --------
    >>> str(InstrumentError("did not answer", where="table", command="home", do="is it switched on?"))
    'table (home): did not answer; is it switched on?'
    """

    def __init__(
        self, what: str, *, where: object = None, do: str | None = None, command: str | None = None
    ) -> None:
        self.instrument, self.command = where, command
        named = f"{where} ({command})" if where is not None and command else where
        super().__init__(what, where=named if named is not None else command, do=do)


class ConnectionLost(InstrumentError):
    """The instrument cannot be reached, or went away."""


class DeadlineError(InstrumentError):
    """The instrument did not answer, or was not done, in the time allowed."""


class ProtocolError(InstrumentError):
    """What the instrument sent is no answer in its protocol."""


class RefusedError(InstrumentError):
    """The instrument understood, and said no."""


class StateError(InstrumentError):
    """The instrument is not in a state to do what was asked: not homed, stalled, at a limit, stopped."""


class BenchError(InstrumentError):
    """Several instruments failed, or one of several; all of them are named.

    Parameters
    ----------
    failures : sequence of ReseauError
        What happened to each.
    """

    def __init__(self, failures: Sequence[ReseauError]) -> None:
        self.failures = tuple(failures)
        lines = " | ".join(str(failure) for failure in self.failures)
        super().__init__(f"{len(self.failures)} failed: {lines}", where="bench")
