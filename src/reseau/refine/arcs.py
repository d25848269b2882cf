"""Echoes matched with formed arcs: place, length, curvature, tilt, width, brightness and ground together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..data import Array, Mask, Rows
from ..optics.formation import Outline
from ..optics.strokes import Strokes
from .echoes import Echoes
from .matching import Matches, MatchOptions, match

__all__ = ["ArcMatches", "ArcShape", "match_arcs"]

_WINDOWS = (8, 12, 17, 24, 34, 48, 68)
"""Half sides of windows, pixels; arcs of like size are matched in one batch."""
_MARGIN_PX = 5
"""What a window shows of the ground around an arc."""
_FORM_SIGMA = np.array([0.5, 0.5, 0.3, 0.3])
"""Prior standard deviations: log length, log thickness, curvature × length, tilt (rad)."""
_LAGS = 4
"""Distance, in pixels along both axes, to which residuals are asked whether they go together."""
_NUMBERS = ("psf_px", "contrast", "t", "noise", "correlation", "seen", "rejected")
_HELD = 0.2
"""Share of those for a second attempt where the first did not converge."""
_ROUND = 1.5
"""Length over thickness below which a spot shows no direction."""
_LENGTH, _THICKNESS = 1.3, 0.6
"""Outline over four standard deviations of the light that stands out, about."""


@dataclass(frozen=True, eq=False)
class ArcShape:
    """Arcs as functions of what is estimated: logarithms of length and thickness, curvature × length, tilt.

    Parameters
    ----------
    start : Strokes
        Approximate arcs, (k,); the parameters are corrections to them.
    spacing : float
        Largest distance of nodes, pixels.
    """

    start: Strokes
    spacing: float

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return 4

    def strokes(self, form: Array, at: Rows) -> Strokes:
        """The arcs `at` with the corrections (m, 4)."""
        s = self.start
        return Strokes(
            s.length[at] * np.exp(form[:, 0]),
            s.thickness[at] * np.exp(form[:, 1]),
            s.curvature[at] + form[:, 2] / s.length[at],
            s.tilt[at] + form[:, 3],
            s.taper,
        )

    def outline(self, form: Array, at: Rows) -> Outline:
        """Outlines of the arcs `at`."""
        return self.strokes(form, at).outline(self.spacing, self._nodes)

    def motions(self, form: Array, at: Rows) -> Array:
        """Velocities of their nodes, (m, 4, j, 2)."""
        moved = self.strokes(form, at).motions(self.spacing, self._nodes)
        moved[:, 2] /= self.start.length[at, None, None]
        return moved

    @property
    def _nodes(self) -> int:
        # Arcs may turn out half as long again as they seemed.
        return int(1.5 * self.start.nodes(self.spacing))


@dataclass(frozen=True, eq=False)
class ArcMatches:
    """What came out, in columns over the m echoes.

    Parameters
    ----------
    xy, cov, psf_px, contrast, t, noise, correlation, seen, rejected, converged : ndarray
        As in :class:`reseau.refine.matching.Matches`; `cov` allows for residuals that go together.
    form : Strokes
        The arcs found.
    """

    xy: Array
    cov: Array
    psf_px: Array
    contrast: Array
    t: Array
    noise: Array
    correlation: Array
    seen: Array
    rejected: Array
    converged: Mask
    form: Strokes


def match_arcs(
    grey: NDArray[np.float32], valid: Mask, echoes: Echoes, at: Rows, options: MatchOptions, noise: float
) -> ArcMatches:
    """Match the echoes `at`, those of like size together.

    Parameters
    ----------
    grey : ndarray (h, w)
        Frame.
    valid : ndarray (h, w) of bool
        Pixels that may be used.
    echoes : Echoes
        All of the frame; each keeps the others from its own light.
    at : ndarray of int (m,)
        Which are to be matched.
    options : MatchOptions
        How; the window is set here.
    noise : float
        Standard deviation of the grey values.
    """
    start = _start(echoes, at, options.psf_px)
    half = _half_sides(start)
    parts: list[tuple[Rows, Matches, Strokes]] = []
    for side in np.unique(half):
        rows = np.flatnonzero(half == side)
        windowed = replace(options, half_px=int(side), polarity="bright")

        def adjusted(
            rows: Rows, form_sigma: Array, windowed: MatchOptions = windowed
        ) -> tuple[Rows, Matches, Strokes]:
            shape = ArcShape(_rows(start, rows), options.psf_px)
            own = echoes.claimed, at[rows]
            found = match(
                grey,
                valid,
                shape,
                echoes.xy[at[rows]],
                windowed,
                noise=noise,
                form_sigma=form_sigma,
                claims=own,
            )
            return rows, found, shape.strokes(found.form, np.arange(len(rows)))

        parts.append(adjusted(rows, _FORM_SIGMA))
        # A round spot has no tilt: what does not converge is held closer to how a rod's echo lies.
        again = rows[~parts[-1][1].converged]
        if len(again):
            parts.append(adjusted(again, _HELD * _FORM_SIGMA))
    return _together(parts, len(at), start.taper)


def _start(echoes: Echoes, at: Rows, psf_px: float) -> Strokes:
    """Outlines to begin with, from the moments of the light."""
    long, wide, tilt = echoes.length[at], echoes.thickness[at], echoes.tilt[at]
    # What has no direction of its own begins level, as the echo of a rod lies.
    round_ = long < _ROUND * wide
    tilt = np.where(round_, 0.0, tilt)
    wide = np.where(round_, np.sqrt(long * wide), wide)
    long = np.where(round_, wide, long)
    thin = np.sqrt(np.maximum(wide**2 - (4 * psf_px) ** 2, psf_px**2))
    length = np.maximum(_LENGTH * long, 4 * psf_px)
    # A region's moments know the bend of a short arc badly; its matching begins with a straight one.
    bend = np.clip(echoes.curvature[at] * length, -0.6, 0.6) * (long > 2 * wide)
    return Strokes(length, np.minimum(_THICKNESS * thin, length), bend / length, tilt)


def _half_sides(start: Strokes) -> Rows:
    """Half sides of the windows, from a few sizes."""
    reach = np.maximum(start.length, 2 * start.thickness) / 2 + _MARGIN_PX
    return np.array(_WINDOWS)[np.minimum(np.searchsorted(_WINDOWS, reach), len(_WINDOWS) - 1)]


def _rows(strokes: Strokes, rows: Rows) -> Strokes:
    s = strokes
    return Strokes(s.length[rows], s.thickness[rows], s.curvature[rows], s.tilt[rows], s.taper)


def _inflation(residuals: Array) -> Array:
    """Factors (m,) by which variances grow because neighbouring residuals go together.

    The adjustment takes residuals for independent. What an echo differs from its formed image by (speckle, a
    reverberation) goes on over several pixels, so that there is less to know than pixels: by the sum of the
    autocorrelation, for parameters that change the image smoothly. Only correlations that chance does not
    explain are summed: white residuals leave all as it is, and residuals of a fit, which add up to nought,
    have negative ones farther off that tell of the fit alone.
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


def _together(parts: list[tuple[Rows, Matches, Strokes]], count: int, taper: float) -> ArcMatches:
    """Columns in the order of the echoes again."""

    def column(name: str, tail: tuple[int, ...] = ()) -> Array:
        values = np.empty((count, *tail))
        for rows, found, strokes in parts:
            values[rows] = getattr(found if hasattr(found, name) else strokes, name)
        return values

    cov = column("cov", (2, 2))
    for rows, found, _ in parts:
        cov[rows] *= _inflation(found.residuals)[:, None, None]
    tilt, curvature = column("tilt"), column("curvature")
    # An arc and the one turned by half a turn, bent the other way, are the same.
    turns = np.round(tilt / np.pi)
    tilt, curvature = tilt - np.pi * turns, curvature * np.where(turns % 2 == 0, 1.0, -1.0)
    return ArcMatches(
        xy=column("xy", (2,)),
        cov=cov,
        **{name: column(name) for name in _NUMBERS},
        converged=column("converged") > 0,
        form=Strokes(column("length"), column("thickness"), curvature, tilt, taper),
    )
