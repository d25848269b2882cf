"""Acquisitions on a bench: instruments, plans, and the engine that carries plans out into an archive."""

from ..instruments import RemoteOperator
from . import by_hand
from .acquisition import Acquisition, Plan
from .bench import ROLES, Bench, BenchFile, Checked, InstrumentEntry, drivers, found_instruments, plugin
from .checks import (
    Limits,
    Readiness,
    edge_sigma,
    exposure_fault,
    exposure_of,
    grey_counts,
    readiness,
    shift_between,
)
from .discovery import bench_text
from .engine import Control, Decision, Rerun, carry_out, rerun
from .judging import Procedure, Watch
from .lighting import LightRule, Steered, level_of, next_light, steer
from .lock import BenchLock, Holder
from .plans import Goal, SensorSeriesPlan
from .steps import HEIGHT, Step, at_heights, paper_steps, read_steps, spread

__all__ = [
    "HEIGHT",
    "ROLES",
    "Acquisition",
    "Bench",
    "BenchFile",
    "BenchLock",
    "Checked",
    "Control",
    "Decision",
    "Goal",
    "Holder",
    "InstrumentEntry",
    "LightRule",
    "Limits",
    "Plan",
    "Procedure",
    "Readiness",
    "RemoteOperator",
    "Rerun",
    "SensorSeriesPlan",
    "Steered",
    "Step",
    "Watch",
    "at_heights",
    "bench_text",
    "by_hand",
    "carry_out",
    "drivers",
    "edge_sigma",
    "exposure_fault",
    "exposure_of",
    "found_instruments",
    "grey_counts",
    "level_of",
    "next_light",
    "paper_steps",
    "plugin",
    "read_steps",
    "readiness",
    "rerun",
    "shift_between",
    "spread",
    "steer",
]
