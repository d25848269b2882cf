"""Display of an acquisition: text lines with a progress bar, or JSON lines for programs."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, Self, TypeVar

from .common import remark_lines

P = ParamSpec("P")
T = TypeVar("T")


class Display:
    """Prints the events of an acquisition.

    Parameters
    ----------
    as_json : bool
        Whether to print each event as a line of JSON on standard output.
    total : int, optional
        Number of poses, if known.
    sections : bool
        Whether to count sections of the scanner instead of frames.
    units : mapping of str to str, optional
        Units of the standard deviations, by parameter.
    """

    def __init__(
        self,
        as_json: bool,
        total: int | None,
        sections: bool = False,
        units: Mapping[str, str] | None = None,
    ) -> None:
        self._json, self._total, self._sections, self._units = as_json, total, sections, dict(units or {})
        self._poses, self._stored, self._frames, self._reached = 0, 0, 0, ""
        self._start = time.monotonic()
        self._bar: Any = None
        self._stream = sys.stdout  # the engine redirects sys.stdout while it runs

    def __enter__(self) -> Self:
        if not self._json and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
            from rich.table import Column

            # A narrow terminal shows only the start of the text.
            rest = Column(ratio=1, no_wrap=True, overflow="ellipsis")
            text = TextColumn("{task.description}", table_column=rest)
            columns = BarColumn(bar_width=12), MofNCompleteColumn(), TimeRemainingColumn(), text
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True, expand=True)
            self._bar.start()
            self._task = self._bar.add_task("starting", total=self._total)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def aside(self, question: Callable[P, T]) -> Callable[P, T]:
        """Return a function that hides the bar while it asks a question."""

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
        """Print an event."""
        if self._json:
            # JSON has no NaN or infinity.
            plain = {
                k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in facts.items()
            }
            self._print(json.dumps({"event": kind, **plain}, default=str))
            return
        if kind == "precision":
            self._reached = self._precision(facts)
        if kind == "frame" or self._counted(facts):
            self._frames += 1
            self._poses += facts.get("ok", True)
            self._stored += facts.get("ok", True) and facts.get("there", False)
            if self._poses == self._stored:
                self._start = time.monotonic()
        line = self._line(kind, facts)
        if line:
            self._print(line)
        if self._bar is not None:
            first = self._reached.split("  ")[0]  # all of them are printed above the bar
            parts = [first, f"{self._frames} frames", facts.get("step") or kind]
            self._bar.update(self._task, completed=self._poses, description=" · ".join(filter(None, parts)))

    def _counted(self, facts: dict[str, Any]) -> bool:
        """Whether a picture is counted."""
        return self._sections and facts.get("kind") == "scan"

    def _line(self, kind: str, facts: dict[str, Any]) -> str:
        """Return the line for an event, or an empty string."""
        if kind == "begin":
            return f"session {facts['session']}"
        if kind == "frame":
            of = f"/{self._total}" if self._total else ""
            good = f"{facts['points']} points" if "points" in facts else "good"
            take = f" take {facts['take']}" if facts["take"] else ""
            outcome = good if facts["ok"] else facts["why"]
            return f"{self._poses}{of} {facts['step']}{take}: {outcome}{self._remaining()}"
        if kind == "picture":
            at = f"{self._poses}/{self._total} " if self._counted(facts) else ""
            return f"{at}{facts['step']}: {facts['kind']}"
        if kind == "precision":
            scatter = facts.get("scatter", 0.0)
            doubt = (
                f"\n    images have errors in common: sigmas are {scatter:.1f} times the formal ones"
                if scatter > 2
                else ""
            )
            return f"    {self._reached}{doubt}"
        if kind == "outlook":
            if "why" in facts:
                return f"    next {facts['step']}: no prediction ({facts['why']})"
            return f"    next {facts['step']}: {self._precision(facts)} predicted"
        if kind == "next":
            predicted = self._precision(facts)
            tail = f": {predicted} predicted" if predicted else ""
            return f"next pose {facts['step']}{tail}" if facts["step"] else "no pose is left"
        if kind == "check":
            return "checks: " + ("; ".join(facts["faults"]) or "passed")
        if kind == "interrupt":
            waits = f"pausing after {facts['waits_for'] or 'this step'}; Ctrl-C again pauses at once"
            return "pausing at once" if facts["at_once"] else waits
        if kind == "home":
            return f"homing {facts['axis']}"
        if kind == "asked":
            return f"asked {facts['operator']}: {facts['request']}"
        if kind == "verdict":
            return "\n".join((*facts["lines"], *remark_lines(facts["warnings"], facts["tests"])))
        if kind == "without":
            return f"without {facts['instrument']}: {facts['why']}"
        if kind == "again":
            return f"retry: {facts['why']}"
        if kind == "rest" and "failed" in facts:
            return f"stopped, but: {facts['failed']}"
        return ""

    def _print(self, line: str) -> None:
        if self._bar is not None and self._stream.isatty():
            self._bar.console.print(line, markup=False, highlight=False)
            return
        self._stream.write(line + "\n")
        self._stream.flush()

    def _remaining(self) -> str:
        """Remaining time, from the frames taken by this process."""
        taken = self._poses - self._stored
        if not self._total or not taken or self._poses >= self._total:
            return ""
        seconds = (time.monotonic() - self._start) / taken * (self._total - self._poses)
        return f", {seconds:.0f} s left"

    def _precision(self, facts: dict[str, Any]) -> str:
        """Standard deviations to two digits, with units."""
        parts = []
        for name, value in facts.items():
            if isinstance(value, float) and name != "scatter":
                unit = self._units.get(name.removeprefix("sigma_"), "")
                parts.append(f"{name} {value:.2g}{' ' if unit else ''}{unit}")
        return "  ".join(parts)
