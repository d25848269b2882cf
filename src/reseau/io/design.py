"""``reseau-design/1``: a reseau, a sheet of targets, or the rods of a test object."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import scipy
from pydantic import Field, model_validator

from ..core.data import Array, twice
from .document import Document, Strict

Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
"""Beyond this, squares of coordinates lose the digits of the design."""
_ONE_PLACE = 1e-6
"""Points closer than this share of the extent of the design are at one place."""
_LEAST_EXTENT = 1e-6
"""Extent of the smallest design, in its unit."""


class Mark(Strict):
    """Shape and size of the marks of a design, in the unit of the design.

    Examples
    --------
    >>> Mark(shape="disk", size=2.0).line_width is None
    True
    """

    shape: Literal["cross", "disk", "square", "line-grid", "rod"]
    size: float | None = Field(default=None, gt=0)
    line_width: float | None = Field(default=None, gt=0)


class DesignPoint(Strict):
    """One mark of a design: coordinates in its plane, and its approximate position in the image.

    A slanted wire of a phantom, as the diagonal of an N, has an `end`: the plane of an image cuts it anywhere
    between (`x`, `y`) and `end`, both projected into the plane of the design.

    Examples
    --------
    >>> DesignPoint(id="A1", x=10.0, y=-5.0, sigma=0.002).nominal_px is None
    True
    >>> DesignPoint(id="N1", x=10.0, y=-5.0, end=(30.0, -5.0)).end
    (30.0, -5.0)
    """

    id: str = Field(min_length=1)
    x: Coordinate | None
    y: Coordinate | None
    end: tuple[Coordinate, Coordinate] | None = None
    sigma: float | None = Field(default=None, ge=0)
    nominal_px: tuple[Coordinate, Coordinate] | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.x is None) != (self.y is None):
            raise ValueError(f"point {self.id!r} has only one of its two coordinates")
        if self.end is not None and (self.x is None or self.end == (self.x, self.y)):
            raise ValueError(f"`end` of {self.id!r} must lie at another place than its `x` and `y`")
        return self


class Rings(Strict):
    """Coded rings around some disks of a sheet, which identify these disks.

    Parameters
    ----------
    inner, outer : float
        Diameters of the rings in the unit of the design.
    sectors : dict of str to tuple of (float, float)
        For each coded point the sectors of its ring that have the marks' polarity: start and end angle in
        degrees, from x towards y.

    Examples
    --------
    >>> Rings(inner=3.0, outer=5.0, sectors={"A1": ((0.0, 90.0), (180.0, 270.0))}).sectors["A1"][0]
    (0.0, 90.0)
    """

    inner: float = Field(gt=0)
    outer: float = Field(gt=0)
    sectors: dict[str, tuple[tuple[float, float], ...]] = Field(min_length=1)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.inner < self.outer:
            raise ValueError(f"`inner` ({self.inner}) must be less than `outer` ({self.outer})")
        for name, sectors in self.sectors.items():
            if not all(start < end <= start + 360 for start, end in sectors):
                raise ValueError(f"each sector of {name!r} must end at a larger angle than it starts")
        return self


class ReseauDesign(Document):
    """``reseau-design/1``: a reseau, a sheet of targets, or the rods of a test object.

    Examples
    --------
    >>> points = (DesignPoint(id="A", x=0.0, y=0.0), DesignPoint(id="B", x=10.0, y=0.0))
    >>> cross = Mark(shape="cross", size=1.0, line_width=0.1)
    >>> design = ReseauDesign(name="two", unit="mm", mark=cross, polarity="dark", points=points)
    >>> design.ids, design.xy.tolist()
    (('A', 'B'), [[0.0, 0.0], [10.0, 0.0]])
    >>> ReseauDesign.parse(design.to_json(), where="two.json") == design
    True
    """

    SCHEMA: ClassVar[str] = "reseau-design/1"
    name: str
    unit: str
    mark: Mark
    polarity: Literal["dark", "bright"]
    origin: str | None = None
    axis: str | None = None
    points: tuple[DesignPoint, ...]
    rings: Rings | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.points:
            raise ValueError("the design has no points")
        names = set(self.ids)
        if (again := twice(self.ids)) is not None:
            raise ValueError(f"duplicate id {again!r} in `points`")
        self._check_places()
        for role in ("origin", "axis"):
            named = getattr(self, role)
            if named is not None and named not in names:
                raise ValueError(f"`{role}` is {named!r}, which is not the id of a point")
        if self.origin is not None and self.origin == self.axis:
            raise ValueError(f"`origin` and `axis` both name {self.origin!r}; they must differ")
        if self.rings is not None:
            self._check_rings(self.rings, names)
        return self

    def _check_places(self) -> None:
        if self.mark.shape != "rod" and any(point.end is not None for point in self.points):
            raise ValueError("`end` of a point requires marks of shape 'rod'")
        places = self.segments.reshape(-1, 4)
        known = np.asarray(np.isfinite(places).all(axis=1))
        if known.sum() > 1 and 0 < np.ptp(places[known], axis=0).max() < _LEAST_EXTENT:
            raise ValueError(f"all points lie within {_LEAST_EXTENT:g} {self.unit}; check the unit")
        size = max(self.mark.size or 0.0, self.mark.line_width or 0.0)
        if known.sum() > 1 and size > np.ptp(places[known], axis=0).max():
            raise ValueError(
                f"marks of {size:g} {self.unit} are larger than the whole design; check the unit"
            )
        pair = at_one_place(places)
        what, at = "lie at one place", "({:g}, {:g})"
        by_nominal = pair is None
        if by_nominal:
            pair = at_one_place(self.nominal_px)
            what, at = "have one nominal position", "({:g}, {:g}) px"
        if pair is None:
            return
        one, other = (self.points[i] for i in pair)
        place = one.nominal_px if by_nominal else (one.x, one.y)
        assert place is not None
        raise ValueError(
            f"points {one.id!r} and {other.id!r} {what}, {at.format(*place)}; correct or remove one of them"
        )

    def _check_rings(self, rings: Rings, names: set[str]) -> None:
        for name in rings.sectors:
            if name not in names:
                raise ValueError(f"`rings` contains {name!r}, which is not the id of a point")
        if self.mark.shape != "disk" or self.mark.size is None or self.mark.size >= rings.inner:
            raise ValueError("`rings` require marks of shape 'disk' and a size less than `inner`")

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file; keys of coded rings and slanted wires are left out without them."""
        content = super().to_dict()
        if self.rings is None:
            del content["rings"]
        for point in content["points"]:
            if point["end"] is None:
                del point["end"]
        return content

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the points."""
        return tuple(point.id for point in self.points)

    @property
    def xy(self) -> Array:
        """Coordinates in the plane of the design, (n, 2); NaN where unknown, and for slanted wires."""
        fixed = [(None, None) if p.end else (p.x, p.y) for p in self.points]
        return np.array(fixed, dtype=np.float64).reshape(-1, 2)

    @property
    def segments(self) -> Array:
        """Both ends (n, 2, 2) of the place at which an image may show each point; NaN where unknown.

        They differ for slanted wires only.
        """
        ends = [((p.x, p.y), p.end or (p.x, p.y)) for p in self.points]
        return np.array(ends, dtype=np.float64).reshape(-1, 2, 2)

    @property
    def nominal_px(self) -> Array:
        """Approximate positions in the image, (n, 2); NaN where unknown."""
        return np.array([p.nominal_px or (np.nan, np.nan) for p in self.points], dtype=np.float64)

    def from_behind(self) -> Self:
        """Return the design as it is seen from behind: left and right exchanged, without nominal positions.

        Examples
        --------
        >>> mark = Mark(shape="disk", size=1.0)
        >>> points = (DesignPoint(id="A", x=1.0, y=2.0), DesignPoint(id="B", x=10.0, y=2.0))
        >>> design = ReseauDesign(name="two", unit="mm", mark=mark, polarity="dark", points=points)
        >>> design.from_behind().xy.tolist()
        [[-1.0, 2.0], [-10.0, 2.0]]
        """
        points = [
            point.model_copy(
                update={
                    "x": None if point.x is None else -point.x,
                    "end": None if point.end is None else (-point.end[0], point.end[1]),
                    "nominal_px": None,
                }
            )
            for point in self.points
        ]
        rings = self.rings
        if rings is not None:  # an angle from x towards y is reflected as the place
            sectors = {
                name: tuple((180.0 - end, 180.0 - start) for start, end in each)
                for name, each in rings.sectors.items()
            }
            rings = rings.model_copy(update={"sectors": sectors})
        return self.model_copy(update={"points": tuple(points), "rings": rings})

    def expected_at(self, nominal_px: Array) -> Self:
        """Return the design with approximate positions in an image (n, 2); NaN where unknown."""
        places = [(float(x), float(y)) if np.isfinite([x, y]).all() else None for x, y in nominal_px]
        points = [
            point.model_copy(update={"nominal_px": place})
            for point, place in zip(self.points, places, strict=True)
        ]
        return self.model_copy(update={"points": tuple(points)})


def at_one_place(places: Array) -> tuple[int, int] | None:
    """The first two rows of `places` (n, k) that are equal to a millionth of their extent, if any."""
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    if len(known) < 2:
        return None
    # A single point far away, by a slip of the pen, does not make others one place.
    low, high = np.quantile(places[known], [0.1, 0.9], axis=0)
    within = _ONE_PLACE * float((high - low).max())
    pairs = scipy.spatial.KDTree(places[known]).query_pairs(within, p=np.inf, output_type="ndarray")
    if not len(pairs):
        return None
    first, second = known[pairs[np.lexsort(pairs.T[::-1])[0]]]
    return int(first), int(second)
