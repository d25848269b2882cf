"""Recognition of a testfield in a frame: lines found, targets classified, squares read by their code.

The image of each kind of target is formed with the lattice of lines at each square, and every target is
compared with all of them. The residual sum of squares, after adjustment of contrast, brightness, a small
shift and the sharpness, gives its likelihood. In a cluster every kind occurs twice; the likeliest such
arrangement is the solution of an assignment problem.

Where blur hides lines of one pixel width, the frame is first sharpened with a Wiener filter (Gonzalez and
Woods, *Digital Image Processing*, 5.8). The sharpened frame serves for recognition only; targets are measured
in the original.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure
from ...designs.topology import HIDDEN, Decoded, TopologicalCode
from ...io import TestfieldDesign
from ...optics.formation import Outline, PixelResponse
from ..matching.matcher import SIZE
from ..matching.shapes import GrownOutline, Window
from ..plane.lattice_mapping import images_of, reduced, slope_of, straightened, stretches
from ..plane.levels import levels_at
from ..plane.polynomial import median
from .lattice import LatticeFit, extremes, lattices
from .target_images import flat_outline, stacked

_ALIKE = 0.06
"""Relative difference of local frames below which they share one set of formed images."""
_SHIFT_PX = 0.4
"""Standard deviation of the distance of a target from its position predicted by the lines."""
_UNLIKE, _UNEXPLAINED = 4.0, 0.3
"""A target is unknown if its residual variance exceeds this multiple of the usual noise and this share of the
variance of the image."""
_WIDTH_PX = 0.2
"""Required accuracy of the width of the point-spread function for classification."""
_LEAST_VARIANCE = 1e-6
"""Residual variance assumed where an image of a few pixels fits exactly."""
_ENOUGH_PX = 7
"""Half the number of pixels on a side of the windows in which targets are distinguished; of larger ones, not
all pixels are used."""
_LEAST_STEP_PX = 2.5
"""Least distance of targets in the image, along either direction, at which they can be distinguished."""
_LEAST_PIXELS = 7
"""Least number of pixels of a target that is compared with formed images, of five unknowns."""
_MOST_SQUARES = 4
"""Most squares between the lines that are compared, relative to those of the design; more belong to another
pattern."""
_FAINT = 0.3
"""Minimum contrast of a target relative to the usual contrast."""
_SURE = 3
"""Most targets of a single square that may be hidden or wrong, if there is no other square to confirm it."""
_AGREE = 8
"""Number of squares that agree with the design from which the others in sight may be illegible."""
_SHARE_READ, _CONTRADICT = 0.3, 0.2
"""Share of the squares in sight that must agree with the design, and number of others, relative to those that
agree, that may contradict them."""
_CHANCE, _TOGETHER, _MOSTLY = 1 / 8, 9.0, 0.8
"""Share of targets that have the symbol of the design by chance; agreement of all squares together, in
standard deviations, from which it cannot be by chance (wrong positions reach 5 in a lattice that is shifted
by one target); least share of squares that agree better than by chance (it is two thirds where one half of
the squares belongs elsewhere)."""
_ANGLE = 7.5
"""Resolution of the directions of targets, degrees."""
f32 = np.float32
_SYMMETRY = {"square": 90.0, "cross": 90.0, "triangle": 120.0, "circle": np.inf}


@dataclass(frozen=True, eq=False)
class Kinds:
    """Kinds of targets of a design in all possible rotations, in columns.

    Parameters
    ----------
    shape : tuple of str (k,)
    size, angle : ndarray (k,)
        Size in millimetres, direction in degrees.
    symbol : ndarray of int (k,)
        Symbol of the code, as in :attr:`TestfieldDesign.symbols`.
    """

    shape: tuple[str, ...]
    size: Array
    angle: Array
    symbol: Rows

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, design: TestfieldDesign) -> Kinds:
        """The kinds of a design, rotated by multiples of 90°."""
        found: dict[tuple[int, float, float], str] = {}
        targets = design.targets
        for shape, size, angle, symbol in zip(
            targets.shape, targets.size, targets.angle, design.symbols.tolist(), strict=True
        ):
            period = _SYMMETRY[shape]
            for quarter in range(4):
                turned = 0.0 if np.isinf(period) else (angle + 90 * quarter) % period
                rounded = 0.0 if np.isinf(period) else round(turned / _ANGLE) * _ANGLE % period
                found.setdefault((symbol, size, rounded), shape)
        columns = [np.array(column, dtype=np.float64) for column in zip(*found, strict=True)]
        return cls(tuple(found.values()), columns[1], columns[2], columns[0].astype(np.intp))

    def outline(self, spacing: float) -> Outline:
        """Outlines (k, j, 2) in millimetres, padded with nodes of zero weight."""
        return stacked(
            [flat_outline(*kind, spacing) for kind in zip(self.shape, self.size, self.angle, strict=True)]
        )


@dataclass(frozen=True, eq=False)
class Reading:
    """Classified clusters, in columns over the s visible squares.

    Parameters
    ----------
    cell : ndarray of int (s, 2)
        Lattice coordinates of their lower left corners.
    alone, joint : ndarray of int (s, 16)
        Symbol of each target, from its own likelihood and from that of the cluster; row by row from the upper
        left of the lattice.
    decoded : tuple of Decoded (s,)
        Result of decoding `joint`.
    xy : ndarray (s, 16, 2)
        Positions of the targets predicted by the lines.
    level, contrast : ndarray (s, 16)
        Grey value around each target, and its contrast; NaN where there is none.
    psf_px : float
        Best width of the point-spread function.
    small : int
        Number of further squares in sight, which are too small to be read.
    """

    cell: Rows
    alone: Rows
    joint: Rows
    decoded: tuple[Decoded, ...]
    xy: Array
    level: Array
    contrast: Array
    psf_px: float
    small: int = 0


def read_clusters(
    grey: NDArray[np.float32],
    fit: LatticeFit,
    design: TestfieldDesign,
    psf_px: float,
    response: PixelResponse,
) -> Reading | Failure:
    """Classify the targets of all squares between the lines, and read the squares by the code.

    Returns
    -------
    Reading or Failure
        A failure if no square is visible.
    """
    work = _Clusters(grey, fit, design, response)
    if not work.visible.any():
        return Failure("no square between the lines is visible", Code.NOT_FOUND)
    for _ in range(3):
        found = work.compared(psf_px)
        better = float(np.clip(psf_px + found.widening, 0.5 * psf_px, 2 * psf_px))
        if abs(better - psf_px) < _WIDTH_PX:
            break
        psf_px = better
    alone, joint = work.classified(found)
    code = TopologicalCode.of(design)
    decoded = code.decoded(joint)
    level, contrast = (np.where(joint == HIDDEN, np.nan, values) for values in (found.level, found.contrast))
    return Reading(work.cell, alone, joint, decoded, work.xy, level, contrast, better, work.small)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Negative log-likelihoods (s, 16, 8) of the symbols and of none of them (s, 16); level and contrast
    (s, 16); required change of the width."""

    cost: Array
    none: Array
    level: Array
    contrast: Array
    widening: float


class _Clusters:
    """The targets between the lines, and their comparison with the formed images of all kinds."""

    def __init__(
        self, grey: NDArray[np.float32], fit: LatticeFit, design: TestfieldDesign, response: PixelResponse
    ) -> None:
        self.response, self.kinds = response, Kinds.of(design)
        self.sign = -1.0 if design.polarity == "dark" else 1.0
        i, j = (np.arange(number.min(), number.max()) for number in (fit.across, fit.along))
        self.cell = np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1).reshape(-1, 2)
        relative = design.xy[np.array(design.targets.square) == 1] - design.centres[0]
        order = np.lexsort((relative[:, 0], -relative[:, 1]))
        self.step = float(np.ptp(relative[:, 0]) / 3)
        # Only squares that are in the frame and large enough to be read; a wrong lattice may have any size.
        xy = images_of(
            fit.mapping, (self.cell[:, None] + 0.5 + relative[order] / design.pitch).reshape(-1, 2)
        )
        xy, (h, w) = xy.reshape(-1, 16, 2), grey.shape
        frames = slope_of(fit.mapping, self.cell + 0.5) / design.pitch
        seen: Mask = np.asarray(((xy > 1) & (xy < [w - 2, h - 2])).all(axis=2))
        longest, shortest = (self.step * scale for scale in stretches(np.nan_to_num(frames)))
        legible: Mask = seen.any(axis=1) & (shortest > _LEAST_STEP_PX) & (longest < max(h, w) / 2)
        legible &= legible.sum() <= _MOST_SQUARES * len(design.centres)
        self.small = int((seen.any(axis=1) & (shortest <= _LEAST_STEP_PX)).sum())
        self.cell, self.xy, self.visible = self.cell[legible], xy[legible], seen[legible]
        if not legible.any():
            return
        self.group, self.frames = _grouped(frames[legible])
        reach = np.ceil(np.abs(self.frames).sum(axis=2).max(axis=0) * self.step / 2).astype(int)
        # Large targets are distinguished by every second pixel, or less.
        wide = float(shortest[legible].min()) / _LEAST_STEP_PX
        self.each = max(1, min(round(reach.min() / _ENOUGH_PX), int(wide)))
        reach += -reach % self.each
        self.columns, self.rows = (np.arange(-r, r + 1.0) for r in reach // self.each)
        columns, rows = self.each * self.columns, self.each * self.rows
        offset = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        self.seen = levels_at(grey, self.xy[:, :, None] + offset, cv2.INTER_CUBIC).astype(np.float32)
        self.variance = self.seen.var(axis=2)
        # Pixels that are nearer to a neighbour than to the target are ignored.
        on_board = np.einsum("gij,nj->gni", np.linalg.inv(self.frames), offset)
        self.own = (np.abs(on_board) <= self.step / 2).all(axis=2)
        self.visible &= (self.own.sum(axis=1) >= _LEAST_PIXELS)[self.group][:, None]

    def compared(self, psf_px: float) -> _Comparison:
        """Compare every target with all kinds."""
        pixels = self.own.sum(axis=1)
        rest = np.empty((*self.xy.shape[:2], len(self.kinds.symbol)))
        x = np.empty((*rest.shape, 5))
        design = self._design(psf_px)
        for group, own in enumerate(self.own):
            of = self.group == group
            if pixels[group] < _LEAST_PIXELS:
                rest[of], x[of] = np.inf, 0.0
                continue
            seen = self.seen[of][..., own].astype(np.float64)
            # Projection onto the column space of each design: a = q r, x = r⁻¹ qᵀ l, v² = l² − (qᵀ l)².
            q, r = np.linalg.qr(design[group][:, own])
            part = (seen.reshape(-1, seen.shape[2]) @ np.swapaxes(q, 1, 2).reshape(-1, q.shape[1]).T).reshape(
                *seen.shape[:2], *q.shape[::2]
            )
            x[of] = np.einsum("kuv,stkv->stku", np.linalg.inv(r), part)
            left = (seen**2).sum(axis=2)[:, :, None] - (part**2).sum(axis=3)
            rest[of] = np.maximum(left, 0) / pixels[group]
        best = rest.argmin(axis=2)[..., None]
        noise = max(median(np.take_along_axis(rest, best, 2)[self.visible].ravel()), _LEAST_VARIANCE)
        amplitude = self.sign * x[..., 1]
        level, contrast, _, _, wider = np.moveaxis(np.take_along_axis(x, best[..., None], 2)[:, :, 0], 2, 0)
        ordinary = median(np.abs(contrast[self.visible]))
        shift = np.hypot(x[..., 2], x[..., 3]) / np.maximum(amplitude, 1e-9)
        cost = 0.5 * pixels[self.group][:, None, None] * rest / noise + 0.5 * (shift / _SHIFT_PX) ** 2
        cost[amplitude < _FAINT * ordinary] = np.inf
        by_symbol = [cost[..., self.kinds.symbol == symbol].min(axis=2) for symbol in range(8)]
        widening = median((wider / np.where(contrast == 0, np.inf, contrast))[self.visible])
        left = np.maximum(_UNLIKE, _UNEXPLAINED * self.variance / noise)
        none = 0.5 * pixels[self.group][:, None] * left
        return _Comparison(np.stack(by_symbol, axis=2), none, level, np.abs(contrast), widening)

    def classified(self, found: _Comparison) -> tuple[Rows, Rows]:
        """Symbols (s, 16) of the targets, each by itself, and jointly for a cluster."""
        cost = np.where(self.visible[..., None], found.cost, np.inf)
        cost = np.minimum(cost, 1e6 * found.none.max())
        alone = np.where(cost.min(axis=2) < found.none, cost.argmin(axis=2), HIDDEN)
        joint = np.full(alone.shape, HIDDEN)
        # Each symbol occurs twice, or the target is unknown.
        unknown = np.broadcast_to(found.none[..., None], (*found.none.shape, 16))
        for square, choices in enumerate(np.concatenate([np.repeat(cost, 2, axis=2), unknown], axis=2)):
            row, column = scipy.optimize.linear_sum_assignment(choices)
            joint[square, row] = np.where(column < 16, column // 2, HIDDEN)
        return alone, joint

    def _design(self, psf_px: float) -> Array:
        """Design matrices (g, k, n, 5): level, contrast, shifts, width."""
        scale = float(stretches(self.frames)[0].max())
        outline = self.kinds.outline(float(f"{psf_px / scale:.2g}"))
        turned = np.swapaxes(self.frames, 1, 2)[:, None]
        nodes = Outline(outline.xy @ turned, outline.dxy @ turned).oriented()
        flat = Outline(*(v.reshape(-1, *v.shape[2:]) for v in (nodes.xy, nodes.dxy))).single()
        # Pixels `each` apart are adjacent ones in an image reduced by this factor.
        images = GrownOutline(Outline(flat.xy / f32(self.each), flat.dxy / f32(self.each)), SIZE)
        every = np.arange(len(images.nodes.xy))
        none = np.zeros((len(every), 2))
        columns, rows = (np.tile(v, (len(every), 1)) for v in (self.columns, self.rows))
        window = Window(columns, rows, PixelResponse(self.response.fill / self.each))
        width = np.full(len(every), psf_px / self.each)
        share, slopes = images.derivatives(none, width, none[:, :1], every, window)
        slopes = slopes[:, :3] / f32(self.each)
        design = np.stack([np.ones_like(share), share, *np.moveaxis(slopes, 1, 0)], axis=-1)
        return design.reshape(*nodes.xy.shape[:2], -1, 5).astype(np.float64)


def _grouped(frames: Array) -> tuple[Rows, Array]:
    """Groups of similar local frames (s, 2, 2): group of each frame, and the frames of the groups."""
    size = np.linalg.norm(frames, axis=(1, 2))
    group = np.full(len(frames), -1)
    kept: list[int] = []
    while (group < 0).any():
        first = int(np.argmin(group))
        near = np.linalg.norm(frames - frames[first], axis=(1, 2)) < _ALIKE * size
        near[first] = True
        group[near & (group < 0)] = len(kept)
        kept.append(first)
    return group, frames[kept]


@dataclass(frozen=True, eq=False)
class Placement:
    """Position of the lattice on the board: lattice = frame · design + origin.

    `squares` is the number of squares that agree with the design: those read that are expected there or, if
    too few can be read, those whose targets agree better than by chance.
    """

    frame: Array
    origin: Array
    squares: int

    def identified(self, reading: Reading, design: TestfieldDesign) -> Rows:
        """Cells (n, 2) with the squares expected there, or all those on the board if none can be read."""
        off = reading.cell[:, None] + 0.5 - self.origin - design.centres @ self.frame.T
        expected = 1 + np.abs(off).sum(axis=2).argmin(axis=1)
        found = np.array([decoded.square if decoded else 0 for decoded in reading.decoded])
        on_board = np.abs(off).sum(axis=2).min(axis=1) < 0.5
        agree = on_board & (found == expected)
        return np.asarray(reading.cell[agree if agree.any() else on_board])


def locate(reading: Reading, design: TestfieldDesign) -> Placement | Failure:
    """Determine the position of the lattice on the board from the majority of the clusters.

    Returns
    -------
    Placement or Failure
        A failure if no cluster can be read, if they contradict each other, or if the image is mirrored.
    """
    votes: Counter[tuple[bool, int, int, int]] = Counter()
    best: dict[tuple[bool, int, int, int], int] = {}
    known = [k for k, decoded in enumerate(reading.decoded) if decoded]
    squares = [reading.decoded[k] for k in known]
    turned = _QUARTERS[[decoded.quarter_turns for decoded in squares]].reshape(-1, 2, 2)
    centres = design.centres[[decoded.square - 1 for decoded in squares]].reshape(-1, 2)
    origins = reading.cell[known] + 0.5 - np.einsum("sij,sj->si", turned, centres) / design.pitch
    for decoded, (right, up) in zip(squares, np.rint(2 * origins).astype(int).tolist(), strict=True):
        vote = decoded.mirrored, decoded.quarter_turns, right, up
        votes[vote] += 1
        best[vote] = min(best.get(vote, 16), decoded.corrections + decoded.hidden)
    in_sight = int(((reading.joint != HIDDEN).sum(axis=1) >= 8).sum())
    least = min(_SHARE_READ * in_sight, _AGREE)
    likely, most = votes.most_common(1)[0] if votes else ((False, 0, 0, 0), 0)
    mirrored, quarters, *doubled = likely
    others = votes.total() - most
    if most < least and (together := _placed_together(reading, design)) is not None:
        # At the limit of resolution few of the squares in sight can be read, each by itself.
        turns, right, up = together[0]
        agreeing = votes[False, turns, right, up]
        if votes.total() - agreeing <= max(1, _CONTRADICT * agreeing):
            return Placement(_QUARTERS[turns] / design.pitch, np.array([right, up]) / 2, together[1])
    if not votes:
        return Failure(
            f"{in_sight} squares are visible, but none belongs to the design {design.name!r}",
            Code.OTHER_DESIGN,
        )
    if most == 1 and (alone := best[likely]) > _SURE:
        return Failure(
            f"{in_sight} squares are visible, and only one resembles a square of the design {design.name!r}, "
            f"in {16 - alone} of 16 targets",
            Code.OTHER_DESIGN,
        )
    # In a mirrored image the squares contradict each other about the position.
    if mirrored and sum(n for vote, n in votes.items() if vote[0]) >= max(2, _SHARE_READ * in_sight):
        return Failure("shows the testfield mirrored", Code.MIRRORED)
    if others > max(1, _CONTRADICT * most):
        return Failure(
            f"{most} squares agree with the design {design.name!r}, but {others} contradict them",
            Code.INCONSISTENT,
        )
    if mirrored or most < least:
        return Failure(
            f"only {most} of {in_sight} visible squares belong to the design {design.name!r}",
            Code.OTHER_DESIGN,
        )
    return Placement(_QUARTERS[quarters] / design.pitch, np.array(doubled) / 2, most)


def _placed_together(reading: Reading, design: TestfieldDesign) -> tuple[tuple[int, int, int], int] | None:
    """The position of the lattice with which the targets of all squares together agree best.

    In a wrong position a target has the symbol of the design by chance: one in eight, so that of n targets
    n/8 agree with a variance of 7 n/64. In the right one most squares agree better than that, even where none
    of them can be read.

    Returns
    -------
    ((int, int, int), int) or None
        Number of quarter turns and doubled origin; number of squares that agree better than by chance. None
        if the agreement is not significant, or other positions are possible.
    """
    known = TopologicalCode.of(design).appearances[:4].reshape(-1, 16)
    one = np.eye(8, dtype=np.float32)
    visible = reading.joint != HIDDEN
    looks = np.where(visible[..., None], one[reading.joint], f32(0))
    agree = looks.reshape(len(looks), -1) @ one[known].reshape(len(known), -1).T
    seen = visible.sum(axis=1)
    # The origin of the lattice that each square of the design, in each rotation, gives to each cell.
    centres = np.concatenate([design.centres @ turn.T for turn in _QUARTERS]) / design.pitch
    origin = np.rint(2 * (reading.cell[:, None] + 0.5 - centres)).astype(np.int64)
    turns = np.repeat(np.arange(4), len(design.centres))
    first, span = origin.min(axis=(0, 1)), np.ptp(origin, axis=(0, 1)) + 1
    place = (turns * span[0] + origin[..., 0] - first[0]) * span[1] + origin[..., 1] - first[1]
    places, which = np.unique(place, return_inverse=True)

    def total(values: NDArray[Any]) -> Array:
        return np.asarray(
            np.bincount(which.ravel(), np.broadcast_to(values, place.shape).ravel()), np.float64
        )

    count, squares = total(seen[:, None]), total(seen[:, None] > 0)
    score = (total(agree) - _CHANCE * count) / np.sqrt(_CHANCE * (1 - _CHANCE) * np.maximum(count, 1))
    better = total(agree > _CHANCE * seen[:, None])
    best = int(score.argmax())
    rival = float(np.delete(score, best).max(initial=0.0))
    significant = score[best] > max(_TOGETHER, 2 * rival) and better[best] > _MOSTLY * squares[best]
    if not significant or count[best] < 0.5 * seen.sum():
        return None
    quarters, rest = divmod(int(places[best]), int(span[0] * span[1]))
    right, up = np.array(divmod(rest, int(span[1]))) + first
    return (quarters, int(right), int(up)), int(better[best])


_QUARTERS = np.array([[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]], float)
"""Rotation matrices for 0 to 3 quarter turns from x to y."""


_SCALES = (1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0)
"""Scales at which a frame is searched; targets have a few pixels at one of them."""
_SMALLEST_PX, _LARGEST_PX = 24, 4_000_000
"""Least side of a frame that is searched, and number of its pixels above which it is not enlarged."""
_SHARPEST_PX = 0.4
"""Width of the point-spread function of a reduced frame."""
_LEAST_PSF = 0.5
"""Least width of the point-spread function, relative to the expected one, taken from an enlarged frame."""
_ELSEWHERE = 0.2
"""Share of spots beyond a testfield from which a second testfield is searched."""


@dataclass(frozen=True, eq=False)
class Read:
    """Recognized testfield: the frame in which it was read, its spots, lattice, clusters, and position."""

    frame: SearchedFrame
    spots: Array
    lattice: LatticeFit
    reading: Reading
    placed: Placement

    def original(self) -> tuple[LatticeFit, Reading]:
        """Lattice and clusters in pixels of the frame as it was taken."""
        scale, lattice, reading = self.frame.scale, self.lattice, self.reading
        if scale == 1:
            return lattice, reading
        shift = np.full(2, (scale - 1) / 2)
        blurred = reading.psf_px**2 - (max(scale, 1.0) ** 2 - 1) / 12
        psf_px = max(np.sqrt(max(blurred, 0.0)), _LEAST_PSF * self.frame.psf_px) / scale
        mapping = reduced(lattice.mapping, scale, shift)
        xy = (reading.xy - shift) / scale
        return replace(lattice, mapping=mapping), replace(reading, xy=xy, psf_px=float(psf_px))


@dataclass(frozen=True, eq=False)
class SearchedFrame:
    """A frame in which a testfield is searched.

    Parameters
    ----------
    grey, dark : ndarray (h, w)
        Grey values, and the same with dark targets on a bright background.
    noise : float
        Standard deviation of the noise.
    design : TestfieldDesign
        The testfield.
    psf_px : float
        Expected width of the point-spread function.
    response : PixelResponse
        Light-sensitive area of the pixels.
    scale : float
        Size of the frame relative to the original one.
    """

    grey: NDArray[np.float32]
    dark: NDArray[np.float32]
    noise: float
    design: TestfieldDesign
    psf_px: float
    response: PixelResponse
    scale: float = 1.0

    def _scaled(self, scale: float) -> SearchedFrame:
        """The frame reduced or enlarged."""
        if scale == 1:
            return self
        each = max(1, round(1 / scale))
        high, wide = (n // each * each for n in self.grey.shape)
        size = round(wide * scale), round(high * scale)
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        grey = np.asarray(cv2.resize(self.grey[:high, :wide], size, interpolation=how), dtype=np.float32)
        psf_px = float(np.hypot(scale * self.psf_px, np.sqrt((max(scale, 1.0) ** 2 - 1) / 12)))
        return replace(
            self,
            grey=grey,
            dark=grey if self.dark is self.grey else -grey,
            noise=min(scale, 1.0) * self.noise,
            psf_px=max(psf_px, _SHARPEST_PX),
            response=PixelResponse(1.0) if scale < 1 else self.response,
            scale=scale,
        )

    def read(self) -> Read | Failure:
        """The testfield with the squares of the design, at the coarsest scale at which all are legible.

        Of those at which only some are, at the one that shows most of them.
        """
        failure: Failure | None = None
        best: Read | None = None
        for scale in _SCALES:
            size = scale**2 * self.grey.size
            if min(self.grey.shape) * scale < _SMALLEST_PX or (scale > 1 and size > _LARGEST_PX):
                continue
            seen = self._scaled(scale)
            found = seen._among(extremes(seen.dark, seen.noise))
            if isinstance(found, Read):
                if best is None or found.placed.squares > best.placed.squares:
                    best = found
                if not found.reading.small:
                    return best
                continue
            if best is None and found.code == Code.MIRRORED:
                return found
            # That the targets of another design were seen says more than that there are none.
            if failure is None or found.code != Code.NOT_FOUND:
                failure = found
        if best is not None:
            return best
        return Failure("is too small to show a testfield", Code.NOT_FOUND) if failure is None else failure

    def _among(self, spots: Array) -> Read | Failure:
        """The first lattice of spots whose squares are those of the design."""
        failure: Failure | None = None
        for lattice in lattices(spots, self.design, self.grey.shape):
            reading = read_clusters(self.grey, lattice, self.design, self.psf_px, self.response)
            placed = reading if isinstance(reading, Failure) else locate(reading, self.design)
            if isinstance(placed, Placement) and isinstance(reading, Reading):
                return Read(self, spots, lattice, reading, placed)
            if isinstance(placed, Failure) and placed.code == Code.MIRRORED:
                return placed
            if failure is None and isinstance(placed, Failure):
                failure = placed
        if failure is None:
            failure = Failure("no spots form the lattice of a testfield", Code.NOT_FOUND)
        return failure


def shows_second(read: Read) -> bool:
    """Whether a second testfield is visible beyond the one that was read."""
    design = read.frame.design
    identified = read.placed.identified(read.reading, design)
    # Keep a margin of half a square; the projectivity is accurate enough to locate the border.
    low, high = identified.min(axis=0) - 0.5, identified.max(axis=0) + 1.5
    at = straightened(read.lattice.mapping, read.spots)
    beyond = ((at < low) | (at > high)).any(axis=1)
    if beyond.mean() < _ELSEWHERE:
        return False
    other = read.frame._among(read.spots[beyond])
    if isinstance(other, Failure):
        return False
    # The rest may show other squares of the same testfield.
    at = (design.centres @ other.placed.frame.T) + other.placed.origin
    mine = (design.centres @ read.placed.frame.T) + read.placed.origin
    ends = (at >= other.reading.cell.min(axis=0)) & (at <= other.reading.cell.max(axis=0) + 1)
    seen = ends.all(axis=1)
    apart = np.hypot(*(other.lattice.mapping(at[seen]) - read.lattice.mapping(mine[seen])).T)
    step = np.hypot(*(other.lattice.mapping(at[seen] + [0.25, 0.0]) - other.lattice.mapping(at[seen])).T)
    return bool(np.median(apart / step) > 1)
