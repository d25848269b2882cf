"""Other orientations in which a design fits a frame: turned, mirrored, or shifted by a step of its grid.

A regular grid looks the same from several sides, and its marks do not tell their names. Only the measured
positions may: a real grid is uneven by more than they are uncertain.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy

from ...core.data import Array, Mask
from ...optics.field import SmoothField, trend_degree
from .assignment import Assignment, assign, spacing
from .grid_search import GridOptions, climbed
from .placement import Placement
from .wires import grid_wires

_SAME, _SYMMETRIC = 0.2, 0.5
"""Distance, in pitches, at which two marks are in one place; share of such marks in a symmetric design."""
_MIRROR = np.diag([1.0, -1.0])


def rival_orientations(
    source: Array, placed: Placement, options: GridOptions, lost: float
) -> list[tuple[str, Assignment]]:
    """Orientations in which about as many marks find a candidate, with their names.

    Parameters
    ----------
    source : ndarray (n, 2)
        Design coordinates.
    placed : Placement
        The position that was found.
    options : GridOptions
        What is known about the orientation.
    lost : float
        Score by which a rival may be lower.

    Returns
    -------
    list of (str, Assignment)
        The highest score first.
    """
    found, valid = placed.assignment, placed.screened.valid
    across = grid_wires(source).directions[:, :, 0].mean(axis=0)
    # Coordinates along and across the wires; the middle of the design stays where it is.
    axes = np.stack([across, [-across[1], across[0]]], axis=1) / np.hypot(*across)
    along = source @ axes
    middle = (along.min(axis=0) + along.max(axis=0)) / 2
    rivals = []
    for quarters, mirrored in itertools.product(range(4), (False, True)):
        if not (quarters or mirrored):
            continue
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
        change = np.array([[c, -s], [s, c]]) @ (_MIRROR if mirrored else np.eye(2))
        moved = ((along - middle) @ change.T + middle) @ axes.T
        if not _allowed(found.field.jacobian(source.mean(axis=0)[None])[0] @ axes @ change @ axes.T, options):
            continue
        near = scipy.spatial.KDTree(source).query(moved)[0] < _SAME * spacing(source)
        if near.mean() < _SYMMETRIC:
            continue
        rival = assign(source, found.field(moved), placed.candidates, valid, shifts=1)
        if rival is None:
            continue
        if (found.candidate < 0).sum() > found.missed + lost:
            # The frame shows a part of the design, and it may be another part.
            rival = climbed(rival, source, placed.candidates, valid)
        if rival.score >= found.score - lost:
            rivals.append((_name(quarters, mirrored), rival))
    return sorted(rivals, key=lambda rival: -rival[1].score)


def _allowed(linear: Array, options: GridOptions) -> bool:
    """Whether a linear mapping from design to image agrees with what is known of the orientation."""
    mirrored = bool(np.linalg.det(linear) < 0)
    if options.mirrored is not None and mirrored != options.mirrored:
        return False
    plain = linear @ _MIRROR if mirrored else linear
    turn = np.arctan2(plain[1, 0] - plain[0, 1], plain[0, 0] + plain[1, 1])
    return options.max_rotation is None or bool(abs(turn) <= options.max_rotation)


def _name(quarters: int, mirrored: bool) -> str:
    turned = f"turned by {90 * quarters}°" if quarters else ""
    return " and ".join(part for part in ("mirrored" if mirrored else "", turned) if part)


def misfit(source: Array, xy: Array, known: Mask) -> float:
    """Rms of measured positions (n, 2) about the smoothest mapping from the design; infinite for too few."""
    if known.sum() < 10:
        return float("inf")
    degree = trend_degree(int(known.sum()), most=3)
    return float(SmoothField.fit(source[known], xy[known], degree=degree, local=False).noise.max())
