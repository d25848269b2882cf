"""From instruments to frames: the bench, plans, and what carries them out into an archive."""

from .acquisition import Acquisition, Plan
from .bench import Bench, BenchFile, Checked, InstrumentEntry, drivers, found_instruments, plugin
from .checks import Limits, Readiness, edge_sigma, exposure_fault, readiness, shift_between
from .goal import Goal
from .lock import BenchLock
from .procedure import Procedure, Watch
from .rerun import Rerun, rerun
from .run import Decision, carry_out
from .step import HEIGHT, Step, at_heights, paper_steps, read_steps, spread

__all__ = [
    "HEIGHT",
    "Acquisition",
    "Bench",
    "BenchFile",
    "BenchLock",
    "Checked",
    "Decision",
    "Goal",
    "InstrumentEntry",
    "Limits",
    "Plan",
    "Procedure",
    "Readiness",
    "Rerun",
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
