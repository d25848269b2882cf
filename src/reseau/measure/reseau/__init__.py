"""The marks of a reseau, or the disks of a sheet, in one frame: found, numbered, measured."""

from .marks import ReseauOptions
from .measure import ReseauResult, measure_reseau

__all__ = ["ReseauOptions", "ReseauResult", "measure_reseau"]
