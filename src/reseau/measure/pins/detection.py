"""The light of a raster: how it falls off over a screen, told by what shines between the echoes.

A phosphor, a tube and a lens give less light towards the corners, to the picture as to the raster's own glow.
Over the length of an echo that is a slope which moves its middle to the brighter side, by the slope times the
square of its width.

The images of the rods of an ultrasonic test object: short arcs, amid what else a scanner's screen shows.

Spots that stand out → those that are drawn, too long or too faint put aside → each matched with a formed arc
→ judged by its own image and by its fellows. y is measured on the line, x in its middle (Wishahy: "the pin's
images appear as horizontal curved lines"). A spot that is declined is reported with the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from ...core.data import Array, Frame, ImagePoints, Mask, Rows
from ..matching import MatchOptions
from ..screening import Screened, screen
from .arcs import ArcMatches, match_arcs
from .echoes import Echoes, Grey, find_echoes, ground_of
from .graphics import bridged, find_cuts, is_sharp, looks_sharp, same_in_all, series

__all__ = ["PinDetections", "PinOptions", "falloff", "find_pins"]

_STEP = 20
"""Distance of the places at which the glow is looked at, pixels."""
_INSIDE = 0.08
"""Part of the reseau's extent at its edges that is not looked at: there a screen may end."""
_LEAST = 10.0
"""Glow over the noise from which on the raster counts as lit."""
_ROUGH = 0.1
"""Scatter of the glow about a parabola, as a share of it, from which on it is no glow but an image."""
_LIMITS = (0.5, 2.0)


def falloff(ground: Grey, hidden: Mask, noise: float) -> Grey | None:
    """Light of the raster relative to the middle: a paraboloid through what shines between the echoes.

    Parameters
    ----------
    ground : ndarray (h, w)
        The frame without what is small in it.
    hidden : ndarray (h, w) of bool
        Pixels that a reseau covers; within its extent the raster is looked at.
    noise : float
        Standard deviation of the grey values.

    Returns
    -------
    ndarray (h, w) or None
        None where no raster is lit, or too little of it is seen.
    """
    ends = [np.flatnonzero(hidden.any(axis=axis))[[0, -1]] for axis in (0, 1) if hidden.any()]
    lengths = [int(high - low) for low, high in ends]
    if not ends or min(lengths) < 8 * _STEP:
        return None
    x, y = (
        np.arange(low + _INSIDE * n, high - _INSIDE * n, _STEP).astype(np.intp)
        for (low, high), n in zip(ends, lengths, strict=True)
    )
    h, w = ground.shape
    middle, size = np.array([w - 1, h - 1]) / 2, max(h, w) / 2
    u, v = np.meshgrid((x - middle[0]) / size, (y - middle[1]) / size)
    glow = ground[np.ix_(y, x)].astype(np.float64).ravel()
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1).reshape(-1, 6)
    weight: Array = np.ones_like(glow)
    values: Array = np.zeros(6)
    scatter = np.inf
    for _ in range(6):  # Tukey's weights: where an echo is as wide as the ground's window, it is none of it
        found = np.linalg.lstsq(design * weight[:, None], glow * weight, rcond=None)[0]
        values = np.asarray(found, dtype=np.float64)
        off = np.abs(glow - design @ values)
        scatter = float(max(1.4826 * np.median(off), 1e-3 * noise))
        weight = np.clip(1 - (off / (5 * scatter)) ** 2, 0, None)
    if values[0] < _LEAST * noise or scatter > _ROUGH * values[0]:
        return None
    across, down = (np.arange(w) - middle[0]) / size, ((np.arange(h) - middle[1]) / size)[:, None]
    c = values / values[0]
    light = 1 + c[1] * across + c[2] * down + c[3] * across**2 + c[4] * across * down + c[5] * down**2
    return np.asarray(np.clip(light, *_LIMITS), dtype=np.float32)


_UPRIGHT_FROM = 1.8
"""Length over thickness from which the direction of an arc can be told."""
_GROUND_LENGTHS = 1.0
"""Side of the running median that is the ground, in the greatest lengths of an arc."""
_LONG_PX = 40.0
"""Length up to which an arc is a pin's in a frame of any size."""
_IN_ROWS = ("a character in a row of characters", "one of a scale's equally spaced marks")
_STATIC = 0.7
"""Share of a spot that must be the same in all frames to be no part of the image."""


@dataclass(frozen=True)
class PinOptions:
    """How pins are found and measured.

    Parameters
    ----------
    psf_px : float
        Width (one sigma) of the Gaussian that smooths the frame for finding echoes.
    most_length_px : float, optional
        Greatest length of a pin's arc; by default 6 % of the frame's diagonal, not below 40 px. What is
        longer is an edge of the sector, the face of the transducer or an interface.
    most_tilt_deg : float
        Greatest tilt of an arc against the rows of the frame.
    least_strength : float
        Least brightness over the ground, as a share of that of the brightest echo.
    least_correlation : float
        Least correlation of a spot with its formed arc, noise apart.
    most_touching : float
        Share of its height above which a spot must not touch another.
    sharpest_px : float
        Width (one sigma) of a line across below which it is drawn and no echo.
    least_seen, most_rejected : float
        Share of an arc that must lie in the frame, that may be left out as disturbed.
    most_wire_px : int
        Greatest width of the dark cut of a wire across an echo, blur included; 0: there are no wires.
    most_sigma_px : float
        Largest standard deviation of a coordinate that still counts as measured.
    gate : float
        How far a pin may lie from where the others have it, in the design's typical spacing.
    max_rotation_deg : float
        Largest rotation of the design in the image; half a turn is tried as well.
    mirrored : bool, optional
        Whether the image shows the design mirrored; None: to be found out.
    """

    psf_px: float = 1.2
    most_length_px: float | None = None
    most_tilt_deg: float = 60.0
    least_strength: float = 0.2
    least_correlation: float = 0.92
    most_touching: float = 0.6
    sharpest_px: float = 0.66
    least_seen: float = 0.6
    most_rejected: float = 0.35
    most_wire_px: int = 5
    most_sigma_px: float = 0.5
    gate: float = 0.15
    max_rotation_deg: float = 12.0
    mirrored: bool | None = None


@dataclass(frozen=True, eq=False)
class PinDetections:
    """Spots of a frame and what speaks against them, in columns, the brightest first.

    Parameters
    ----------
    image, sha256 : str
        The frame.
    xy : ndarray (m, 2)
        Middle of the line, pixels; for those never matched about where the spot lies.
    cov : ndarray (m, 2, 2)
        Covariances in px², NaN where not matched.
    ok : ndarray of bool (m,)
        Which are images of point reflectors.
    why : tuple of str (m,)
        What else the others are; empty where ok.
    strength : ndarray (m,)
        Brightness over the ground, as a share of the brightest echo.
    length, thickness, curvature, tilt : ndarray (m,)
        Of the arc (px, px, 1/px, rad): four widths along and across, see :class:`reseau.optics.Arcs`; NaN
        where not matched.
    contrast, t, noise, correlation : ndarray (m,)
        Of the match: see :class:`reseau.measure.matching.Matches`; NaN where not matched.
    centroid : ndarray (m, 2)
        Centre of gravity of the region above a fifth of the height, for comparison with programs that measure
        that; the tail of a reverberation draws it down.
    """

    image: str
    sha256: str
    xy: Array
    cov: Array
    ok: Mask
    why: tuple[str, ...]
    strength: Array
    length: Array
    thickness: Array
    curvature: Array
    tilt: Array
    contrast: Array
    t: Array
    noise: Array
    correlation: Array
    centroid: Array

    def __len__(self) -> int:
        return len(self.ok)

    @property
    def points(self) -> ImagePoints:
        """The pins, numbered from the brightest."""
        names = tuple(str(i + 1) for i in range(int(self.ok.sum())))
        return ImagePoints(names, self.xy[self.ok], self.cov[self.ok])


def find_pins(
    frame: Frame,
    options: PinOptions | None = None,
    others: Sequence[Frame] = (),
    hidden: Mask | None = None,
) -> PinDetections:
    """Find every arc-like point reflector of a frame.

    Parameters
    ----------
    frame : Frame
        A frame with bright echoes on a dark ground.
    options : PinOptions, optional
        How.
    others : sequence of Frame
        Further frames of the sequence, in which the object has moved: what is the same in all is no echo.
    hidden : ndarray (h, w) of bool, optional
        Pixels that wires of a reseau cover, where they are known; upright cuts through echoes are found.
        The raster against which the wires stand out then tells how the light falls off.

    Returns
    -------
    PinDetections
        Pins, and the spots that were declined.

    Raises
    ------
    ImageError
        When the frame is all black, saturated, or of one grey.
    """
    o = options or PinOptions()
    screened = screen(frame, run=None)
    longest = o.most_length_px or max(_LONG_PX, 0.06 * float(np.hypot(*frame.pixels.shape)))
    ground = ground_of(screened.grey, max(15, round(_GROUND_LENGTHS * longest)))
    if hidden is not None and (dim := falloff(ground, hidden, screened.noise)) is not None:
        screened, ground = replace(screened, grey=screened.grey / dim), ground / dim
    light = screened.grey - ground
    least = max(2.5 * screened.noise, 0.05 * o.least_strength * float(light.max()))
    covered = find_cuts(light, screened.noise, o.most_wire_px)
    if hidden is not None:
        covered |= hidden
    echoes = find_echoes(bridged(light, covered), o.psf_px, least)
    open_ = replace(screened, valid=screened.valid & ~covered)
    return _Judge(frame, open_, echoes, longest, o, tuple(others)).verdict()


class _Judge:
    """The spots of a frame, and what speaks against each."""

    def __init__(
        self,
        frame: Frame,
        screened: Screened,
        echoes: Echoes,
        longest: float,
        options: PinOptions,
        others: tuple[Frame, ...],
    ) -> None:
        self.frame, self.screened, self.echoes, self.options = frame, screened, echoes, options
        self.longest = longest
        self.still = same_in_all(frame, others)
        self.why = np.full(len(echoes), "", dtype=object)

    def verdict(self) -> PinDetections:
        """Decline what needs no match, match the rest, decide."""
        e, o = self.echoes, self.options
        sharp = is_sharp(e)
        coarse = [
            (
                e.length > self.longest,
                "longer than a pin: an edge of the sector, a transducer's face or an interface",
            ),
            (sharp, "sharp all around: drawn by the instrument"),
            (e.joined > o.most_touching, "touches another spot"),
            (self._static(), "the same in all frames"),
        ]
        drawn = sharp | looks_sharp(e)
        coarse += zip(series(e, drawn), _IN_ROWS, strict=True)
        for mask, reason in coarse:
            self._object(np.arange(len(e)), mask, reason)
        open_ = self.why == ""
        brightest = float(e.height[open_].max(initial=0.0))
        # What is far too faint is not worth a match; the final word needs the brightest pin, known only then.
        self._object(
            np.arange(len(e)), e.height < 0.5 * o.least_strength * brightest, "too faint beside the others"
        )
        at = np.flatnonzero(self.why == "")
        found = self._match(at)
        for mask, reason in self._objections(at, found):
            self._object(at, mask, reason)
        every = np.arange(len(e))
        for mask, reason in zip(series(e, drawn | self._looks_drawn(at, found)), _IN_ROWS, strict=True):
            self._object(every, mask, reason, also_sharp=sharp)
        brightest = float(e.height[self.why == ""].max(initial=0.0))
        self._object(every, e.height < o.least_strength * brightest, "too faint beside the others")
        return self._columns(at, found, brightest)

    def _object(self, at: Rows, mask: Mask, reason: str, also_sharp: Mask | None = None) -> None:
        """Write down a reason where there is none yet; of what is drawn, the more telling one."""
        free = self.why[at] == ""
        if also_sharp is not None:
            free |= also_sharp[at]
        self.why[at[mask & free]] = reason

    def _static(self) -> Mask:
        e = self.echoes
        if self.still is None:
            return np.zeros(len(e), dtype=bool)
        inside = e.owner >= 0
        same = np.bincount(e.owner[inside], self.still[inside], minlength=len(e))
        return np.asarray(same > _STATIC * e.area)

    def _match(self, at: Rows) -> ArcMatches:
        s = self.screened
        # No echo is far brighter than what is seen of it; one that is hidden would be found to be.
        options = MatchOptions(contrast_sigma=self.frame.full_scale)
        return match_arcs(s.grey, s.valid, self.echoes, at, options, max(s.noise, 0.3))

    def _objections(self, at: Rows, found: ArcMatches) -> list[tuple[Mask, str]]:
        """What speaks against a spot in its own image, the gravest first."""
        o, e = self.options, self.echoes
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        upright = np.abs(e.tilt[at]) > np.deg2rad(o.most_tilt_deg)
        upright &= e.length[at] > _UPRIGHT_FROM * e.thickness[at]
        moved = np.hypot(*(found.xy - e.xy[at]).T) > np.maximum(3.0, 0.5 * e.length[at])
        border = np.array([self.frame.width, self.frame.height]) - 1
        outside = ((found.xy < 0) | (found.xy > border)).any(axis=1)
        near = (np.minimum(found.xy, border - found.xy) < 2 * found.form.along[:, None] + 2).any(axis=1)
        unseen = found.seen < o.least_seen
        return [
            (outside | (unseen & near), "cut off by the edge of the frame"),
            (unseen, "hidden in good part by a wire or a neighbour"),
            (~found.converged, "the match does not converge"),
            (found.form.across < o.sharpest_px, "sharper than an echo: drawn by the instrument"),
            (self._likeness(found) < o.least_correlation, "not the image of an arc"),
            (found.rejected > o.most_rejected, "disturbed by something that crosses it"),
            (moved, "the match wanders off"),
            (upright, "stands too steep for the arc of a pin"),
            (4 * found.form.along > 1.6 * self.longest, "longer than a pin"),
            (~(sigma <= o.most_sigma_px), "too uncertain"),
        ]

    def _likeness(self, found: ArcMatches) -> Array:
        """Correlations with the formed arcs (m,), what the noise takes from them given back."""
        white = np.clip((self.screened.noise / np.maximum(found.noise, 1e-12)) ** 2, 0, 1)
        likeness: Array = np.sqrt(1 - (1 - np.clip(found.correlation, 0, 1) ** 2) * (1 - white))
        return likeness

    def _looks_drawn(self, at: Rows, found: ArcMatches) -> Mask:
        suspect = np.zeros(len(self.echoes), dtype=bool)
        suspect[at] = (self._likeness(found) < self.options.least_correlation) | (
            found.form.across < self.options.sharpest_px
        )
        return suspect

    def _columns(self, at: Rows, found: ArcMatches, brightest: float) -> PinDetections:
        e = self.echoes

        def spread(values: Array) -> Array:
            full = np.full((len(e), *values.shape[1:]), np.nan)
            full[at] = values
            return full

        xy = e.xy.copy()
        xy[at] = np.where(np.isfinite(found.xy), found.xy, e.xy[at])
        names = [f.name for f in fields(found) if f.name in PinDetections.__dataclass_fields__]
        columns = {name: spread(getattr(found, name)) for name in names if name != "xy"}
        arcs = found.form
        return PinDetections(
            image=self.frame.name,
            sha256=self.frame.sha256,
            xy=xy,
            ok=self.why == "",
            why=tuple(self.why),
            strength=e.height / max(brightest, 1e-12),
            centroid=e.centroid,
            length=spread(4 * arcs.along),
            thickness=spread(4 * arcs.across),
            curvature=spread(arcs.curvature),
            tilt=spread(arcs.tilt),
            **columns,
        )
