"""What is seen of an acquisition: lines, below them a bar where there is a terminal; JSON for programs."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any, ParamSpec, Self, TypeVar

__all__ = ["Display"]

P = ParamSpec("P")
T = TypeVar("T")


class Display:
    """Shows the events of an acquisition.

    Parameters
    ----------
    as_json : bool
        Whether every event is a line of JSON on standard output.
    total : int, optional
        Poses, where it is known how many there will be.
    sections : bool
        Whether it is the scanner's sections that are counted.
    """

    def __init__(self, as_json: bool, total: int | None, sections: bool = False) -> None:
        self._json, self._total, self._sections = as_json, total, sections
        self._poses, self._there, self._frames, self._reached = 0, 0, 0, ""
        self._began = time.monotonic()
        self._bar: Any = None
        self._stream = sys.stdout  # while the engine runs, what it prints itself goes elsewhere

    def __enter__(self) -> Self:
        if not self._json and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
            from rich.table import Column

            # Where the terminal is narrow, what is told last is cut off.
            rest = Column(ratio=1, no_wrap=True, overflow="ellipsis")
            text = TextColumn("{task.description}", table_column=rest)
            columns = BarColumn(bar_width=12), MofNCompleteColumn(), TimeRemainingColumn(), text
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True, expand=True)
            self._bar.start()
            self._task = self._bar.add_task("begins", total=self._total)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def aside(self, question: Callable[P, T]) -> Callable[P, T]:
        """What asks somebody something, and the bar is out of the way for as long."""

        def asked(*args: P.args, **kwargs: P.kwargs) -> T:
            if self._bar is None:
                return question(*args, **kwargs)
            self._bar.stop()
            try:
                return question(*args, **kwargs)
            finally:
                self._bar.start()

        return asked

    def watch(self, kind: str, facts: dict[str, Any]) -> None:
        """Show an event."""
        if self._json:
            # JSON has no word for what is no number.
            plain = {
                k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in facts.items()
            }
            self._say(json.dumps({"event": kind, **plain}, default=str))
            return
        if kind == "precision":
            self._reached = _told(facts)
        if kind == "frame" or self._counted(facts):
            self._frames += 1
            self._poses += facts.get("ok", True)
            self._there += facts.get("ok", True) and facts.get("there", False)
            if self._poses == self._there:
                self._began = time.monotonic()
        line = self._line(kind, facts)
        if line:
            self._say(line)
        if self._bar is not None:
            first = self._reached.split("  ")[0]  # all of them stand above
            told = [first, f"{self._frames} frames", facts.get("step") or kind]
            self._bar.update(self._task, completed=self._poses, description=" · ".join(filter(None, told)))

    def _counted(self, facts: dict[str, Any]) -> bool:
        """Whether a picture is one of those that are counted."""
        return self._sections and facts.get("kind") == "scan"

    def _line(self, kind: str, facts: dict[str, Any]) -> str:
        """One line for what is worth one."""
        if kind == "begin":
            return f"session {facts['session']}"
        if kind == "frame":
            of = f"/{self._total}" if self._total else ""
            good = f"{facts['points']} points" if "points" in facts else "good"
            take = f" take {facts['take']}" if facts["take"] else ""
            outcome = good if facts["ok"] else facts["why"]
            return f"{self._poses}{of} {facts['step']}{take}: {outcome}{self._left()}"
        if kind == "picture":
            at = f"{self._poses}/{self._total} " if self._counted(facts) else ""
            return f"{at}{facts['step']}: {facts['kind']}"
        if kind == "precision":
            return f"    {self._reached}"
        if kind == "outlook":
            known = "why" not in facts
            return f"    {facts['step']} " + (
                f"would bring {_told(facts)}" if known else f"cannot be foretold yet: {facts['why']}"
            )
        if kind == "next":
            predicted = _told(facts)
            brings = f", would bring {predicted}" if predicted else ""
            return f"next: {facts['step']}{brings}" if facts["step"] else "no pose is left"
        if kind == "check":
            return "checks: " + ("; ".join(facts["faults"]) or "good")
        if kind == "again":
            return f"once more: {facts['why']}"
        if kind == "rest" and "failed" in facts:
            return f"at rest, but: {facts['failed']}"
        return ""

    def _say(self, line: str) -> None:
        if self._bar is not None and self._stream.isatty():
            self._bar.console.print(line, markup=False, highlight=False)
            return
        self._stream.write(line + "\n")
        self._stream.flush()

    def _left(self) -> str:
        """How long the rest takes, by those that have been taken now."""
        taken = self._poses - self._there
        if not self._total or not taken or self._poses >= self._total:
            return ""
        seconds = (time.monotonic() - self._began) / taken * (self._total - self._poses)
        return f", {seconds:.0f} s left"


def _told(facts: dict[str, Any]) -> str:
    """Precision reached, as people read it."""
    values = [(name, value) for name, value in facts.items() if isinstance(value, float)]
    return "  ".join(f"{name} {value:.3g}" for name, value in values)
