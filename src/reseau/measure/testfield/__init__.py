"""Measurement of a coded testfield in one frame: find its lines, read its squares, measure its targets."""

from .measure import TestfieldOptions, TestfieldResult, measure_testfield

__all__ = ["TestfieldOptions", "TestfieldResult", "measure_testfield"]
