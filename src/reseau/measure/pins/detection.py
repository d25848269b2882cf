"""Detection of the rods of an ultrasonic test object: short arcs among everything else on a scanner's screen.

1. Find bright spots.
2. Discard those that are drawn by the instrument, too long or too faint.
3. Match each of the others with a formed arc.
4. Test each by its own image and by the other spots. Rejected spots are reported with the reason.

y is measured on the line, x at its centre (Wishahy: "the pin's images appear as horizontal curved lines").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import scipy

from ...core import vocabulary as v
from ...core.data import Array, Frame, ImagePoints, Mask, Rows
from ...core.failure import Code, Failure
from ...core.overlaid import Overlaid
from ..matching.patches import MatchOptions
from ..points import Reason
from ..screening import Screened, screen
from .arcs import ArcMatches
from .echoes import Echoes, Grey, find_echoes, ground_of
from .forms import match_arcs
from .graphics import bridged, find_cuts, is_sharp, looks_drawn, same_in_all, series
from .reverberations import find_reverberations
from .screenlight import blur_of_wires, falloff
from .shapes import ends_of, reach_of

if TYPE_CHECKING:
    from ...core.overlay import Layer


_UPRIGHT_FROM = 1.8
"""Minimum length over thickness from which the direction of an arc is determined."""
_GROUND_LENGTHS = 1.0
"""Side of the running median of the background, as a multiple of the maximum length of an arc."""
_LONG_PX = 40.0
"""Minimum of the largest length of a pin's arc, in a frame of any size."""
_IN_ROWS = (
    Reason("a character in a row of characters", Code.DRAWN),
    Reason("one of a scale's equally spaced marks", Code.DRAWN),
)
_TOO_UNCERTAIN = Reason("too uncertain", Code.UNCERTAIN)
_HALF_SEEN = (Code.HIDDEN, Code.UNCERTAIN, Code.OVERLAPPING, Code.OUTSIDE)
"""Why an echo may not be measured and have a reverberation all the same."""
_ECHO_PX = 6.0, 1.8
"""Usual size of an echo (one sigma) along and across, pixels, over which its brightness is averaged."""
_MOST_BY_CHANCE = 0.5
"""Largest number of spots as bright as an echo that chance makes in its frame."""
_STATIC = 0.7
"""Share of a spot that must be the same in all frames for it to be a static graphic."""


@dataclass(frozen=True)
class PinOptions:
    """Options of the detection of pins.

    Parameters
    ----------
    smoothing_px : float
        Width (one sigma) of the Gaussian that smooths the frame for detection.
    max_length_px : float, optional
        Largest length of a pin's arc; by default 6 % of the frame's diagonal, at least 40 px. Longer spots
        are edges of the sector, the face of the transducer or interfaces.
    most_tilt_deg : float
        Largest tilt of an arc against the rows of the frame, or the common direction of its echoes.
    least_strength : float
        Minimum brightness over the background, as a share of that of the brightest echo.
    least_correlation : float
        Minimum correlation of a spot with its formed arc, corrected for noise.
    most_touching : float
        A spot must not touch another above this share of its height.
    sharpest_px : float
        Minimum width (one sigma) of an echo across, and of its ends; sharper lines are drawn by the
        instrument.
    least_seen, most_rejected : float
        Minimum share of an arc in the frame; largest share that may be rejected as disturbed.
    most_wire_px : int
        Largest width of the dark cut of a wire across an echo, including blur; 0 if there are no wires.
    most_sigma_px : float
        Largest standard deviation of a coordinate that is accepted.
    gate : float
        Largest distance of a pin from its predicted position, relative to the typical spacing of the design.
    max_rotation_deg : float
        Largest rotation of the design in the image; a rotation by 180° is tried, too.
    mirrored : bool, optional
        Whether the image shows the design from behind, left and right exchanged, or from the front (x right,
        y up); None to determine it. Not used with nominal positions.

    Examples
    --------
    >>> PinOptions(most_wire_px=0, mirrored=False).gate
    0.15
    """

    smoothing_px: float = 1.2
    max_length_px: float | None = None
    most_tilt_deg: float = 60.0
    least_strength: float = 0.2
    least_correlation: float = 0.92
    most_touching: float = 0.6
    sharpest_px: float = 0.66
    least_seen: float = 0.4
    most_rejected: float = 0.35
    most_wire_px: int = 5
    most_sigma_px: float = 0.5
    gate: float = 0.15
    max_rotation_deg: v.MaxRotationDeg = 12.0
    mirrored: v.Mirrored | None = None


@dataclass(frozen=True, eq=False)
class PinDetections(Overlaid):
    """Spots of a frame and reasons for rejection, in columns, the brightest first.

    Parameters
    ----------
    image, sha256 : str
        The frame.
    xy : ndarray (m, 2)
        Centre of the line, pixels; approximate for spots that were not matched.
    cov : ndarray (m, 2, 2)
        Covariances in px², NaN where not matched.
    ok : ndarray of bool (m,)
        Which spots are images of point reflectors.
    why : tuple of str (m,)
        Reason for rejection; empty where ok.
    strength : ndarray (m,)
        Brightness over the background, as a share of the brightest echo.
    length, thickness, curvature, tilt : ndarray (m,)
        Parameters of the arc (px, px, 1/px, rad): four widths along and across, see
        :class:`reseau.optics.Arcs`; NaN where not matched.
    contrast, t, noise, correlation : ndarray (m,)
        Quality of the match, see :class:`reseau.measure.matching.Matches`; NaN where not matched.
    centroid : ndarray (m, 2)
        Centroid of the region above one fifth of the height, for comparison with programs that measure it;
        the tail of a reverberation shifts it downwards.
    reach : ndarray (m,), optional
        Distance from the middle at which the light tells the place of the echo along the line, pixels: about
        half the length of a line, and 1.2 times the width along of a beam; NaN where not matched.
    shared : ndarray (m, 2, k), optional
        Derivatives of the positions by k errors of unit variance that all have in common, as that of the tilt
        of all echoes; they are part of `cov`. NaN where not matched.

    Examples
    --------
    >>> none, one = np.full(2, np.nan), np.ones(2)
    >>> xy, ok = np.array([[40.1, 40.2], [80.0, 12.0]]), np.array([True, False])
    >>> why = ("", Reason("a character in a row of characters", Code.DRAWN))
    >>> columns = [xy, np.tile(1e-4 * np.eye(2), (2, 1, 1)), ok, why, *[one] * 9, xy]
    >>> spots = PinDetections("screen.png", "", *columns)
    >>> len(spots), spots.points.names, spots.codes
    (2, ('1',), (None, <Code.DRAWN: 'drawn'>))
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
    reach: Array | None = None
    shared: Array | None = None

    def __len__(self) -> int:
        return len(self.ok)

    @property
    def codes(self) -> tuple[Code | None, ...]:
        """Codes (m,) of the reasons; None where a spot is a pin."""
        return tuple(why.code if isinstance(why, Reason) else None for why in self.why)

    @property
    def direction(self) -> float:
        """Common direction (rad) of the echoes in the image, from -π/2 to π/2."""
        double = np.exp(2j * self.tilt[self.ok]) * np.minimum(
            self.length[self.ok] / self.thickness[self.ok] - 1, 5
        )
        return float(np.angle(double.sum()) / 2)

    def turned_back(self, width: int) -> PinDetections:
        """The same spots in the frame, of this width, that was turned by 90° against the clock for them."""
        back = np.array([[0.0, -1.0], [1.0, 0.0]])
        columns: dict[str, Any] = {"tilt": self.tilt + np.pi / 2, "cov": back @ self.cov @ back.T}
        columns |= {name: getattr(self, name) @ back.T + [width - 1.0, 0.0] for name in ("xy", "centroid")}
        if self.shared is not None:
            columns["shared"] = back @ self.shared
        return replace(self, **columns)

    def _heading(self) -> str:
        return f"{self.image}: {int(self.ok.sum())} echoes found"

    def layers(self) -> list[Layer]:
        """What is drawn over the frame: pins, then rejected spots, one layer for each reason."""
        from ...core.overlay import Layer, declined_layers

        points, rest = self.points, np.flatnonzero(~self.ok)
        found = Layer(f"echoes, {len(points)}", points.xy, points.names, points.cov)
        codes = [(self.codes[i] or Code.DECLINED).value for i in rest]
        nameless = [""] * len(rest)
        return [found, *declined_layers(nameless, self.xy[rest], [self.why[i] for i in rest], codes)]

    @property
    def points(self) -> ImagePoints:
        """The pins, numbered in order of brightness."""
        names = tuple(str(i + 1) for i in range(int(self.ok.sum())))
        return ImagePoints(names, self.xy[self.ok], self.cov[self.ok])


def find_pins(
    frame: Frame,
    options: PinOptions | None = None,
    others: Sequence[Frame] = (),
    hidden: Mask | None = None,
) -> PinDetections | Failure:
    """Find every arc-like point reflector of a frame.

    Parameters
    ----------
    frame : Frame
        A frame with bright echoes on a dark background.
    options : PinOptions, optional
        Options of the detection.
    others : sequence of Frame
        Other frames of the sequence, in which the object has moved: spots that are the same in all frames are
        no echoes.
    hidden : ndarray (h, w) of bool, optional
        Pixels covered by the wires of a reseau, if known; otherwise vertical cuts through echoes are found.
        The raster between the wires then gives the falloff of light.

    Returns
    -------
    PinDetections or Failure
        Pins, and rejected spots; a failure when the frame is all black, saturated, or of one grey.

    Examples
    --------
    >>> import numpy as np
    >>> from reseau.optics import Arcs
    >>> arcs = Arcs(*np.array([[6.0] * 2, [2.0] * 2, [0.01] * 2, [0.0] * 2]))
    >>> x, y = np.tile(np.arange(140.0), (2, 1)), np.tile(np.arange(120.0), (2, 1))
    >>> light = arcs.image(np.array([[40.0, 40.0], [100.0, 60.0]]), x, y).sum(axis=0)
    >>> grey = 20 + 150 * light + np.random.default_rng(0).normal(0, 1, light.shape)
    >>> pins = find_pins(Frame(grey, 255.0))
    >>> sorted(np.rint(pins.points.xy[:, 0]).tolist()), pins.codes
    ([40.0, 100.0], (None, None))
    """
    o = options or PinOptions()
    screened = screen(frame, run=None)
    if isinstance(screened, Failure):
        return screened
    judge = _judge(frame, screened, o, tuple(others), hidden)
    if abs(judge.direction) <= np.pi / 4:
        return judge.verdict()
    # The echoes stand upright in the frame: turned by 90°, they lie along its rows.
    lying = replace(frame, pixels=np.rot90(frame.pixels))
    turned = tuple(replace(other, pixels=np.rot90(other.pixels)) for other in others)
    screened = replace(screened, grey=np.rot90(screened.grey), valid=np.rot90(screened.valid))
    behind = None if hidden is None else np.rot90(hidden)
    return _judge(lying, screened, o, turned, behind).verdict().turned_back(frame.width)


def _judge(
    frame: Frame, screened: Screened, o: PinOptions, others: tuple[Frame, ...], hidden: Mask | None
) -> _Judge:
    """The spots of a frame, to be judged."""
    longest = o.max_length_px or max(_LONG_PX, 0.06 * float(np.hypot(*frame.pixels.shape)))
    ground = ground_of(screened.grey, max(15, round(_GROUND_LENGTHS * longest)))
    blur = None
    if hidden is not None:
        blur = blur_of_wires(screened.grey, hidden, screened.noise)
        if (dim := falloff(ground, hidden, screened.noise)) is not None:
            screened, ground = replace(screened, grey=screened.grey / dim), ground / dim
    light = screened.grey - ground
    least = max(2.5 * screened.noise, 0.05 * o.least_strength * float(light.max()))
    covered = find_cuts(light, screened.noise, o.most_wire_px)
    if hidden is not None:
        covered |= hidden
    echoes = find_echoes(bridged(light, covered), o.smoothing_px, least)
    open_ = replace(screened, valid=screened.valid & ~covered)
    judge = _Judge(frame, open_, echoes, longest, least, o, others, blur)
    judge.by_chance = _by_chance(bridged(light, covered), echoes, _lit(screened.valid & ~covered, hidden))
    return judge


def _lit(valid: Mask, hidden: Mask | None) -> Mask:
    """Pixels between the echoes: those that are seen, within the extent of a reseau."""
    if hidden is None or not hidden.any():
        return valid
    row, column = (np.flatnonzero(hidden.any(axis=axis)) for axis in (1, 0))
    seen = np.zeros_like(valid)
    seen[row[0] : row[-1], column[0] : column[-1]] = True
    return np.asarray(seen & valid & ~hidden)


def _by_chance(light: Grey, echoes: Echoes, lit: Mask) -> Array:
    """How many spots (m,) as bright as each one, over the size of an echo, what is between echoes makes.

    Speckle is as bright as echoes, and smaller. Averaged over an echo, its brightness above the median falls
    off exponentially at most.
    """
    along, across = _ECHO_PX
    even = cv2.GaussianBlur(light, (0, 0), along, sigmaY=across)
    middle, upper = np.quantile(even[lit], [0.5, 0.75]).tolist() if lit.any() else (0.0, 1.0)
    scale = max(upper - middle, 1e-6) / np.log(2)
    places = lit.sum() / (4 * np.pi * along * across)
    brightest = scipy.ndimage.maximum(even, echoes.owner, np.arange(len(echoes)))
    return np.asarray(0.5 * places * np.exp(-np.maximum(np.asarray(brightest) - middle, 0) / scale))


class _Judge:
    """The spots of a frame, and the objections to each."""

    def __init__(
        self,
        frame: Frame,
        screened: Screened,
        echoes: Echoes,
        longest: float,
        least: float,
        options: PinOptions,
        others: tuple[Frame, ...],
        blur: tuple[float, float] | None,
    ) -> None:
        self.blur = blur
        self.frame, self.screened, self.echoes, self.options = frame, screened, echoes, options
        self.longest, self.least = longest, least
        self.direction = self._direction()
        self.by_chance = np.zeros(len(echoes))
        self.still = same_in_all(frame, others)
        self.why = np.full(len(echoes), "", dtype=object)

    def _direction(self) -> float:
        """Common direction (rad) of long spots, by their brightness over that of their steps."""
        e = self.echoes
        drawn = looks_drawn(e)
        long = (e.length > _UPRIGHT_FROM * e.thickness) & (e.length <= self.longest)
        long &= ~(drawn | np.any(series(e, drawn), axis=0))
        soft = e.height[long] / np.maximum(e.edge[long, 0], 1e-6)
        return float(np.angle((soft**2 * np.exp(2j * e.tilt[long])).sum()) / 2)

    def verdict(self) -> PinDetections:
        """Reject spots that need no match, match the others, decide."""
        e, o = self.echoes, self.options
        sharp = is_sharp(e)
        coarse = [
            (
                e.length > self.longest,
                Reason("longer than a pin: edge of the sector, transducer face or interface", Code.UNLIKE),
            ),
            (sharp, Reason("sharp all around: drawn by the instrument", Code.DRAWN)),
            (e.joined > o.most_touching, Reason("touches another spot", Code.OVERLAPPING)),
            (self._static(), Reason("the same in all frames", Code.DRAWN)),
            (
                self.by_chance > _MOST_BY_CHANCE,
                Reason("no brighter than speckle or grain", Code.LOW_CONTRAST),
            ),
        ]
        drawn = sharp | looks_drawn(e)
        coarse += zip(series(e, drawn), _IN_ROWS, strict=True)
        for mask, reason in coarse:
            self._object(np.arange(len(e)), mask, reason)
        open_ = self.why == ""
        brightest = float(e.height[open_].max(initial=0.0))
        # Very faint spots are not matched; the final test needs the brightest pin, known only afterwards.
        self._object(
            np.arange(len(e)),
            e.height < 0.5 * o.least_strength * brightest,
            Reason("too faint compared with the others", Code.LOW_CONTRAST),
        )
        at = np.flatnonzero(self.why == "")
        found = self._match(at)
        for mask, reason in self._objections(at, found):
            self._object(at, mask, reason)
        every = np.arange(len(e))
        for mask, reason in zip(series(e, drawn | self._looks_drawn(at, found)), _IN_ROWS, strict=True):
            self._object(every, mask, reason, also_sharp=sharp)
        self._repeated(at, found)
        brightest = float(e.height[self.why == ""].max(initial=0.0))
        self._object(
            every,
            e.height < o.least_strength * brightest,
            Reason("too faint compared with the others", Code.LOW_CONTRAST),
        )
        return self._columns(at, found, brightest)

    def _object(self, at: Rows, mask: Mask, reason: Reason, also_sharp: Mask | None = None) -> None:
        """Record a reason where there is none yet; for drawn spots keep the more specific one."""
        free = self.why[at] == ""
        if also_sharp is not None:
            free |= also_sharp[at]
        self.why[at[mask & free]] = reason

    def _repeated(self, at: Rows, found: ArcMatches) -> None:
        """Reject second echoes of the same reflectors."""
        e, xy = self.echoes, self.echoes.xy.copy()
        measured = found.converged & np.isin(self.why[at], ["", _TOO_UNCERTAIN])
        xy[at[measured]] = found.xy[measured]
        codes = np.array([getattr(why, "code", None) for why in self.why], dtype=object)
        echo = np.array([code is None or code in _HALF_SEEN for code in codes], dtype=bool)
        seen = np.flatnonzero(echo | (codes == Code.LOW_CONTRAST))
        repeated = find_reverberations(
            xy[seen],
            e.height[seen],
            e.length[seen],
            echo[seen],
            ~self.screened.valid,
            self.least,
            self.longest,
            self.direction,
        )
        second, doubtful = repeated.of != -1, repeated.doubtful
        text = f"{abs(repeated.spacing):.1f} px behind another one"
        self._object(seen, second & doubtful, Reason(f"a point, or a reverberation {text}", Code.AMBIGUOUS))
        self._object(seen, second, Reason(f"a reverberation {text}", Code.REVERBERATION))

    def _static(self) -> Mask:
        e = self.echoes
        if self.still is None:
            return np.zeros(len(e), dtype=bool)
        inside = e.owner >= 0
        same = np.bincount(e.owner[inside], self.still[inside], minlength=len(e))
        return np.asarray(same > _STATIC * e.area)

    def _match(self, at: Rows) -> ArcMatches:
        s = self.screened
        # The hidden part of an echo is assumed to be about as bright as the visible part.
        options = MatchOptions(contrast_sigma=self.frame.full_scale)
        return match_arcs(s.grey, s.valid, self.echoes, at, options, max(s.noise, 0.3), self.blur)

    def _objections(self, at: Rows, found: ArcMatches) -> list[tuple[Mask, Reason]]:
        """Objections to spots from their own images, the most serious first."""
        o, e = self.options, self.echoes
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        # Against the rows, or the common direction, which few echoes tell roughly.
        steep = np.abs((e.tilt[at] - [[0.0], [self.direction]] + np.pi / 2) % np.pi - np.pi / 2).min(axis=0)
        upright = steep > np.deg2rad(o.most_tilt_deg)
        upright &= e.length[at] > _UPRIGHT_FROM * e.thickness[at]
        moved = np.hypot(*(found.xy - e.xy[at]).T) > np.maximum(3.0, 0.5 * e.length[at])
        border = np.array([self.frame.width, self.frame.height]) - 1
        outside = ((found.xy < 0) | (found.xy > border)).any(axis=1)
        near = (np.minimum(found.xy, border - found.xy) < 2 * found.arcs.along[:, None] + 2).any(axis=1)
        unseen = found.seen < o.least_seen
        return [
            (outside | (unseen & near), Reason("cut off by the edge of the frame", Code.OUTSIDE)),
            (unseen, Reason("largely hidden by a wire or a neighbour", Code.HIDDEN)),
            (~found.converged, Reason("the match did not converge", Code.NOT_CONVERGED)),
            (
                (found.arcs.across < o.sharpest_px) | (ends_of(found.arcs)[1] < o.sharpest_px),
                Reason("sharper than an echo: drawn by the instrument", Code.DRAWN),
            ),
            (self._likeness(found) < o.least_correlation, Reason("not the image of an arc", Code.UNLIKE)),
            (
                found.rejected > o.most_rejected,
                Reason("disturbed by an object that crosses it", Code.DISTURBED),
            ),
            (moved, Reason("the match moved away from the spot", Code.DEVIATES)),
            (upright, Reason("too steep for the arc of a pin", Code.UNLIKE)),
            (4 * found.arcs.along > 1.6 * self.longest, Reason("longer than a pin", Code.UNLIKE)),
            (~(sigma <= o.most_sigma_px), _TOO_UNCERTAIN),
        ]

    def _likeness(self, found: ArcMatches) -> Array:
        """Correlations with the formed arcs (m,), corrected for noise."""
        white = np.clip((self.screened.noise / np.maximum(found.noise, 1e-12)) ** 2, 0, 1)
        return np.sqrt(1 - (1 - np.clip(found.correlation, 0, 1) ** 2) * (1 - white))

    def _looks_drawn(self, at: Rows, found: ArcMatches) -> Mask:
        suspect = np.zeros(len(self.echoes), dtype=bool)
        suspect[at] = (self._likeness(found) < self.options.least_correlation) | (
            (found.arcs.across < self.options.sharpest_px)
            | (ends_of(found.arcs)[1] < self.options.sharpest_px)
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
        arcs = found.arcs
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
            reach=spread(reach_of(arcs)),
            **columns,
        )
