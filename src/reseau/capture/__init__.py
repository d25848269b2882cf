"""Acquisitions on a bench: instruments, plans, and the engine that carries plans out into an archive."""

from ..core.plugins import plugin
from ..instruments import RemoteOperator
from . import by_hand
from .acquisition import Acquisition
from .bench import Bench, BenchFile, InstrumentEntry, found_instruments
from .engine import carry_out
from .lock import BenchLock
from .plans import Goal, SensorSeriesPlan
from .steps import Step, paper_steps, spread

__all__ = [
    "Acquisition",
    "Bench",
    "BenchFile",
    "BenchLock",
    "Goal",
    "InstrumentEntry",
    "RemoteOperator",
    "SensorSeriesPlan",
    "Step",
    "by_hand",
    "carry_out",
    "found_instruments",
    "paper_steps",
    "plugin",
    "spread",
]
