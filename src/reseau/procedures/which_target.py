"""Which of several targets photographs show."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from ..core.data import Frame
from ..core.errors import ReseauError
from ..core.failure import Code, Failure
from ..designs.known import known_designs
from ..io import BoardDesign, ReseauDesign, TestfieldDesign, read_text
from ..io.testfield import parse_design
from .target_measurement import measurer_of

__all__ = ["designs_beside", "which_target"]

Design = ReseauDesign | TestfieldDesign | BoardDesign
_ENOUGH, _LEAST = 0.8, 8


def designs_beside(folders: Iterable[Path]) -> dict[str, Design]:
    """Designs in folders, by their files, and then those that `reseau design` draws by default.

    Examples
    --------
    >>> list(designs_beside([]))[0]
    'sheet on A4'
    """
    found = dict[str, Design]()
    for folder in folders:
        for file in sorted(folder.glob("*.json")):
            try:
                found[str(file)] = parse_design(read_text(file), file)
            except ReseauError:
                continue  # another document
    return found | dict(known_designs())


def which_target(frames: Iterable[Frame], designs: Mapping[str, Design]) -> tuple[str, Design] | Failure:
    """Find the target that photographs show.

    Targets that identify themselves are tried before plain chessboards and grids, and given ones before
    others; a target is taken if it has nearly as many points as that with the most. Targets of the same
    pattern in other sizes are not distinguished: the calibration does not depend on the size.

    Parameters
    ----------
    frames : iterable of Frame
        A few photographs.
    designs : mapping of str to design
        The candidates.

    Examples
    --------
    >>> which_target([], {}).code
    <Code.NOT_FOUND: 'not-found'>
    """
    points = dict.fromkeys(designs, 0)
    for frame in frames:
        seen = dict[str, int]()
        for name, design in designs.items():
            pattern = _pattern(design)
            if pattern not in seen:
                measured = measurer_of(design)(frame)
                count = 0 if isinstance(measured, Failure) else len(measured.points)
                seen[pattern] = count if count >= _LEAST else 0
            points[name] += seen[pattern]
    most = max(points.values(), default=0)
    if most == 0:
        return Failure("shows none of the known targets; give the design", Code.NOT_FOUND)
    plain = {name for name, design in designs.items() if _plain(design)}
    order = [name for name in designs if name not in plain] + [name for name in designs if name in plain]
    name = next(name for name in order if points[name] >= _ENOUGH * most)
    return name, designs[name]


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
    """Whether nothing in the target identifies it."""
    if isinstance(design, BoardDesign):
        return design.kind in ("chess", "circles")
    return isinstance(design, ReseauDesign) and design.rings is None
