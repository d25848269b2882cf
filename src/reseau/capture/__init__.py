"""From instruments to frames: the bench, and what is found on it."""

from .bench import Bench, BenchFile, Checked, InstrumentEntry, drivers, found_instruments, plugin

__all__ = ["Bench", "BenchFile", "Checked", "InstrumentEntry", "drivers", "found_instruments", "plugin"]
