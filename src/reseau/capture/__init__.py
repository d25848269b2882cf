"""Acquisitions on a bench: instruments, plans, and the engine that carries plans out into an archive."""

from .acquisition import Acquisition, Plan, Procedure, Watch
from .bench import Bench, BenchFile, Checked, InstrumentEntry, drivers, found_instruments, plugin
from .checks import Limits, Readiness, edge_sigma, exposure_fault, readiness, shift_between
from .engine import Control, Decision, Rerun, carry_out, rerun
from .lock import BenchLock
from .plans import Goal, SensorSeriesPlan
from .steps import HEIGHT, Step, at_heights, paper_steps, read_steps, spread

__all__ = [
    "HEIGHT",
    "Acquisition",
    "Bench",
    "BenchFile",
    "BenchLock",
    "Checked",
    "Control",
    "Decision",
    "Goal",
    "InstrumentEntry",
    "Limits",
    "Plan",
    "Procedure",
    "Readiness",
    "Rerun",
    "SensorSeriesPlan",
    "Step",
    "Watch",
    "at_heights",
    "carry_out",
    "drivers",
    "edge_sigma",
    "exposure_fault",
    "found_instruments",
    "paper_steps",
    "plugin",
    "read_steps",
    "readiness",
    "rerun",
    "shift_between",
    "spread",
]
