"""A failed estimate is a value: falsy, with a reason for the user and a code for the program."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NoReturn

from .errors import EstimationError

__all__ = ["Code", "Failure"]


class Code(StrEnum):
    """Why an estimate failed or a result carries a warning; callers branch on it, never on a text."""

    AMBIGUOUS = "ambiguous"
    COLLINEAR = "collinear"
    DECLINED = "declined"
    DOUBTFUL_CONTROL = "doubtful-control"
    INCONSISTENT = "inconsistent"
    LOW_CONTRAST = "low-contrast"
    MIRRORED = "mirrored"
    NOT_CONVERGED = "not-converged"
    NOT_FINITE = "not-finite"
    NOT_FOUND = "not-found"
    NOT_IDENTIFIED = "not-identified"
    NO_DATUM = "no-datum"
    NO_REDUNDANCY = "no-redundancy"
    OTHER_DESIGN = "other-design"
    PREREQUISITE_MISSING = "prerequisite-missing"
    RANK_DEFECT = "rank-defect"
    SATURATED = "saturated"
    SEVERAL_TARGETS = "several-targets"
    SINGULAR = "singular"
    TOO_FEW_IMAGES = "too-few-images"
    TOO_FEW_LEVELS = "too-few-levels"
    TOO_FEW_POINTS = "too-few-points"
    TOO_MANY_OUTLIERS = "too-many-outliers"
    TOO_SMALL = "too-small"


@dataclass(frozen=True)
class Failure:
    """An estimate that could not be had; falsy.

    Parameters
    ----------
    reason : str
        One line for the user: what was wrong and what helps, without the name of the file.
    code : Code
        The same for programs.
    where : str
        The frame, file or mark it is about; empty where the caller knows.

    Examples
    --------
    >>> found = Failure("3 points are too few", Code.TOO_FEW_POINTS, where="left.png")
    >>> bool(found), found.code == "too-few-points", str(found)
    (False, True, 'left.png: 3 points are too few')
    """

    reason: str
    code: Code
    where: str = ""

    def __bool__(self) -> bool:
        return False

    def __str__(self) -> str:
        return f"{self.where}: {self.reason}" if self.where else self.reason

    def required(self) -> NoReturn:
        """Raise, for callers that must have the estimate.

        Raises
        ------
        EstimationError
            With the reason.
        """
        raise EstimationError(self.reason, where=self.where or None)
