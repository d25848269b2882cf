"""The clusters of a testfield read: every target by the likelihood of its formed image, squares by the code.

The image of each kind of target is formed as the lattice of lines has it at each square, and every target is
compared with all of them: the sum of squares that is left when contrast, brightness, a small shift and the
sharpness are adjusted is its likelihood. Of a cluster it is known that every kind stands in it twice. The
likeliest arrangement of that sort is an assignment problem, and is solved as one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure
from ...designs.topology import HIDDEN, Decoded, TopologicalCode
from ...io import TestfieldDesign
from ...optics.formation import Outline, PixelResponse
from ..matching import SIZE, GrownOutline, Window
from .images import flat_outline, stacked
from .lattice import LatticeFit

__all__ = ["Kinds", "Placement", "Reading", "locate", "read_clusters"]

_ALIKE = 0.06
"""Relative difference of local frames below which one set of formed images serves for both."""
_SHIFT_PX = 0.4
"""Standard deviation of what a target is off the place where the lines have it."""
_UNLIKE, _UNEXPLAINED = 4.0, 0.3
"""A target is none of the design's where more is left than so many times the ordinary noise, and than this
part of what is seen."""
_WIDTH_PX = 0.2
"""How well the width of the point-spread function must be known for targets to be told apart."""
_LEAST_VARIANCE = 1e-6
"""Square of the grey values that are left where an image of a few pixels fits exactly."""
_FAINT = 0.3
"""Part of the ordinary contrast below which there is no target."""
_ANGLE = 7.5
"""Directions of targets are told apart to this, in degrees."""
_SYMMETRY = {"square": 90.0, "cross": 90.0, "triangle": 120.0, "circle": np.inf}


@dataclass(frozen=True, eq=False)
class Kinds:
    """Targets of a design as they may appear, in columns.

    Parameters
    ----------
    shape : tuple of str (k,)
    size, angle : ndarray (k,)
        Millimetres and degrees.
    symbol : ndarray of int (k,)
        As in :attr:`TestfieldDesign.symbols`.
    """

    shape: tuple[str, ...]
    size: Array
    angle: Array
    symbol: Rows

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, design: TestfieldDesign) -> Kinds:
        """The kinds of a design, turned by all quarters."""
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
        """Outlines (k, j, 2) in millimetres; where one has fewer nodes, the rest weighs nothing."""
        return stacked(
            [flat_outline(*kind, spacing) for kind in zip(self.shape, self.size, self.angle, strict=True)]
        )


@dataclass(frozen=True, eq=False)
class Reading:
    """The clusters as they were read, in columns over the s squares in sight.

    Parameters
    ----------
    cell : ndarray of int (s, 2)
        Lattice coordinates of their lower left corners.
    alone, joint : ndarray of int (s, 16)
        What each target is taken for, by its own likelihood and by that of the cluster; rows from the upper
        left of the lattice.
    decoded : tuple of Decoded (s,)
        What the code makes of the latter.
    xy : ndarray (s, 16, 2)
        Where the lines have the targets.
    level, contrast : ndarray (s, 16)
        Grey values around each target, and what it takes of them or adds; NaN where there is none.
    psf_px : float
        Width of the point-spread function that serves best.
    """

    cell: Rows
    alone: Rows
    joint: Rows
    decoded: tuple[Decoded, ...]
    xy: Array
    level: Array
    contrast: Array
    psf_px: float


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
        A failure where no square is in sight.
    """
    work = _Clusters(grey, fit, design, response)
    if not work.visible.any():
        return Failure("no square between the lines is in sight", Code.NOT_FOUND)
    for _ in range(3):
        found = work.compared(psf_px)
        better = float(np.clip(psf_px + found.widening, 0.5 * psf_px, 2 * psf_px))
        if abs(better - psf_px) < _WIDTH_PX:
            break
        psf_px = better
    alone, joint = work.classified(found)
    code = TopologicalCode.of(design)
    decoded = tuple(code.decode(symbols) for symbols in joint)
    level, contrast = (np.where(joint == HIDDEN, np.nan, values) for values in (found.level, found.contrast))
    return Reading(work.cell, alone, joint, decoded, work.xy, level, contrast, better)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Minus log-likelihoods (s, 16, 8) of the symbols, and of none of them (s, 16); level and contrast
    (s, 16); change of width wanted."""

    cost: Array
    none: Array
    level: Array
    contrast: Array
    widening: float


class _Clusters:
    """The targets between the lines, and what they are compared with."""

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
        at = self.cell[:, None] + 0.5 + relative[order] / design.pitch
        self.xy = fit.mapping(at.reshape(-1, 2)).reshape(-1, 16, 2)
        frames = fit.mapping.derivatives(self.cell + 0.5).d_xy / design.pitch
        self.group, self.frames = _grouped(frames)
        h, w = grey.shape
        seen: Mask = (self.xy > 1) & (self.xy < [w - 2, h - 2])
        self.visible: Mask = np.asarray(seen.all(axis=2))
        reach = np.ceil(np.abs(self.frames).sum(axis=2).max(axis=0) * self.step / 2).astype(int)
        self.columns, self.rows = (np.arange(-r, r + 1.0) for r in reach)
        offset = np.stack(np.meshgrid(self.columns, self.rows), axis=-1).reshape(-1, 2)
        sampled = (self.xy[:, :, None] + offset).astype(np.float32)
        flat = sampled.reshape(-1, len(offset), 2)
        self.seen = cv2.remap(
            grey, flat[..., 0], flat[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        ).reshape(*self.xy.shape[:2], -1)
        # What is nearer to a neighbour than to the target is not looked at.
        on_board = np.einsum("gij,nj->gni", np.linalg.inv(self.frames), offset)
        self.own = (np.abs(on_board) <= self.step / 2).all(axis=2)

    def compared(self, psf_px: float) -> _Comparison:
        """Compare every target with all kinds."""
        pixels = self.own.sum(axis=1)
        rest = np.empty((*self.xy.shape[:2], len(self.kinds.symbol)))
        x = np.empty((*rest.shape, 5))
        design = self._design(psf_px)
        for group, own in enumerate(self.own):
            of = self.group == group
            seen = self.seen[of][..., own].astype(np.float64)
            # By what of the image lies in the space of each design: a = q r, x = r⁻¹ qᵀ l, v² = l² − (qᵀ l)².
            q, r = np.linalg.qr(design[group][:, own])
            part = (seen.reshape(-1, seen.shape[2]) @ np.swapaxes(q, 1, 2).reshape(-1, q.shape[1]).T).reshape(
                *seen.shape[:2], *q.shape[::2]
            )
            x[of] = np.einsum("kuv,stkv->stku", np.linalg.inv(r), part)
            left = (seen**2).sum(axis=2)[:, :, None] - (part**2).sum(axis=3)
            rest[of] = np.maximum(left, 0) / pixels[group]
        best = rest.argmin(axis=2)[..., None]
        noise = max(float(np.median(np.take_along_axis(rest, best, 2)[self.visible])), _LEAST_VARIANCE)
        amplitude = self.sign * x[..., 1]
        level, contrast, _, _, wider = np.moveaxis(np.take_along_axis(x, best[..., None], 2)[:, :, 0], 2, 0)
        ordinary = np.median(np.abs(contrast[self.visible]))
        shift = np.hypot(x[..., 2], x[..., 3]) / np.maximum(amplitude, 1e-9)
        cost = 0.5 * pixels[self.group][:, None, None] * rest / noise + 0.5 * (shift / _SHIFT_PX) ** 2
        cost[amplitude < _FAINT * ordinary] = np.inf
        by_symbol = [cost[..., self.kinds.symbol == symbol].min(axis=2) for symbol in range(8)]
        widening = float(np.median((wider / np.where(contrast == 0, np.inf, contrast))[self.visible]))
        left = np.maximum(_UNLIKE, _UNEXPLAINED * self.seen.var(axis=2) / noise)
        none = 0.5 * pixels[self.group][:, None] * left
        return _Comparison(np.stack(by_symbol, axis=2), none, level, np.abs(contrast), widening)

    def classified(self, found: _Comparison) -> tuple[Rows, Rows]:
        """Symbols (s, 16) of the targets, each by itself, and all of a cluster together."""
        cost = np.where(self.visible[..., None], found.cost, np.inf)
        cost = np.minimum(cost, 1e6 * found.none.max())
        alone = np.where(cost.min(axis=2) < found.none, cost.argmin(axis=2), HIDDEN)
        joint = np.full(alone.shape, HIDDEN)
        for square, each in enumerate(cost):
            # Every symbol twice, or none of them.
            choices = np.concatenate(
                [np.repeat(each, 2, axis=1), np.repeat(found.none[square, :, None], 16, axis=1)], axis=1
            )
            row, column = linear_sum_assignment(choices)
            joint[square, row] = np.where(column < 16, column // 2, HIDDEN)
        return alone, joint

    def _design(self, psf_px: float) -> Array:
        """Design matrices (g, k, n, 5): level, contrast, shifts, width."""
        scale = float(np.linalg.norm(self.frames, ord=2, axis=(1, 2)).max())
        outline = self.kinds.outline(float(f"{psf_px / scale:.2g}"))
        turned = np.swapaxes(self.frames, 1, 2)[:, None]
        nodes = Outline(outline.xy @ turned, outline.dxy @ turned).oriented()
        flat = Outline(*(v.reshape(-1, *v.shape[2:]) for v in (nodes.xy, nodes.dxy))).single()
        images = GrownOutline(flat, SIZE)
        every = np.arange(len(images.nodes.xy))
        none = np.zeros((len(every), 2))
        columns, rows = (np.tile(v, (len(every), 1)) for v in (self.columns, self.rows))
        window = Window(columns, rows, self.response)
        share, slopes = images.derivatives(none, np.full(len(every), psf_px), none[:, :1], every, window)
        design = np.stack([np.ones_like(share), share, *np.moveaxis(slopes[:, :3], 1, 0)], axis=-1)
        return design.reshape(*nodes.xy.shape[:2], -1, 5).astype(np.float64)


def _grouped(frames: Array) -> tuple[Rows, Array]:
    """Groups of like local frames (s, 2, 2): which group each is of, and the frames of the groups."""
    kept: list[Any] = []
    group = np.zeros(len(frames), dtype=np.intp)
    for k, frame in enumerate(frames):
        size = np.linalg.norm(frame)
        near = [i for i, other in enumerate(kept) if np.linalg.norm(frame - other) < _ALIKE * size]
        if not near:
            kept.append(frame)
        group[k] = near[0] if near else len(kept) - 1
    return group, np.array(kept)


@dataclass(frozen=True, eq=False)
class Placement:
    """Where on the board the lattice of lines lies: lattice = frame · design + origin."""

    frame: Array
    origin: Array
    squares: int


def locate(reading: Reading, design: TestfieldDesign) -> Placement | Failure:
    """Put the lattice on the board by what most clusters say.

    Returns
    -------
    Placement or Failure
        A failure where no cluster can be read, they contradict each other, or the image is mirrored.
    """
    votes: Counter[tuple[bool, int, int, int]] = Counter()
    for cell, decoded in zip(reading.cell, reading.decoded, strict=True):
        if decoded:
            turn = _quarter(decoded.quarter_turns)
            origin = cell + 0.5 - turn @ design.centres[decoded.square - 1] / design.pitch
            key = np.rint(2 * origin).astype(int)
            votes[decoded.mirrored, decoded.quarter_turns, int(key[0]), int(key[1])] += 1
    in_sight = int(((reading.joint != HIDDEN).sum(axis=1) >= 8).sum())
    if not votes:
        return Failure(
            f"{in_sight} squares are in sight, but none is one of the design {design.name!r}",
            Code.OTHER_DESIGN,
        )
    (mirrored, quarters, *doubled), most = votes.most_common(1)[0]
    others = sum(votes.values()) - most
    # In a mirror every square says something else about the place of the board.
    if mirrored and sum(n for vote, n in votes.items() if vote[0]) >= max(2, 0.3 * in_sight):
        return Failure("shows the testfield in a mirror", Code.MIRRORED)
    if others > max(1, 0.2 * most):
        return Failure(
            f"{most} squares lie as in the design {design.name!r}, {others} read like it do not",
            Code.INCONSISTENT,
        )
    if mirrored or most < 0.3 * in_sight:
        return Failure(
            f"of {in_sight} squares in sight only {most} are of the design {design.name!r}", Code.OTHER_DESIGN
        )
    return Placement(_quarter(quarters) / design.pitch, np.array(doubled) / 2, most)


def _quarter(turns: int) -> Array:
    """Rotation by quarters, x into y."""
    return np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), turns)
