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

Each message says in one line *what* is wrong, *where*, and what to *do*; `cause` and `cure` of its class say
so in general terms. An estimator that fails does not raise: it returns a
:class:`reseau.core.failure.Failure`; `EstimationError` is raised where the estimate is required.
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

    cause = "one of those below"
    cure = "as for the one that is named"
    exit_status = 1

    def __init__(self, what: str, *, where: object = None, do: str | None = None) -> None:
        self.what, self.where, self.do = what, where, do
        line = what if where is None else f"{where}: {what}"
        super().__init__(" ".join((line if do is None else f"{line}; {do}").split()))

    @property
    def reason(self) -> str:
        """What is wrong and what to do, where the place is named already."""
        return self.what if self.do is None else f"{self.what}; {self.do}"


class UsageError(ReseauError):
    """Wrong or contradictory arguments."""

    cause = "an argument or an option is wrong, or two of them contradict each other"
    cure = "correct what the message names; `--help` lists what a command takes"
    exit_status = 2


class InputError(ReseauError):
    """A file or external value that cannot be used."""

    cause = "a file is missing, cannot be read or written, or its content does not suit the task"
    cure = "check the path and its permissions, and correct what the message names"
    exit_status = 2


class ImageError(InputError):
    """A file or an array that is not a usable image."""

    cause = "the file is no image, is damaged, or is of a kind that is not supported"
    cure = "copy the file again, or convert it to TIFF or PNG"


class FormatError(InputError):
    """A document that does not conform to its schema."""

    cause = "a document lacks a key, has one that is not known, or a value of another kind"
    cure = "correct the key that is named; `reseau schema NAME` prints the format"


class ArchiveError(ReseauError):
    """The archive cannot store or return an item: full, read-only, damaged, or missing."""

    cause = "the archive is full, read-only or damaged, or does not have the item"
    cure = "`reseau archive list` shows what there is, `reseau archive verify` what is damaged"


class EstimationError(ReseauError):
    """A required estimate failed."""

    cause = "an estimate failed without which there is no result"
    cure = "that of its code, in the table above"


class SettingError(UsageError):
    """A setting that an instrument does not have, or a value out of its limits; nothing was sent."""

    cause = "the instrument does not have this setting, or the value is beyond its limits"
    cure = (
        "choose a value within the limits that the message states; `reseau bench status` shows the settings"
    )


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

    cause = "the instrument did not do what it was asked for, in another way than those below"
    cure = "`reseau bench check` runs the self-test of every instrument"

    def __init__(
        self, what: str, *, where: object = None, do: str | None = None, command: str | None = None
    ) -> None:
        self.instrument, self.command = where, command
        named = f"{where} ({command})" if where is not None and command else where
        super().__init__(what, where=named if named is not None else command, do=do)


class ConnectionLost(InstrumentError):
    """The instrument cannot be reached, or the connection broke."""

    cause = "it is off, unplugged, at another address, or in use by another program"
    cure = "check power, cable and `address`; `reseau bench list` shows what answers"


class DeadlineError(InstrumentError):
    """The instrument did not answer or finish in time."""

    cause = "it is busy, stuck, or slower than the time limit that the message states"
    cure = "wait or switch it off and on; give a longer limit where the work takes longer"


class ProtocolError(InstrumentError):
    """The answer of the instrument violates its protocol."""

    cause = "the answer is damaged, or that of another kind of instrument"
    cure = "check cable, speed of the line and `driver`; switch it off and on"


class RefusedError(InstrumentError):
    """The instrument refused the command."""

    cause = "the instrument understood the command and declined it; the message has its reason"
    cure = "correct the value, or release the instrument from its front panel"


class StateError(InstrumentError):
    """The state of the instrument does not allow the command: not homed, stalled, at a limit, stopped."""

    cause = "an axis is not homed, stalled, at a limit or stopped, or the instrument is not ready"
    cure = "home it (`reseau bench home`), or remove what is in its way"


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

    cause = "one or more instruments failed; the message names all of them"
    cure = "that of each, as above"

    def __init__(self, failures: Sequence[ReseauError]) -> None:
        self.failures = tuple(failures)
        lines = " | ".join(str(failure) for failure in self.failures)
        super().__init__(f"{len(self.failures)} failed: {lines}", where="bench")
