"""Instruments that behave like hardware, all in one shared world."""

from .camera import Camera, film
from .display import Bending, Display, Instrument
from .faults import Faults, swapped
from .plate import Plate
from .reflectors import Reflectors
from .scanner import Scanner, Video
from .screen import Screen
from .testfield import FieldBench, FieldTruth, Stain, Station, paper_stations
from .world import Truth, World

__all__ = [
    "Bending",
    "Camera",
    "Display",
    "Faults",
    "FieldBench",
    "FieldTruth",
    "Instrument",
    "Plate",
    "Reflectors",
    "Scanner",
    "Screen",
    "Stain",
    "Station",
    "Truth",
    "Video",
    "World",
    "film",
    "paper_stations",
    "swapped",
]
