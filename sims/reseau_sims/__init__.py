"""Simulated instruments in one shared, seeded world."""

from .camera import FilmCamera, film
from .display import Bending, Display, Instrument
from .faults import Faults, swapped
from .photograph import Photograph
from .plate import Plate
from .reflectors import Reflectors
from .scanner import Scanner, Video
from .screen import Screen
from .testfield import FieldBench, FieldTruth, Stain, Station, paper_stations
from .water import Water
from .world import Truth, World

__all__ = [
    "Bending",
    "Display",
    "Faults",
    "FieldBench",
    "FieldTruth",
    "FilmCamera",
    "Instrument",
    "Photograph",
    "Plate",
    "Reflectors",
    "Scanner",
    "Screen",
    "Stain",
    "Station",
    "Truth",
    "Video",
    "Water",
    "World",
    "film",
    "paper_stations",
    "swapped",
]
