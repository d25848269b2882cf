"""The curve of grey values where a file states none: what edges show of it, for all frames of a roll."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from ...core.data import Array
from ...core.tone import ToneCurve
from ...io.scans import Scan
from .steps import SRGB, STRAIGHT, Developed, Tone

_DENSE, _DENSITIES = 3.0, (2.0, 3.0, 4.0)
"""Grey value that is added to densities, as a share of full scale, and the largest densities of scanners."""
_SHARES, _DEVELOPED = (0.3, 0.6, 1.0), "proportional to the light, with a penumbra or halation on the film"
"""Widths of blurs on the film, in those of the steps, and what they are."""
CURVES: tuple[tuple[str, float], ...] = (
    ("proportional to the light", 0.5),
    ("those of sRGB", 0.25),
    ("a power of 1.8", 0.1),
    *((f"densities up to {most:g}", 0.03) for most in _DENSITIES),
    *((_DEVELOPED, 0.02) for _ in _SHARES),
)
"""Curves that grey values may have where a file states none, with their prior probabilities."""
_ODD = 0.02
"""Prior probability that a frame has a curve of its own, or shows one only because its edges are bent for
another reason: half of it for each."""
_SAME_PX = 0.005
"""Displacement of an edge, and difference of its standard deviation, that does not matter: pixels."""


def curves_of(curve: ToneCurve | None, full_scale: float, polarity: int) -> list[Tone | Developed]:
    """The curve that a file states; those of `CURVES` if it states none.

    Densities up to D are powers of a grey value to which much is added: (1 + x/n)ⁿ of D ln 10.
    """
    if curve is not None:
        return [Tone.of_file(curve, full_scale, polarity)]
    straight = replace(STRAIGHT, scale=full_scale, polarity=polarity)
    return [
        straight,
        Tone(*SRGB, full_scale, polarity),
        replace(straight, gamma=1.8),
        *(replace(straight, gamma=d * float(np.log(10)) * (1 + _DENSE), added=_DENSE) for d in _DENSITIES),
        *(Developed(share, full_scale, polarity) for share in _SHARES),
    ]


def probabilities_of(log: Array) -> Array:
    """Probabilities (…, k) of the curves by the logarithms of their likelihoods."""
    return np.asarray(scipy.special.softmax(np.log([prior for _, prior in CURVES]) + log, axis=-1))


def decided_together(log: Array) -> tuple[Array, Array]:
    """One curve for several frames, or scans of frames, of one scanner.

    Most show the same curve. What one shows may be a curve of its own; or its edges are bent for another
    reason and show nothing of the curve, which is that of the others.

    Parameters
    ----------
    log : ndarray (n, k)
        Logarithms of the likelihoods of the curves by the edges of each.

    Returns
    -------
    (ndarray (k,), ndarray (n, k))
        Logarithm of the likelihood by all of them; and probabilities of the curves for each.

    Examples
    --------
    Two of three frames show sRGB, and one nothing:

    >>> log = np.zeros((3, len(CURVES)))
    >>> log[:2, 1] = 8.0
    >>> decided_together(log)[1][:, 1].round(2)
    array([1.  , 1.  , 0.99])
    """
    alike = np.log(1 - _ODD) + log
    # What an odd one shows is any of the curves, with their prior probabilities.
    odd = np.log(_ODD) + scipy.special.logsumexp(log, axis=1, b=[each for _, each in CURVES], keepdims=True)
    either = np.logaddexp(alike, odd)
    shown = either.sum(axis=0)
    common, half = probabilities_of(shown), np.exp(odd - either) / 2
    return shown, common * (1 - half) + (half @ common)[:, None] * probabilities_of(log)


class CurveEvidence(NamedTuple):
    """What edges show of the curve of grey values that a file does not state, for each of `CURVES`.

    Parameters
    ----------
    log : ndarray (k,)
        Logarithms of the likelihoods.
    share : ndarray (k,)
        Probabilities with which the edges were measured: by these edges, or by all of a roll.
    moved : ndarray (k,)
        How far inwards each puts the edges, against their mean, pixels.
    coding : str
        Type of the grey values and channels: scans of one roll that differ in it may differ in their curve.
    """

    log: Array
    share: Array
    moved: Array
    coding: str = ""

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> CurveEvidence:
        """Read what :meth:`to_dict` has written."""
        log, share, moved = (np.array(content[name]) for name in ("log", "share", "moved"))
        return cls(log, share, moved, content["coding"])

    def to_dict(self) -> dict[str, Any]:
        """Return the content for a file."""
        return {name: each if name == "coding" else each.tolist() for name, each in self._asdict().items()}

    def like(self, other: CurveEvidence | None) -> bool:
        """Whether the probabilities of the curves put edges where those of other evidence do."""
        if other is None:
            return True
        shares = np.array([self.share, other.share])
        mean = shares @ other.moved
        spread = np.sqrt((shares * (other.moved - mean[:, None]) ** 2).sum(axis=1))
        return bool(max(abs(np.diff(mean)), abs(np.diff(spread))) < _SAME_PX)


def curves_of_scan(scan: Scan, frames: Iterable[CurveEvidence | None]) -> CurveEvidence | None:
    """What the frames of a scan together show of the curve of grey values; None if the scan states it.

    Examples
    --------
    >>> from reseau.io.scans import scan_of
    >>> curves_of_scan(scan_of(np.zeros((20, 30), np.uint8)), []).share[:3]
    array([0.5 , 0.25, 0.1 ])
    """
    if scan.curve is not None:
        return None
    coding = f"{scan.dtype.name} {' '.join(scan.channels)}"
    own = [each for each in frames if each is not None]
    if len(own) == 1:
        return own[0]._replace(coding=coding)
    log = moved = np.zeros(len(CURVES))
    if own:
        log, _ = decided_together(np.array([each.log for each in own]))
        moved = np.mean([each.moved for each in own], axis=0)
    return CurveEvidence(log, probabilities_of(log), moved, coding)


def curves_of_roll(scans: Iterable[CurveEvidence | None]) -> list[CurveEvidence | None]:
    """What all scans of a roll together show of the curve of each; None where it is stated.

    Examples
    --------
    >>> one = CurveEvidence(np.array([0.0, 5, 0, 0, 0, 0, 0, 0, 0]), np.eye(9)[0], np.zeros(9), "uint8 grey")
    >>> [float(curves_of_roll([one] * count)[0].share[1].round(3)) for count in (1, 2)]
    [0.0, 1.0]
    """
    found = list(scans)
    known = {k: each for k, each in enumerate(found) if each is not None}
    for coding in {each.coding for each in known.values()}:
        alike = [k for k, each in known.items() if each.coding == coding]
        if len(alike) > 1:
            _, shares = decided_together(np.array([known[k].log for k in alike]))
            found = [
                known[k]._replace(share=shares[alike.index(k)]) if k in alike else each
                for k, each in enumerate(found)
            ]
    return found
