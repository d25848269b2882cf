"""One frame to image coordinates: marks of a reseau, a testfield or a sheet, pins, edges of film frames."""

from .boards import (
    BoardOptions,
    BoardResult,
    PuzzlePart,
    boards_shown,
    measure_board,
    measure_tags,
    puzzle_part,
)
from .fitting import fit_mapping, mapping_problem, reduce_mapping
from .matching import Matches, MatchOptions, match
from .pins import (
    Layout,
    LayoutOptions,
    PinDetections,
    PinOptions,
    PinResult,
    Wires,
    find_pins,
    lay_wires,
    measure_pins,
)
from .reseau import ReseauOptions, ReseauResult, measure_reseau
from .testfield import TestfieldOptions, TestfieldResult, measure_testfield

__all__ = [
    "BoardOptions",
    "BoardResult",
    "Layout",
    "LayoutOptions",
    "MatchOptions",
    "Matches",
    "PinDetections",
    "PinOptions",
    "PinResult",
    "PuzzlePart",
    "ReseauOptions",
    "ReseauResult",
    "TestfieldOptions",
    "TestfieldResult",
    "Wires",
    "boards_shown",
    "find_pins",
    "fit_mapping",
    "lay_wires",
    "mapping_problem",
    "match",
    "measure_board",
    "measure_pins",
    "measure_reseau",
    "measure_tags",
    "measure_testfield",
    "puzzle_part",
    "reduce_mapping",
]
