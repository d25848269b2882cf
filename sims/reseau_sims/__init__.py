"""Instruments that behave like hardware, all in one shared world; in process for now."""

from .camera import Camera, film
from .faults import Faults
from .plate import Plate
from .screen import Screen
from .world import Truth, World

__all__ = ["Camera", "Faults", "Plate", "Screen", "Truth", "World", "film", "simulated_bench"]


def simulated_bench(seed: int = 0) -> World:
    """The bench that stands in for one of real instruments; found by its entry point."""
    return World.standard(seed)
