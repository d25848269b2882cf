"""A plan carried out on a bench: every picture is in the archive before the next thing happens.

Plans are those of bluesky, generators of messages. Some messages are this module's own, `expose`, `series`,
`picture` and `ask` among them. What they bring is stored under the name of the step, and a step that has its
picture does not take it again: a message that is replayed after a pause, or a plan that begins anew after a
crash, finds what is there.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

from bluesky import Msg
from bluesky import plan_stubs as bps

from ..core.errors import StateError, UsageError
from ..instruments import Oscilloscope, Turntable
from .step import Step
from .work import Work

__all__ = ["Acquisition", "Plan"]

Plan = Generator[Msg, Any, Any]


def message(command: str, *args: Any, **kwargs: Any) -> Msg:
    """A message of a plan."""
    return Msg(command, *args, **kwargs)  # type: ignore[no-untyped-call]


class Acquisition(Work):
    """A session on a bench, as plans and bluesky's engine have it; parameters as of :class:`Work`."""

    name = "acquisition"
    parent = None

    # Messages for plans.

    def at(self, step: Step, average: int = 1) -> Plan:
        """Go to a pose and take its frame, again if it is bad; nothing where it has been done before.

        Returns
        -------
        ArchivedFrame
            The last one taken there.
        """
        yield from bps.checkpoint()
        if not self.done(step):
            yield from self.move(step.position)
        found = yield message("expose", self, step, average=average)
        yield from bps.create("primary")
        yield from bps.read(self)
        yield from bps.save()
        return found

    def series(self, steps: Sequence[Step]) -> Plan:
        """Take frames of one scene as fast as the camera delivers them, a step for each; only those that are
        not there.
        """
        yield from bps.checkpoint()
        yield message("series", self, steps)
        yield from bps.create("primary")
        yield from bps.read(self)
        yield from bps.save()

    def set_back(self) -> Plan:
        """Have the camera expose as it did before the steps that set it."""
        yield message("set_back", self)

    def move(self, position: Mapping[str, float]) -> Plan:
        """Move axes of the table, all at once."""
        if position:
            axes = self.one(Turntable).axes
            unknown = [axis for axis in position if axis not in axes]
            if unknown:
                raise UsageError(f"has no axis {unknown[0]}", where="table", do=f"it has {', '.join(axes)}")
            yield message("move", self, dict(position))

    def home(self) -> Plan:
        """Have the axes of the table that have no reference find it; where they drive to is theirs."""
        yield message("home", self)

    def pictures(self, step: Step, kind: str) -> Plan:
        """Sweep with the scanner (`scan`), keep what the oscilloscope's own screen shows (`screen`), or a
        frame that nothing is measured in (`probe`).

        Returns
        -------
        ArchivedFrame or None
            None where the bench has no oscilloscope for a screen.
        """
        if kind != "screen" or self.has(Oscilloscope):
            return (yield message("picture", self, step, kind))
        return None

    def ask(self, what: str, step: Step) -> Plan:
        """Have the operator do something before a step; not where the step has been done."""
        if not self.done(step):
            yield message("ask", self, what)

    def check(self, count: int = 5) -> Plan:
        """Take some frames of the unmoved scene; their exposure, focus, vibration and drift.

        Returns
        -------
        Readiness
            Falsy, with the reasons, when something is beyond its limits.
        """
        return (yield message("check", self, count))

    def choose(self, candidates: Sequence[Step], wanted: str) -> Plan:
        """Ask the procedure for the pose that lowers a standard deviation most.

        Returns
        -------
        (Step, float) or None
            The pose, and what is predicted of it.
        """
        return (yield message("choose", self, candidates, wanted))

    def outlook(self, step: Step) -> Plan:
        """Have it told what the next pose would bring, where that can be predicted."""
        if self.procedure is not None and not self.done(step):
            yield message("outlook", self, step)

    @property
    def commands(self) -> dict[str, Callable[[Msg], Any]]:
        """The messages above, for ``RunEngine.register_command``."""
        work: dict[str, Callable[..., Any]] = {
            "expose": self.expose,
            "series": self.expose_series,
            "set_back": self.restore_exposure,
            "move": self.move_to,
            "home": self.home_axes,
            "picture": self.take_picture,
            "ask": self.have_done,
            "check": self.look_first,
            "choose": self.choose_pose,
            "outlook": self.foretell,
        }

        def registered(do: Callable[..., Any]) -> Callable[[Msg], Any]:
            async def command(msg: Msg) -> Any:
                return await asyncio.get_running_loop().run_in_executor(
                    None, lambda: do(*msg.args, **msg.kwargs)
                )

            return command

        return {name: registered(do) for name, do in work.items()}

    # What bluesky asks of an object that is read, and paused.

    def read(self) -> dict[str, Any]:
        """The last frame: which step and take, its hash, whether it is good."""
        last = self._last
        if last is None:
            raise StateError("no frame has been taken", where=self.name)
        verdict = self._known[last.id]
        values = {
            "step": last.step,
            "take": last.take,
            "frame": last.sha256,
            "ok": verdict.ok,
            "why": verdict.why,
        }
        return {name: {"value": value, "timestamp": 0.0} for name, value in values.items()}

    def describe(self) -> dict[str, Any]:
        """What a reading holds."""
        kinds = {"step": "string", "take": "integer", "frame": "string", "ok": "boolean", "why": "string"}
        return {name: {"source": self.name, "dtype": kind, "shape": []} for name, kind in kinds.items()}

    def read_configuration(self) -> dict[str, Any]:
        """Nothing; instruments have their own."""
        return {}

    def describe_configuration(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def pause(self) -> None:
        """Bring the bench to rest; called by the engine before it waits."""
        self.rest()

    def resume(self) -> None:
        """Make the bench ready again; called by the engine before it goes on."""
        self.ready()
