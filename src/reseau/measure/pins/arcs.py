"""Matching of echoes with formed arcs: position, widths, curvature, tilt, brightness and background."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...optics import Arcs
from ..matching import match
from ..matching.patches import MatchOptions
from .echoes import Echoes
from .shapes import ACROSS_SIGMA, ArcShape, Form, ends_of

_WINDOWS = np.array([6, 9, 13, 18, 25, 35, 50, 70])
"""Half sides of windows, pixels; arcs of similar size are matched in one batch."""
_RELIABLE = 8.0
"""Minimum contrast over its standard deviation of an arc whose light is subtracted from others."""
_MARGIN_PX = 4.0
"""Background shown by a window around an arc, pixels."""
_LAGS = 4
"""Distance in pixels, along both axes, up to which the autocorrelation of residuals is summed."""
_NUMBERS = (
    *("xy", "cov", "contrast", "t", "noise", "correlation", "seen", "rejected", "converged", "pixels"),
    "inflation",
)
_TIGHTENED = 0.2
"""Factor of these in a second attempt, where the first did not converge."""
_ROUND = 1.5
"""Length over thickness below which a spot has no direction."""
_OF_MOMENTS = 1.7
"""Approximate width of a Gaussian over that of its part above one third of its height."""
_OF_LINES = 1.1
"""The same of an even line."""
_FLAT = 0.8
"""Flatness with which the matching of a line starts."""
_REACH = 2.6
"""Half size of a window, in widths of the arc."""
_WIDER_GAP_PX = 2
"""Width of the additional margin next to hidden pixels that is left out to test the position of an arc."""


@dataclass(frozen=True, eq=False)
class ArcMatches:
    """Results of matching, in columns over the m echoes.

    Parameters
    ----------
    xy, cov, contrast, t, noise, correlation, seen, rejected, converged : ndarray
        As in :class:`reseau.measure.matching.Matches`; `cov` is corrected for correlated residuals.
    pixels : ndarray (m,)
        Number of pixels that are as good as independent.
    inflation : ndarray (m,)
        Factor of the variances for correlated residuals, 1 if these are white.
    arcs : Arcs
        The matched arcs.
    sigma : dict of str to ndarray (m,)
        Standard deviations of the unknowns of the form.
    by_prior : dict of str to ndarray (m, 2)
        Derivatives of the positions by the means of their priors.
    shared : ndarray (m, 2, k)
        Derivatives of the positions by k errors of unit variance that all arcs share, which `cov` contains.
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
    pixels: Array
    inflation: Array
    arcs: Arcs
    sigma: dict[str, Array]
    by_prior: dict[str, Array]
    shared: Array

    def replaced(self, rows: Rows, other: ArcMatches) -> ArcMatches:
        """These matches with `rows` replaced by others."""
        columns: dict[str, Any] = {}
        for name in _NUMBERS:
            columns[name] = getattr(self, name).copy()
            columns[name][rows] = getattr(other, name)
        for name in ("sigma", "by_prior"):
            columns[name] = _with_rows(getattr(self, name), rows, getattr(other, name), len(self.xy))
        return ArcMatches(**columns, arcs=_replaced(self.arcs, rows, other.arcs), shared=self.shared)

    def moved(self, before: ArcMatches, rows: Rows) -> Array:
        """Shifts (k, 2) from the `rows` of other matches to these; NaN where these did not converge."""
        return np.where(self.converged[:, None], self.xy - before.xy[rows], np.nan)


class Windows:
    """Arcs of a frame and the windows in which they are matched, grouped by size.

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
        self.start, self.start_of_lines = _starts(echoes, at)
        self.half = _half_sides(self.start)

    def resized(self, arcs: Arcs) -> None:
        """Let the windows have the size of these arcs (m,)."""
        self.half = _half_sides(arcs)

    @property
    def every(self) -> Rows:
        """Rows of all echoes to be matched."""
        return np.arange(len(self.at))

    def matched(
        self, rows: Rows, form: Form, start: Arcs, xy: Array, valid: Mask | None = None
    ) -> ArcMatches:
        """Match the arcs `rows`, excluding the pixels of others.

        Parameters
        ----------
        rows : ndarray of int (k,)
            Which ones.
        form : Form
            What is unknown of their form.
        start, xy : Arcs (k,), ndarray (k, 2)
            Where to start.
        valid : ndarray (h, w) of bool, optional
            Pixels that may be used, if these are others.
        """
        parts = []
        for part in self.of_like_size(rows):
            here = np.searchsorted(rows, part)
            found = self._adjusted(part, form, start.select(here), xy[here], valid=valid)
            # A round spot has no tilt: if it does not converge, tighten the prior of the form.
            again = np.flatnonzero(~found.converged)
            if len(again):
                which = here[again]
                found = found.replaced(
                    again,
                    self._adjusted(
                        part[again], form.tightened(_TIGHTENED), start.select(which), xy[which], valid=valid
                    ),
                )
            parts.append((here, found))
        return _merged(parts, len(rows))

    def shift_without_others(self, touching: Rows, found: ArcMatches, form: Form) -> Array:
        """Shifts (m, 2) of arcs if the light of others is subtracted instead of excluded."""
        modelled = found.converged & (found.t > _RELIABLE)
        pulled = np.zeros((len(touching), 2))
        for rows in self.of_like_size(touching):
            others = np.stack([self._light_of_others(k, found, modelled) for k in rows])
            again = self._adjusted(rows, form, found.arcs.select(rows), found.xy[rows], others, modelled)
            pulled[np.searchsorted(touching, rows)] = again.moved(found, rows)
        return pulled

    def hidden_flanks(self, found: ArcMatches) -> Array:
        """Hidden share of the information about the position of an arc, on its worse side, (m,)."""
        share = np.zeros(len(self.at))
        for rows in self.of_like_size(np.flatnonzero(found.converged)):
            window = self.window(rows, found.xy[rows])
            _, parts = found.arcs.select(rows).derivatives(found.xy[rows], *window)
            columns, lines = (np.rint(axis).astype(np.intp) for axis in window)
            height, width = self.valid.shape
            shown = self.valid[
                np.clip(lines, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None, :]
            ]
            for flank in (parts[:, :2].clip(0, None), -parts[:, :2].clip(None, 0)):
                hidden = (flank * ~shown[:, None]).sum(axis=(2, 3)) / flank.sum(axis=(2, 3))
                share[rows] = np.maximum(share[rows], hidden.max(axis=1))
        return share

    def usable(self, rows: Rows, columns: Array, lines: Array) -> Mask:
        """Pixels of the windows of some arcs that may be used, (k, r, c)."""
        c, r = (np.rint(axis).astype(np.intp) for axis in (columns, lines))
        height, width = self.valid.shape
        inside = ((r >= 0) & (r < height))[:, :, None] & ((c >= 0) & (c < width))[:, None, :]
        at = np.clip(r, 0, height - 1)[:, :, None], np.clip(c, 0, width - 1)[:, None, :]
        owner = self.echoes.claimed[at]
        return np.asarray(inside & self.valid[at] & ((owner < 0) | (owner == self.at[rows][:, None, None])))

    def grey_in(self, columns: Array, lines: Array) -> Array:
        """Grey values of windows, (k, r, c)."""
        c, r = (np.rint(axis).astype(np.intp) for axis in (columns, lines))
        height, width = self.valid.shape
        at = np.clip(r, 0, height - 1)[:, :, None], np.clip(c, 0, width - 1)[:, None, :]
        return np.asarray(self.grey[at], dtype=np.float64)

    def shift_with_wider_gap(self, half_hidden: Rows, found: ArcMatches, form: Form) -> Array:
        """Shifts (m, 2) of arcs if the pixels next to hidden ones are left out, too."""
        side = 2 * _WIDER_GAP_PX + 1
        less = cv2.erode(self.valid.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        again = self.matched(
            half_hidden, form, found.arcs.select(half_hidden), found.xy[half_hidden], valid=less
        )
        return again.moved(found, half_hidden)

    def window(self, rows: Rows, xy: Array) -> tuple[Array, Array]:
        """Columns and rows of the pixels around arcs of one size, (k, c) and (k, r)."""
        (half_x, half_y), centre = self.half[rows[0]], np.rint(xy)
        columns = centre[:, :1] + np.arange(-half_x, half_x + 1.0)
        return columns, centre[:, 1:] + np.arange(-half_y, half_y + 1.0)

    def of_like_size(self, rows: Rows) -> list[Rows]:
        """The arcs `rows` in groups whose windows have one size."""
        sizes = np.unique(self.half[rows], axis=0)
        return [rows[(self.half[rows] == size).all(axis=1)] for size in sizes]

    def _light_of_others(self, arc: int, found: ArcMatches, modelled: Mask) -> Array:
        """Light of the other arcs in the window of one, (rows, columns)."""
        window = self.window(np.array([arc]), found.xy[[arc]])
        reach = 5 * found.arcs.along + 5 * found.arcs.across
        off = np.abs(found.xy - np.rint(found.xy[arc]))
        near = (off < reach[:, None] + self.half[arc]).all(axis=1) & modelled
        near[arc] = False
        others = np.flatnonzero(near)
        image = found.arcs.select(others).image(
            found.xy[others], *(np.broadcast_to(axis, (len(others), axis.shape[1])) for axis in window)
        )
        return np.asarray(np.tensordot(found.contrast[others], image, axes=1))

    def _adjusted(
        self,
        rows: Rows,
        form: Form,
        start: Arcs,
        xy: Array,
        others: Array | None = None,
        modelled: Mask | None = None,
        valid: Mask | None = None,
    ) -> ArcMatches:
        """Match the arcs `rows`, all with the same size of window."""
        shape = ArcShape(start, tuple(form.sigma))
        owner = self.echoes.claimed
        if modelled is not None:
            open_ = np.append(np.zeros(len(self.echoes), dtype=bool), True)
            open_[self.at[modelled]] = True
            owner = np.where(open_[owner], -1, owner)
        windowed = replace(
            self.options,
            half_px=(int(self.half[rows[0], 0]), int(self.half[rows[0], 1])),
            psf_px=start.across,
            psf_log_sigma=ACROSS_SIGMA,
            polarity="bright",
        )
        found = match(
            self.grey,
            self.valid if valid is None else valid,
            shape,
            xy,
            windowed,
            noise=self.noise,
            form_sigma=np.array(list(form.sigma.values())),
            claims=(owner, self.at[rows]),
            others=others,
        )
        inflation = _inflation(found.residuals)
        arcs = shape.arcs(found.psf_px, found.form, np.arange(len(rows)))
        # An arc rotated by 180° with opposite curvature is the same arc; its ends change places.
        turns = np.round(arcs.tilt / np.pi)
        sign = np.where(turns % 2 == 0, 1.0, -1.0)
        assert arcs.fading is not None
        return ArcMatches(
            **{name: getattr(found, name) for name in _NUMBERS if hasattr(found, name) and name != "cov"},
            inflation=inflation,
            cov=found.cov * inflation[:, None, None],
            pixels=np.isfinite(found.residuals).sum(axis=(1, 2)) / inflation,
            arcs=replace(
                arcs,
                tilt=arcs.tilt - np.pi * turns,
                curvature=arcs.curvature * sign,
                fading=arcs.fading * sign,
            ),
            sigma={
                name: np.sqrt(inflation) * values
                for name, values in zip(form.sigma, found.form_sigma.T, strict=True)
            },
            by_prior={
                name: found.form_cofactor[:, :, k] / sigma**2 * (sign[:, None] if name == "fading" else 1.0)
                for k, (name, sigma) in enumerate(form.sigma.items())
            },
            shared=np.zeros((len(rows), 2, 0)),
        )


def _starts(echoes: Echoes, at: Rows) -> tuple[Arcs, Arcs]:
    """Approximate arcs from the moments of the light, as beams and as lines."""
    long, wide, tilt = echoes.length[at], echoes.thickness[at], echoes.tilt[at]
    # A spot without direction starts horizontal, like the echo of a rod.
    round_ = long < _ROUND * wide
    tilt = np.where(round_, 0.0, tilt)
    wide = np.where(round_, np.sqrt(long * wide), wide)
    long = np.where(round_, wide, long)
    along, across = (_OF_MOMENTS / 4 * values for values in (long, wide))
    # The moments determine the curvature of a short arc poorly; its matching starts with a straight one.
    bend = np.clip(echoes.curvature[at] * along, -0.3, 0.3) * (long > 2 * wide)
    beams = Arcs(along, across, bend / along, tilt, *np.zeros((5, len(at))))
    shorter = _OF_LINES / _OF_MOMENTS * along
    return beams, replace(beams, along=shorter, flatness=np.full(len(at), _FLAT))


def _half_sides(start: Arcs) -> Rows:
    """Half sides of the windows (k, 2), from a few sizes."""
    half, soft = ends_of(start)
    u, v = half + _REACH * soft, _REACH * start.across
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


def _merged(parts: list[tuple[Rows, ArcMatches]], count: int) -> ArcMatches:
    """Columns of matches from parts of them."""
    names = sorted({name for _, found in parts for name in found.sigma})

    def column(values: list[Array], tail: tuple[int, ...] = ()) -> Array:
        whole: Array = np.zeros((count, *tail))
        for (rows, _), part in zip(parts, values, strict=True):
            whole[rows] = part
        return whole

    tails: dict[str, tuple[int, ...]] = {"xy": (2,), "cov": (2, 2)}
    columns: dict[str, Any] = {
        name: column([getattr(found, name) for _, found in parts], tails.get(name, ())) for name in _NUMBERS
    }
    columns["converged"] = columns["converged"] > 0
    arcs = {f.name: column([getattr(found.arcs, f.name) for _, found in parts]) for f in fields(Arcs)}
    sigma = {name: column([found.sigma[name] for _, found in parts]) for name in names}
    by_prior = {name: column([found.by_prior[name] for _, found in parts], (2,)) for name in names}
    shared = np.zeros((count, 2, 0))
    return ArcMatches(**columns, arcs=Arcs(**arcs), sigma=sigma, by_prior=by_prior, shared=shared)


def _with_rows(values: dict[str, Array], rows: Rows, other: dict[str, Array], count: int) -> dict[str, Array]:
    """Columns by name of `count` rows, with some replaced by others; 0 where a name is missing."""
    known = {name: column.copy() for name, column in values.items()}
    for name, column in other.items():
        known.setdefault(name, np.zeros((count, *column.shape[1:])))
    for name, column in known.items():
        column[rows] = other.get(name, 0.0)
    return known


def _replaced(arcs: Arcs, rows: Rows, other: Arcs) -> Arcs:
    """Arcs with `rows` replaced by others."""
    columns = {}
    for f in fields(Arcs):
        columns[f.name] = getattr(arcs, f.name).copy()
        columns[f.name][rows] = getattr(other, f.name)
    return Arcs(**columns)
