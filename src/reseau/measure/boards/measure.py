"""Measurement of boards: from a frame and a design to image coordinates with covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core import vocabulary as v
from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ...core.threads import one_thread
from ...designs.boards import marker_cells
from ...designs.dots import halves_of_dots
from ...io.board import BoardDesign
from ...optics.composition import Chain
from ..mosaic import balanced
from ..plane.growth import LENS_FROM, SADDLE_PX
from ..plane.lattice_mapping import images_of, second_order, slope_of, stretches
from ..plane.lens_mapping import lens_through
from ..plane.plane_mapping import STRENGTHS, plane_through, projectivity_behind
from ..points import Measured, Reason
from ..reseau.disks import find_disks
from ..reseau.mark_windows import Located
from ..reseau.marks import ReseauOptions
from ..reseau.plane_marks import PlaneMarks
from ..reseau.sheet import DiskMarks
from ..screening import Screened, inner_pixels, screen
from .candidates import Saddles, along, bright_between, find_saddles, sector_levels
from .corners import BORDER_PX, CornerMarks, DeltilleMarks, Sectors
from .deltilles import find_deltille
from .markers import find_markers, find_tags
from .placement import FEWEST, SECOND, Placed, dark_sectors, failed, find_puzzle, lay_chessboard, lay_circles
from .puzzles import PuzzlePart
from .tags import with_seen_edges

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


_BRIGHT = 0.75
"""Share of the range of the sensor below which no noise makes a pixel clipped."""
_MIRRORED = "the board is seen mirrored: the print is, or the program that took the picture mirrors it"
_UNCERTAIN = Reason("measured, but which point it is is not certain", Code.AMBIGUOUS)
_MISREAD = 3
"""Most markers that may be misread: a mirrored one of many is like another one of its dictionary."""
_CIRCLE_EDGE = 3.0
"""Distance from the next circle in which pixels are not used, in widths of the point-spread function."""


@dataclass(frozen=True)
class BoardOptions:
    """Options of the measurement of a board.

    Parameters
    ----------
    mirrored : bool
        Whether the board is seen from behind or the image is mirrored.
    psf_px : float
        Approximate width (one sigma) of the point-spread function; it is estimated.
    row_jitter_px : float
        Standard deviation of the shift of single rows, if known.
    fill : float
        Light-sensitive share of the pixel pitch along either axis, 0 to 1, if known.
    least_t : float
        Minimum contrast of a mark over its standard deviation.
    most_sigma_px : float
        Largest standard deviation of a coordinate that is accepted.
    neighbour_px : float
        Largest deviation, per axis, from the prediction of the neighbours.

    Examples
    --------
    >>> BoardOptions(mirrored=True).most_sigma_px
    0.2
    """

    mirrored: v.Mirrored = False
    psf_px: v.PsfPx = 0.8
    row_jitter_px: v.RowJitterPx = 0.0
    fill: v.Fill = 1.0
    least_t: float = 3.5
    most_sigma_px: float = 0.2
    neighbour_px: float = 0.5


@dataclass(frozen=True, eq=False, repr=False)
class BoardResult(Measured):
    """Points of a board measured in one frame, in columns over all points of the design.

    Parameters
    ----------
    psf_px : ndarray (n,)
        Width of the point-spread function at each point; NaN where there was no match.
    notes : tuple of Remark
        What a user should know: ambiguous names, motion, curves of the camera.

    Examples
    --------
    See :func:`measure_board`:

    >>> issubclass(BoardResult, Measured)
    True
    """

    psf_px: Array
    notes: tuple[Remark, ...]


def measure_board(
    frame: Frame, design: BoardDesign, options: BoardOptions | None = None
) -> BoardResult | Failure:
    """Measure the points of a board of any kind: corners of squares or tags, or circles.

    Parameters
    ----------
    frame : Frame
        A photograph that shows the board, whole or in part, at any rotation and tilt.
    design : BoardDesign
        The board.
    options : BoardOptions, optional
        Options of the measurement.

    Returns
    -------
    BoardResult or Failure
        A failure (falsy) if the board is not found in the frame.

    Notes
    -----
    Derived in ``docs/mathematics/boards.md``.

    Examples
    --------
    Draw a chessboard with edges half way between pixels, and measure its corners:

    >>> design = BoardDesign(name="small", unit="mm", kind="chess", columns=6, rows=5, pitch=20.0)
    >>> squares = np.indices((5, 6)).sum(axis=0) % 2 * 160 + 30
    >>> sheet = np.pad(np.kron(squares, np.ones((20, 20))), 30, constant_values=190)
    >>> sheet = cv2.GaussianBlur(sheet, (0, 0), 0.8)
    >>> sheet += np.random.default_rng(0).normal(0, 1, sheet.shape)
    >>> found = measure_board(Frame(sheet, 255.0), design)
    >>> found.found, bool(np.abs(found.xy[0] - 49.5).max() < 0.05)
    (20, True)
    """
    options, frame = options or BoardOptions(), balanced(frame)
    with one_thread():
        if not options.mirrored:
            return _measured(frame, design, options)
        turned = replace(frame, pixels=np.ascontiguousarray(frame.pixels[:, ::-1]))
        return _unmirrored(_measured(turned, design, options), frame.width)


def puzzle_part(frame: Frame) -> PuzzlePart | Failure:
    """Find out which part of the code of PuzzleBoards a frame shows, of a board of any size.

    Some 6 × 6 corners in sight are enough.

    Parameters
    ----------
    frame : Frame
        A photograph.

    Returns
    -------
    PuzzlePart or Failure
        A failure (falsy) if there is no PuzzleBoard, or too little of one.

    Examples
    --------
    >>> noise = np.random.default_rng(0).normal(100, 2, (80, 80))
    >>> puzzle_part(Frame(noise, 255.0)).code
    <Code.NOT_FOUND: 'not-found'>
    """
    with one_thread():
        screened = screen(balanced(frame), None)
        if isinstance(screened, Failure):
            return screened
        return find_puzzle(screened.grey, find_saddles(screened.grey, screened.noise))


def _unmirrored(found: BoardResult | Failure, width: int) -> BoardResult | Failure:
    """The result in the image that was mirrored before it was measured."""
    last = width - 1

    def back(xy: Array) -> Array:
        return np.stack([last - xy[..., 0], xy[..., 1]], axis=-1)

    if isinstance(found, Failure):
        return found if found.places is None else replace(found, places=back(found.places))
    sign = np.array([-1.0, 1.0])
    return replace(
        found,
        xy=back(found.xy),
        predicted=back(found.predicted),
        deviation=found.deviation * sign,
        cov=found.cov * np.outer(sign, sign),
    )


def _measured(frame: Frame, design: BoardDesign, options: BoardOptions) -> BoardResult | Failure:
    screened = screen(frame, None)
    if isinstance(screened, Failure):
        return screened
    placed = _placed(frame, screened, design)
    if isinstance(placed, Failure):
        return Failure(
            f"board {design.name!r} was not found in the frame: {placed.reason}",
            placed.code,
            where=frame.name,
            places=placed.places,
        )
    # Whether a bright pixel beside a clipped one is itself clipped depends on its noise.
    clipped = cv2.dilate((frame.pixels >= frame.full_scale).astype(np.uint8), np.ones((3, 3), np.uint8))
    bright = frame.pixels > _BRIGHT * frame.full_scale
    valid = screened.valid & ~(bright & (clipped > 0))
    screened = replace(screened, valid=inner_pixels(valid, BORDER_PX))
    common = ReseauOptions(
        psf_px=options.psf_px,
        row_jitter_px=options.row_jitter_px,
        fill=options.fill,
        least_t=options.least_t,
        most_sigma_px=options.most_sigma_px,
        neighbour_px=options.neighbour_px,
    )
    marks: PlaneMarks
    if design.kind == "circles":
        assert design.size is not None
        marks = CircleMarks(frame, screened, placed.located, common, design.size)
    else:
        kind = DeltilleMarks if design.kind == "deltille" else CornerMarks
        marks = kind(frame, screened, placed.located, common, sectors_of(design))
    columns = marks.columns(with_field=False)
    found = BoardResult(**columns | {"notes": placed.notes + columns["notes"]})
    if placed.certain:
        return found
    why = tuple(_UNCERTAIN if ok else why for ok, why in zip(found.ok, found.why, strict=True))
    return replace(found, ok=np.zeros_like(found.ok), why=why)


def _placed(frame: Frame, screened: Screened, design: BoardDesign) -> Placed | Failure:
    """Where the points of the board are, approximately."""
    if design.kind == "circles":
        grey = screened.grey if design.polarity == "dark" else -screened.grey
        disks = find_disks(grey, screened.valid, screened.noise)
        found = lay_circles(grey, disks, design)
        return replace(found, places=disks.xy) if isinstance(found, Failure) else found
    if design.kind == "deltille":
        found, places = find_deltille(screened.grey, screened.noise, design)
        return replace(found, places=places) if isinstance(found, Failure) else found
    saddles = find_saddles(screened.grey, screened.noise)
    if design.kind in ("chess", "puzzle"):
        found = lay_chessboard(screened.grey, saddles, design)
        if isinstance(found, Failure) and found.code is Code.NOT_FOUND:
            found = lay_chessboard(screened.grey, with_seen_edges(screened.grey, saddles), design)
        if isinstance(found, Failure) and found.code is Code.OTHER_DESIGN and design.kind == "puzzle":
            grey = np.ascontiguousarray(screened.grey[:, ::-1])
            if lay_chessboard(grey, saddles.mirrored(frame.width), design):
                return Failure(_MIRRORED, Code.MIRRORED)
    else:
        markers = _markers(frame, screened.grey, saddles, design)
        found = lay_marked(screened.grey, saddles, design, markers)
        read = len(markers[1])
        if isinstance(found, Failure) or read <= _MISREAD:
            turned = replace(frame, pixels=np.ascontiguousarray(frame.pixels[:, ::-1]))
            grey = np.ascontiguousarray(screened.grey[:, ::-1])
            if len(_markers(turned, grey, saddles.mirrored(frame.width), design)[1]) > max(1, 2 * read):
                return Failure(_MIRRORED, Code.MIRRORED)
    return replace(found, places=saddles.xy[: 4 * len(design.ids)]) if isinstance(found, Failure) else found


def _markers(
    frame: Frame, grey: NDArray[np.float32], saddles: Saddles, design: BoardDesign
) -> tuple[Array, NDArray[np.intp]]:
    """Corners (m, 4, 2) of the markers that can be read, clockwise from the upper left, and their numbers."""
    if design.kind == "aprilgrid":
        return find_tags(grey, saddles, design)
    return find_markers(frame, design)


class CircleMarks(DiskMarks):
    """Circles of a grid, whose printed size is that of the design to a few hundredths."""

    word = "circle"
    learnt_from = 24
    sampled = 8
    precise_start = True
    bounded = True
    curve_first = True
    eccentric = True
    even = True
    formed_px = 0.0007

    def __init__(
        self, image: Frame, screened: Screened, located: Located, options: ReseauOptions, size: float
    ) -> None:
        super().__init__(image, screened, located, options, size)
        nearest = scipy.spatial.KDTree(self.xy).query(self.xy, k=2)[0][:, 1]
        self.free = float(nearest.min()) - size / 2

    def _region(self, rows: Rows, half: tuple[int, int]) -> Mask | None:
        """See :class:`PlaneMarks`: what lies before the next circles."""
        slope = second_order(self.mapping, self.at[rows])[1] @ self.frame
        least = stretches(slope)[1]
        limit = self.free - _CIRCLE_EDGE * self.look.blur_px / least
        if (np.hypot(*half) < limit * least).all():
            return None
        centre = np.rint(self.start[rows])
        x = centre[:, :1] + np.arange(-half[0], half[0] + 1) - self.start[rows, :1]
        y = centre[:, 1:] + np.arange(-half[1], half[1] + 1) - self.start[rows, 1:]
        back = np.linalg.inv(slope)[..., None, None]
        one, two = (back[:, k, 0] * x[:, None, :] + back[:, k, 1] * y[:, :, None] for k in (0, 1))
        return np.asarray(one * one + two * two < np.maximum(limit, 0.0)[:, None, None] ** 2)


def sectors_of(design: BoardDesign) -> Sectors:
    """What surrounds the corners of a board."""
    count = len(design.ids)
    if design.kind in ("aprilgrid", "markers"):
        assert design.size is not None
        names = np.arange(count) % 4
        # The tag lies above and to the right of its lower left corner.
        towards = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        if design.kind == "markers":
            towards = towards[::-1]
        outlines, side = _bright_cells(design)
        border, free = design.border_bits * side, design.pitch - design.size
        reach = min(border, free if design.kind == "aprilgrid" else max(free, side))
        touching = np.full(count, design.kind == "aprilgrid")
        along = min(2 * reach, design.size / 2)
        ink = np.full(len(outlines), -1.0)
        return Sectors(_normals(towards[names]), touching, reach, along, outlines, ink)
    if design.kind == "deltille":
        angle = np.deg2rad([90.0, 210.0, 330.0])
        normal = np.tile(np.stack([np.cos(angle), np.sin(angle)], axis=1), (count, 1, 1))
        # The corners at the other ends of edges are as near to what lies beyond the middle.
        reach = design.step[1] / 2
        none = np.zeros((0, 4, 2))
        return Sectors(normal, np.ones(count, dtype=bool), reach, reach, none, np.zeros(0))
    below = design.nodes.sum(axis=1) % 2 == (0 if design.dark_corner else 1)
    dark = np.where(below[:, None], [1.0, -1.0], [1.0, 1.0])
    reach = design.pitch / 2
    if design.kind == "charuco":
        outlines = design.markers[1]
        ink = np.ones(len(outlines))
    else:
        outlines, ink = halves_of_dots(design)
        if design.size is not None:
            # The dots of a PuzzleBoard take the middles of its edges.
            reach -= design.size / 2
    return Sectors(_normals(dark), np.ones(count, dtype=bool), reach, reach, outlines, ink)


def _normals(dark: Array) -> Array:
    """Normals (n, 2, 2) of edges along x and y towards the sector with these signs (n, 2) of x and y."""
    return np.asarray(dark[:, None] * np.eye(2)[::-1])


def _bright_cells(design: BoardDesign) -> tuple[Array, float]:
    """Outlines (m, 4, 2) of the bright cells next to the border of tags, as runs; side of a cell."""
    corners, black = marker_cells(design)
    assert design.size is not None
    first, last = design.border_bits, black.shape[1] - design.border_bits - 1
    side = design.size / black.shape[1]
    found = []
    for tag, cells in zip(corners, ~black, strict=True):
        for turned in range(2):
            lines = cells.T if turned else cells
            for k in (first, last):
                # The corner cells belong to the rows.
                ends = (first + turned, last + 1 - turned)
                edges = np.diff(np.concatenate([[0], lines[k, slice(*ends)].astype(np.int8), [0]]))
                for a, b in np.flatnonzero(edges).reshape(-1, 2) + ends[0]:
                    low, high = np.array([a, k]), np.array([b, k + 1])
                    low, high = (low[::-1], high[::-1]) if turned else (low, high)
                    (x0, y0), (x1, y1) = tag[0] + side * low * [1, -1], tag[0] + side * high * [1, -1]
                    found.append([(x0, y1), (x1, y1), (x1, y0), (x0, y0)])
    return np.array(found).reshape(-1, 4, 2), side
