"""Where a board is whose markers were read: those that agree with its layout, and corners beside them."""

from __future__ import annotations

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ...io.board import BoardDesign
from ...optics.composition import Chain
from ..plane.growth import LENS_FROM, SADDLE_PX
from ..plane.lattice_mapping import images_of, slope_of
from ..plane.lens_mapping import lens_through
from ..plane.plane_mapping import STRENGTHS, plane_through, projectivity_behind
from ..reseau.mark_windows import Located
from .candidates import Saddles, along, bright_between, sector_levels
from .placement import FEWEST, SECOND, Placed, dark_sectors, failed

_GROWN = 16
"""Most steps from the markers read to the corners beside them."""
_NEAR_PX = 2.5
"""Distance within which a saddle is the corner that markers predict, pixels; or in steps of the lattice."""
_NEAR = 0.2
_LENS_FROM, _MARKER_PX = 16, 1.0
"""Corners of markers that determine the distortion of a lens; their standard deviation as they are found."""
_READ_PX = 2.0
"""Error of the corners of markers as they are read, at most; below it a fisheye does not show."""
_ASTRAY = 0.25
"""Largest share of the markers read that do not lie where the board has them: misread, or bent aside."""
_FEW_READ = 3
"""Number of markers up to which as many that agree as do not are not enough."""
_EVEN = 0.5
"""Largest difference of two dark sectors, as a share of their contrast to the paper."""


def _plane_of_markers(
    plane: Array, image: Array, shape: tuple[int, int]
) -> tuple[Array | None, NDArray[np.bool_]]:
    """Projectivity from the board to the corners of markers (4 m, 2), and which of them agree with it.

    Through a lens more of them agree than with the projectivity alone.
    """
    if len(plane) == 4:
        matrix = cv2.getPerspectiveTransform(plane.astype(np.float32), image.astype(np.float32))
        return np.asarray(matrix), np.ones(4, dtype=bool)
    # They are good to two pixels; distortion bends the board.
    limit = max(3.0, 0.006 * max(shape))
    found, good = projectivity_behind(plane, image, shape, 0.0, limit)
    while _LENS_FROM <= good.sum() < len(good):
        start = plane_through(plane[good], image[good], shape, _READ_PX)
        lens = lens_through(plane[good], image[good], np.full(good.sum(), _MARKER_PX), shape, start)
        if lens is None:
            break
        agree = np.hypot(*(lens.mapping(plane) - image).T) < limit
        if agree.sum() <= good.sum():
            break
        good = agree
    if not good.all():
        bent = [projectivity_behind(plane, image, shape, strength, limit) for strength in STRENGTHS[1:]]
        found, good = max([(found, good), *bent], key=lambda one: int(one[1].sum()))
    return found, good


def _agreeing(
    design: BoardDesign, corners: Array, numbers: NDArray[np.intp], shape: tuple[int, int]
) -> tuple[Rows, Array, Array, Mask, Chain, tuple[Remark, ...]] | Failure:
    """Markers of the board that were read: their rows (m,), corners (4 m, 2) in pitches and in the image.

    Also which corners agree with the places of the others, the mapping through these, and notes.
    """
    own, places = design.markers
    row_of = {int(number): k for k, number in enumerate(own)}
    keep = np.array([int(number) in row_of for number in numbers], dtype=bool)
    if not keep.any():
        return Failure("no marker of the board was read", Code.NOT_FOUND)
    corners, rows = corners[keep], np.array([row_of[int(number)] for number in numbers[keep]])
    plane, image = places[rows].reshape(-1, 2) / design.pitch, corners.reshape(-1, 2)
    matrix, good = _plane_of_markers(plane, image, shape)
    if matrix is None or good.sum() < 4:
        return Failure("the markers read do not agree with the board", Code.INCONSISTENT)
    whole = good.reshape(-1, 4).all(axis=1)
    astray = int((~whole).sum())
    if 0 < len(rows) <= min(2 * astray, _FEW_READ):
        # Nothing tells which of them are misread.
        return Failure(f"the {len(rows)} markers read do not agree with each other", Code.INCONSISTENT)
    use = np.repeat(whole, 4) if whole.any() else good
    mapping = plane_through(plane[use], image[use], shape, _READ_PX)
    # Markers beside the board do not contradict it.
    near = whole | _on_board(mapping, places.mean(axis=1) / design.pitch, corners.mean(axis=1))
    if len(rows) > _FEW_READ and astray > 1:
        other = design.model_copy(update={"legacy": not design.legacy}).markers[1][rows].reshape(-1, 2)
        alike = _plane_of_markers(other / design.pitch, image, shape)[1].reshape(-1, 4).all(axis=1)
        contrary = int((near & ~whole).sum())
        if contrary > _ASTRAY * near.sum() or (~alike).sum() < astray:
            return Failure(
                f"{astray} of {len(rows)} markers lie at other places than on the board: it has "
                "another layout (old or new) or number of columns",
                Code.OTHER_DESIGN,
            )
    if np.linalg.det(matrix[:2, :2] - np.outer(matrix[:2, 2], matrix[2, :2]) / matrix[2, 2]) > 0:
        return Failure("the board is seen mirrored", Code.MIRRORED)
    beside = corners[~near], numbers[keep][~near]
    twice = len(beside[0]) > _FEW_READ and not isinstance(_agreeing(design, *beside, shape), Failure)
    each = np.repeat(near, 4)
    return rows[near], plane[each], image[each], use[each], mapping, (SECOND,) * twice


def _on_board(mapping: Chain, markers: Array, seen: Array) -> Mask:
    """Whether places (m, 2) of a frame are those of markers (n, 2) of the board, or between them."""
    tree = scipy.spatial.KDTree(images_of(mapping, markers))
    gap, nearest = tree.query(seen)
    apart = tree.query(tree.data[nearest], k=2)[0][:, 1]
    return np.asarray(gap < apart / np.sqrt(2))


def lay_marked(
    grey: NDArray[np.float32],
    saddles: Saddles,
    design: BoardDesign,
    markers: tuple[Array, NDArray[np.intp]],
) -> Placed | Failure:
    """Find the corners of a ChArUco board or an AprilGrid by its markers.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    saddles : Saddles
        Their saddles.
    design : BoardDesign
        The board.
    markers : (ndarray (m, 4, 2), ndarray (m,))
        Corners of markers in the frame, clockwise from the upper left, and their numbers.

    Returns
    -------
    Placed or Failure
        A failure if no or only contradicting markers were read. Of a grid of separate markers, whose corners
        are no saddles, the corners of the markers read are found.
    """
    shape = (grey.shape[0], grey.shape[1])
    agreeing = _agreeing(design, *markers, shape)
    if isinstance(agreeing, Failure):
        return agreeing
    rows, plane, image, use, mapping, notes = agreeing
    nodes = design.xy / design.pitch
    frame, origin = np.eye(2) / design.pitch, np.zeros(2)
    if design.kind == "markers":
        known, start = np.zeros(len(nodes), dtype=bool), images_of(mapping, nodes)
        whole = use.reshape(-1, 4).all(axis=1)
        of = (4 * rows[whole][:, None] + np.arange(4)).ravel()
        known[of], start[of] = True, image[np.repeat(whole, 4)]
        return Placed(Located(design.ids, design.xy, "dark", mapping, frame, origin, known, start), notes)
    known = np.zeros(len(nodes), dtype=bool)
    start = images_of(mapping, nodes)
    dark, apart = dark_sectors(design), 1.0
    if design.kind == "aprilgrid":
        assert design.size is not None
        apart = min(design.size, design.pitch - design.size) / design.pitch
    through_lens, last = False, (plane[use], image[use], mapping)

    def again_through(at: Array, xy: Array) -> Chain:
        """Mapping through points; through the same as before it is the same."""
        nonlocal last
        if not (np.array_equal(at, last[0]) and np.array_equal(xy, last[1])):
            last = at, xy, plane_through(at, xy, shape)
        return last[2]

    for _ in range(_GROWN):
        again, row = _nearest(saddles, mapping, nodes, dark, plane[use], known, apart)
        if design.kind == "charuco":
            again &= _filled(grey, mapping, nodes, dark)
        same = np.array_equal(again, known)
        known, start = again, np.where(again[:, None], saddles.xy[row], images_of(mapping, nodes))
        if known.sum() < 4 or (same and through_lens):
            break
        # A polynomial through few corners does not predict the next ones through a wide lens.
        through_lens |= same
        both = np.concatenate([nodes[known], nodes[known], plane[use]])
        there = np.concatenate([start[known], start[known], image[use]])
        if known.sum() >= FEWEST and known.sum() > 0.5 * len(rows):
            both, there = nodes[known], start[known]
        mapping = again_through(both, there)
        if through_lens:
            at, seen = np.concatenate([nodes[known], plane[use]]), np.concatenate([start[known], image[use]])
            sigma = np.repeat([SADDLE_PX, _MARKER_PX], [known.sum(), use.sum()])
            lens = lens_through(at, seen, sigma, shape, mapping) if len(at) >= LENS_FROM else None
            mapping = mapping if lens is None else lens.mapping
    if known.sum() < 4:
        return failed(int(known.sum()), "corners beside the markers read")
    mapping = again_through(nodes[known], start[known]) if known.sum() >= FEWEST else mapping
    return Placed(Located(design.ids, design.xy, "dark", mapping, frame, origin, known, start), notes)


def _filled(grey: NDArray[np.float32], mapping: Chain, nodes: Array, dark: Mask) -> Mask:
    """Whether both dark sectors of corners are dark: on the outer edge of a board one of them is paper."""
    # The nodes of the design have y up: its steps have the dark sectors below and to the right beside them.
    far, near = (sector_levels(grey, mapping, nodes, share) for share in (0.3, 0.08))
    ink = np.where(dark[:, None], far[:, 2:], far[:, :2])
    paper = np.where(dark[:, None], near[:, :2], near[:, 2:]).max(axis=1)
    return np.asarray(np.ptp(ink, axis=1) < _EVEN * np.maximum(paper - ink.min(axis=1), 1e-9))


def _nearest(
    saddles: Saddles, mapping: Chain, nodes: Array, dark: Mask, plane: Array, known: Mask, apart: float
) -> tuple[Mask, Rows]:
    """Corners, `apart` from each other, that are found where the mapping predicts them, and their saddles."""
    if not len(saddles):
        return np.zeros(len(nodes), dtype=bool), np.zeros(len(nodes), dtype=np.intp)
    where, slopes = images_of(mapping, nodes), slope_of(mapping, nodes)
    gap, row = scipy.spatial.KDTree(saddles.xy).query(where)
    pixels = apart * np.linalg.norm(slopes, axis=1).min(axis=1)
    # Do not extrapolate: the next corners are those beside what is known.
    support = np.concatenate([plane, nodes[known]])
    close = scipy.spatial.KDTree(support).query(nodes)[0] < 1.8
    down = slopes * [1.0, -1.0]
    fits = bright_between(saddles.edges[row], down) != dark
    near = gap < np.minimum(_NEAR * pixels, _NEAR_PX + 0.03 * pixels)
    found: Mask = near & close & fits & along(saddles.edges[row], slopes)
    return found, row.astype(np.intp)
