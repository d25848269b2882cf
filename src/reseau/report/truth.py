"""The truth of a simulator, and the comparison of results with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from ..core.data import Array
from ..optics.mapping import PlaneMapping

Pair = tuple[float, float]
"""Root mean squares of x and of y."""


class KnownPoints(Protocol):
    """True rods or points of a body in a simulator."""

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
    """The truth of a simulator.

    Parameters
    ----------
    view : PlaneMapping
        From the plane of the reseau to PHOTO I, without noise.
    rods : KnownPoints, optional
        The true rods, and their positions in PHOTO II.
    bodies : sequence of KnownPoints
        The points in each PHOTO III.
    """

    view: PlaneMapping
    rods: KnownPoints | None = None
    bodies: Sequence[KnownPoints] = ()


@dataclass(frozen=True)
class Stage:
    """Root mean square of the remaining errors of marks, per axis, in the unit of the design."""

    name: str
    fitted: Pair
    check: Pair


@dataclass(frozen=True)
class CameraComparison:
    """Comparison of group A with the truth.

    Parameters
    ----------
    marks, checked : int
        Numbers of fitted and of check marks.
    position_px : (float, float)
        Root mean square error of the measured positions.
    position_normalised : (float, float)
        The same in units of their standard deviations; 1 when these are realistic.
    stages : tuple of Stage
        Marks compared with their design coordinates: in the common system only, after the best similarity,
        and corrected.
    approximation : (float, float)
        Residuals of the model for noise-free positions: the model's error without measurement errors.
    check_normalised : (float, float)
        Corrected check marks compared with the same adjustment of noise-free positions, in units of their
        standard deviations.
    coefficients_normalised : float
        The same for the coefficients.
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
    """Comparison of the rods in PHOTO II with the truth.

    Parameters
    ----------
    rods, known : int
        Numbers of measured and of existing rods.
    position_px, position_normalised : (float, float)
        Errors of the measured positions, and the same in units of their standard deviations.
    made : (float, float)
        True minus design coordinates of the rods: their actual tolerance.
    """

    rods: int
    known: int
    position_px: Pair
    position_normalised: Pair
    made: Pair


@dataclass(frozen=True)
class BodyComparison:
    """Comparison of the points of a body in PHOTO III with the truth.

    Parameters
    ----------
    points, known, strays : int
        Numbers of true points found, of existing points, and of false points found.
    position_px, position_normalised : (float, float)
        Errors of the measured positions, and the same in units of their standard deviations.
    error, error_normalised : (float, float)
        Errors of the true coordinates, and the same in units of their standard deviations.
    sigma : (float, float)
        Their standard deviations.
    identity : dict
        Names of true points, by the names of the points found.
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
    """Remaining errors of points after correcting for a group; None where there are no such points.

    Parameters
    ----------
    name : str
        Name of the correction.
    rods, check : (float, float) or None
        Fitted rods and check rods, compared with their design coordinates.
    body : (float, float) or None
        Points of bodies compared with the truth.
    ideal : (float, float) or None
        The same computed with the true coordinates of the rods, without the effect of their tolerance.
    """

    name: str
    rods: Pair | None
    check: Pair | None = None
    body: Pair | None = None
    ideal: Pair | None = None


@dataclass(frozen=True)
class Comparison:
    """Comparison of the whole procedure with the truth; steps that were not done are None or empty.

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
        Effect of each correction.
    """

    unit: str
    camera: CameraComparison
    rods: RodComparison | None = None
    bodies: tuple[BodyComparison, ...] = ()
    factors: tuple[Factor, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as JSON values."""
        return asdict(self)
