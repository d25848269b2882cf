"""What is seen of an acquisition: a bar where there is a terminal, lines elsewhere, JSON for programs."""

from __future__ import annotations

import json
import sys
import time
from typing import Any, Self

__all__ = ["Display"]


class Display:
    """Shows the events of an acquisition.

    Parameters
    ----------
    as_json : bool
        Whether every event is a line of JSON on standard output.
    total : int, optional
        Poses, where it is known how many there will be.
    """

    def __init__(self, as_json: bool, total: int | None) -> None:
        self._json, self._total = as_json, total
        self._poses, self._frames, self._reached = 0, 0, ""
        self._began = time.monotonic()
        self._bar: Any = None
        self._stream = sys.stdout  # while the engine runs, what it prints itself goes elsewhere

    def __enter__(self) -> Self:
        if not self._json and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=30),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task("begins", total=self._total)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def watch(self, kind: str, facts: dict[str, Any]) -> None:
        """Show an event."""
        if self._json:
            self._say(json.dumps({"event": kind, **facts}, default=str))
            return
        if kind == "precision":
            self._reached = _told(facts)
        if kind == "frame":
            self._frames += 1
            self._poses += bool(facts["ok"])
            self._reached = ""
        if self._bar is not None:
            text = f"{facts.get('step', kind)} · {self._frames} frames {self._reached}"
            self._bar.update(self._task, completed=self._poses, description=text)
        else:
            self._line(kind, facts)

    def _line(self, kind: str, facts: dict[str, Any]) -> None:
        """One line for what is worth one."""
        if kind == "frame":
            of = f"/{self._total}" if self._total else ""
            outcome = f"{facts['points']} points" if "points" in facts else "good"
            take = f" take {facts['take']}" if facts["take"] else ""
            left = self._left()
            outcome = outcome if facts["ok"] else facts["why"]
            self._say(f"{self._poses}{of} {facts['step']}{take}: {outcome}{left}")
        elif kind == "precision":
            self._say(f"    {self._reached}")
        elif kind == "outlook":
            self._say(
                f"    {facts['step']} would bring {_told(facts)}" if "why" not in facts else facts["why"]
            )
        elif kind == "next":
            self._say(f"next: {facts['step']}" if facts["step"] else "no pose is left")
        elif kind == "check":
            self._say("checks: " + ("; ".join(facts["faults"]) or "good"))
        elif kind == "again":
            self._say(f"once more: {facts['why']}")
        elif kind == "rest" and "failed" in facts:
            self._say(f"at rest, but: {facts['failed']}")

    def _say(self, line: str) -> None:
        self._stream.write(line + "\n")
        self._stream.flush()

    def _left(self) -> str:
        if not self._total or not self._poses or self._poses >= self._total:
            return ""
        seconds = (time.monotonic() - self._began) / self._poses * (self._total - self._poses)
        return f", {seconds:.0f} s left"


def _told(facts: dict[str, Any]) -> str:
    """Precision reached, as people read it."""
    values = [(name, value) for name, value in facts.items() if isinstance(value, float)]
    return "  ".join(f"{name} {value:.3g}" for name, value in values)
