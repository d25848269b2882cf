"""Matching of echoes with formed arcs: position, widths, curvature, tilt, brightness and background."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...optics import Arcs
from ..matching import Matches, MatchOptions, Window, match
from .echoes import Echoes

__all__ = ["ArcMatches", "ArcShape", "match_arcs"]

_WINDOWS = np.array([6, 9, 13, 18, 25, 35, 50, 70])
"""Half sides of windows, pixels; arcs of similar size are matched in one batch."""
_RELIABLE = 8.0
"""Minimum contrast over its standard deviation of an arc whose light is subtracted from others."""
_MARGIN_PX = 4.0
"""Background shown by a window around an arc, pixels."""
_FORM_SIGMA = np.array([0.5, 0.05, 0.3])
"""Prior standard deviations: logarithm of the width along, sag at that width over it, tilt (rad)."""
_ACROSS_SIGMA = 0.5
"""Prior standard deviation of the logarithm of the width across."""
_LAGS = 4
"""Distance in pixels, along both axes, up to which the autocorrelation of residuals is summed."""
_NUMBERS = ("contrast", "t", "noise", "correlation", "seen", "rejected")
_TIGHTENED = 0.2
"""Factor of these in a second attempt, where the first did not converge."""
_ROUND = 1.5
"""Length over thickness below which a spot has no direction."""
_OF_MOMENTS = 1.7
"""Approximate width of a Gaussian over that of its part above one third of its height."""
_REACH = 2.6
"""Half size of a window, in widths of the arc."""
_HALF_HIDDEN = 0.5
"""Hidden share of a flank from which the position of an arc depends on the other flank."""
_WIDER_GAP_PX = 2
"""Width of the additional margin next to hidden pixels that is left out to test the position of an arc."""


@dataclass(frozen=True, eq=False)
class ArcShape:
    """Arcs as functions of corrections: logarithm of the width along, sag over that width, tilt.

    The width of the point-spread function is that of the arc across.

    Parameters
    ----------
    start : Arcs (k,)
        Approximate arcs.
    """

    start: Arcs

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return 3

    def arcs(self, width: Array, form: Array, at: Rows) -> Arcs:
        """The arcs `at` with widths across (m,) and corrections (m, 3)."""
        s = self.start
        return Arcs(
            s.along[at] * np.exp(form[:, 0]),
            width,
            s.curvature[at] + form[:, 1] / s.along[at],
            s.tilt[at] + form[:, 2],
        )

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.shapes.Shape`."""
        return self.arcs(width, form, at).image(xy, window.columns, window.rows)

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.shapes.Shape`."""
        image, parts = self.arcs(width, form, at).derivatives(xy, window.columns, window.rows)
        parts[:, 4] /= self.start.along[at, None, None]
        return image, parts


@dataclass(frozen=True, eq=False)
class ArcMatches:
    """Results of matching, in columns over the m echoes.

    Parameters
    ----------
    xy, cov, contrast, t, noise, correlation, seen, rejected, converged : ndarray
        As in :class:`reseau.measure.matching.Matches`; `cov` is corrected for correlated residuals.
    form : Arcs
        The matched arcs.
    """

    xy: Array
    cov: Array
    contrast: Array
    t: Array
    noise: Array
    correlation: Array
    seen: Array
    rejected: Array
    converged: Mask
    form: Arcs


def match_arcs(
    grey: NDArray[np.float32], valid: Mask, echoes: Echoes, at: Rows, options: MatchOptions, noise: float
) -> ArcMatches:
    """Match the echoes `at`, grouped by size.

    Parameters
    ----------
    grey : ndarray (h, w)
        Frame.
    valid : ndarray (h, w) of bool
        Pixels that may be used.
    echoes : Echoes
        All echoes of the frame; pixels of the others are excluded.
    at : ndarray of int (m,)
        Indices of the echoes to match.
    options : MatchOptions
        Options of the matching; window and widths are set here.
    noise : float
        Standard deviation of the grey values.
    """
    work = _Matching(grey, valid, echoes, at, options, noise)
    found = _in_order(work.all(), len(at))
    touching = np.flatnonzero((echoes.joined[at] > 0) & found.converged)
    if len(touching):
        # It is unknown how the instrument combines overlapping echoes: behind a logarithmic amplifier the
        # stronger one is shown; otherwise their sum. The first match assumed the former; the difference to
        # the latter is added to the uncertainty.
        pulled = work.shift_without_others(touching, found)
        found.cov[touching] += pulled[:, :, None] * pulled[:, None, :]
    half_hidden = np.flatnonzero((work.hidden_flanks(found) > _HALF_HIDDEN) & found.converged)
    if len(half_hidden):
        # If one flank of an arc is hidden, its centre follows from the shape of the other. Effects of raster
        # lines or reverberation on this shape no longer cancel and are not noise of single pixels. Their size
        # is estimated by leaving out slightly more of the arc.
        pulled = work.shift_with_wider_gap(half_hidden, found)
        found.cov[half_hidden] += pulled[:, :, None] * pulled[:, None, :]
    return found


class _Matching:
    """Arcs of a frame and their windows."""

    def __init__(
        self,
        grey: NDArray[np.float32],
        valid: Mask,
        echoes: Echoes,
        at: Rows,
        options: MatchOptions,
        noise: float,
    ) -> None:
        self.grey, self.valid, self.echoes, self.at = grey, valid, echoes, at
        self.options, self.noise = options, noise
        self.start = _start(echoes, at)
        self.half = _half_sides(self.start)

    def all(self) -> list[tuple[Rows, Matches, Arcs]]:
        """Match every arc, excluding the pixels of others."""
        parts = []
        for rows in self._of_like_size(np.arange(len(self.at))):
            parts.append(self._adjusted(rows, self.start, self.echoes.xy[self.at], _FORM_SIGMA))
            # A round spot has no tilt: if it does not converge, tighten the prior of the form.
            again = rows[~parts[-1][1].converged]
            if len(again):
                parts.append(
                    self._adjusted(again, self.start, self.echoes.xy[self.at], _TIGHTENED * _FORM_SIGMA)
                )
        return parts

    def shift_without_others(self, touching: Rows, found: ArcMatches) -> Array:
        """Shifts (m, 2) of arcs if the light of others is subtracted instead of excluded."""
        modelled = found.converged & (found.t > _RELIABLE)
        pulled = np.zeros((len(touching), 2))
        for rows in self._of_like_size(touching):
            others = np.stack([self._light_of_others(k, found, modelled) for k in rows])
            _, again, _ = self._adjusted(rows, found.form, found.xy, _FORM_SIGMA, others, modelled)
            moved = np.where(again.converged[:, None], again.xy - found.xy[rows], np.nan)
            pulled[np.searchsorted(touching, rows)] = moved
        return pulled

    def hidden_flanks(self, found: ArcMatches) -> Array:
        """Hidden share of the information about the position of an arc, on its worse side, (m,)."""
        share = np.zeros(len(self.at))
        for rows in self._of_like_size(np.flatnonzero(found.converged)):
            window = self._window(rows, found.xy[rows])
            _, parts = found.form.select(rows).derivatives(found.xy[rows], *window)
            columns, lines = (np.rint(axis).astype(np.intp) for axis in window)
            height, width = self.valid.shape
            shown = self.valid[
                np.clip(lines, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None, :]
            ]
            for flank in (parts[:, :2].clip(0, None), -parts[:, :2].clip(None, 0)):
                hidden = (flank * ~shown[:, None]).sum(axis=(2, 3)) / flank.sum(axis=(2, 3))
                share[rows] = np.maximum(share[rows], hidden.max(axis=1))
        return share

    def shift_with_wider_gap(self, half_hidden: Rows, found: ArcMatches) -> Array:
        """Shifts (m, 2) of arcs if the pixels next to hidden ones are left out, too."""
        side = 2 * _WIDER_GAP_PX + 1
        less = cv2.erode(self.valid.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        pulled = np.zeros((len(half_hidden), 2))
        for rows in self._of_like_size(half_hidden):
            _, again, _ = self._adjusted(rows, found.form, found.xy, _FORM_SIGMA, valid=less)
            moved = np.where(again.converged[:, None], again.xy - found.xy[rows], np.nan)
            pulled[np.searchsorted(half_hidden, rows)] = moved
        return pulled

    def _window(self, rows: Rows, xy: Array) -> tuple[Array, Array]:
        """Columns and rows of the pixels around arcs of one size, (k, c) and (k, r)."""
        (half_x, half_y), centre = self.half[rows[0]], np.rint(xy)
        columns = centre[:, :1] + np.arange(-half_x, half_x + 1.0)
        return columns, centre[:, 1:] + np.arange(-half_y, half_y + 1.0)

    def _of_like_size(self, rows: Rows) -> list[Rows]:
        sizes = np.unique(self.half[rows], axis=0)
        return [rows[(self.half[rows] == size).all(axis=1)] for size in sizes]

    def _light_of_others(self, arc: int, found: ArcMatches, modelled: Mask) -> Array:
        """Light of the other arcs in the window of one, (rows, columns)."""
        window = self._window(np.array([arc]), found.xy[[arc]])
        reach = 5 * found.form.along + 5 * found.form.across
        off = np.abs(found.xy - np.rint(found.xy[arc]))
        near = (off < reach[:, None] + self.half[arc]).all(axis=1) & modelled
        near[arc] = False
        others = np.flatnonzero(near)
        image = found.form.select(others).image(
            found.xy[others], *(np.broadcast_to(axis, (len(others), axis.shape[1])) for axis in window)
        )
        return np.asarray(np.tensordot(found.contrast[others], image, axes=1))

    def _adjusted(
        self,
        rows: Rows,
        start: Arcs,
        xy: Array,
        form_sigma: Array,
        others: Array | None = None,
        modelled: Mask | None = None,
        valid: Mask | None = None,
    ) -> tuple[Rows, Matches, Arcs]:
        """Match the arcs `rows`, all with the same size of window."""
        shape = ArcShape(start.select(rows))
        owner = self.echoes.claimed
        if modelled is not None:
            open_ = np.append(np.zeros(len(self.echoes), dtype=bool), True)
            open_[self.at[modelled]] = True
            owner = np.where(open_[owner], -1, owner)
        windowed = replace(
            self.options,
            half_px=(int(self.half[rows[0], 0]), int(self.half[rows[0], 1])),
            psf_px=shape.start.across,
            psf_log_sigma=_ACROSS_SIGMA,
            polarity="bright",
        )
        found = match(
            self.grey,
            self.valid if valid is None else valid,
            shape,
            xy[rows],
            windowed,
            noise=self.noise,
            form_sigma=form_sigma,
            claims=(owner, self.at[rows]),
            others=others,
        )
        return rows, found, shape.arcs(found.psf_px, found.form, np.arange(len(rows)))


def _start(echoes: Echoes, at: Rows) -> Arcs:
    """Approximate arcs from the moments of the light."""
    long, wide, tilt = echoes.length[at], echoes.thickness[at], echoes.tilt[at]
    # A spot without direction starts horizontal, like the echo of a rod.
    round_ = long < _ROUND * wide
    tilt = np.where(round_, 0.0, tilt)
    wide = np.where(round_, np.sqrt(long * wide), wide)
    long = np.where(round_, wide, long)
    along, across = (_OF_MOMENTS / 4 * values for values in (long, wide))
    # The moments determine the curvature of a short arc poorly; its matching starts with a straight one.
    bend = np.clip(echoes.curvature[at] * along, -0.3, 0.3) * (long > 2 * wide)
    return Arcs(along, across, bend / along, tilt)


def _half_sides(start: Arcs) -> Rows:
    """Half sides of the windows (k, 2), from a few sizes."""
    u, v = _REACH * start.along, _REACH * start.across
    v = v + 0.5 * np.abs(start.curvature) * u**2
    c, s = np.abs(np.cos(start.tilt)), np.abs(np.sin(start.tilt))
    reach = np.stack([np.hypot(c * u, s * v), np.hypot(s * u, c * v)], axis=1) + _MARGIN_PX
    return _WINDOWS[np.minimum(np.searchsorted(_WINDOWS, reach), len(_WINDOWS) - 1)]


def _inflation(residuals: Array) -> Array:
    """Factors (m,) that correct variances for correlated residuals.

    The adjustment assumes independent residuals. The difference between an echo and its formed image
    (speckle, reverberation) extends over several pixels, so there is less information than pixels: by a
    factor of the sum of the autocorrelation, for parameters that change the image smoothly. Only significant
    correlations are summed: white residuals leave the variances unchanged, and the negative correlations at
    larger distances, which result from fitting alone, are ignored.
    """
    r = np.nan_to_num(residuals)
    squares = r * r
    power = np.maximum(squares.sum(axis=(1, 2)), 1e-300)
    independent = 3 * power**2 / np.maximum((squares * squares).sum(axis=(1, 2)), 1e-300)
    chance = 4 / np.sqrt(np.maximum(independent, 1.0))
    total, rows, columns = np.ones(len(r)), *r.shape[1:]
    for down in range(_LAGS + 1):
        for right in range(-_LAGS if down else 1, _LAGS + 1):
            here = r[:, : rows - down, max(0, -right) : columns - max(0, right)]
            there = r[:, down:, max(0, right) : columns + min(0, right)]
            together = (here * there).sum(axis=(1, 2)) / power
            total += 2 * np.where(together > chance, together, 0.0)
    return total


def _in_order(parts: list[tuple[Rows, Matches, Arcs]], count: int) -> ArcMatches:
    """Columns in the order of the echoes."""

    def column(name: str, tail: tuple[int, ...] = ()) -> Array:
        values = np.empty((count, *tail))
        for rows, found, arcs in parts:
            values[rows] = getattr(found if hasattr(found, name) else arcs, name)
        return values

    cov = column("cov", (2, 2))
    for rows, found, _ in parts:
        cov[rows] *= _inflation(found.residuals)[:, None, None]
    tilt, curvature = column("tilt"), column("curvature")
    # An arc rotated by 180° with opposite curvature is the same arc.
    turns = np.round(tilt / np.pi)
    tilt, curvature = tilt - np.pi * turns, curvature * np.where(turns % 2 == 0, 1.0, -1.0)
    return ArcMatches(
        xy=column("xy", (2,)),
        cov=cov,
        **{name: column(name) for name in _NUMBERS},
        converged=column("converged") > 0,
        form=Arcs(column("along"), column("across"), curvature, tilt),
    )
