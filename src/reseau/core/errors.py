"""All exceptions that a public call raises.

::

    ReseauError
    ├── UsageError           wrong or contradictory arguments                   exit status 2
    │   └── SettingError         … a setting out of its limits; nothing was sent
    ├── InputError           an unusable file or external value                 exit status 2
    │   ├── ImageError       … an unusable image
    │   └── FormatError      … an invalid document
    ├── ArchiveError         the archive cannot store or return an item         exit status 1
    ├── EstimationError      a required estimate failed                         exit status 1
    └── InstrumentError      an instrument did not execute a command            exit status 1
        ├── ConnectionLost       it cannot be reached, or the connection broke
        ├── DeadlineError        it did not answer or finish in time
        ├── ProtocolError        its answer violates its protocol
        ├── RefusedError         it refused the command
        ├── StateError           its state does not allow it: not homed, stalled, at a limit, stopped
        └── BenchError           several instruments failed

Each message says in one line *what* is wrong, *where*, and what to *do*. An estimator that fails does not
raise: it returns a :class:`reseau.core.failure.Failure`; `EstimationError` is raised where the estimate is
required.
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
    """Root of the exceptions, with a one-line message for the user.

    Parameters
    ----------
    what : str
        What is wrong.
    where : object, optional
        File, key, mark or argument concerned; named first.
    do : str, optional
        What to do; named last.

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
    """Wrong or contradictory arguments."""

    exit_status = 2


class InputError(ReseauError):
    """A file or external value that cannot be used."""

    exit_status = 2


class ImageError(InputError):
    """A file or an array that is not a usable image."""


class FormatError(InputError):
    """A document that does not conform to its schema."""


class ArchiveError(ReseauError):
    """The archive cannot store or return an item: full, read-only, damaged, or missing."""


class EstimationError(ReseauError):
    """A required estimate failed."""


class SettingError(UsageError):
    """A setting that an instrument does not have, or a value out of its limits; nothing was sent."""


class InstrumentError(ReseauError):
    """An instrument did not execute a command.

    Parameters
    ----------
    what, where, do
        As for :class:`ReseauError`; `where` is the name of the instrument.
    command : str, optional
        The last command.

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
    """The instrument cannot be reached, or the connection broke."""


class DeadlineError(InstrumentError):
    """The instrument did not answer or finish in time."""


class ProtocolError(InstrumentError):
    """The answer of the instrument violates its protocol."""


class RefusedError(InstrumentError):
    """The instrument refused the command."""


class StateError(InstrumentError):
    """The state of the instrument does not allow the command: not homed, stalled, at a limit, stopped."""


class BenchError(InstrumentError):
    """One or more of several instruments failed; all of them are named.

    Parameters
    ----------
    failures : sequence of ReseauError
        Failure of each.

    Examples
    --------
    >>> first, second = StateError("is not homed", where="table"), DeadlineError("timed out", where="scope")
    >>> str(BenchError([first, second]))
    'bench: 2 failed: table: is not homed | scope: timed out'
    """

    def __init__(self, failures: Sequence[ReseauError]) -> None:
        self.failures = tuple(failures)
        lines = " | ".join(str(failure) for failure in self.failures)
        super().__init__(f"{len(self.failures)} failed: {lines}", where="bench")
