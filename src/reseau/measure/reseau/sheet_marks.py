"""The disks of a sheet matched with their formed images, and the verdict on each of them.

The image of every disk is formed as the mapping through all has it there, to second order: what is estimated
is the image of its centre, not the centre of its ellipse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Failure
from ...io import ReseauDesign
from ...optics.field import SmoothField
from ...optics.formation import Outline, PixelResponse
from ..matching import Matches, MatchOptions, grey_variance, match
from ..screening import Screened, screen
from ..testfield.lattice import second_order
from ..testfield.targets import merged
from .disks import Disks, find_disks
from .marks import ReseauOptions
from .sheet import SheetPlacement, lay_sheet, through

__all__ = ["measure_sheet"]

_FORM = np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])
"""A disk grows, is stretched along an axis, or along a diagonal: paper is no plane. None moves its centre."""
_FORM_SIGMA = np.array([0.1, 0.03, 0.03])
_CLASS_PX = 4
"""Windows are of sizes in such steps."""
_GROUND_PX = 5
"""What a window shows around its disk."""
_EDGE_PX = 3
"""Pixels next to a ring that its blur may reach."""
_OWN_PX = 2
"""Pixels next to a disk that its own blur reaches."""
_SLOPE = 0.3
"""How the contrast of a disk may change from its middle to the edge of its window by reflected light."""
_SEEN = 0.95
_UNEASY = 1.4
"""Times the ordinary residuals from which on the ground is tried curved."""
_BLURRED, _GROWN, _BENT = 1.8, 0.2, 0.12
"""How sharpness, size and form of a disk may differ from what is expected there, as shares."""
_BULGED = 0.3
"""How far a disk may lie off where its neighbours have it, in radii: paper bulges."""
_UNMODELLED_PX = 0.05
"""What positions scatter beyond their own sigmas: the sheet is not plane."""
_NODES_PX = 1.1
"""Distance of nodes on an outline in widths of the point-spread function."""


def measure_sheet(frame: Frame, design: ReseauDesign, options: ReseauOptions) -> dict[str, Any] | Failure:
    """Measure the disks of a sheet with coded rings, at any rotation and tilt.

    Parameters
    ----------
    frame : Frame
        A photograph.
    design : ReseauDesign
        The sheet.
    options : ReseauOptions
        How.

    Returns
    -------
    dict or Failure
        Columns of :class:`reseau.measure.reseau.ReseauResult`.
    """
    screened = screen(frame, None)
    grey = screened.grey if design.polarity == "dark" else -screened.grey
    disks = find_disks(grey, screened.valid, screened.noise)
    placed = lay_sheet(grey, disks, design, options.mirrored)
    if isinstance(placed, Failure):
        return Failure(
            f"design {design.name!r} is not to be found in the frame: {placed.reason}",
            placed.code,
            where=frame.name,
        )
    valid = screened.valid & (frame.pixels < frame.full_scale)
    return _Sheet(frame, replace(screened, valid=valid), disks, design, placed, options).columns()


def _arc(start: float, end: float) -> Array:
    """Points (40, 2) on the unit circle from one angle to another, degrees."""
    angle = np.deg2rad(np.linspace(start, end, 40))
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


@dataclass(frozen=True, eq=False)
class _Look:
    """What the disks of this frame look like."""

    psf_px: float
    size: float
    variance: tuple[float, float] | None


class _Sheet:
    """The two rounds of matching, and the verdict on every disk."""

    def __init__(
        self,
        image: Frame,
        screened: Screened,
        disks: Disks,
        design: ReseauDesign,
        placed: SheetPlacement,
        options: ReseauOptions,
    ) -> None:
        assert design.mark.size is not None
        self.image, self.screened, self.design, self.options = image, screened, design, options
        self.frame, self.mapping = placed.frame, placed.mapping
        self.origin = placed.origin
        self.at = design.xy @ placed.frame.T + placed.origin
        self.found = placed.disk >= 0
        self.start = np.where(self.found[:, None], disks.xy[placed.disk], self.mapping(self.at))
        self.look = _Look(options.psf_px, design.mark.size, None)

    def columns(self) -> dict[str, Any]:
        """Columns of the result."""
        rows = np.flatnonzero(self.found)
        first = self._match(rows)
        sure = first.converged & (first.t > 8) & (first.rejected < 0.2)
        self._learn(first, rows, sure)
        rows = self._in_sight()
        found = self._match_all(rows)
        why, field = self._judged(rows, found)
        again = np.flatnonzero((why != "") & (found.seen > 0.5))
        if 0 < len(again) < len(rows) and field is not None:
            # Where a disk was missed, its neighbours now say better where to look.
            self.start[rows[again]] = field(self._straight(rows[again]))
            good = why == ""
            found = merged(
                [np.flatnonzero(good | (found.seen <= 0.5)), again],
                [found.select(good | (found.seen <= 0.5)), self._match_all(rows[again])],
            )
            why, field = self._judged(rows, found)
        return self._spread(rows, found, why, field)

    def _straight(self, rows: Rows) -> Array:
        """Images by the projectivity alone: what a smooth field starts from."""
        return self.mapping.first(self.at[rows])

    def _in_sight(self) -> Rows:
        """Disks whose centres lie in the frame."""
        h, w = self.screened.grey.shape
        inside = ((self.start > 0) & (self.start < (w - 1, h - 1))).all(axis=1)
        return np.flatnonzero(inside)

    def _outline(self, rows: Rows) -> Outline:
        """Images of the disks around the images of their centres."""
        _, slope, bend = second_order(self.mapping, self.at[rows])
        scale = float(np.linalg.norm(slope @ self.frame, ord=2, axis=(1, 2)).max())
        flat = Outline.circle(self.look.size / 2, _NODES_PX * self.look.psf_px / scale)
        step, tangent = flat.xy @ self.frame.T, flat.dxy @ self.frame.T
        # F(s + d) − F(s) = J d + ½ d H d, and its derivative J + H d.
        nodes = np.einsum("kab,jb->kja", slope, step) + 0.5 * np.einsum("kabc,jb,jc->kja", bend, step, step)
        tangents = np.einsum("kab,jb->kja", slope, tangent) + np.einsum(
            "kabc,jb,jc->kja", bend, step, tangent
        )
        return Outline(nodes, tangents).oriented().single()

    def _match(self, rows: Rows, background: int = 1) -> Matches:
        """Match disks, those of like size in windows of one size."""
        outline, start = self._outline(rows), self.start[rows]
        reach = np.abs(outline.xy).max(axis=1)
        sizes, of = np.unique(np.ceil(reach / _CLASS_PX).astype(np.intp), axis=0, return_inverse=True)
        of = of.ravel()
        valid = self.screened.valid & ~self._rings()
        parts, found = [], []
        for k, size in enumerate(sizes):
            part = np.flatnonzero(of == k)
            half = size * _CLASS_PX + _GROUND_PX
            options = MatchOptions(
                half_px=(int(half[0]), int(half[1])),
                psf_px=self.look.psf_px,
                psf_log_sigma=0.5,
                response=PixelResponse(self.options.fill),
                polarity=self.design.polarity,
                row_jitter_px=self.options.row_jitter_px,
                settled=0.05,
                contrast_slope=_SLOPE,
                background=background,
                variance=self.look.variance,
            )
            found.append(
                match(
                    self.screened.grey,
                    valid,
                    Outline(outline.xy[part], outline.dxy[part]),
                    start[part],
                    options,
                    noise=self.screened.noise,
                    form=_FORM,
                    form_sigma=_FORM_SIGMA,
                )
            )
            parts.append(part)
        return merged(parts, found)

    def _rings(self) -> Mask:
        """Pixels of the coded rings, which are no ground."""
        hidden, own = np.zeros((2, *self.screened.grey.shape), dtype=np.uint8)
        rings = self.design.rings
        assert rings is not None
        for name, sectors in rings.sectors.items():
            centre = self.design.xy[self.design.ids.index(name)]
            self._fill(own, self.look.size / 2 * _arc(0, 360) + centre)
            for start, end in sectors:
                arc = _arc(start, end)
                edge = np.concatenate([rings.inner / 2 * arc, rings.outer / 2 * arc[::-1]])
                self._fill(hidden, edge + centre)
        # Seen at a slant a ring comes near its disk; between them the disk has the say.
        hidden, own = (
            cv2.dilate(mask, np.ones((2 * reach + 1,) * 2, np.uint8))
            for mask, reach in ((hidden, _EDGE_PX), (own, _OWN_PX))
        )
        return np.asarray((hidden > 0) & (own == 0))

    def _fill(self, mask: NDArray[np.uint8], corners: Array) -> None:
        """Fill the image of a polygon of the sheet."""
        xy = self.mapping(corners @ self.frame.T + self.origin)
        if np.abs(xy).max() < 1e5:  # else the mapping is used far beyond the disks that it is known from
            cv2.fillPoly(mask, [np.rint(xy).astype(np.int32)], 1)

    def _learn(self, first: Matches, rows: Rows, sure: Mask) -> None:
        """Mapping, sharpness, size and noise from the disks beyond doubt."""
        if sure.sum() < 6:
            return
        rows = rows[sure]
        self.mapping = through(self.at[rows], first.xy[sure], self.screened.grey.shape)
        self.look = _Look(
            float(np.median(first.psf_px[sure])),
            self.look.size * (1 + float(np.median(first.form[sure, 0]))),
            grey_variance(self.screened.grey, self.start[rows], first.residuals[sure]),
        )
        self.start = np.where(self.found[:, None], self.start, self.mapping(self.at))
        self.start[rows] = first.xy[sure]

    def _match_all(self, rows: Rows) -> Matches:
        """Match disks; where the ground is uneven, with a curved one if that is better."""
        found = self._match(rows)
        ordinary = np.median(found.noise[found.converged]) if found.converged.any() else np.inf
        uneasy = ~found.converged | (found.noise > _UNEASY * ordinary) | (found.rejected > 0.05)
        if not uneasy.any():
            return found
        curved = self._match(rows[uneasy], background=2)
        better = curved.converged & ~(curved.noise > 0.9 * found.noise[uneasy])
        keep = ~uneasy
        keep[uneasy] = ~better
        parts = [np.flatnonzero(keep), np.flatnonzero(~keep)]
        return merged(parts, [found.select(keep), curved.select(better)])

    def _objections(self, found: Matches) -> list[tuple[Mask, str]]:
        """What speaks against a disk in its own image, the gravest first."""
        o = self.options
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        strong = found.converged & (found.t > 8)
        ordinary = float(np.median(found.psf_px[strong])) if strong.any() else self.look.psf_px
        return [
            (found.seen < _SEEN, "hidden, dazzled or beyond the edge of the frame"),
            (~found.converged, "the match does not converge"),
            (~(found.t >= o.least_t) | (found.contrast <= 0), "no disk stands out from its surroundings"),
            (found.psf_px > _BLURRED * ordinary, "blurred unlike the other disks"),
            (np.abs(found.form[:, 0]) > _GROWN, "of another size than the other disks"),
            (np.hypot(found.form[:, 1], found.form[:, 2]) > _BENT, "its outline is not that of a disk"),
            (found.correlation < 0.8, "the image is not that of a disk"),
            (found.rejected > 0.25, "partly hidden or disturbed"),
            (~(sigma <= o.most_sigma_px), "too uncertain"),
        ]

    def _judged(self, rows: Rows, found: Matches) -> tuple[Array, SmoothField | None]:
        """Why each disk is not measured, and the field through the others."""
        why = np.full(len(rows), "", dtype=object)
        for mask, reason in self._objections(found):
            why[mask & (why == "")] = reason
        source, field = self._straight(rows), None
        variance = np.trace(found.cov, axis1=1, axis2=2) / 2 + _UNMODELLED_PX**2
        slope = second_order(self.mapping, self.at[rows])[1] @ self.frame
        radius = self.look.size / 2 * np.sqrt(np.abs(np.linalg.det(slope)))
        while (good := np.flatnonzero(why == "")).size >= 10:
            relative = np.sqrt(variance[good] / np.median(variance[good]))
            length = field.length if field is not None and np.isfinite(field.length) else None
            field = SmoothField.fit(source[good], found.xy[good], sigma=relative, length=length)
            deviation, sigma = field.leave_one_out()
            limit = np.maximum(np.maximum(self.options.neighbour_px, _BULGED * radius[good, None]), 4 * sigma)
            excess = (np.abs(deviation) / limit).max(axis=1)
            worst = int(excess.argmax())
            if excess[worst] <= 1:
                break
            why[good[worst]] = f"{np.hypot(*deviation[worst]):.1f} px off the prediction of its neighbours"
        return why, field

    def _spread(self, rows: Rows, found: Matches, why: Array, field: SmoothField | None) -> dict[str, Any]:
        """Columns over all disks of the design."""
        n, good = len(self.at), why == ""
        ok, reasons = np.zeros(n, dtype=bool), np.full(n, "outside the frame", dtype=object)
        ok[rows], reasons[rows] = good, why
        predicted, deviation = self.mapping(self.at), np.full((n, 2), np.nan)
        if field is not None:
            predicted[rows] = field(self._straight(rows))
            deviation[rows[good]] = field.leave_one_out()[0]

        def spread(values: Array, keep: Mask | slice = slice(None)) -> Array:
            full = np.full((n, *values.shape[1:]), np.nan)
            full[rows[keep]] = values[keep]
            return full

        if field is not None and good.sum() >= 10:
            design = SmoothField.fit(self.design.xy[rows[good]], found.xy[good])
        else:
            design = SmoothField.fit(self.design.xy, self.mapping(self.at), local=False)
        return {
            "image": self.image.name,
            "sha256": self.image.sha256,
            "ids": self.design.ids,
            "field": design,
            "xy": spread(found.xy, good),
            "cov": spread(found.cov, good),
            "ok": ok,
            "why": tuple(reasons),
            "predicted": predicted,
            "deviation": deviation,
        } | {name: spread(getattr(found, name)) for name in ("psf_px", "contrast", "t", "noise")}
