"""A coded testfield in one frame: its lines, its squares read by their code, its targets measured."""

from .measure import TestfieldOptions, TestfieldResult, measure_testfield

__all__ = ["TestfieldOptions", "TestfieldResult", "measure_testfield"]
