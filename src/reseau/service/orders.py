"""The queue of a bench: what was asked of it, by whom, in which order it is done, and what became of it.

A journal of the archive, so that pages, schedules and the command line ask the same owner: the worker that
holds the instruments takes one order after the other. An order that finds an instrument not ready is tried
again, each time after twice as long.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Literal, cast

from ..archive import Archive
from ..archive.journal import Entry
from ..capture import BenchFile, BenchLock
from ..core.errors import InstrumentError, ReseauError, StateError, UsageError

_PREFIX = "orders/"
What = Literal["recalibration", "session"]
OrderState = Literal["waiting", "running", "blocked", "done", "failed", "withdrawn"]
OVER: frozenset[OrderState] = frozenset({"done", "failed", "withdrawn"})
BUSY = ("running", "pausing", "paused", "asking", "ending")
"""States of a bench with a session."""
_FIRST_PAUSE, _TRIES = timedelta(seconds=30), 6


@dataclass(frozen=True)
class Order:
    """Something that a bench is asked to do.

    Parameters
    ----------
    number : int
        Its number in the queue of the bench.
    what : {"recalibration", "session"}
        What is asked for.
    given : dict
        Of a recalibration its `name`; of a session `name`, `plan`, `parameters` and `inputs`.
    session : str
        Name of the session that it makes.
    by : str
        Who asked.
    at : datetime
        When.
    state : {"waiting", "running", "blocked", "done", "failed", "withdrawn"}
        Its state; a blocked one is tried again.
    why : str
        Outcome, or why it failed or is blocked.
    attempts : int
        How often it was begun.
    again : datetime or None
        When a blocked one is tried again.
    log : tuple of (datetime, str)
        What happened to it.

    Examples
    --------
    >>> at = datetime.fromisoformat("2026-03-02T00:00Z")
    >>> Order(1, "recalibration", {"name": "left"}, "left-20260302", "Ada", at).state
    'waiting'
    """

    number: int
    what: What
    given: dict[str, Any]
    session: str
    by: str
    at: datetime
    state: OrderState = "waiting"
    why: str = ""
    attempts: int = 0
    again: datetime | None = None
    log: tuple[tuple[datetime, str], ...] = ()


class Orders:
    """The queue of a bench.

    Parameters
    ----------
    archive : Archive
        The archive.
    bench : str
        Name of the bench.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     orders = Orders(archive, "cellar")
    ...     first, second = (orders.add("recalibration", {"name": each}, "Ada") for each in ("left", "right"))
    ...     orders.put_first(second.number, "Ada")
    ...     [each.given["name"] for each in orders.waiting()]
    ['right', 'left']
    """

    def __init__(self, archive: Archive, bench: str) -> None:
        self._archive, self._journal = archive, archive.journal(_PREFIX + bench)

    def add(self, what: What, given: Mapping[str, Any], by: str, session: str = "") -> Order:
        """Put an order at the end of the queue."""
        name = session or str(given["name"])
        if what == "recalibration" and not session:
            name = f"{name}-{self._archive.clock():%Y%m%dT%H%M%SZ}"
        document = {"what": what, "given": dict(given), "session": name, "by": by}
        return self.get(int(self._journal.add("asked", document).key.split()[1]))

    def all(self, last: int = 50) -> list[Order]:
        """Return the last orders, in the order in which they were asked for."""
        entries = self._journal.entries()
        asked = [each for each in entries if each.kind == "asked"][-last:]
        return [self._order(each, entries) for each in asked]

    def get(self, number: int) -> Order:
        """Return an order.

        Raises
        ------
        UsageError
            If there is none of this number.
        """
        entries = self._journal.entries()
        found = [each for each in entries if each.key == f"asked {number}"]
        if not found:
            raise UsageError("is no order of this bench", where=f"order {number}")
        return self._order(found[0], entries)

    def _order(self, asked: Entry, entries: list[Entry]) -> Order:
        """An order, by the entries about it."""
        number, d = int(asked.key.split()[1]), asked.document
        own = [each for each in entries if each.document.get("order") == number]
        log = [(asked.at, f"asked for by {d['by']}")]
        state: OrderState = "waiting"
        why, attempts, again = "", 0, None
        for each in own:
            log.append((each.at, each.document["text"]))
            if each.kind == "begun":
                state, attempts, again = "running", attempts + 1, None
            elif each.kind in ("blocked", "done", "failed", "withdrawn"):
                state, why = cast(OrderState, each.kind), each.document["text"]
                again = each.at + _FIRST_PAUSE * 2 ** (attempts - 1) if state == "blocked" else None
        return Order(
            number, d["what"], d["given"], d["session"], d["by"], asked.at, state, why, attempts, again,
            tuple(log),
        )  # fmt: skip

    def waiting(self) -> list[Order]:
        """Return the orders that are not done, in the order in which they will be."""
        entries = self._journal.entries("first")
        first = {each.document["order"]: number for number, each in enumerate(entries, start=1)}
        found = [each for each in self.all() if each.state in ("waiting", "blocked")]
        return sorted(found, key=lambda each: (-first.get(each.number, 0), each.number))

    @property
    def paused(self) -> str:
        """By whom the queue is paused; empty if it is not."""
        found = [each for each in self._journal.entries() if each.kind in ("paused", "resumed")]
        return str(found[-1].document["by"]) if found and found[-1].kind == "paused" else ""

    def pause(self, by: str, *, pause: bool = True) -> None:
        """Begin no further order, or begin them again."""
        self._journal.add("paused" if pause else "resumed", {"by": by})

    def put_first(self, number: int, by: str) -> None:
        """Have an order done before the others."""
        self._still(number)
        self._journal.add("first", {"order": number, "text": f"put first by {by}"})

    def withdraw(self, number: int, by: str) -> None:
        """Have an order not done.

        Raises
        ------
        StateError
            If it runs, or is over.
        """
        self._still(number)
        self._journal.append(f"over {number}", "withdrawn", {"order": number, "text": f"withdrawn by {by}"})

    def _still(self, number: int) -> None:
        if (found := self.get(number)).state not in ("waiting", "blocked"):
            raise StateError(f"is {found.state}", where=f"order {number}")

    def next(self) -> Order | None:
        """Return the order to begin now; None if there is none, or the queue is paused."""
        now = self._archive.clock()
        ready = [each for each in self.waiting() if each.again is None or each.again <= now]
        return ready[0] if ready and not self.paused else None

    def begin(self, order: Order) -> Order | None:
        """Note that an order is begun; None if somebody else was faster."""
        number = order.attempts + 1
        document = {
            "order": order.number,
            "text": "begun" if number == 1 else f"begun again, attempt {number}",
        }
        made = self._journal.append(f"begun {order.number} {number}", "begun", document)
        return None if made is None else self.get(order.number)

    def note(self, order: Order, text: str) -> None:
        """Add a line to the log of an order."""
        self._journal.add("note", {"order": order.number, "text": text})

    def end(self, order: Order, outcome: str) -> None:
        """Note that an order is done."""
        self._journal.append(f"over {order.number}", "done", {"order": order.number, "text": outcome})

    def fail(self, order: Order, error: ReseauError) -> None:
        """Note why an order could not be carried out; what an instrument caused is tried again."""
        document = {"order": order.number, "text": str(error)}
        if isinstance(error, InstrumentError) and order.attempts < _TRIES:
            self._journal.append(f"blocked {order.number} {order.attempts}", "blocked", document)
        else:
            self._journal.append(f"over {order.number}", "failed", document)

    def interrupted(self) -> None:
        """Have orders continued whose worker ended; called by the one that holds the instruments now."""
        for each in self.all():
            if each.state == "running":
                self.fail(each, InstrumentError("ended while it ran", where="worker"))


def owner(bench: str) -> str:
    """The owner that the worker of a service gives for the locks of its bench."""
    return f"reseau serve, bench {bench}"


def held_by_service(bench: BenchFile) -> bool:
    """Return whether the worker of a service holds the instruments of a bench."""
    holders = [BenchLock.holder(each.address) for each in bench.instruments.values()]
    return any(each is not None and each.owner == owner(bench.name) for each in holders)


def asked(
    archive: Archive, bench: str, what: What, given: Mapping[str, Any], by: str, session: str,
    over: Callable[[float], bool], patience_s: float = 30.0,
) -> Order:  # fmt: skip
    """Ask the owner of a bench for something, and wait until it is over.

    Parameters
    ----------
    archive : Archive
        The archive that both use.
    bench : str
        Name of the bench.
    what, given, by, session
        As for :meth:`Orders.add`.
    over : callable
        Waits for some seconds, and returns whether the waiting should end.
    patience_s : float
        Time after which nobody takes orders for this bench.

    Raises
    ------
    StateError
        If nobody takes the order.
    UsageError
        If it is withdrawn, or fails.
    """
    orders = Orders(archive, bench)
    order, begun = orders.add(what, given, by, session), archive.clock()
    while order.state not in OVER:
        idle = all(each.state != "running" for each in orders.all())
        late = (archive.clock() - begun).total_seconds() > patience_s
        if over(0.5) or (order.attempts == 0 and idle and late and not orders.paused):
            orders.withdraw(order.number, by)
            raise StateError("was not begun", where=f"order {order.number}", do="see the page of the bench")
        order = orders.get(order.number)
    if order.state != "done":
        raise UsageError(f"{order.state}: {order.why}", where=f"order {order.number}")
    return order
