"""A bench: instruments by name, what drives them, where they are, and what they may do.

``bench.toml`` says it::

    schema = "reseau-bench/1"
    name = "cellar"

    [instruments.table]
    driver = "zaber"                    # an entry point of the group reseau.instruments
    address = "/dev/ttyUSB0"
    settings = {speed = 10.0}           # pushed on every connection
    limits = {speed = [0.1, 20.0]}      # narrower than the instrument's own
    options = {axes = {tilt = {device = 1, per_unit = 2844.4, low = -50, high = 50}}}
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self, TypeVar, runtime_checkable

from pydantic import Field

from ..core.errors import BenchError, FormatError, ReseauError, SettingError, UsageError
from ..instruments import Identity, Instrument
from ..io import Document, Strict, read_text

__all__ = ["Bench", "BenchFile", "Checked", "InstrumentEntry", "drivers", "found_instruments", "plugin"]

T = TypeVar("T")


@runtime_checkable
class _Combined(Protocol):
    """An instrument that works with others of its bench."""

    def combine(self, instruments: Mapping[str, Instrument]) -> None:
        """Find them by the names that its options tell."""


INSTRUMENTS, DISCOVERY, SIMULATORS = "reseau.instruments", "reseau.discovery", "reseau.simulators"
"""Groups of entry points: drivers; functions that list addresses; simulated benches behind real protocols."""


def plugin(group: str, name: str) -> Any:
    """What an installed package offers under a name.

    Raises
    ------
    UsageError
        When nothing does, or it cannot be loaded.
    """
    found = entry_points(group=group, name=name)
    if not found:
        known = ", ".join(sorted(each.name for each in entry_points(group=group)))
        raise UsageError(f"is not installed for {group}", where=name, do=f"there are {known or 'none'}")
    try:
        return next(iter(found)).load()
    except (ImportError, AttributeError) as error:
        raise UsageError(f"cannot be loaded ({error})", where=name) from None


def drivers() -> tuple[str, ...]:
    """Names of the drivers that are installed."""
    return tuple(sorted({each.name for each in entry_points(group=INSTRUMENTS)}))


def found_instruments() -> dict[str, tuple[str, ...] | ReseauError]:
    """Addresses that are found now, by the way in which they were searched; or why they could not be."""
    found: dict[str, tuple[str, ...] | ReseauError] = {}
    for each in sorted(entry_points(group=DISCOVERY), key=lambda each: each.name):
        try:
            found[each.name] = tuple(plugin(DISCOVERY, each.name)())
        except ReseauError as error:
            found[each.name] = error
    return found


class InstrumentEntry(Strict):
    """One instrument of a bench."""

    driver: str
    address: str
    settings: dict[str, float | int | str] = Field(default_factory=dict)
    limits: dict[str, tuple[float, float]] = Field(default_factory=dict)
    options: dict[str, Any] = Field(default_factory=dict)


class BenchFile(Document):
    """The content of ``bench.toml``."""

    SCHEMA: ClassVar[str] = "reseau-bench/1"
    name: str = "bench"
    instruments: dict[str, InstrumentEntry]

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a bench from a TOML file.

        Raises
        ------
        InputError
            When the file cannot be read.
        FormatError
            When it is no bench.
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
            raise FormatError(f"is no TOML ({error})", where=where) from None
        return cls.parse(content, where=where)


@dataclass(frozen=True)
class Checked:
    """What came out when an instrument was checked.

    Parameters
    ----------
    name, driver, address : str
        Of the instrument.
    found : dict
        What was tested, and what came out.
    error : ReseauError, optional
        What failed.
    """

    name: str
    driver: str
    address: str
    found: dict[str, str] = field(default_factory=dict)
    error: ReseauError | None = None


class Bench:
    """Instruments by name, as one resource.

    Parameters
    ----------
    file : BenchFile
        Says which.
    build : callable, optional
        Makes the instrument of an entry: by default its driver, found by its entry point.

    Raises
    ------
    BenchError
        When instruments cannot be made of what the file says; all of them are named.
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

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """The bench of a file; raises as :meth:`BenchFile.read` and the class do."""
        return cls(BenchFile.read(path))

    def __getitem__(self, name: str) -> Instrument:
        if name not in self.instruments:
            known = ", ".join(self.instruments)
            raise UsageError("is not on this bench", where=name, do=f"there are {known or 'none'}")
        return self.instruments[name]

    def one(self, kind: type, name: str | None = None) -> Any:
        """The instrument of a kind: that of a name, or the only one.

        Raises
        ------
        UsageError
            When there is none, or several and none was named.
        """
        found = {each: made for each, made in self.instruments.items() if isinstance(made, kind)}
        names = ", ".join(found) or "none"
        if name is not None:
            if not isinstance(self[name], kind):
                raise UsageError(f"is no {kind.__name__}", where=name, do=f"there are {names}")
            return self[name]
        if len(found) != 1:
            do = "name one" if found else None
            raise UsageError(f"has {names} for a {kind.__name__}", where="bench", do=do)
        return next(iter(found.values()))

    def has(self, kind: type) -> bool:
        """Whether there is an instrument of a kind."""
        return any(isinstance(each, kind) for each in self.instruments.values())

    def connect(self, seconds: float | None = None) -> dict[str, Identity]:
        """Connect all at once.

        Raises
        ------
        BenchError
            When one or more cannot be connected; all of them are named, the others are let go.
        """
        outcomes = self._all(lambda instrument: instrument.connect(seconds))
        failures = [each for each in outcomes.values() if isinstance(each, ReseauError)]
        if failures:
            self.close()
            raise BenchError(failures)
        return {name: each for name, each in outcomes.items() if isinstance(each, Identity)}

    def check(self, seconds: float | None = None) -> list[Checked]:
        """Have all instruments test themselves, at once; failures are among the results."""
        outcomes = self._all(lambda instrument: instrument.check(seconds))
        checked = []
        for name, entry in self.file.instruments.items():
            outcome = outcomes[name]
            error = outcome if isinstance(outcome, ReseauError) else None
            found = {} if isinstance(outcome, ReseauError) else outcome
            checked.append(Checked(name, entry.driver, entry.address, found, error))
        return checked

    def stop(self) -> None:
        """Stop everything.

        Raises
        ------
        BenchError
            When one or more could not be stopped; all of them are named.
        """
        failures = [
            each for each in self._all(lambda instrument: instrument.stop()).values() if each is not None
        ]
        if failures:
            raise BenchError(failures)

    def close(self) -> None:
        """Let go of all; never raises."""
        self._all(lambda instrument: instrument.close())

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _all(self, work: Callable[[Instrument], T]) -> dict[str, T | ReseauError]:
        """The outcome of the same work on every instrument, each in a thread of its own."""

        def outcome(instrument: Instrument) -> T | ReseauError:
            try:
                return work(instrument)
            except ReseauError as error:
                return error

        if not self.instruments:
            return {}
        with ThreadPoolExecutor(len(self.instruments), "bench") as pool:
            return dict(zip(self.instruments, pool.map(outcome, self.instruments.values()), strict=True))


def built(name: str, entry: InstrumentEntry) -> Instrument:
    """The driver of an entry, not connected yet.

    Raises
    ------
    ReseauError
        When there is no such driver, or the entry does not fit it.
    """
    make = plugin(INSTRUMENTS, entry.driver)
    try:
        made = make(name, entry.address, settings=entry.settings, limits=entry.limits, **entry.options)
    except ReseauError as error:
        raise SettingError(str(error), where=name) from None
    except (TypeError, ValueError, AttributeError) as error:
        # Options are the driver's own: what it does not take, Python says.
        raise SettingError(f"its options do not fit ({error})", where=name) from None
    if not isinstance(made, Instrument):
        raise UsageError(f"{entry.driver} is no driver of an instrument", where=name)
    return made
