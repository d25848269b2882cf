"""Slanted edges of a photograph: found, each with a region that contains nothing else, and measured.

Line segments (von Gioi's LSD, at full and reduced resolution) are candidates. Across a segment, the mean
profile along it tells how far both sides are flat; that, and the segment without its ends, is the region.
Edges that are not slanted, too short, or too close to others are declined with a reason.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Frame, Mask
from ..core.failure import Code, Failure
from .edge import LEAST_SLANT, MOST_SLANT, EdgeSpread, measure_edge

Region = tuple[int, int, int, int]

_REACH_PX, _LEAST_REACH_PX = 40, 10
"""Distance from an edge up to which its sides are examined, and at which they must still be flat."""
_SHORTEST_PX, _LONGEST_PX = 24.0, 160.0
"""Length of an edge without its ends."""
_CORNER_PX = 3.0
_FLAT = 0.06
"""Deviation of a side from flat, as a share of the step of the edge."""
_RISEN = 0.02
"""Change of the mean profile over a pixel, as a share of the step, at which the edge has ended."""
_SMALLEST_STEP = 0.08
"""Least step of an edge, as a share of the range of grey values in the frame."""
_SCALES = (1.0, 0.25)
"""Resolutions at which segments are sought; blurred edges are seen at the lower one."""
_CAP_PX = 4000.0
"""Longer side up to which segments are sought at full resolution."""


@dataclass(frozen=True, eq=False)
class EdgeRegion:
    """The surroundings of one edge.

    Parameters
    ----------
    name : str
        ``E1`` …, from the top left to the bottom right.
    xy : ndarray (2, 2)
        Its ends (px), without corners.
    region : (left, top, width, height)
        Rectangle around the pixels to be used.
    good : ndarray (height, width) of bool, optional
        Pixels of the frame to be used; by default all of the region.
    why : Failure, optional
        Why it cannot be measured.

    Examples
    --------
    >>> EdgeRegion("E1", np.array([[10.0, 10.0], [14.0, 60.0]]), (0, 10, 25, 50)).centre.tolist()
    [12.0, 35.0]
    """

    name: str
    xy: Array
    region: Region
    good: Mask | None = None
    why: Failure | None = None

    @property
    def centre(self) -> Array:
        """Middle of the edge (px)."""
        middle: Array = self.xy.mean(axis=0)
        return middle


@dataclass(frozen=True, eq=False)
class ChartEdge:
    """An edge of a photograph, and what was measured.

    Parameters
    ----------
    at : EdgeRegion
        Where it is.
    found : EdgeSpread or Failure
        Its sharpness, or why it was declined.

    Examples
    --------
    >>> from reseau.core.failure import Code
    >>> region = EdgeRegion("E1", np.array([[10.0, 10.0], [14.0, 60.0]]), (0, 10, 25, 50))
    >>> edge = ChartEdge(region, Failure("is not slanted", Code.NOT_FOUND))
    >>> bool(edge.found), edge.found.reason
    (False, 'is not slanted')
    """

    at: EdgeRegion
    found: EdgeSpread | Failure


def find_edges(frame: Frame) -> tuple[EdgeRegion, ...]:
    """Find straight edges between two flat areas.

    Parameters
    ----------
    frame : Frame
        Grey values proportional to the light.

    Returns
    -------
    tuple of EdgeRegion
        From the top to the bottom, those that cannot be measured with the reason.

    Examples
    --------
    >>> y, x = np.mgrid[:200, :200] - 99.5
    >>> turned = np.maximum(abs(x - 0.1 * y), abs(y + 0.1 * x)) < 60
    >>> square = Frame(np.where(turned, 40.0, 180.0).astype(np.float32), 255.0)
    >>> [(edge.name, edge.why) for edge in find_edges(square)]
    [('E1', None), ('E2', None), ('E3', None), ('E4', None)]
    """
    pixels = np.ascontiguousarray(frame.pixels, dtype=np.float32)
    low, high = np.percentile(pixels[:: max(1, len(pixels) // 1000)], [0.5, 99.5])
    if not high > low:
        return ()
    segments = _segments(pixels, float(low), float(high))
    kept: list[EdgeRegion] = []
    taken = np.zeros(pixels.shape, dtype=bool)
    order = np.argsort(-np.hypot(*(segments[:, 1] - segments[:, 0]).T), kind="stable")
    for ends in segments[order]:
        middle = np.rint(ends.mean(axis=0)).astype(int)
        if taken[tuple(np.clip(middle[::-1], 0, np.array(pixels.shape) - 1))]:
            continue
        found = _region(pixels, ends, float(high - low))
        if found is None:
            continue
        kept.append(found)
        thick = max(5, round(0.1 * float(np.hypot(*(ends[1] - ends[0])))))
        mark = np.zeros(pixels.shape, dtype=np.uint8)
        first, last = np.rint(ends).astype(int).tolist()
        cv2.line(mark, first, last, 1, thick)
        taken |= mark > 0
    rows = sorted(kept, key=lambda each: (round(each.centre[1] / 20), each.centre[0]))
    return tuple(
        EdgeRegion(f"E{k}", each.xy, each.region, each.good, each.why) for k, each in enumerate(rows, 1)
    )


def _segments(pixels: NDArray[Any], low: float, high: float) -> Array:
    """Ends (n, 2, 2) of line segments, of each the longest at any resolution first."""
    grey = np.clip((pixels - low) * (255 / (high - low)), 0, 255).astype(np.uint8)
    found = [np.empty((0, 2, 2))]
    reduced = min(1.0, _CAP_PX / max(grey.shape))
    for scale in _SCALES:
        scale *= reduced
        if min(grey.shape) * scale < 32:
            continue
        size = round(grey.shape[1] * scale), round(grey.shape[0] * scale)
        small = grey if scale == 1 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        lines = cv2.createLineSegmentDetector().detect(small)[0]
        if lines is not None:
            ends = (lines.reshape(-1, 2, 2).astype(np.float64) + 0.5) / scale - 0.5
            found.append(ends[np.hypot(*(ends[:, 1] - ends[:, 0]).T) > _SHORTEST_PX])
    return np.concatenate(found)


def _region(pixels: NDArray[Any], ends: Array, spread: float) -> EdgeRegion | None:
    """The region of an edge; None for lines and for steps that are not those of a chart."""
    along = ends[1] - ends[0]
    length = float(np.hypot(*along))
    along = along / length
    normal = np.array([-along[1], along[0]])
    steps = np.arange(0.1 * length, 0.9 * length)
    offsets = np.arange(-_REACH_PX, _REACH_PX + 1.0)
    profile, uneven = _profile(pixels, ends[0], along, normal, steps, offsets)
    limits = _flat_sides(profile, uneven, spread)
    if limits is None:
        return None
    core, reach = limits
    cut = core + _CORNER_PX
    ends = np.stack([ends[0] + cut * along, ends[1] - cut * along])
    nothing = EdgeRegion("", ends, (0, 0, 0, 0))
    if reach < max(_LEAST_REACH_PX, core + 4):
        return _declined(nothing, "another feature or uneven light is too close", Code.OVERLAPPING)
    if length - 2 * cut < _SHORTEST_PX:
        return _declined(nothing, f"it is {length:.0f} px long, too short for its blur", Code.TOO_SMALL)
    slant = float(np.abs(along).min() / np.abs(along).max())
    if not LEAST_SLANT < slant < MOST_SLANT:
        angle = np.rad2deg(np.arctan(slant))
        return _declined(nothing, f"it is slanted by {angle:.1f}°: rotate the chart by 3° to 20°", Code.SLANT)
    middle, half = ends.mean(axis=0), min(length / 2 - cut, _LONGEST_PX / 2)
    ends = np.stack([middle - half * along, middle + half * along])
    axis = int(np.abs(along).argmax())
    aside = reach / float(np.abs(along).max())
    low, high = ends.min(axis=0), ends.max(axis=0)
    low[1 - axis] -= aside
    high[1 - axis] += aside
    left, top = np.maximum(np.ceil(low), 0).astype(int).tolist()
    right, bottom = np.minimum(np.floor(high), np.array(pixels.shape[::-1]) - 1).astype(int).tolist()
    region = (left, top, right - left + 1, bottom - top + 1)
    y, x = np.mgrid[top : bottom + 1, left : right + 1]
    near = np.abs((x - middle[0]) * normal[0] + (y - middle[1]) * normal[1]) <= reach
    return EdgeRegion("", ends, region, near)


def _declined(at: EdgeRegion, reason: str, code: Code) -> EdgeRegion:
    return EdgeRegion(at.name, at.xy, at.region, None, Failure(reason, code))


def _profile(
    pixels: NDArray[Any], start: Array, along: Array, normal: Array, steps: Array, offsets: Array
) -> tuple[Array, Array]:
    """Mean grey value at distances from an edge, and how much it varies along it; NaN outside the frame."""
    x, y = (start[k] + steps[:, None] * along[k] + offsets * normal[k] for k in (0, 1))
    grey = cv2.remap(
        pixels, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"),
    )  # fmt: skip
    inside = (x >= 0) & (y >= 0) & (x <= pixels.shape[1] - 1) & (y <= pixels.shape[0] - 1)
    grey = np.where(inside, grey, np.nan).astype(np.float64)
    # Means of a sixth of the edge each, so that noise does not count as uneven light.
    parts = np.stack([part.mean(axis=0) for part in np.array_split(grey, 6)])
    return parts.mean(axis=0), np.ptp(parts, axis=0)


def _flat_sides(profile: Array, uneven: Array, spread: float) -> tuple[float, float] | None:
    """Distances where the edge has ended, and up to which both sides are flat; None if it is no edge."""
    zero = len(profile) // 2
    sides = profile[zero::-1], profile[zero:]
    cores, reaches, levels = [], [], []
    near = np.abs(np.diff(profile[zero - 3 : zero + 4]))
    if not np.isfinite(near).all():
        return None
    step = float(np.nanmax(profile) - np.nanmin(profile))
    if step < _SMALLEST_STEP * spread:
        return None
    for side in sides:
        slope = np.abs(np.diff(side))
        ended = np.flatnonzero((slope[:-1] < _RISEN * step) & (slope[1:] < _RISEN * step))
        if not len(ended):
            return None
        cores.append(int(ended[0]))
        levels.append(float(side[ended[0] : ended[0] + 3].mean()))
    step = abs(levels[1] - levels[0])
    if step < _SMALLEST_STEP * spread:  # a line: the same on both sides
        return None
    for k, side in enumerate(sides):
        rough = uneven[zero::-1] if k == 0 else uneven[zero:]
        bad = ~((np.abs(side - levels[k]) < _FLAT * step) & (rough < 2 * _FLAT * step))
        bad[: cores[k] + 1] = False
        reaches.append(int(np.flatnonzero(bad)[0]) - 1 if bad.any() else len(side) - 1)
    return float(max(cores)), float(min(reaches))


def measure_edges(
    frame: Frame,
    regions: Sequence[Region] = (),
    *,
    step: Callable[[str], object] = lambda name: None,
) -> tuple[ChartEdge, ...] | Failure:
    """Measure the slanted edges of a photograph.

    Parameters
    ----------
    frame : Frame
        Grey values proportional to the light.
    regions : sequence of (left, top, width, height)
        Regions with one edge each; without any, edges are found.
    step : callable
        Called with the name of each edge before it is measured.

    Returns
    -------
    tuple of ChartEdge or Failure
        A failure if no edge could be measured.

    Examples
    --------
    >>> from scipy.special import ndtr
    >>> y, x = np.mgrid[:64, :64] - 31.5
    >>> noise = np.random.default_rng(1).normal(0, 1, x.shape)
    >>> frame = Frame(40 + 150 * ndtr((x - 0.1 * y) / 0.9) + noise, 255.0)
    >>> [(edge.at.name, round(float(edge.found.fit["psf"]), 1)) for edge in measure_edges(frame)]
    [('E1', 0.8)]
    """
    given = tuple(
        EdgeRegion(f"E{k}", np.array([[x, y], [x + w, y + h]], dtype=np.float64), (x, y, w, h))
        for k, (x, y, w, h) in enumerate(regions, 1)
    )
    found = []
    for at in given or find_edges(frame):
        step(at.name)
        found.append(ChartEdge(at, _measured(frame, at)))
    if not found:
        return Failure("no straight edge between two flat areas was found", Code.NOT_FOUND)
    failures = [edge.found for edge in found if isinstance(edge.found, Failure)]
    if len(failures) == len(found):
        usual = max(failures, key=lambda each: sum(other.code == each.code for other in failures))
        return Failure(f"none of {len(found)} edges can be measured: {usual.reason}", usual.code)
    return tuple(found)


def _measured(frame: Frame, at: EdgeRegion) -> EdgeSpread | Failure:
    if at.why is not None:
        return at.why
    left, top, width, height = at.region
    left, top = max(left, 0), max(top, 0)
    part = Frame(frame.pixels[top : at.region[1] + height, left : at.region[0] + width], frame.full_scale)
    if min(part.pixels.shape) < 2:
        return Failure("its region is outside the frame", Code.OUTSIDE)
    return measure_edge(part, good=at.good)
