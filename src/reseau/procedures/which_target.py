"""Which of several targets photographs show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from ..core.data import Frame, ImagePoints
from ..core.errors import ImageError, ReseauError
from ..core.failure import Code, Failure
from ..designs import board
from ..designs.known import known_designs
from ..exchange.boards import read_target
from ..io import BoardDesign, ReseauDesign, TestfieldDesign
from ..io.reading import is_points
from ..measure.boards.measure import puzzle_part
from ..measure.boards.puzzles import PuzzlePart
from ..measure.boards.shown import boards_shown
from .target_measurement import measurer_of

T = TypeVar("T")
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
_LATEST = 2
CONTRADICT = (Code.OTHER_DESIGN, Code.NOT_FOUND, Code.INCONSISTENT, Code.AMBIGUOUS)
"""Why a target is not measured, where a wrong design may be the reason."""
_KINDS = {
    "chess": "a chessboard",
    "puzzle": "a PuzzleBoard",
    "deltille": "a deltille",
    "charuco": "a ChArUco board",
    "circles": "a grid",
    "aprilgrid": "an AprilGrid",
    "markers": "a grid",
}


def designs_beside(folders: Iterable[Path]) -> dict[str, Design]:
    """Designs in folders, by their files, and then those that `reseau design` draws by default.

    Examples
    --------
    >>> list(designs_beside([]))[0]
    'sheet on A4'
    """
    found = dict[str, Design]()
    for folder in {folder.resolve(): folder for folder in reversed([*folders])}.values():
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

    What photographs show is looked at first; of the candidates those are measured that may be it. Targets
    that identify themselves are tried before plain chessboards and grids, and given ones before others; a
    target is taken if it has nearly as many points as that with the most. Those that have as many are named,
    and the first is taken: targets of the same pattern in other sizes are not distinguished, and the
    calibration does not depend on the size. A PuzzleBoard that is not among the candidates is found, too, by
    the part of its code that all photographs show.

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
    photographs = _Photographs(frames, tried)
    usual = next((d for d in designs.values() if isinstance(d, BoardDesign) and d.kind == "puzzle"), None)
    puzzle = _puzzle_of(photographs.small, usual)
    candidates = dict(designs)
    if puzzle is not None and _pattern(puzzle[1]) not in map(_pattern, designs.values()):
        candidates[puzzle[0]] = puzzle[1]
    found = photographs.explained_by(candidates)
    if found is not None and puzzle is not None and found[1] is puzzle[1]:
        # Those tried may show a part of it.
        return _puzzle_of(photographs.every(), usual) or puzzle
    if found is not None:
        return found
    shown = {described(design): design for design in photographs.boards()}
    found = photographs.explained_by(shown)
    if found is not None:
        return found
    also = f"; {_shown_words(list(shown.values()))}" if shown else ""
    return Failure(
        f"none of the known targets is seen{also}; describe yours with `reseau design board --out "
        "board.json`, and give that file",
        Code.NOT_FOUND,
    )


def corrected(frames: Iterable[Frame], told: BoardDesign, tried: int = 3) -> BoardDesign | Failure:
    """Find the board that photographs show, of the kind of one that they contradict.

    The boards that the photographs show, with what else is known of the one that was told, compete with it:
    that is taken which has most points in all of them.

    Parameters
    ----------
    frames : iterable of Frame
        Photographs.
    told : BoardDesign
        The design that was given.
    tried : int
        Number of photographs in which points are counted.

    Returns
    -------
    BoardDesign or Failure
        A failure (falsy) that says what the photographs show, if it is no other board of this kind.

    Examples
    --------
    >>> corrected([], board("chess", 7, 10, 23.0)).code
    <Code.NOT_FOUND: 'not-found'>
    """
    photographs = _Photographs(frames, tried)
    shown = photographs.boards()
    variants = {described(told): told}
    for design in (one for each in shown for one in _as_told(each, told)):
        variants.setdefault(repr(_pattern(design)), design)
    found = photographs.explained_by(variants) if len(variants) > 1 else None
    if found is not None and found[1] is not told:
        assert isinstance(found[1], BoardDesign)
        return found[1]
    return Failure(_shown_words(shown, len(photographs.full)) if shown else "", Code.NOT_FOUND)


def measured_or_shown(frame: Frame, design: object, measure: Callable[[Frame], T | Failure]) -> T | Failure:
    """Measure a target in a frame; where the frame contradicts its design, the failure says what it shows.

    Parameters
    ----------
    frame : Frame
        A photograph.
    design : BoardDesign or object
        The target.
    measure : callable
        Measures it in a frame.

    Examples
    --------
    >>> frame = Frame(np.zeros((100, 100)), 255.0)
    >>> measured_or_shown(frame, None, lambda frame: Failure("no target", Code.NOT_FOUND)).reason
    'no target'
    """
    found = measure(frame)
    if not (isinstance(found, Failure) and isinstance(design, BoardDesign) and found.code in CONTRADICT):
        return found
    other = corrected([frame], design)
    if isinstance(other, Failure):
        shown = other.reason
    else:
        shown = f"the photograph shows {described(other)}: {difference(other, design)}; correct the design"
    return replace(found, reason=f"{found.reason}; {shown}") if shown else found


def difference(other: BoardDesign, told: BoardDesign) -> str:
    """Return what of a design to change, to have another one.

    Examples
    --------
    >>> difference(board("chess", 7, 10, 23.0), board("chess", 6, 10, 23.0))
    'columns 7 in place of 6'
    """
    new, old = other.to_dict(), told.to_dict()
    fields = [key for key in BoardDesign.model_fields if new.get(key) != old.get(key)]
    return ", ".join(f"{key} {getattr(other, key)} in place of {getattr(told, key)}" for key in fields)


def _as_told(shown: BoardDesign, told: BoardDesign) -> list[BoardDesign]:
    """A board that photographs show, with what else is known of one of its kind that was told; or none.

    Also the one that was told with all but its numbers of rows and columns, of which photographs may show a
    part only.
    """
    if shown.kind != told.kind:
        return []
    counts, turned = (shown.columns, shown.rows), (told.columns < told.rows) != (shown.columns < shown.rows)
    if turned and shown.kind in ("chess", "circles") and not shown.asymmetric:
        counts = counts[::-1]
    layout: dict[str, object] = {"columns": counts[0], "rows": counts[1], "dots": ()}
    for name in ("dictionary", "border_bits", "legacy", "asymmetric", "polarity", "first_id"):
        layout[name] = getattr(shown, name)
    if _contains(told.dictionary, shown.dictionary):
        layout["dictionary"] = told.dictionary
    same = told.model_copy(update=layout)
    all_of_it = same.model_copy(update={"columns": told.columns, "rows": told.rows})
    if shown.size is None or told.size is None:
        return [same, all_of_it]
    share = shown.size / shown.pitch
    # A tag is measured with a ruler, the gap beside it is not.
    other = {"pitch": told.size / share} if told.kind == "aprilgrid" else {"size": told.pitch * share}
    scaled = {key: float(f"{value:.3g}") for key, value in other.items()}
    return [same, all_of_it, same.model_copy(update=scaled)]


def _contains(larger: str | None, smaller: str | None) -> bool:
    """Whether a dictionary of markers is another one, or a larger one of its series with the same markers."""
    if larger is None or smaller is None:
        return False
    (one, _, count), (other, _, least) = (name.lower().rpartition("_") for name in (larger, smaller))
    sizes = count.isdecimal() and least.isdecimal()
    return one == other and (int(count) >= int(least) if sizes else count == least)


def described(design: BoardDesign) -> str:
    """A board in words, without its size.

    Examples
    --------
    >>> described(board("chess", 7, 10, 23.0)), described(board("charuco", 7, 10, 23.0))
    ('a chessboard of 7 × 10 squares', 'a ChArUco board of 7 × 10 squares with markers of DICT_5X5_100')
    """
    text = f"{_KINDS[design.kind]} of {design.columns} × {design.rows} "
    text += {"circles": f"{design.polarity} circles", "aprilgrid": "tags", "markers": "markers"}.get(
        design.kind, "corners" if design.kind == "deltille" else "squares"
    )
    if design.kind == "charuco":
        text += f" with markers of {design.dictionary}"
    elif design.dictionary is not None:
        text += f" of {design.dictionary}"
    if design.border_bits > 1:
        text += f" with borders of {design.border_bits} bits"
    text += " in the layout before OpenCV 4.6" if design.legacy else ""
    return text + (", every second row shifted" if design.asymmetric else "")


def _shown_words(shown: Sequence[BoardDesign], photographs: int = 2) -> str:
    """What photographs show, in words: that which most of them show."""
    which = "the photographs show" if photographs > 1 else "the photograph shows"
    return f"{which} {Counter(map(_unturned, shown)).most_common(1)[0][0]}"


def _unturned(design: BoardDesign) -> str:
    """A board in words; of a lattice without markers nothing tells columns from rows."""
    if design.kind != "chess":
        return described(design)
    low, high = sorted((design.columns, design.rows))
    return f"a lattice of {high} × {low} squares without markers"


class _Photographs:
    """Photographs in which targets are looked for, the first ones at once, others where they tell more."""

    def __init__(self, frames: Iterable[Frame], tried: int) -> None:
        self.others = iter(frames)
        self.full = list(islice(self.others, tried))
        self.small = [_reduced(frame) for frame in self.full]
        self._further = list[Frame]()
        self._shown: dict[int, list[BoardDesign]] = {}

    def shown(self, frame: Frame) -> list[BoardDesign]:
        """Boards that one of them shows."""
        if id(frame) not in self._shown:
            self._shown[id(frame)] = boards_shown(frame)
        return self._shown[id(frame)]

    def every(self) -> Iterator[Frame]:
        """All of them, reduced."""
        return chain(self._further or self.small, map(_reduced, self.others))

    def explained_by(self, candidates: Mapping[str, Design]) -> tuple[str, Design] | None:
        """The candidate with most points; none where something larger is seen instead.

        With its name, and those of others that have as many.
        """
        points = self._counted(self.small, candidates)
        if not any(points.values()) and any(a is not b for a, b in zip(self.full, self.small, strict=True)):
            # Testfields, which take long, have targets large enough to be seen in reduced frames.
            quick = {name: each for name, each in candidates.items() if _turn(each) < _LATEST}
            points |= self._counted(self.full, quick)
        order = sorted(candidates, key=lambda name: (_plain(candidates[name]), -points[name]))
        while most := max(points.values(), default=0):
            name = next(name for name in order if points[name] >= _ENOUGH * most)
            design = candidates[name]
            if not _plain(design) or not _is_part_of_another(self.further(), design):
                same = _plain(design), points[name]
                alike = [each for each in order if (_plain(candidates[each]), points[each]) == same]
                given = [each for each in alike if each not in known_designs()]
                return _either(given or alike), design
            pattern = _pattern(design)
            points |= {name: 0 for name, each in candidates.items() if _pattern(each) == pattern}
        return None

    def _counted(self, frames: Sequence[Frame], designs: Mapping[str, Design]) -> dict[str, int]:
        """Points of each design measured in all frames; none of plain patterns that most frames do not show.

        A part of a larger grid may pass for a smaller one, the whole does not. What was found in one frame is
        looked for in the next one before anything else.
        """
        patterns = {name: _pattern(design) for name, design in designs.items()}
        first = {pattern: name for name, pattern in reversed(patterns.items())}
        total, times = dict.fromkeys(first, 0), Counter[str]()
        for frame in frames:
            seen, enough, known = dict[str, int](), _LATEST, any(total.values())
            for pattern in sorted(first, key=lambda each: (not total[each], _turn(designs[first[each]]))):
                design = designs[first[pattern]]
                if (known and not total[pattern] and any(seen.values())) or _turn(design) > enough:
                    break
                if _may_be(design, self.shown(frame)):
                    measured = measurer_of(design)(frame)
                    count = 0 if isinstance(measured, Failure) else len(measured.candidates)
                    seen[pattern] = count if count >= _LEAST else 0
                    if count >= (_ENOUGH * len(design.ids) if _plain(design) else _LEAST):
                        enough = _turn(design)
            for pattern, count in seen.items():
                total[pattern] += count
                times[pattern] += count > 0
        return {
            name: 0 if _plain(designs[name]) and 2 * times[pattern] <= len(frames) else total[pattern]
            for name, pattern in patterns.items()
        }

    def further(self) -> list[Frame]:
        """Those tried, and some more, reduced."""
        if not self._further:
            self._further = [*self.small, *map(_reduced, islice(self.others, _MORE))]
        return self._further

    def boards(self) -> list[BoardDesign]:
        """Boards that the photographs show; with markers, of the first ones that show any."""
        found, showing = list[BoardDesign](), 0
        for frame in self.further():
            shown = self.shown(frame)
            found += shown
            showing += any(not _plain(each) for each in shown)
            if showing >= len(self.small):
                break
        return found


def target_of(
    photographs: Iterable[Path | Frame | ImagePoints], read: Callable[[Path | Frame], Frame]
) -> tuple[str, Design] | Failure:
    """Find the target that photographs show, among the designs beside their files and the usual ones.

    Parameters
    ----------
    photographs : iterable of Path, Frame or ImagePoints
        Those of a calibration; of image coordinates nothing is seen.
    read : callable
        Returns the frame of a file, or of a frame; see
        :func:`~reseau.procedures.exposures.photograph_reader`.

    Returns
    -------
    (str, design) or Failure
        What was found, in words.

    Examples
    --------
    >>> target_of([], lambda photograph: photograph).code
    <Code.NOT_FOUND: 'not-found'>
    """
    every = list(photographs)
    files = [path for path in every if isinstance(path, Path)]
    folders = dict.fromkeys(folder for path in files for folder in (path.parent, path.parent.parent))

    def frames() -> Iterator[Frame]:
        for each in every:
            if isinstance(each, Frame) or (isinstance(each, Path) and not is_points(each)):
                try:
                    yield read(each)
                except ImageError:
                    continue  # is reported with its name when all are measured

    found = which_target(frames(), designs_beside([*folders, Path()]))
    if isinstance(found, Failure):
        return found
    name, design = found
    size = "" if Path(name).is_file() else "; photographs do not tell its size, on which only lengths depend"
    return f"the target is {name}{size}", design


def _is_part_of_another(frames: Iterable[Frame], design: Design) -> bool:
    """Whether photographs show a larger lattice: parts of it may pass for the design."""
    shown = larger = 0
    for frame in frames:
        measured = measurer_of(design)(frame)
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


def _may_be(design: Design, shown: Sequence[BoardDesign]) -> bool:
    """Whether a frame that shows these boards may show a design; what is coded says so itself."""
    kinds = {each.kind for each in shown}
    if isinstance(design, TestfieldDesign):
        # Its targets are disks, too.
        return kinds <= {"circles"}
    if isinstance(design, BoardDesign) and design.dictionary is not None:
        return any(each.dictionary is not None for each in shown)
    if isinstance(design, BoardDesign) and _plain(design):
        return design.kind in kinds
    return not _plain(design) or not shown or "circles" in kinds


def _turn(design: Design) -> int:
    """When a design is looked for: those that are coded first, testfields, which take long, at the end."""
    return _LATEST if isinstance(design, TestfieldDesign) else int(_plain(design))


def _either(names: Sequence[str]) -> str:
    """One of several, in words."""
    *first, last = names
    return f"{', '.join(first)} or {last}" if first else last
