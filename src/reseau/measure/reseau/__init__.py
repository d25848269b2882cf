"""The marks of a reseau, or the disks of a sheet, in one frame: found, numbered, measured."""

from .measure import ReseauOptions, ReseauResult, measure_reseau

__all__ = ["ReseauOptions", "ReseauResult", "measure_reseau"]
