"""A bench: the instruments of a laboratory by name, with driver, address, settings and limits.

``bench.toml``::

    schema = "reseau-bench/1"
    name = "cellar"

    [instruments.table]
    driver = "zaber"                    # an entry point of the group reseau.instruments
    address = "/dev/ttyUSB0"
    settings = {speed = 10.0}           # sent on every connection
    limits = {speed = [0.1, 20.0]}      # narrower than the instrument's own
    options = {axes = {tilt = {device = 1, per_unit = 2844.4, low = -50, high = 50}}}
"""

from __future__ import annotations

import copy
import json
import time
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self, TypeVar, runtime_checkable

from pydantic import Field

from ..core.errors import (
    BenchError,
    FormatError,
    InstrumentError,
    ReseauError,
    SettingError,
    UsageError,
)
from ..core.plugins import DISCOVERY, INSTRUMENTS, TOOLS, plugin, plugins
from ..instruments import Camera, Finding, Identity, Instrument, Oscilloscope, Turntable, UltrasonicScanner
from ..io import Document, Strict, read_text
from ..io.refraction import RefractionEntry
from .lock import BenchLock

T = TypeVar("T")


@runtime_checkable
class _Combined(Protocol):
    """An instrument that uses others of its bench: those that its attribute `uses` names, otherwise all."""

    def combine(self, instruments: Mapping[str, Instrument]) -> None:
        """Find the other instruments by the names in its options."""


ROLES: Mapping[str, type] = {
    "camera": Camera,
    "table": Turntable,
    "oscilloscope": Oscilloscope,
    "scanner": UltrasonicScanner,
}
"""What instruments are for a session, by the name of the option that chooses one."""

IN_PROCESS = "in this process"
"""Address of a simulated instrument that is part of this process. No other process can use it."""


def drivers() -> tuple[str, ...]:
    """Return the names of the installed drivers.

    Examples
    --------
    >>> "zaber" in drivers()
    True
    """
    return plugins(INSTRUMENTS)


def found_instruments() -> dict[str, tuple[str, ...] | ReseauError]:
    """Search for instruments; return addresses, or the error of the search, by the kind of search.

    Examples
    --------
    >>> found = found_instruments()  # doctest: +SKIP
    >>> found["serial"]  # doctest: +SKIP
    ('/dev/ttyUSB0',)
    """
    found: dict[str, tuple[str, ...] | ReseauError] = {}
    for name in plugins(DISCOVERY):
        try:
            found[name] = tuple(plugin(DISCOVERY, name)())
        except ReseauError as error:
            found[name] = error
    return found


class InstrumentEntry(Strict):
    """One instrument of a bench.

    Parameters
    ----------
    driver : str
        Name of the driver, an entry point of the group ``reseau.instruments``.
    address : str
        Address in the form that the driver expects.
    settings : dict
        Sent on every connection.
    limits : dict
        Lowest and highest value of settings, narrower than those of the instrument.
    options : dict
        Arguments of the driver.
    refraction : RefractionEntry, optional
        For a camera: windows and media between it and its object, as in ``reseau-network/1``. All its images
        are seen through all windows in their order.

    Examples
    --------
    >>> InstrumentEntry(driver="ping360", address="tcp://127.0.0.1:9092").settings
    {}
    """

    driver: str
    address: str
    settings: dict[str, float | int | str] = Field(default_factory=dict)
    limits: dict[str, tuple[float, float]] = Field(default_factory=dict)
    options: dict[str, Any] = Field(default_factory=dict)
    refraction: RefractionEntry | None = None


class BenchFile(Document):
    """The content of ``bench.toml``.

    Parameters
    ----------
    name : str
        Name of the bench.
    operator : str
        Address of a program that carries out what no instrument can, ``tcp://host:port``; see
        :class:`~reseau.capture.RemoteOperator`. Empty: the person at the terminal does.
    instruments : dict of str to InstrumentEntry
        Instruments by name.

    Examples
    --------
    >>> text = '''schema = "reseau-bench/1"
    ... [instruments.sonar]
    ... driver = "ping360"
    ... address = "tcp://127.0.0.1:9092"
    ... '''
    >>> list(BenchFile.parse_toml(text, where="bench.toml").instruments)
    ['sonar']
    """

    SCHEMA: ClassVar[str] = "reseau-bench/1"
    name: str = "bench"
    operator: str = ""
    instruments: dict[str, InstrumentEntry]

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a bench from a TOML file.

        Raises
        ------
        InputError
            If the file cannot be read.
        FormatError
            If it is not a bench.
        """
        return cls.parse_toml(read_text(Path(path)), where=path)

    @classmethod
    def parse_toml(cls, text: str, *, where: object) -> Self:
        """Read a bench from TOML; `where` names it in messages.

        Raises
        ------
        FormatError
            When it is no TOML, or no bench.
        """
        try:
            content = json.dumps(tomllib.loads(text), default=str)
        except tomllib.TOMLDecodeError as error:
            raise FormatError(f"is not TOML ({error})", where=where) from None
        return cls.parse(content, where=where)


@dataclass(frozen=True)
class Checked:
    """Result of the self-test of an instrument.

    Parameters
    ----------
    name, driver, address : str
        The instrument.
    found : dict
        Outcome of each test.
    error : ReseauError, optional
        The error, if the instrument failed.

    Examples
    --------
    >>> Checked("table", "zaber", "/dev/ttyUSB0", {"tilt": "homed"}).error is None
    True
    """

    name: str
    driver: str
    address: str
    found: dict[str, str] = field(default_factory=dict)
    error: ReseauError | None = None


class Bench:
    """Instruments by name, connected and stopped together.

    All of them must answer; of a :meth:`part` only those that it requires.

    Parameters
    ----------
    file : BenchFile
        The instruments.
    build : callable, optional
        Makes the instrument of an entry. Default: by its driver.

    Raises
    ------
    BenchError
        If an entry does not fit its driver; the message names all such entries.

    Examples
    --------
    >>> bench = Bench(BenchFile(name="empty", instruments={}))
    >>> with bench:
    ...     bench.check()
    []
    """

    def __init__(
        self, file: BenchFile, build: Callable[[str, InstrumentEntry], Instrument] | None = None
    ) -> None:
        self.file = file
        made, failures = {}, []
        for name, entry in file.instruments.items():
            try:
                made[name] = (build or built)(name, entry)
            except ReseauError as error:
                failures.append(error)
        for each in made.values():
            try:
                if isinstance(each, _Combined):
                    each.combine(made)
            except ReseauError as error:
                failures.append(error)
        if failures:
            raise BenchError(failures)
        self.instruments: Mapping[str, Instrument] = made
        self.required = frozenset(made)
        self.silent: Mapping[str, ReseauError] = {}
        """Why instruments could not be connected last time, by name."""

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a bench from a file; raises as :meth:`BenchFile.read` and the class."""
        return cls(BenchFile.read(path))

    def __getitem__(self, name: str) -> Instrument:
        if name not in self.instruments:
            known = ", ".join(self.instruments)
            raise UsageError("is not on this bench", where=name, do=f"its instruments: {known or 'none'}")
        return self.instruments[name]

    def part(self, names: Iterable[str], required: Iterable[str] | None = None) -> Self:
        """Return the bench with some of its instruments, and those that they use.

        Parameters
        ----------
        names : iterable of str
            Instruments that the part consists of.
        required : iterable of str, optional
            Those that must answer when the part is connected. Default: all.

        Raises
        ------
        UsageError
            If there is no such instrument.

        Examples
        --------
        >>> entry = InstrumentEntry(driver="ping360", address="tcp://127.0.0.1:9092")
        >>> bench = Bench(BenchFile(name="tank", instruments={"left": entry, "right": entry}))
        >>> list(bench.part(["right"]).instruments)
        ['right']
        """
        wanted, left = dict[str, Instrument](), list(names)
        while left:
            name = left.pop()
            if name not in wanted:
                wanted[name] = found = self[name]
                left += getattr(found, "uses", self.instruments) if isinstance(found, _Combined) else ()
        return self._only(wanted, wanted if required is None else required)

    def without(self, names: Iterable[str]) -> Self:
        """Return the bench without some instruments: none of those that are left is required.

        Examples
        --------
        >>> entry = InstrumentEntry(driver="ping360", address="tcp://127.0.0.1:9092")
        >>> bench = Bench(BenchFile(name="tank", instruments={"left": entry, "right": entry}))
        >>> list(bench.without(["right"]).instruments)
        ['left']
        """
        return self._only(self.instruments.keys() - set(names), ())

    def _only(self, names: Collection[str], required: Iterable[str]) -> Self:
        part = copy.copy(self)
        part.instruments = {name: each for name, each in self.instruments.items() if name in names}
        entries = {name: each for name, each in self.file.instruments.items() if name in names}
        part.file = self.file.model_copy(update={"instruments": entries})
        part.required = frozenset(required)
        return part

    def one(self, kind: type, name: str | None = None) -> Any:
        """Return the instrument of a kind: the named one, or the only one.

        Raises
        ------
        UsageError
            If there is none, or there are several and no name is given.
        """
        found = {each: made for each, made in self.instruments.items() if isinstance(made, kind)}
        names = ", ".join(found) or "none"
        role = next((role for role, each in ROLES.items() if each is kind), kind.__name__)
        where = f"bench {self.file.name}"
        if name is not None:
            if not isinstance(self[name], kind):
                raise UsageError(f"is no {role}", where=name, do=f"on this bench: {names}")
            return self[name]
        if not found:
            raise UsageError(f"has no {role}", where=where, do="add one under [instruments] of its file")
        if len(found) != 1:
            raise UsageError(f"has several of {role}: {names}", where=where, do=f"give `--{role} NAME`")
        return next(iter(found.values()))

    def has(self, kind: type) -> bool:
        """Return whether there is an instrument of a kind."""
        return any(isinstance(each, kind) for each in self.instruments.values())

    def connect(self, seconds: float | None = None) -> dict[str, Identity]:
        """Connect all instruments at the same time; return the identities of those that answer.

        Raises
        ------
        BenchError
            If a required instrument cannot be connected; names all such instruments, and closes the others.
        """
        outcomes = self._all(lambda instrument: instrument.connect(seconds))
        self.silent = {name: each for name, each in outcomes.items() if isinstance(each, ReseauError)}
        failures = [error for name, error in self.silent.items() if name in self.required]
        if failures:
            self.close()
            raise BenchError(failures)
        return {name: each for name, each in outcomes.items() if isinstance(each, Identity)}

    def check(self, seconds: float | None = None, owner: str = "") -> list[Checked]:
        """Run the self-test of all instruments at the same time; failures are among the results.

        Parameters
        ----------
        seconds : float, optional
            Time limit for each instrument (s).
        owner : str
            With it, each instrument is locked for its test; one that another process uses is not tested, and
            the result says who uses it.
        """

        def checked(instrument: Instrument) -> dict[str, str]:
            addresses = self._addresses(instrument.name)
            with BenchLock(addresses, owner) if owner else nullcontext():
                return instrument.check(seconds)

        # What consists of other instruments is tested when they are not in use.
        composed = [name for name in self.instruments if not self._addresses(name)]
        outcomes = self.without(composed)._all(checked) | self._only(composed, ())._all(checked)
        found = []
        for name, entry in self.file.instruments.items():
            outcome = outcomes[name]
            error = outcome if isinstance(outcome, ReseauError) else None
            tested = {} if isinstance(outcome, ReseauError) else outcome
            found.append(Checked(name, entry.driver, entry.address, tested, error))
        return found

    def diagnose(self, seconds: float = 10.0) -> dict[str, list[Finding]]:
        """Return what is found on the way to each instrument: what holds it, permissions, network, answers.

        An instrument is connected only if nothing stands in the way and no other process uses it.
        """
        examine = plugin(TOOLS, "doctor")

        def found(instrument: Instrument) -> list[Finding]:
            entry = self.file.instruments[instrument.name]
            if (holder := BenchLock.holder(entry.address)) is not None:
                return [Finding(False, f"is used by {holder}", "wait, or stop it with `reseau bench stop`")]
            findings = list(examine(entry.driver, entry.address))
            if all(each.fine is not False for each in findings):
                findings.append(_answers(instrument, seconds))
            return findings

        return {
            name: each if isinstance(each, list) else [Finding(False, each.what, each.do or "")]
            for name, each in self._all(found).items()
        }

    def stop(self) -> None:
        """Stop all instruments.

        Raises
        ------
        BenchError
            If an instrument could not be stopped; names all such instruments.
        """
        self._all_or_raise(lambda instrument: instrument.stop())

    def unstage(self) -> None:
        """Stop all instruments after a run: they can be used by hand again.

        Raises
        ------
        BenchError
            As :meth:`stop`.
        """
        self._all_or_raise(lambda instrument: instrument.unstage())

    def close(self) -> None:
        """Close all connections; never raises."""
        self._all(lambda instrument: instrument.close())

    def lock(self, owner: str, *also: str) -> BenchLock:
        """Return the lock of the instruments, for a ``with`` block.

        Instruments that are part of this process (address ``in this process``) are not locked: no other
        process can use them, and another process may have its own at the same address.

        Parameters
        ----------
        owner : str
            Purpose of the lock, shown to whoever is refused.
        also : str
            Other things to lock, for instance the name of a session.
        """
        return BenchLock([*self._addresses(*self.file.instruments), *also], owner)

    def _addresses(self, *names: str) -> list[str]:
        """Addresses that no other process can use at the same time."""
        return [
            entry.address
            for name, entry in self.file.instruments.items()
            if name in names
            and entry.address != IN_PROCESS
            and not getattr(self.instruments[name], "composed", False)
        ]

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _all_or_raise(self, work: Callable[[Instrument], object]) -> None:
        failures = [each for each in self._all(work).values() if isinstance(each, ReseauError)]
        if failures:
            raise BenchError(failures)

    def _all(self, work: Callable[[Instrument], T]) -> dict[str, T | ReseauError]:
        """The outcome of the same work on every instrument, each in its own thread."""

        def outcome(instrument: Instrument) -> T | ReseauError:
            try:
                return work(instrument)
            except ReseauError as error:
                return error
            except Exception as error:  # a defect of a driver is the failure of its instrument alone
                return InstrumentError(f"its driver failed ({error!r})", where=instrument.name)

        if not self.instruments:
            return {}
        with ThreadPoolExecutor(len(self.instruments), "bench") as pool:
            return dict(zip(self.instruments, pool.map(outcome, self.instruments.values()), strict=True))


def _answers(instrument: Instrument, seconds: float) -> Finding:
    """How an instrument answers, and what its firmware is."""
    began = time.monotonic()
    try:
        identity = instrument.connect(seconds)
    except ReseauError as error:
        return Finding(False, error.what, error.do or "")
    finally:
        instrument.close()
    took = time.monotonic() - began
    who, firmware = f"{identity.maker} {identity.model}", identity.firmware or "not told"
    text = f"answers in {took:.2g} s: {who}, firmware {firmware}"
    slow = took > seconds / 2
    return Finding(None if slow else True, text, "set `seconds` in its options higher" if slow else "")


def built(name: str, entry: InstrumentEntry) -> Instrument:
    """Return the instrument of an entry, made by its driver, not connected.

    Raises
    ------
    ReseauError
        If there is no such driver, or the entry does not fit it.
    """
    make = plugin(INSTRUMENTS, entry.driver)
    try:
        made = make(name, entry.address, settings=entry.settings, limits=entry.limits, **entry.options)
    except ReseauError as error:
        raise SettingError(str(error), where=name) from None
    except (TypeError, ValueError, AttributeError) as error:
        # Options are arguments of the driver: Python reports the unknown ones.
        raise SettingError(f"its options do not fit ({error})", where=name) from None
    if not isinstance(made, Instrument):
        raise UsageError(f"{entry.driver} does not make an instrument", where=name)
    return made


_DRIVERS = {
    "aravis": ("camera", "aravis"),
    "video": ("camera", "v4l2"),
    "visa": ("oscilloscope", "oscilloscope"),
}
"""Name and driver of what a kind of search finds. What is behind a serial port does not tell its protocol."""
_SERIAL = "zaber, smc100, ping360 or compactpulser"


def bench_text(found: Mapping[str, Sequence[str] | ReseauError], name: str = "bench") -> str:
    """Return a bench file for the results of :func:`~reseau.capture.found_instruments`.

    Instruments whose driver is not known, and a rig of several cameras, are in comments, to be completed.

    Examples
    --------
    >>> text = bench_text({"aravis": ["192.0.2.30", "192.0.2.31"], "serial": ["/dev/ttyUSB0"]})
    >>> from reseau.capture import BenchFile
    >>> list(BenchFile.parse_toml(text, where="bench.toml").instruments)
    ['camera', 'camera_2']
    >>> "/dev/ttyUSB0" in text
    True
    """
    lines = ['schema = "reseau-bench/1"', f"name = {_quoted(name)}", ""]
    counts: dict[str, int] = {}
    cameras = []
    for way, addresses in found.items():
        if isinstance(addresses, ReseauError):
            lines += [f"# {way}: {addresses}", ""]
            continue
        for address in addresses:
            if way not in _DRIVERS:
                lines += [
                    f"# [instruments.{way}_{_next(counts, way)}]", f'# driver = ""  # {_SERIAL}',
                    f"# address = {_quoted(address)}", "",
                ]  # fmt: skip
                continue
            kind, driver = _DRIVERS[way]
            number = _next(counts, kind)
            own = kind if number == 1 else f"{kind}_{number}"
            if driver == "aravis":
                cameras.append(own)
            lines += [f"[instruments.{own}]", f'driver = "{driver}"', f"address = {_quoted(address)}", ""]
    if len(cameras) > 1:
        lines += [
            "# Cameras that expose at once; each of them needs the same trigger in its settings.",
            "# [instruments.rig]", '# driver = "rig"', f"# address = {_quoted(', '.join(cameras))}",
            '# settings = {trigger = "software"}', "",
        ]  # fmt: skip
    if not counts:
        lines += ["# Nothing was found.", "[instruments]", ""]
    elif not any(line.startswith("[") for line in lines):
        lines += ["[instruments]", ""]
    return "\n".join(lines)


def _next(counts: dict[str, int], kind: str) -> int:
    counts[kind] = counts.get(kind, 0) + 1
    return counts[kind]


def _quoted(text: str) -> str:
    """A text as TOML."""
    escaped = "".join(f"\\u{ord(c):04x}" if ord(c) < 32 else f"\\{c}" if c in '"\\' else c for c in text)
    return f'"{escaped}"'
