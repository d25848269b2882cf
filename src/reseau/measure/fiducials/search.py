"""Find fiducial marks in an overview of a scan: candidates by shape, combined by the pattern of the camera.

Each mark is formed at the scale of the overview and correlated with it; the design's coordinates, up to a
similarity close to one of the eight ways in which film can lie in a scanner, then select the candidates
that form the pattern. Nominal positions are not needed. The scale is that of the file, if it states one
that suits, or any at which the pattern fills the scan.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...calibration import film_axes
from ...core.data import Array, Rows
from ...io import FiducialDesign
from ...io.scans import Scan
from ...optics.formation import PixelResponse
from ..matching.shapes import Window
from .forms import margin_of, reach_of, shape_of, thicknesses
from .learnt import OWN_PSF

_MARK_PX, _BOLD_PX, _LONGEST = 24.0, 1.0, 3000
"""Size of the smallest mark with its surroundings, and width of its boldest part, in the overview; largest
longer side of that."""
_UNEVEN = 0.05
"""Difference of a mark from itself, turned, that its making explains, in units of its contrast, one sigma."""
_SAME_FORM = 0.98
"""Correlation of two images of marks from which the same places look like both: noise of a learnt mark."""
_CANDIDATES = 80
"""Most candidates for each form of a mark."""
_LEAST = 0.35
"""Least correlation of a candidate with its formed image."""
_AWAY_PX, _AFFINE = 3.0, 0.004
"""Tolerance of a mark's position in the pattern: in pixels, and in units of the pattern's extent."""
_FILLED = 0.55
"""Least share of a scan's sides that the marks of a photograph span."""
_LONG = 0.5
"""Least distance of two marks that predict the others, in units of the largest."""


@dataclass(frozen=True)
class Attitude:
    """One of the ways in which film can lie in a scanner.

    Parameters
    ----------
    rotation : int
        Direction of the camera's x-axis in the scan, degrees counter-clockwise: 0, 90, 180 or 270; in a
        mirrored scan, after left and right were exchanged.
    mirrored : bool
        Whether the scan shows the film from behind.

    Examples
    --------
    >>> str(Attitude(90, False)), Attitude(0, True).matrix  # camera (x right, y up) to pixels (y down)
    ('rotated by 90°', array([[-1.,  0.],
           [ 0., -1.]]))
    """

    rotation: int
    mirrored: bool

    @property
    def matrix(self) -> Array:
        """From camera coordinates to pixels at 1 px/mm, (2, 2)."""
        return film_axes(self.rotation, self.mirrored)

    def __str__(self) -> str:
        turned = f"rotated by {self.rotation}°" if self.rotation else "upright"
        return f"mirrored, {turned}" if self.mirrored else turned


def attitudes(rotation: int | None, mirrored: bool | None) -> list[Attitude]:
    """All ways that agree with what is known; upright and not mirrored first."""
    return [
        Attitude(turn, side)
        for side, turn in itertools.product((False, True), (0, 90, 180, 270))
        if (rotation is None or turn == rotation) and (mirrored is None or side == mirrored)
    ]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Candidates that form the pattern of the camera.

    Parameters
    ----------
    attitude : Attitude
        How the film lies.
    linear, shift : ndarray (2, 2), (2,)
        Similarity from camera coordinates to pixels of the overview.
    xy : ndarray (n, 2)
        Candidates in the overview, NaN for marks without one.
    likeness : ndarray (n,)
        Their correlations with the formed marks; 0 without a candidate.
    negative : bool
        Whether bright marks are dark in the scan, and dark ones bright.
    """

    attitude: Attitude
    linear: Array
    shift: Array
    xy: Array
    likeness: Array
    negative: bool = False

    @property
    def score(self) -> float:
        """Sum of the correlations above those that any texture reaches."""
        return float(np.maximum(self.likeness - _LEAST, 0.0).sum())


def formed_mark(design: FiducialDesign, k: int, linear: Array, psf: float = 0.8) -> NDArray[np.float32]:
    """Image (2h + 1, 2h + 1) of a mark and what is around it; 1 on the mark, negative for a dark one.

    Parameters
    ----------
    design : FiducialDesign
        The camera.
    k : int
        Index of the mark.
    linear : ndarray (2, 2)
        From camera coordinates to pixels.
    psf : float
        Width of the point-spread function, pixels.
    """
    point = design.points[k]
    mark = design.marks[point.mark]
    scale = float(np.sqrt(abs(np.linalg.det(linear))))
    half = max(3, int(np.ceil((reach_of(mark) + margin_of(mark)) * scale)))
    shape = shape_of(mark, linear @ turned(point.turn_deg), 0.7 * psf, np.ones(3))
    along = np.arange(-half, half + 1.0)[None]
    window = Window(along, along, PixelResponse())
    width = np.array([psf if mark.learnt is None else OWN_PSF])
    none = np.zeros((1, shape.parameters))
    share = shape.image(np.zeros((1, 2)), width, none, np.array([0]), window)[0]
    return np.asarray(share if mark.polarity == "bright" else -share, dtype=np.float32)


def odds_of_same(difference: float, whole: float) -> float:
    """Odds that two images of a mark, or one and itself when it is turned, show the same figure.

    Parameters
    ----------
    difference : float
        Rms difference beyond noise on the mark, in units of its contrast. It is normal if the mark is made
        unevenly, and as probable as any up to `whole` if the figures are two.
    whole : float
        Rms value of the mark there.
    """
    uneven = np.exp(-((difference / _UNEVEN) ** 2) / 2) * np.sqrt(2 / np.pi) / _UNEVEN
    return float(uneven * whole)


def same_figure(one: NDArray[np.float32], other: NDArray[np.float32], noise: float) -> bool:
    """Whether two images (h, w) of marks show the same figure; `noise` is that of each."""
    on = np.maximum(np.abs(one), np.abs(other)) > 0.1
    square = ((one[on] - other[on]) ** 2).mean() - 2 * noise**2
    return odds_of_same(float(np.sqrt(max(square, 0.0))), float(np.sqrt((one[on] ** 2).mean()))) > 1


def same_places(one: Pattern, other: Pattern) -> bool:
    """Whether two patterns have the same marks, each perhaps with another name."""
    a, b = (p.xy[np.isfinite(p.xy).all(axis=1)] for p in (one, other))
    near = np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1)).min(axis=1) < 3.0
    return bool(near.all()) and one.negative == other.negative


def turned(degrees: float) -> Array:
    """Rotation matrix, counter-clockwise with y up."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s], [s, c]])


def least_scales(design: FiducialDesign, size: tuple[float, float]) -> tuple[float, float]:
    """Least and largest scale (px/mm) at which all marks lie in a scan and fill it."""
    extent = np.ptp(design.xy, axis=0)
    long, short = max(extent), max(min(extent), 1e-6)
    most = 1.02 * min(max(size) / long, min(size) / short)
    return _FILLED * most, most


def overview_size(scan: Scan, design: FiducialDesign, scale: float) -> int:
    """Longer side of an overview in which marks at a scale (px/mm) are just large enough to be found."""
    # Thin lines of large marks would vanish in an overview in which the marks are just large enough.
    smallest = min(
        min(2 * (reach_of(mark) + margin_of(mark)) / _MARK_PX, thicknesses(mark)[1] / _BOLD_PX)
        for mark in design.marks.values()
    )
    longer = max(scan.width, scan.height)
    return int(np.ceil(longer / max(1.0, smallest * scale, longer / _LONGEST)))


class Candidates:
    """Places of an overview that look like marks.

    Parameters
    ----------
    overview : ndarray (h, w)
        Reduced grey values.
    step : float
        Smallest difference of grey values that may be a mark.
    reduction : float
        Pixels of the scan in one of the overview.

    Examples
    --------
    >>> from reseau.io import FiducialMark, FiducialPoint, MarkPart
    >>> dot = FiducialMark(polarity="dark", parts=(MarkPart(shape="disk", size=0.6),))
    >>> places = ((10.0, 0.0), (0.0, 10.0), (-10.0, 0.0))
    >>> points = tuple(FiducialPoint(id=str(k), x=x, y=y, mark="dot") for k, (x, y) in enumerate(places))
    >>> design = FiducialDesign(name="", marks={"dot": dot}, points=points)
    >>> grey = np.full((60, 60), 9, np.float32)
    >>> grey[20:27, 30:37] = 200
    >>> Candidates(grey, 1.0).of(design, 0, 10 * np.eye(2), True)[0]  # of a negative
    array([[33., 23.]])
    """

    def __init__(self, overview: NDArray[np.float32], step: float, reduction: float = 1.0) -> None:
        self.overview, self.step, self.reduction = overview, step, reduction
        self._seen: list[tuple[NDArray[np.float32], list[tuple[Array, Array]]]] = []
        self._known: dict[tuple[object, ...], list[tuple[Array, Array]]] = {}
        self._flat: dict[int, NDArray[np.bool_]] = {}

    @classmethod
    def of_scan(cls, scan: Scan, size: int) -> Candidates:
        """Those of an overview of a scan, whose longer side has `size` pixels."""
        overview, reduction = scan.overview(size)
        return cls(np.ascontiguousarray(overview.mean(axis=2)), scan.full_scale / 255 * 0.6, reduction)

    def of(self, design: FiducialDesign, k: int, linear: Array, negative: bool) -> tuple[Array, Array]:
        """Positions (m, 2) and correlations (m,) of a mark; `linear` is from camera coordinates to pixels."""
        point = design.points[k]
        turn = design.marks[point.mark], np.rint(1e6 * linear @ turned(point.turn_deg)).tobytes()
        if turn not in self._known:
            self._known[turn] = self._found(formed_mark(design, k, linear))
        return self._known[turn][negative]

    def _found(self, template: NDArray[np.float32]) -> list[tuple[Array, Array]]:
        """Those of one image of a mark, and of its negative; of images that hardly differ the same."""
        side = len(template)
        for other, found in self._seen:
            if len(other) == side and np.corrcoef(template.ravel(), other.ravel())[0, 1] > _SAME_FORM:
                return found
        if side not in self._flat:
            self._flat[side] = _spread(self.overview, side) < self.step
        self._seen.append((template, _peaks(self.overview, template, self._flat[side])))
        return self._seen[-1][1]


def find_patterns(
    candidates: Candidates,
    design: FiducialDesign,
    scale: float,
    within: float,
    allowed: list[tuple[Attitude, bool]],
    max_tilt_deg: float,
    known: dict[int, Array] | None = None,
) -> list[Pattern]:
    """Find the pattern of the marks, in each attitude in which it fits.

    Parameters
    ----------
    candidates : Candidates
        Of the overview.
    design : FiducialDesign
        The camera.
    scale, within : float
        Scale of the overview in px/mm, and its relative uncertainty.
    allowed : list of (Attitude, bool)
        Possible attitudes, and whether the scan is a negative.
    max_tilt_deg : float
        Largest rotation besides that of the attitude.
    known : dict of int to ndarray (2,), optional
        Places of marks that are known.

    Returns
    -------
    list of Pattern
        The best for each attitude, the highest score first.
    """
    found = []
    for attitude, negative in allowed:
        linear = scale * attitude.matrix
        each = [
            (known[k][None], np.ones(1))
            if known and k in known
            else candidates.of(design, k, linear, negative)
            for k in range(len(design.points))
        ]
        best = _combined(design.xy @ linear.T, each, within, max_tilt_deg)
        if best is not None:
            chosen, likeness = best
            found.append(
                Pattern(attitude, *_similarity(design.xy, chosen, linear), chosen, likeness, negative)
            )
    return sorted(found, key=lambda pattern: -pattern.score)


def _spread(image: NDArray[np.float32], side: int) -> NDArray[Any]:
    """Standard deviation of the grey values in squares."""
    mean = cv2.boxFilter(image, cv2.CV_64F, (side, side))
    square = cv2.sqrBoxFilter(image, cv2.CV_64F, (side, side))
    return np.asarray(np.sqrt(np.maximum(square - mean * mean, 0.0)))


def _peaks(
    image: NDArray[np.float32], template: NDArray[np.float32], flat: NDArray[np.bool_]
) -> list[tuple[Array, Array]]:
    """Positions (m, 2) and values (m,) of the largest maxima of the correlation, and of its negative."""
    half = len(template) // 2
    if min(image.shape) <= len(template):
        return [(np.empty((0, 2)), np.empty(0))] * 2
    # Marks may be cut by the edge of the scan.
    padded = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_REFLECT_101)
    r = cv2.matchTemplate(padded, template, cv2.TM_CCOEFF_NORMED)
    r[flat | ~np.isfinite(r)] = 0.0
    around = np.ones((2 * max(2, half // 2) + 1,) * 2, np.uint8)
    found = []
    for value in (r, -r):
        rows, columns = np.nonzero((value == cv2.dilate(value, around)) & (value > _LEAST))
        order = np.argsort(-value[rows, columns], kind="stable")[:_CANDIDATES]
        rows, columns = rows[order], columns[order]
        places = np.stack([columns, rows], axis=1).astype(np.float64)
        found.append((places, value[rows, columns].astype(np.float64)))
    return found


def _combined(
    expected: Array, candidates: list[tuple[Array, Array]], within: float, max_tilt_deg: float
) -> tuple[Array, Array] | None:
    """The candidates (n, 2) that best form a pattern, and their correlations (n,); None without three."""
    trees = [scipy.spatial.KDTree(xy) if len(xy) else None for xy, _ in candidates]
    place = expected[:, 0] + 1j * expected[:, 1]
    extent = float(np.abs(place[:, None] - place).max())
    reach = _AWAY_PX + _AFFINE * extent
    best_score, best = 0.0, None
    for p, z in _pairs(place, candidates, within, max_tilt_deg):
        start = candidates[p][0][:, 0] + 1j * candidates[p][0][:, 1]
        at = start[z[0]][:, None] + z[1][:, None] * (place - place[p])
        score, rows = np.zeros(len(at)), np.full(at.shape, -1)
        for k, tree in enumerate(trees):
            if tree is None:
                continue
            away, row = tree.query(np.stack([at[:, k].real, at[:, k].imag], 1), distance_upper_bound=reach)
            hit = np.isfinite(away)
            rows[hit, k] = row[hit]
            value = candidates[k][1][row[hit]]
            score[hit] += np.maximum(value - _LEAST, 0.0) * (1 - 0.3 * (away[hit] / reach) ** 2)
        score[(rows >= 0).sum(axis=1) < 3] = 0.0
        if len(score) and score.max() > best_score:
            best_score, best = float(score.max()), rows[int(score.argmax())]
    if best is None:
        return None
    xy, likeness = np.full(expected.shape, np.nan), np.zeros(len(expected))
    for k, row in enumerate(best):
        if row >= 0:
            xy[k], likeness[k] = candidates[k][0][row], candidates[k][1][row]
    return xy, likeness


def _pairs(
    place: NDArray[Any], candidates: list[tuple[Array, Array]], within: float, max_tilt_deg: float
) -> Iterator[tuple[int, tuple[Rows, NDArray[Any]]]]:
    """First of two marks, and for pairs of candidates the first one and the factor of the similarity."""
    n = len(place)
    pairs = sorted(itertools.combinations(range(n), 2), key=lambda pq: -abs(place[pq[0]] - place[pq[1]]))
    longest = abs(place[pairs[0][0]] - place[pairs[0][1]])
    for p, q in pairs:
        d = place[q] - place[p]
        if abs(d) < _LONG * longest or not len(candidates[p][0]) or not len(candidates[q][0]):
            continue
        a, b = (candidates[i][0][:, 0] + 1j * candidates[i][0][:, 1] for i in (p, q))
        z = (b[None] - a[:, None]) / d
        fits = (np.abs(np.abs(z) - 1) < within) & (np.abs(np.angle(z)) < np.deg2rad(max_tilt_deg))
        first, _ = np.nonzero(fits)
        yield p, (first, z[fits])


def _similarity(camera: Array, pixels: Array, start: Array) -> tuple[Array, Array]:
    """Similarity (2, 2), (2,) from camera coordinates to pixels that has the handedness of `start`."""
    known = np.isfinite(pixels).all(axis=1)
    a, b = camera[known] @ start.T, pixels[known]
    a_mean, b_mean = a.mean(axis=0), b.mean(axis=0)
    p, q = ((v - m)[:, 0] + 1j * (v - m)[:, 1] for v, m in ((a, a_mean), (b, b_mean)))
    z = (p.conj() @ q) / (p.conj() @ p)
    linear = np.array([[z.real, -z.imag], [z.imag, z.real]]) @ start
    return linear, b_mean - camera[known].mean(axis=0) @ linear.T
