"""``reseau-targets/1``: single plane targets in space, as on a frame; their shape, size and direction."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..core.data import Array, twice
from ..optics.formation import Outline, mark_outline
from .document import Columns, Document

Triple = tuple[float, float, float]
Length = Annotated[float, Field(gt=0, le=1e5)]
Shape = Literal["disk", "square"]


class TargetColumns(Columns):
    """Targets in columns.

    Parameters
    ----------
    id : tuple of str
        Names, as in the network.
    shape : tuple of {"disk", "square"}
    size : tuple of float
        Diameter of a disk, side of a square.
    normal : tuple of (float, float, float)
        Direction in which the target faces, in object space; of any length.
    side : tuple of (float, float, float), optional
        Direction of a side of a square.
    xyz : tuple of (float, float, float), optional
        Nominal coordinates.

    Examples
    --------
    >>> TargetColumns(id=("1",), shape=("disk",), size=(12.0,), normal=((0.0, 0.0, 1.0),)).size
    (12.0,)
    """

    id: tuple[str, ...]
    shape: tuple[Shape, ...]
    size: tuple[Length, ...]
    normal: tuple[Triple, ...]
    side: tuple[Triple, ...] | None = None
    xyz: tuple[Triple, ...] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.id:
            raise ValueError("there are no targets")
        if (again := twice(self.id)) is not None:
            raise ValueError(f"duplicate id {again!r}")
        for k, name in enumerate(self.id):
            if not np.linalg.norm(self.normal[k]) > 0:
                raise ValueError(f"target {name!r}: its normal is zero")
            if self.side is not None:
                across = np.cross(self.side[k], self.normal[k])
                if not np.linalg.norm(across) > 0:
                    raise ValueError(f"target {name!r}: its side has the direction of its normal")
        return self


class SpaceTargets(Document):
    """``reseau-targets/1``: plane targets in space.

    Examples
    --------
    >>> targets = SpaceTargets(unit="mm", polarity="bright", targets=TargetColumns(
    ...     id=("1",), shape=("disk",), size=(12.0,), normal=((0.0, 0.0, 2.0),)))
    >>> float(np.ptp(targets.outline(0, 0.1).xy[:, 0]).round(2))
    12.0
    """

    SCHEMA: ClassVar[str] = "reseau-targets/1"
    unit: Literal["mm", "m"]
    polarity: Literal["dark", "bright"]
    name: str = ""
    targets: TargetColumns

    @property
    def unit_mm(self) -> float:
        """The unit in mm."""
        return 1000.0 if self.unit == "m" else 1.0

    def axes(self, k: int) -> Array:
        """Directions (3, 2) in the plane of a target, in object space."""
        normal = np.asarray(self.targets.normal[k], dtype=np.float64)
        normal = normal / np.linalg.norm(normal)
        along = np.eye(3)[int(np.argmin(np.abs(normal)))]
        if self.targets.side is not None:
            along = np.asarray(self.targets.side[k], dtype=np.float64)
        x = along - (along @ normal) * normal
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(normal, x)], axis=1)

    def outline(self, k: int, spacing: float) -> Outline:
        """Outline of a target around its centre, with nodes at most `spacing` apart."""
        return mark_outline(self.targets.shape[k], self.targets.size[k], None, spacing)
