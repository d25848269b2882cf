"""Decisions on calibrations, the calibration that applies, and the drift since the last service event."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from ..calibration import Calibration
from ..core.data import Array
from .charts import Monitored
from .covariates import Explanation
from .rules import Judgement, Outcome


@dataclass(frozen=True)
class Decision:
    """A decision on a calibration of a configuration.

    Parameters
    ----------
    key : str
        Start of the SHA-256 of the calibration, by which the decision is named.
    outcome : {"accepted", "accepted with warning", "rejected", "needs review"}
        The outcome by the rules, or by a person where these left it open.
    since : datetime
        From when on the calibration applies, if it was accepted.
    at : datetime
        When it was decided.
    by, comment : str
        By whom or what, and why.
    judgement : Judgement
        Findings, with the rules by which it was judged.
    compared_with : str or None
        Key of the calibration in force it was compared with.
    reviewed_by, review : str
        Who reviewed it, and the reason; empty if nobody did.
    comments : tuple of (str, str)
        Later comments: by whom, and text.
    name : str
        The name that people gave it; empty if nobody did.
    session : str or None
        Session of the archive that has this calibration among its results; None if none was named.
    earlier : tuple of (str, datetime, Judgement)
        Judgements by earlier versions of the rules: by whom, and when.

    Examples
    --------
    >>> Decision.__dataclass_fields__["outcome"].name
    'outcome'
    """

    key: str
    outcome: Outcome
    since: datetime
    at: datetime
    by: str
    comment: str
    judgement: Judgement
    compared_with: str | None
    reviewed_by: str = ""
    review: str = ""
    comments: tuple[tuple[str, str], ...] = ()
    name: str = ""
    session: str | None = None
    earlier: tuple[tuple[str, datetime, Judgement], ...] = ()

    @property
    def says_something(self) -> bool:
        """Whether it says how the instrument is: it is complete, and no person rejected it."""
        compared = any(each.rule == "image" for each in self.judgement.findings)
        return self.outcome != "rejected" or (compared and not self.reviewed_by)


@dataclass(frozen=True)
class Applied:
    """The calibration that applies to a configuration at a time.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    key : str
        Name of its decision.
    since : datetime
        From when on it applies.
    why : {"decision", "review", "return"}
        What put it in force.

    Examples
    --------
    >>> Applied.__dataclass_fields__["why"].name
    'why'
    """

    calibration: Calibration
    key: str
    since: datetime
    why: Literal["decision", "review", "return"]


@dataclass(frozen=True, eq=False)
class Drift:
    """Control charts of the calibrations of a configuration since its last service event.

    Parameters
    ----------
    keys : tuple of str (n,)
        Decisions on the calibrations, in time order; rejected ones are left out.
    names : tuple of str (c,)
        Parameters, and for a camera the norm of the field.
    values : ndarray (n, c)
        Their values; of the norm the power 2/3 of the rms difference from the first calibration, px.
    charts : Monitored
        The charts.
    explanation : Explanation, optional
        Which signals covariates explain.
    conversion_px : float
        Largest error over the image of calibrations that were converted to the model of the last one.

    Examples
    --------
    >>> import numpy as np
    >>> from reseau.service.charts import monitor
    >>> Drift(("4f2a",), ("c",), np.array([[8.0]]), monitor(np.array([[8.0]]))).keys
    ('4f2a',)
    """

    keys: tuple[str, ...]
    names: tuple[str, ...]
    values: Array
    charts: Monitored
    explanation: Explanation | None = None
    conversion_px: float = 0.0

    @property
    def signals(self) -> list[dict[str, str]]:
        """Calibrations and parameters whose charts signal, with the key since which it probably is so."""
        return [
            {
                "calibration": self.keys[run],
                "parameter": self.names[k],
                "since": self.keys[self.charts.since(int(run), int(k))],
                "direction": "increase" if self.charts.alarm[run, k] > 0 else "decrease",
            }
            for run, k in zip(*self.charts.alarm.nonzero(), strict=True)
        ]

    @property
    def verdicts(self) -> list[dict[str, str]]:
        """What the covariates say about signals."""
        found = () if self.explanation is None else self.explanation.verdicts
        return [
            {"calibration": self.keys[run], "parameter": self.names[k], "verdict": verdict}
            for run, k, verdict in found
        ]
