"""What a polynomial leaves and is not noise: collocation of the residuals of a mapping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ..core.data import Array
from ..optics.field import SmoothField

_ALPHA = 0.01
"""Level, per axis, at which a local model must be significant: subtracted without need, it adds noise."""


@dataclass(frozen=True, eq=False)
class LocalModel:
    """Collocation of the residuals of a mapping: what a polynomial leaves and is not noise.

    Parameters
    ----------
    field : SmoothField
        Mapped minus target, over the targets.
    needed : (bool, bool)
        The axes in which it is subtracted.

    Examples
    --------
    >>> at = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    >>> left = LocalModel.from_dict({"at": at.tolist(), "left": (0 * at + 0.1).tolist(), "degree": 0,
    ...                              "needed": [True, False]})
    >>> left.subtract(np.array([[2.0, 2.0]])).round(3)
    array([[1.9, 2. ]])
    """

    field: SmoothField
    needed: tuple[bool, bool]

    @classmethod
    def where_needed(cls, field: SmoothField | None, alpha: float = _ALPHA) -> Self | None:
        """The model if it is significant in at least one axis, else None."""
        if field is None or not (field.need < alpha).any():
            return None
        return cls(field, (bool(field.need[0] < alpha), bool(field.need[1] < alpha)))

    def subtract(self, xy: Array) -> Array:
        """Mapped points (n, 2) minus the local model there."""
        return xy - self.field(xy) * self.needed

    @property
    def variance(self) -> Array:
        """Variance (2,) of what is subtracted: of a prediction from the other points, without their noise."""
        _, sigma = self.field.leave_one_out()
        noise = self.field.noise * self.field.sigma[:, None]
        variance: Array = np.maximum(sigma**2 - noise**2, 0).mean(axis=0) * self.needed
        return variance

    def to_dict(self) -> dict[str, Any]:
        """The points that it interpolates; fitted again, they give the same field."""
        return {
            "at": self.field.source.tolist(),
            "left": self.field.target.tolist(),
            "sigma": self.field.sigma.tolist(),
            "degree": self.field.degree,
            "needed": list(self.needed),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        """Read back; KeyError, TypeError or ValueError where something is missing or wrong."""
        at, left = (np.array(content[key], dtype=np.float64).reshape(-1, 2) for key in ("at", "left"))
        sigma = np.array(content.get("sigma", np.ones(len(at))), dtype=np.float64)  # earlier files have none
        x, y = (bool(axis) for axis in content["needed"])
        return cls(SmoothField.fit(at, left, sigma=sigma, degree=int(content["degree"])), (x, y))
