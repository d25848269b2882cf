"""``testfield-design/1``: a coded testfield of targets in squares bounded by straight lines."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Annotated, ClassVar, Literal, Self, TypeVar
from weakref import finalize

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..core.data import Array, twice
from .board import BoardDesign
from .design import ReseauDesign, at_one_place
from .document import Columns, Document, Strict

TargetShape = Literal["square", "triangle", "cross", "circle"]
SHAPES: tuple[TargetShape, ...] = ("square", "triangle", "cross", "circle")
"""Shapes of targets, in the order of their numbers."""
Positive = Annotated[float, Field(gt=0)]
D = TypeVar("D", bound=Document)
R = TypeVar("R")


def _once(compute: Callable[[D], R]) -> Callable[[D], R]:
    """Compute a column of a design once; arrays cannot be changed, for all who ask share them.

    The columns lie beside the design, which remains what was read: it is compared, copied and changed by its
    entries alone.
    """
    known: dict[int, R] = {}

    @wraps(compute)
    def column(design: D) -> R:
        at = id(design)
        if at not in known:
            found = compute(design)
            for part in found if isinstance(found, tuple) else (found,):
                if isinstance(part, np.ndarray):
                    part.setflags(write=False)
            known[at] = found
            finalize(design, known.pop, at, None)
        return known[at]

    return column


class FieldLines(Strict):
    """The straight lines: their width, their positions, and the rectangle that they fill.

    Examples
    --------
    >>> lines = FieldLines(
    ...     width=1.0, vertical_x=(0.0, 20.0, 40.0), horizontal_y=(0.0, 20.0), extent=(-5.0, -5.0, 45.0, 25.0)
    ... )
    >>> len(lines.vertical_x) - 1
    2
    """

    width: Positive
    vertical_x: Annotated[tuple[float, ...], Field(min_length=2)]
    horizontal_y: Annotated[tuple[float, ...], Field(min_length=2)]
    extent: tuple[float, float, float, float]

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        for name in ("vertical_x", "horizontal_y"):
            gaps = np.diff(getattr(self, name))
            if not (gaps > self.width).all():
                raise ValueError(f"`{name}` must ascend by more than the width of the lines")
        x0, y0, x1, y1 = self.extent
        if not (x0 <= self.vertical_x[0] < self.vertical_x[-1] <= x1):
            raise ValueError("`extent` must include all of `vertical_x`")
        if not (y0 <= self.horizontal_y[0] < self.horizontal_y[-1] <= y1):
            raise ValueError("`extent` must include all of `horizontal_y`")
        return self


class FieldTargets(Columns):
    """The targets, in columns.

    Examples
    --------
    >>> targets = FieldTargets(
    ...     id=("1", "2"), square=(1, 1), shape=("circle", "cross"), x=(5.0, 15.0), y=(5.0, 5.0),
    ...     size=(3.0, 4.0), angle=(0.0, 0.0),
    ... )
    >>> targets.shape
    ('circle', 'cross')
    """

    id: tuple[Annotated[str, Field(min_length=1)], ...]
    square: tuple[Annotated[int, Field(ge=1)], ...]
    shape: tuple[TargetShape, ...]
    x: tuple[float, ...]
    y: tuple[float, ...]
    size: tuple[Positive, ...]
    angle: tuple[float, ...]

    @model_validator(mode="after")
    def _named_once(self) -> Self:
        if (again := twice(self.id)) is not None:
            raise ValueError(f"duplicate id {again!r} in `targets`")
        return self


class TestfieldDesign(Document):
    """``testfield-design/1``: millimetres, right-handed, y up; squares numbered in rows from the upper left.

    `size` is the side of a square and of an equilateral triangle, the tip-to-tip length of a cross, whose
    arms are a third of that wide, and the diameter of a circle; x, y its centroid. `angle` (degrees,
    counter-clockwise) turns it from upright: the triangle with its apex up.

    Examples
    --------
    >>> from reseau.designs import coded_testfield
    >>> design = coded_testfield()
    >>> design.squares, len(design.centres), design.unit
    ((8, 8), 64, 'mm')
    >>> sorted(set(design.symbols.tolist()))[:3]
    [0, 1, 2]
    """

    __test__: ClassVar[bool] = False  # prevents collection by pytest
    SCHEMA: ClassVar[str] = "testfield-design/1"
    name: str
    unit: Literal["mm"]
    squares: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
    pitch: Positive
    lines: FieldLines
    targets: FieldTargets
    polarity: Literal["dark", "bright"]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        columns, rows = self.squares
        found = (len(self.lines.vertical_x) - 1, len(self.lines.horizontal_y) - 1)
        if found != (columns, rows):
            raise ValueError(f"the lines bound {found[0]} × {found[1]} squares, not {columns} × {rows}")
        if not self.targets.id:
            raise ValueError("the design has no targets")
        if max(self.targets.square) > columns * rows:
            raise ValueError(f"square {max(self.targets.square)} does not exist in {columns} × {rows}")
        pair = at_one_place(self.xy)
        if pair is not None:
            one, other = (self.ids[i] for i in pair)
            x, y = self.xy[pair[0]]
            raise ValueError(
                f"targets {one!r} and {other!r} lie at one place, ({x:g}, {y:g}); correct one of them"
            )
        return self

    def from_behind(self) -> Self:
        """Return the design as it is seen from behind: left and right exchanged; targets keep their names.

        Examples
        --------
        >>> from reseau.designs import coded_testfield
        >>> design = coded_testfield()
        >>> behind = design.from_behind()
        >>> behind.ids == design.ids, bool((behind.xy == design.xy * [-1.0, 1.0]).all())
        (True, True)
        """
        columns, targets, lines = self.squares[0], self.targets, self.lines
        x0, y0, x1, y1 = lines.extent
        # Squares are numbered by their places, which are reflected: the first of a row becomes the last.
        square = [(k - 1) // columns * columns + columns - (k - 1) % columns for k in targets.square]
        reflected = {
            "square": tuple(square),
            "x": tuple(-x for x in targets.x),
            "angle": tuple(-angle for angle in targets.angle),
        }
        bounds = {
            "vertical_x": tuple(-x for x in reversed(lines.vertical_x)),
            "extent": (-x1, y0, -x0, y1),
        }
        update = {
            "targets": targets.model_copy(update=reflected),
            "lines": lines.model_copy(update=bounds),
        }
        return self.model_copy(update=update)

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the targets."""
        return self.targets.id

    @property
    @_once
    def xy(self) -> Array:
        """Centroids of the targets, (n, 2)."""
        return np.stack([self.targets.x, self.targets.y], axis=1).astype(np.float64)

    @property
    @_once
    def centres(self) -> Array:
        """Centres of the squares, (columns·rows, 2), in the order of their numbers."""
        x, y = (np.asarray(at) for at in (self.lines.vertical_x, self.lines.horizontal_y))
        across, up = (x[1:] + x[:-1]) / 2, ((y[1:] + y[:-1]) / 2)[::-1]
        return np.stack([np.tile(across, len(up)), np.repeat(up, len(across))], axis=1)

    @property
    @_once
    def large(self) -> NDArray[np.bool_]:
        """Which targets (n,) are of the larger of the two sizes of their shape."""
        size, shape = np.array(self.targets.size), np.array(self.targets.shape)
        large = np.zeros(len(size), dtype=bool)
        for name in SHAPES:
            of = shape == name
            if of.any():
                large[of] = size[of] > (size[of].min() + size[of].max()) / 2
        return large

    @property
    @_once
    def sizes(self) -> Array:
        """Sizes of the targets (n,), millimetres."""
        return np.array(self.targets.size, dtype=np.float64)

    @property
    @_once
    def kinds(self) -> tuple[tuple[tuple[str, float, float], ...], NDArray[np.intp]]:
        """Kinds of targets (shape, size, angle), and which of them each target (n,) is."""
        targets = self.targets
        each = list(zip(targets.shape, targets.size, targets.angle, strict=True))
        number = {kind: k for k, kind in enumerate(dict.fromkeys(each))}
        return tuple(number), np.array([number[kind] for kind in each], dtype=np.intp)

    @property
    @_once
    def symbols(self) -> NDArray[np.intp]:
        """Symbols of the targets (n,): twice the number of the shape, plus one for large targets."""
        shape = np.array([SHAPES.index(name) for name in self.targets.shape], dtype=np.intp)
        return 2 * shape + self.large


def parse_design(text: str, where: object) -> ReseauDesign | TestfieldDesign | BoardDesign:
    """Read a design from JSON text, by its schema; `where` names it in messages.

    Raises
    ------
    FormatError
        If the text is not a design.

    Examples
    --------
    >>> from reseau.designs import standard_reseau
    >>> type(parse_design(standard_reseau().to_json(), "reseau.json")).__name__
    'ReseauDesign'
    """
    if '"reseau-board/' in text[:4096]:
        return BoardDesign.parse(text, where=where)
    kind = TestfieldDesign if '"testfield-design/' in text[:4096] else ReseauDesign
    return kind.parse(text, where=where)
