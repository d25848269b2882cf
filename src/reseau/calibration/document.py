"""The calibration file ``reseau-calibration/1``: what every procedure ends in."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..core.data import Array
from ..io import Document, Strict

__all__ = ["Calibration", "Covariance", "Quantity"]


class Quantity(Strict):
    """A value with its standard deviation and unit; sigma 0 means held."""

    value: float
    sigma: float = Field(ge=0)
    unit: str


class Covariance(Strict):
    """Covariance matrix of the named parameters, in the products of their units."""

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


class Calibration(Document):
    """A calibration: parameters with full covariance, the tests they passed, and where they hold.

    `model` says how the parameters are to be used, in a form that its own package reads back
    (:meth:`reseau.optics.RationalPolynomial.from_dict` for the camera of an oscilloscope). `times` alone
    holds clock times: without it, same inputs give the same bytes.
    """

    SCHEMA: ClassVar[str] = "reseau-calibration/1"
    kind: Literal["oscilloscope", "camera", "frame"]
    name: str
    model: str | dict[str, Any]
    parameters: dict[str, Quantity]
    covariance: Covariance
    sigma0: float | None
    redundancy: int
    tests: tuple[dict[str, Any], ...] = ()
    validity: dict[str, Any] = Field(default_factory=dict)
    provenance: dict[str, Any] = Field(default_factory=dict)
    times: dict[str, str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        n = len(self.covariance.names)
        if len(self.covariance.matrix) != n or any(len(row) != n for row in self.covariance.matrix):
            raise ValueError(f"`covariance` has {n} names but no {n}×{n} matrix")
        unknown = [name for name in self.covariance.names if name not in self.parameters]
        if unknown:
            raise ValueError(f"`covariance` names {unknown[0]!r}, which is none of the parameters")
        return self

    def values(self) -> dict[str, float]:
        """Parameter values by name."""
        return {name: quantity.value for name, quantity in self.parameters.items()}

    def matrix(self) -> Array:
        """Covariance matrix (u, u) over *all* parameters in their order, zero for held ones."""
        row = {name: i for i, name in enumerate(self.parameters)}
        full = np.zeros((len(row), len(row)))
        where = [row[name] for name in self.covariance.names]
        full[np.ix_(where, where)] = np.array(self.covariance.matrix).reshape(len(where), len(where))
        return full
