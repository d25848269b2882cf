"""A local model on top of a polynomial: what this leaves and is no noise, taken off where it is needed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ..core.data import Array
from ..optics.field import SmoothField

__all__ = ["LocalModel"]

_ALPHA = 0.01
"""Level, per axis, at which the need must be significant: what is taken off without need is noise."""


@dataclass(frozen=True, eq=False)
class LocalModel:
    """Collocation of the residuals of a mapping.

    Parameters
    ----------
    field : SmoothField
        Mapped minus target, over the targets.
    needed : (bool, bool)
        The axes in which it is taken off.
    """

    field: SmoothField
    needed: tuple[bool, bool]

    @classmethod
    def where_needed(cls, field: SmoothField | None, alpha: float = _ALPHA) -> Self | None:
        """The model, where the need of the field is significant in one axis at least."""
        if field is None or not (field.need < alpha).any():
            return None
        return cls(field, (bool(field.need[0] < alpha), bool(field.need[1] < alpha)))

    def take_off(self, xy: Array) -> Array:
        """Mapped points (n, 2) less what the model leaves there."""
        return xy - self.field(xy) * self.needed

    @property
    def variance(self) -> Array:
        """Variance (2,) of what is taken off: of a prediction from the other points, their noise apart."""
        _, sigma = self.field.leave_one_out()
        noise = self.field.noise * self.field.sigma[:, None]
        variance: Array = np.maximum(sigma**2 - noise**2, 0).mean(axis=0) * self.needed
        return variance

    def to_dict(self) -> dict[str, Any]:
        """The points that it goes through; fitted again they give the same field."""
        return {
            "at": self.field.source.tolist(),
            "left": self.field.target.tolist(),
            "degree": self.field.degree,
            "needed": list(self.needed),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        """Read back; KeyError, TypeError or ValueError where something is missing or wrong."""
        at, left = (np.array(content[key], dtype=np.float64).reshape(-1, 2) for key in ("at", "left"))
        x, y = (bool(axis) for axis in content["needed"])
        return cls(SmoothField.fit(at, left, degree=int(content["degree"])), (x, y))
