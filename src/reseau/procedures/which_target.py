"""Which of several targets photographs show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path

import cv2
import numpy as np

from ..core.data import Frame
from ..core.errors import ReseauError
from ..core.failure import Code, Failure
from ..designs import board
from ..designs.known import known_designs
from ..exchange import read_target
from ..io import BoardDesign, ReseauDesign, TestfieldDesign
from ..measure import PuzzlePart, puzzle_part
from .target_measurement import measurer_of

__all__ = ["designs_beside", "which_target"]

Design = ReseauDesign | TestfieldDesign | BoardDesign
_DESIGNS = (".json", ".yaml", ".yml", ".xml")
_ENOUGH, _LEAST = 0.8, 8
_LONG_PX = 1600
"""Length of the longer side of a frame from whose double it is reduced."""
_PUZZLE_MM = 10.0
"""Side of the squares of a PuzzleBoard of which nothing is known."""
_APART = 10
"""Corners between two parts of a code that may belong to one board."""
_MORE, _LARGER = 6, 1 / 3
"""Further photographs in which a plain pattern is looked for; the most that may show a larger lattice, as a
share of those that show it: something beside a board may continue it by chance."""
_CODED, _PLAIN, _LINED = range(3)
"""Kinds of targets in the order in which they are looked for."""


def designs_beside(folders: Iterable[Path]) -> dict[str, Design]:
    """Designs in folders, by their files, and then those that `reseau design` draws by default.

    Examples
    --------
    >>> list(designs_beside([]))[0]
    'sheet on A4'
    """
    found = dict[str, Design]()
    for folder in folders:
        for file in sorted(path for path in folder.glob("*") if path.suffix.lower() in _DESIGNS):
            try:
                found[str(file)] = read_target(file)
            except ReseauError:
                continue  # another document
    return found | dict(known_designs())


def which_target(
    frames: Iterable[Frame], designs: Mapping[str, Design], tried: int = 3
) -> tuple[str, Design] | Failure:
    """Find the target that photographs show.

    Targets that identify themselves are tried before plain chessboards and grids, and given ones before
    others; a target is taken if it has nearly as many points as that with the most. Targets of the same
    pattern in other sizes are not distinguished: the calibration does not depend on the size. A PuzzleBoard
    that is not among the candidates is found, too, by the part of its code that all photographs show.

    Parameters
    ----------
    frames : iterable of Frame
        Photographs.
    designs : mapping of str to design
        The candidates.
    tried : int
        Number of photographs in which targets are looked for; others are taken from the iterable where they
        tell how large a PuzzleBoard is, or whether a plain pattern is a part of a larger one.

    Examples
    --------
    >>> which_target([], {}).code
    <Code.NOT_FOUND: 'not-found'>
    """
    others = iter(frames)
    full = list(islice(others, tried))
    small = [_reduced(frame) for frame in full]
    usual = next((d for d in designs.values() if isinstance(d, BoardDesign) and d.kind == "puzzle"), None)
    puzzle = _puzzle_of(small, usual)
    candidates = designs if puzzle is None else {**designs, puzzle[0]: puzzle[1]}
    points = _counted(small, candidates)
    if not any(points.values()) and any(a is not b for a, b in zip(full, small, strict=True)):
        points = _counted(full, candidates)
    order = sorted(candidates, key=lambda name: _plain(candidates[name]))
    further: list[Frame] | None = None
    while most := max(points.values(), default=0):
        name = next(name for name in order if points[name] >= _ENOUGH * most)
        if puzzle is not None and name == puzzle[0]:
            # Those tried may show a part of it.
            return _puzzle_of(chain(small, map(_reduced, others)), usual) or puzzle
        if not _plain(candidates[name]):
            return name, candidates[name]
        if further is None:
            further = [*full, *islice(others, _MORE)]
        if not _is_part_of_another(further, candidates[name]):
            return name, candidates[name]
        pattern = _pattern(candidates[name])
        points |= {name: 0 for name, design in candidates.items() if _pattern(design) == pattern}
    return Failure(
        "none of the known targets is seen; describe yours with `reseau design board --out board.json`, and "
        "give that file",
        Code.NOT_FOUND,
    )


def _is_part_of_another(frames: Iterable[Frame], design: Design) -> bool:
    """Whether photographs show a larger lattice: parts of it may pass for the design."""
    shown = larger = 0
    for frame in frames:
        measured = measurer_of(design)(_reduced(frame))
        shown += not isinstance(measured, Failure)
        larger += isinstance(measured, Failure) and measured.code is Code.OTHER_DESIGN
    return larger > _LARGER * shown


def _puzzle_of(frames: Iterable[Frame], usual: BoardDesign | None) -> tuple[str, BoardDesign] | None:
    """A PuzzleBoard with all corners that frames show, squares and dots as usual, and its description."""
    parts = [part for part in map(puzzle_part, frames) if not isinstance(part, Failure)]
    if not parts:
        return None
    low, high = _together(parts)
    columns, rows = (b - a + 1 for a, b in zip(low, high, strict=True))
    pitch = _PUZZLE_MM if usual is None else usual.pitch
    size = None if usual is None else usual.size
    # The outer squares are halves.
    design = board("puzzle", columns + 1, rows + 1, pitch, size=size, start=low)
    text = f"PuzzleBoard of {columns} × {rows} corners from column {low[0]} and row {low[1]} of its code"
    return f"a {text}, with squares of {pitch:g} mm", design


def _together(parts: list[PuzzlePart]) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last column and row of the parts that belong to the same board as the largest."""
    rest = sorted(parts, key=lambda part: -part.corners)
    first = rest.pop(0)
    low, high = np.array(first.low), np.array(first.high)
    while True:
        near = [
            (np.array(part.low) <= high + _APART).all() and (np.array(part.high) >= low - _APART).all()
            for part in rest
        ]
        if not any(near):
            return (int(low[0]), int(low[1])), (int(high[0]), int(high[1]))
        for part, joined in zip(rest, near, strict=True):
            if joined:
                low, high = np.minimum(low, part.low), np.maximum(high, part.high)
        rest = [part for part, joined in zip(rest, near, strict=True) if not joined]


def _reduced(frame: Frame) -> Frame:
    """The frame, with its pixels averaged where it is large: which target it shows needs no more of them."""
    h, w = frame.pixels.shape
    factor = max(h, w) // _LONG_PX
    if factor < 2:
        return frame
    pixels = np.ascontiguousarray(frame.pixels[: h // factor * factor, : w // factor * factor])
    size = w // factor, h // factor
    return replace(frame, pixels=np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)))


def _counted(frames: Sequence[Frame], designs: Mapping[str, Design]) -> dict[str, int]:
    """Points of each design measured in all frames; none of plain patterns that most frames do not show.

    A part of a larger grid may pass for a smaller one, the whole does not. What takes long is not looked for
    where something else was found. Designs that a frame showed are looked for in the next one before others.
    """
    patterns = {name: _pattern(design) for name, design in designs.items()}
    total, times, shown = dict.fromkeys(patterns.values(), 0), Counter[str](), len(frames)
    for frame in frames:
        seen: dict[str, int] = {}
        known = any(total.values())
        for found_before in (True, False) if known else (False,):
            if found_before is False and any(seen.values()):
                break
            for effort in (_CODED, _PLAIN, _LINED):
                enough = False
                for name, design in designs.items():
                    pattern = patterns[name]
                    if pattern in seen or _effort(design) != effort:
                        continue
                    if found_before and not total[pattern]:
                        continue
                    measured = measurer_of(design)(frame)
                    count = 0 if isinstance(measured, Failure) else len(measured.points)
                    seen[pattern] = count if count >= _LEAST else 0
                    whole = _ENOUGH * len(design.ids) if _plain(design) else _LEAST
                    enough |= count >= whole
                if enough:
                    break
        for pattern, count in seen.items():
            total[pattern] += count
            times[pattern] += count > 0
    return {
        name: 0 if _plain(designs[name]) and 2 * times[pattern] <= shown else total[pattern]
        for name, pattern in patterns.items()
    }


def _pattern(design: Design) -> str:
    """What distinguishes targets in photographs: all but the size and the name."""
    content = design.to_dict()
    if isinstance(design, BoardDesign):
        size = content.get("size")
        parts = {key: v for key, v in content.items() if key not in ("name", "pitch", "size")}
        return repr((parts, None if size is None else round(size / design.pitch, 3)))
    if isinstance(design, TestfieldDesign):
        return repr(("testfield", design.squares, design.targets.shape, design.polarity))
    scale = float(abs(design.xy).max()) or 1.0
    rings = None if design.rings is None else repr(design.rings.sectors)
    return repr(("reseau", design.ids, (design.xy / scale).round(4).tolist(), rings, design.mark.shape))


def _plain(design: Design) -> bool:
    """Whether nothing but its margin tells a whole target from a part of a larger one."""
    if isinstance(design, TestfieldDesign):
        return False
    if isinstance(design, BoardDesign):
        return design.kind in ("circles", "deltille") or (design.kind == "chess" and not design.dots)
    return design.rings is None


def _effort(design: Design) -> int:
    """What finding the target takes: markers or rings are read, lattices grown, lines laid."""
    if isinstance(design, TestfieldDesign) or (isinstance(design, BoardDesign) and design.kind == "deltille"):
        return _LINED
    return _PLAIN if _plain(design) else _CODED
