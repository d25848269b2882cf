"""Formats of film: those that a frame can be by its proportions and size, and the scale by perforations."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array
from .adjacent_lines import student
from .perforations import PITCH_MM, ROWS_MM

FORMATS: tuple[tuple[float, float], ...] = ((36.0, 24.0), (56.0, 56.0), (56.0, 41.5), (69.0, 56.0))
"""Formats searched by default: 35 mm, 6×6, 6×4.5, 6×7; frames of all others have proportions like these."""
ALL_FORMATS: tuple[tuple[float, float], ...] = (
    *FORMATS,
    (24.0, 18.0),
    (24.0, 24.0),
    (84.0, 56.0),
    (118.0, 88.0),
    (120.0, 95.0),
    (4.8, 3.5),
    (5.79, 4.01),
    (10.26, 7.49),
    (22.0, 16.0),
)
"""Also half frame, 24×24, 6×9, 9×12, 4×5 inch, and the cine formats 8, Super 8, 16 and 35 mm."""
_ASPECT, _SIZE = 0.012, 0.02
"""Relative standard deviations of the proportions of a frame in an overview, and of its size."""
_TRUE, _RANGE = 0.8, 3.4
"""Probability that the resolution that a file states is that of the scan, and logarithmic range of others."""
_LEAST_PITCH, _PERIODS, _SLOWER = 6.0, 6, 0.6
"""Least pitch of perforations in an overview, pixels, and their least number in a row."""
_HEIGHT = 0.45
"""Share of the pitch in which rows across perforations show them entirely."""
_REGULAR = 0.52
"""Least share of the variance along both rows that has the period of perforations in phase: 0.57 to 0.89 in
scans that show them, at most 0.47 in pictures."""
_WINDOW_MM = 40.0
"""Largest width of a window through which 35 mm film with its perforations is scanned."""
_WITHIN = 3
"""Pixels of an overview inside the lines of a frame that are not taken for its interior."""
_VISIBLE = 0.05
"""Least contrast of perforations, as a share of that of the scan."""


def format_probabilities(
    size: Array, among: Sequence[tuple[float, float]], exact: float | None, stated: float | None
) -> list[tuple[tuple[float, float], float]]:
    """Formats, as they lie in the scan, with their probabilities, the most probable first.

    Parameters
    ----------
    size : ndarray (2,)
        Width and height of the frame, pixels.
    among : sequence of (width, height)
        Possible formats in mm, in either orientation.
    exact, stated : float, optional
        Pixels per millimetre that are known, and those that the file states.

    Examples
    --------
    A frame of 720 px × 480 px may be 36 mm × 24 mm or 84 mm × 56 mm; at 508 dpi it is the former:

    >>> size = np.array([720.0, 480.0])
    >>> [(format, round(p, 1)) for format, p in format_probabilities(size, ALL_FORMATS, None, None)[:2]]
    [((36.0, 24.0), 0.5), ((84.0, 56.0), 0.5)]
    >>> format_probabilities(size, ALL_FORMATS, 508 / 25.4, None)[0][0]
    (36.0, 24.0)
    """
    lying = list(dict.fromkeys(each for w, h in among for each in ((w, h), (h, w))))
    sides = np.array(lying)
    weight = student(np.log(size[0] / size[1] * sides[:, 1] / sides[:, 0]), _ASPECT)
    scale = np.log(np.sqrt(np.prod(size) / sides.prod(axis=1)))
    if exact is not None:
        weight = weight * student(scale - np.log(exact), _SIZE)
    elif stated is not None:
        weight = weight * (_TRUE * student(scale - np.log(stated), _SIZE) + (1 - _TRUE) / _RANGE)
    weight = np.round(weight / weight.sum(), 9)  # of equal ones the first is the usual one
    return [(lying[k], float(weight[k])) for k in np.argsort(-weight, kind="stable")]


def scale_by_perforations(overview: NDArray[np.float32], corners: Array) -> tuple[float, bool] | None:
    """Pixels of an overview per millimetre by the two rows of perforations of 35 mm film; None without them.

    Two rows with the period of 4.75 mm, 28.17 mm apart, in either direction of the film. Also whether they
    lie within a frame that was found: then its lines are those of the scanner's window, or of a holder.

    Parameters
    ----------
    overview : ndarray (h, w, c)
        The reduced scan.
    corners : ndarray (4, 2)
        Corners of a frame in it, along or across the film.
    """
    grey = overview.mean(axis=2)
    height, width = grey.shape
    along = corners[1] - corners[0]
    centre = (width - 1) / 2, (height - 1) / 2
    turn = cv2.getRotationMatrix2D(centre, float(np.rad2deg(np.arctan2(along[1], along[0]))), 1.0)
    level = cv2.warpAffine(grey, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
    placed = corners @ turn[:, :2].T + turn[:, 2]
    x, y = np.sort(placed, axis=0).T
    left, right = int(x[1]) + _WITHIN, int(x[2]) - _WITHIN
    inner = level[max(int(y[1]) + _WITHIN, 0) : int(y[2]) - _WITHIN, max(left, 0) : right]
    for part, within in ((inner, True), (level, False)):
        widest = _WINDOW_MM if within else np.inf
        planes = (np.asarray(plane, dtype=np.float32) for plane in (part, part.T))
        share, pitch = max(_rows_of_perforations(plane, widest) for plane in planes)
        if share > _REGULAR:
            return pitch / PITCH_MM, within
    return None


def _rows_of_perforations(grey: NDArray[np.float32], widest: float) -> tuple[float, float]:
    """Share of the variance along the most regular two rows that perforations explain, and their pitch.

    Perforations lie opposite to each other: only what both rows have in common, in phase, speaks for them. At
    their scale the picture is at most `widest` mm wide across the rows.
    """
    height, width = grey.shape
    rest = grey - scipy.ndimage.uniform_filter1d(grey, max(3, width // _PERIODS), axis=1)
    wave = np.fft.rfft(rest * np.hanning(width), n=4 * width, axis=1)
    above = np.cumsum(np.abs(wave[:, ::-1]) ** 2, axis=1)[:, ::-1]
    seen = np.sqrt(above[:, 0]) > _VISIBLE * np.sqrt(above[:, 0].max())
    best = (0.0, 1.0)
    for k in range(4 * _PERIODS, int(4 * width / _LEAST_PITCH)):
        pitch = 4 * width / k
        away, high = round(pitch * ROWS_MM / PITCH_MM), max(1, round(_HEIGHT * pitch))
        if not 0 < away < height - high or height / pitch * PITCH_MM > widest:
            continue
        # A line of a windowed spectrum is sixteen samples wide where it is sampled four times as finely.
        line = (
            wave[:, k - 8 : k + 9] * (seen / np.sqrt(np.maximum(above[:, round(_SLOWER * k)], 1e-9)))[:, None]
        )
        both = (line[:-away] * line[away:].conj()).real.sum(axis=1)
        share = scipy.ndimage.uniform_filter1d(both, high)
        best = max(best, (float(share.max()), pitch))
    return best
