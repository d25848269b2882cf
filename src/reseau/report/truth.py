"""What a simulator knows of the truth, and what a comparison with it says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from ..core.data import Array
from ..optics import PlaneMapping

__all__ = [
    "BodyComparison",
    "CameraComparison",
    "Comparison",
    "Factor",
    "Known",
    "KnownPoints",
    "Pair",
    "RodComparison",
    "Stage",
]

Pair = tuple[float, float]
"""Root mean squares of x and of y."""


class KnownPoints(Protocol):
    """Rods as they were made or points of a body, as a simulator knows them."""

    @property
    def names(self) -> tuple[str, ...]:
        """Their names, (n,)."""

    @property
    def object_xy(self) -> Array:
        """Their coordinates in the object, (n, 2)."""

    @property
    def xy(self) -> Array:
        """Their positions in the photograph without noise, (n, 2) in pixels."""


@dataclass(frozen=True, eq=False)
class Known:
    """All that a simulator knows.

    Parameters
    ----------
    view : PlaneMapping
        From the plane of the reseau to PHOTO I, without noise.
    rods : KnownPoints, optional
        The rods as they were made, and where PHOTO II shows them.
    bodies : sequence of KnownPoints
        What each PHOTO III shows.
    """

    view: PlaneMapping
    rods: KnownPoints | None = None
    bodies: Sequence[KnownPoints] = ()


@dataclass(frozen=True)
class Stage:
    """Root mean square of what is left of the errors of some marks, per axis, in the unit of the design."""

    name: str
    fitted: Pair
    check: Pair


@dataclass(frozen=True)
class CameraComparison:
    """What the truth says about group A.

    Parameters
    ----------
    marks, checked : int
        Marks that were fitted, and marks held out.
    position_px : (float, float)
        Root mean square error of the measured positions.
    position_normalised : (float, float)
        The same in units of their standard deviations: 1 where those are right.
    stages : tuple of Stage
        Marks against their designed coordinates: in the common system only, after the best similarity, and
        corrected.
    approximation : (float, float)
        What the model leaves of noise-free positions: its own error, apart from that of the measurement.
    check_normalised : (float, float)
        Corrected check marks against the same adjustment of noise-free positions, in units of their
        standard deviations.
    coefficients_normalised : float
        The same of the coefficients.
    """

    marks: int
    checked: int
    position_px: Pair
    position_normalised: Pair
    stages: tuple[Stage, ...]
    approximation: Pair
    check_normalised: Pair
    coefficients_normalised: float


@dataclass(frozen=True)
class RodComparison:
    """What the truth says about the rods in PHOTO II.

    Parameters
    ----------
    rods, known : int
        Rods measured, and rods that there are.
    position_px, position_normalised : (float, float)
        Errors of the measured positions, and the same in units of their standard deviations.
    made : (float, float)
        Rods as they were made less as they were designed: what their tolerance was in fact.
    """

    rods: int
    known: int
    position_px: Pair
    position_normalised: Pair
    made: Pair


@dataclass(frozen=True)
class BodyComparison:
    """What the truth says about the points of a body in PHOTO III.

    Parameters
    ----------
    points, known, strays : int
        Points found that there are, points that there are, and points found that are none.
    position_px, position_normalised : (float, float)
        Errors of the measured positions, and the same in units of their standard deviations.
    error, error_normalised : (float, float)
        Errors of the true coordinates likewise.
    sigma : (float, float)
        What their standard deviations say.
    identity : dict
        Names of known points by the names they were found under.
    errors : dict
        Errors of the true coordinates by the same names.
    """

    points: int
    known: int
    strays: int
    position_px: Pair
    position_normalised: Pair
    error: Pair
    error_normalised: Pair
    sigma: Pair
    identity: dict[str, str]
    errors: dict[str, Pair]


@dataclass(frozen=True)
class Factor:
    """What is left of the errors of points when a group is taken off; None where there are no such points.

    Parameters
    ----------
    name : str
        What was taken off.
    rods, check : (float, float) or None
        Rods that were fitted, and rods held out, against their designed coordinates.
    body : (float, float) or None
        Points of bodies against the truth.
    ideal : (float, float) or None
        The same when the rods are given the coordinates that they truly have: the rods' tolerance apart.
    """

    name: str
    rods: Pair | None
    check: Pair | None = None
    body: Pair | None = None
    ideal: Pair | None = None


@dataclass(frozen=True)
class Comparison:
    """What the truth says about the whole procedure; what was not done is None or empty.

    Parameters
    ----------
    unit : str
        Of the designs.
    camera : CameraComparison
        PHOTO I.
    rods : RodComparison or None
        PHOTO II.
    bodies : tuple of BodyComparison
        PHOTO III.
    factors : tuple of Factor
        What each group takes off.
    """

    unit: str
    camera: CameraComparison
    rods: RodComparison | None = None
    bodies: tuple[BodyComparison, ...] = ()
    factors: tuple[Factor, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready data."""
        return asdict(self)
