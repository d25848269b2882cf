"""Interior orientation of scanned film frames from their four edges, with uncertainty, or declined with a
reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from ...core import vocabulary as v
from ...core.data import Array, Frame
from ...core.display import Display
from ...core.failure import Code, Failure
from ...core.overlaid import Overlaid
from ...io import (
    CORNERS,
    EDGES,
    CurveCandidate,
    FormatCandidate,
    FrameOrientation,
    MeasuredCorner,
    MeasuredEdge,
    RivalEdge,
)
from ...io.scans import Scan
from .border import Band, read_band
from .channel import WIDER_SEARCH, Channel, channels_by_contrast, measure_channel
from .curves import CURVES, CurveEvidence, curves_of, curves_of_scan
from .formats import ALL_FORMATS, FORMATS, format_probabilities, scale_by_perforations
from .lines import EdgeData, FrameShape, Lines, adjust_lines, derived, explained_shape, shape_of
from .search import FrameGuess, search_frames, size_of
from .strips import in_reading_order, overview_of, rest_of_strip

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ...core.overlay import Layer


_OVERVIEWS = ((500, 60), (1000, 300))
"""Longer side of the overviews in pixels, and number of combinations of lines tested in each."""
_RELIABLE = 3.0
"""Score of a frame from which no finer overview is needed."""
_REACH = 4.0
"""Largest error of an approximate edge, in pixels of the overview."""
_FILM_MM, _GAP_MM = 0.25, 0.2
"""Width of film examined beyond an edge, and width that separates the frame from other structures."""
_FITS, _AGREES, _CONTRADICTS = (0.3, 1.1), 0.015, 0.08
"""Size of a frame relative to the scan at which the resolution stated in the file can be that of the scan;
and relative differences of the scale from it: from the first the frame is not of its format, from the second
it is another structure."""
_LEAST_TONE, _LEAST_CUT = 0.12, 0.5
"""Least difference from film, as a share of the contrast, of a place in the picture; and the share of such
places along the border of a scan that cuts a frame."""
_COVERED, _NEAR = 0.25, 0.05
"""Least share of the scan within a frame with an edge outside it; and largest distance of a missing edge from
the given corners, as a share of their extent."""
_REACHED, _SEEN, _SAMPLES = 0.12, 0.4, 20
"""Shares of the edges beside a missing one: of the edge at its end that may be hidden, and of all its parts
that must be seen; and the number of these parts."""
_STATUS = {"oriented": 2, "three-edges": 1, "declined": 0}
"""Rank of each status."""
_STATED = 0.05, 0.5
"""Least probability of another explanation of an edge that is stated with the frame, and least share that
what it moves has in the largest standard deviation of a corner."""
_SLANT = float(np.deg2rad(0.7))
"""Standard deviation of the rotation angle of a tilted copying camera, radians."""
_MORE_PROBABLE = 0.5
"""Probability from which an explanation is the answer."""


@dataclass(frozen=True)
class FrameOptions:
    """Prior knowledge of the frames.

    Parameters
    ----------
    formats : tuple of (width, height)
        Possible formats in mm, each tried in both orientations.
    dpi : float, optional
        Resolution of the scan, if it is missing or wrong in the file.
    near : ndarray (4, 2), optional
        Approximate corners ul, ur, lr, ll in pixels, near which to search.
    aspect_sigma : float
        Relative standard deviation of a frame's proportions.
    angle_sigma_deg : float
        Standard deviation of its right angles.
    max_tilt_deg : float
        Largest tilt.
    shape : FrameShape, optional
        Format and shape of the camera's frame from other frames of its roll; replaces the formats.
    curves : ndarray (k,), optional
        Probabilities of the curves of grey values that the file does not state, by all frames of its roll.

    Examples
    --------
    >>> FrameOptions(formats=((36.0, 24.0),), dpi=2400).max_tilt_deg
    16.0
    """

    formats: tuple[tuple[float, float], ...] = FORMATS
    dpi: v.Dpi | None = None
    near: Array | None = None
    aspect_sigma: float = 0.007
    angle_sigma_deg: float = 0.25
    max_tilt_deg: float = 16.0
    shape: FrameShape | None = None
    curves: Array | None = None


@dataclass(frozen=True, eq=False, repr=False)
class FrameResult(Display, Overlaid):
    """One oriented frame, or the reason for declining it; falsy if declined.

    Parameters
    ----------
    image : str
        Name of the scan.
    status : {"oriented", "three-edges", "declined"}
        With three edges the position of the fourth follows from the format, with the resulting covariance.
    why : str
        What was wrong, and what would help.
    format_mm : (float, float) or None
        Width and height as they lie in the scan.
    channel : str or None
        The channel with the best result.
    lines : Lines or None
        The adjusted edges.
    edges : dict
        Result for each edge.
    code : Code or None
        Reason for a declined or incomplete frame, or a remark on it, for programs.
    resolution : float, optional
        Pixels per millimetre of the scan where they contradict the format: the opening of a slide mount.
    roll_frames : int, optional
        Number of frames of the roll whose shape was used.
    place : ndarray (4, 2), optional
        Approximate corners in the scan, also of a declined frame.
    frame : int, optional
        Number of the frame in a scan of several, in reading order.
    formats : tuple of ((float, float), float)
        Formats that the frame can be, with their probabilities, if none was given.
    curves : CurveEvidence, optional
        What its edges show of the curve of grey values that the file does not state.

    Examples
    --------
    >>> edges = {"upper": MeasuredEdge(found=False, points=0, rejected=0, rms_px=None, curvature_px=None)}
    >>> found = FrameResult("07.tif", "declined", "of one tone", None, None, None, edges, Code.LOW_CONTRAST)
    >>> bool(found), found.document().why
    (False, 'of one tone')
    """

    image: str
    status: Literal["oriented", "three-edges", "declined"]
    why: str
    format_mm: tuple[float, float] | None
    channel: str | None
    lines: Lines | None
    edges: dict[str, MeasuredEdge]
    code: Code | None = None
    resolution: float | None = None
    roll_frames: int | None = None
    place: Array | None = None
    frame: int | None = None
    formats: tuple[tuple[tuple[float, float], float], ...] = ()
    curves: CurveEvidence | None = None

    def __bool__(self) -> bool:
        return self.status != "declined"

    def _facts(self) -> list[tuple[str, str]]:
        if self.lines is None or self.format_mm is None:
            return [("image", self.image), ("status", self.status), ("reason", self.why)]
        sigma = np.sqrt(np.diag(self.lines.covariance))
        return [
            ("image", self.image),
            ("status", self.status),
            ("format", f"{self.format_mm[0]:g} × {self.format_mm[1]:g} mm"),
            ("largest sigma of a corner", f"{sigma.max():.2g} px"),
        ]

    def plot(self, axes: Axes | None = None, frame: Frame | None = None) -> Axes:
        """Draw the corners and edges with matplotlib.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        frame : Frame, optional
            The scan, drawn beneath.
        """
        from ...core.figures import ACCENT, over_picture

        axes = over_picture(axes, None if frame is None else frame.pixels)
        if self.lines is not None:
            corners = self.lines.corners
            axes.plot(
                *np.concatenate([corners, corners[:1]]).T, "o-", color=ACCENT, markersize=4, linewidth=0.9
            )
        axes.set_title(f"{self.image}: {self.status}", loc="left")
        return axes

    def _heading(self) -> str:
        number = "" if self.frame is None else f", frame {self.frame}"
        return f"{self.image}{number}: {self.status}" + (f" ({self.why})" if self.why else "")

    def layers(self) -> list[Layer]:
        """What is drawn over the scan: corners, measured edges, and the edges that were not found."""
        from ...core.overlay import MISSING, Layer

        none = np.empty((0, 2))
        if self.lines is None:
            missing = [f"{name}: {edge.why}" for name, edge in self.edges.items() if edge.why]
            return [Layer(text, none, symbol="x", colour=MISSING) for text in missing]
        corners = self.lines.corners
        cov = np.stack([self.lines.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(4)])
        layers = [Layer("corners", corners, CORNERS, cov)]
        for k, name in enumerate(EDGES):
            edge, ends = self.edges[name], corners[[k, (k + 1) % 4]]
            if edge.found:
                rms = "" if edge.rms_px is None else f", rms {edge.rms_px:.2g} px"
                text = f"{name} edge: {edge.points} profiles, {edge.rejected} rejected{rms}"
                layers.append(Layer(text, none, symbol="_", paths=(ends,)))
            else:
                text = f"{name} edge not found: {edge.why}" if edge.why else f"{name} edge not found"
                layers.append(Layer(text, none, symbol="x", colour=MISSING, paths=(ends,)))
        return layers

    def write(self, path: Path | str) -> None:
        """Write ``reseau-orientation/1``.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        self.document().write(path)

    @property
    def px_per_mm(self) -> tuple[float, float] | None:
        """Pixels per millimetre along x and y, from the mean sides of the frame and its format.

        Those of the scan, if the frame is known not to have the size of its format.
        """
        if self.lines is None or self.format_mm is None:
            return None
        if self.resolution is not None:
            return self.resolution, self.resolution
        side = np.roll(self.lines.corners, -1, axis=0) - self.lines.corners
        length = np.hypot(*side.T)
        w, h = self.format_mm
        return float((length[0] + length[2]) / (2 * w)), float((length[1] + length[3]) / (2 * h))

    def document(self) -> FrameOrientation:
        """The document ``reseau-orientation/1``, without a transformation."""
        common = {
            "image": self.image,
            "status": self.status,
            "why": self.why,
            "format_mm": self.format_mm,
            "channel": self.channel,
            "edges": self.edges,
            "roll_frames": self.roll_frames,
            "frame": self.frame,
            "formats": tuple(FormatCandidate(format_mm=each, probability=p) for each, p in self.formats),
            "curves": _candidates(self.curves),
        }
        if self.lines is None or not self:
            none = dict.fromkeys(
                ("corners", "principal_point", "angle_deg", "angle_sigma_deg", "px_per_mm"), None
            )
            return FrameOrientation(**common, **none)  # type: ignore[arg-type]
        corners, cov = self.lines.corners, self.lines.covariance
        point, point_cov, angle, angle_sigma = derived(corners, cov)
        named = {
            name: MeasuredCorner.from_columns(corners[k], cov[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])
            for k, name in enumerate(CORNERS)
        }
        return FrameOrientation(
            **common,  # type: ignore[arg-type]
            corners=named,  # type: ignore[arg-type]
            principal_point=MeasuredCorner.from_columns(point, point_cov),
            angle_deg=float(np.rad2deg(angle)),
            angle_sigma_deg=float(np.rad2deg(angle_sigma)),
            px_per_mm=self.px_per_mm,
        )


def orient_frames(scan: Scan, options: FrameOptions | None = None) -> list[FrameResult]:
    """Orient the frames of a scan.

    Parameters
    ----------
    scan : Scan
        The open scan; only an overview and the bands along the edges are read.
    options : FrameOptions, optional
        Prior knowledge of the frames.

    Returns
    -------
    list of FrameResult
        One result for each frame, in reading order; a declined one if no frame was found.

    Notes
    -----
    Derived in ``docs/mathematics/frame.md``.

    Examples
    --------
    A frame of 36 mm × 24 mm, brighter than the film around it, in grey values proportional to the light:

    >>> from reseau.core.tone import ToneCurve
    >>> from reseau.io.scans import scan_of
    >>> from reseau.optics.formation import draw, rectangles
    >>> frame = draw(rectangles(np.array([[19.5, 19.5, 163.5, 115.5]]), 0.5), (136, 184), 1.0)
    >>> grey = 60 + 120 * frame + np.random.default_rng(0).normal(0, 2, frame.shape)
    >>> near = np.array([[20.0, 20.0], [163.0, 20.0], [163.0, 115.0], [20.0, 115.0]])
    >>> options = FrameOptions(formats=((36.0, 24.0),), near=near)
    >>> scan = replace(scan_of(grey.astype(np.uint8)), curve=ToneCurve(1.0))
    >>> (found,) = orient_frames(scan, options)
    >>> found.status, bool(abs(found.lines.corners[0] - 19.5).max() < 0.1)
    ('oriented', True)
    """
    options = options or FrameOptions()
    declined: list[FrameResult] = []
    for missing in (False, True):
        guesses, reduction = _found(scan, options, missing, cut=bool(declined))
        if isinstance(guesses, Failure):
            declined = declined or ([_declined(scan, guesses)] if missing else [])
            continue
        scale, within = _perforated(scan, guesses[0], reduction, options)
        if scale is not None and (within or not _of_scale(guesses[0], reduction, scale, options)):
            again, finer = _found(scan, options, missing, cut=bool(declined), scale=scale)
            guesses, reduction = (guesses, reduction) if isinstance(again, Failure) else (again, finer)
        results = [_oriented(scan, guess, reduction, options, scale) for guess in guesses]
        if any(results):
            found = in_reading_order(rest_of_strip(scan, results, options, _oriented))
            own = [each.curves for each in found]
            common = curves_of_scan(scan, own) if options.curves is None else None
            if common is None or all(map(common.like, own)):
                return found
            return orient_frames(scan, replace(options, curves=common.share))
        # The reason why four edges are no frame is more useful than why three of them are none.
        declined = declined or results[:1]
    return declined


def _perforated(
    scan: Scan, guess: FrameGuess, reduction: float, options: FrameOptions
) -> tuple[float | None, bool]:
    """Pixels of the scan per millimetre by perforations along or across a frame, and whether it has them.

    They are looked for unless the frame has the size of its format at the resolution of the scan.
    """
    known = _resolution(scan, options, guess.format_mm)
    if options.near is not None or (known is not None and _of_scale(guess, reduction, known, options)):
        return None, False
    overview, r = scan.overview(overview_of(scan, _OVERVIEWS[-1][0]))
    found = scale_by_perforations(overview, (guess.corners + 0.5) * reduction / r - 0.5)
    return (None, False) if found is None else (found[0] * r, found[1])


def _of_scale(guess: FrameGuess, reduction: float, scale: float, options: FrameOptions) -> bool:
    """Whether a frame has the size of one of the formats at a scale."""
    among = ALL_FORMATS if options.formats == FORMATS else options.formats
    own = np.log(size_of(guess.corners) * reduction / scale)
    lying = [np.log(each) for w, h in among for each in ((w, h), (h, w))]
    return any(np.abs(own - each).max() < _CONTRADICTS for each in lying)


def _declined(scan: Scan, failure: Failure) -> FrameResult:
    lost = {
        name: MeasuredEdge(found=False, points=0, rejected=0, rms_px=None, curvature_px=None)
        for name in EDGES
    }
    return FrameResult(scan.name, "declined", failure.reason, None, None, None, lost, failure.code)


def _found(
    scan: Scan, options: FrameOptions, missing: bool, cut: bool, scale: float | None = None
) -> tuple[list[FrameGuess] | Failure, float]:
    """Frames in an overview; a finer overview is used if the first gives no reliable frame.

    After four edges that are no frame, one may be `missing` only because the scan is `cut` there. The `scale`
    is that of perforations, px/mm, at which all formats are searched.
    """
    best: list[FrameGuess] = []
    reduction, dark = 1.0, True
    sizes = options.formats if options.shape is None else [(options.shape.width, options.shape.height)]
    # Four lines of the picture may be a frame of another scale: that of the scan first, if it is stated.
    known = next((k for size in sizes if (k := _resolution(scan, options, size)) is not None), None)
    if scale is not None:
        known, sizes = scale, ALL_FORMATS if options.formats == FORMATS else sizes
    scales = (
        [known]
        if scale is not None or options.dpi is not None
        else [None]
        if missing or known is None
        else [known, None]
    )
    for longest, tried in _OVERVIEWS:
        overview, r = scan.overview(overview_of(scan, longest))
        if longest > _OVERVIEWS[0][0] and r == reduction:
            break
        dark = float(np.ptp(np.quantile(overview, [0.01, 0.99]))) < 0.01 * scan.full_scale
        if dark:
            break
        near = None if options.near is None else (options.near + 0.5) / r - 0.5
        for scale in scales:
            found = search_frames(
                overview,
                sizes,
                max_tilt_deg=options.max_tilt_deg,
                px_per_mm=None if scale is None else scale / r,
                hint=None if scan.dpi is None or cut else scan.dpi / 25.4 / r,
                tried=tried,
                near=near,
                missing=missing,
            )
            if found and found[0].score > _RELIABLE:
                break
        if found and (not best or _rank(found) > _rank(best)):
            best, reduction = found, r
        if best and all(best[0].supported) and best[0].score > _RELIABLE:
            break
        reduction = reduction if best else r
    if best:
        return best, reduction
    if dark:
        return Failure("is of one tone; scan it with more exposure", Code.LOW_CONTRAST), reduction
    formats = ", ".join(f"{w:g}x{h:g}" for w, h in options.formats)
    return Failure(
        f"no frame of the format {formats} stands out from unexposed film on at least three sides; scan it "
        "with a margin of film around, or give --format-mm, --dpi or the approximate corners (overlapping "
        "frames cannot be separated)",
        Code.NOT_FOUND,
    ), reduction


def _rank(found: list[FrameGuess]) -> float:
    return found[0].score + (2.0 if all(found[0].supported) else 0.0)


def _oriented(
    scan: Scan, guess: FrameGuess, reduction: float, options: FrameOptions, exact: float | None = None
) -> FrameResult:
    """Measure the edges of one frame in all channels, adjust, and keep the best channel.

    Its format is the most probable one at the `exact` scale of perforations, or that of the file.
    """
    corners = (guess.corners + 0.5) * reduction - 0.5
    formats: list[tuple[tuple[float, float], float]] = []
    if options.shape is None and options.formats == FORMATS:
        known = exact if options.dpi is None else options.dpi / 25.4
        stated = None if scan.dpi is None else scan.dpi / 25.4
        formats = format_probabilities(size_of(corners), ALL_FORMATS, known, stated)
        formats = [each for each in formats if each[1] > _STATED[0]]
        guess = replace(guess, format_mm=formats[0][0])
    side = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    scale = float((side[0] + side[2]) / (2 * guess.format_mm[0]))
    reach = max(_REACH * reduction, 6.0)

    @cache
    def band(k: int, wide: bool, far: bool = False) -> Band | None:
        ends = corners[k], corners[(k + 1) % 4]
        beside = (WIDER_SEARCH * reach if far else reach) + _FILM_MM * scale
        return read_band(scan, *ends, beside, beside + 8, wide=wide) if guess.supported[k] else None

    shape = options.shape
    if shape is None or guess.format_mm != (shape.width, shape.height):
        shape = FrameShape(*guess.format_mm, options.aspect_sigma, float(np.deg2rad(options.angle_sigma_deg)))
    forms = curves_of(scan.curve, _full_scale(scan, band), guess.polarity)
    best: FrameResult | None = None
    earlier: list[Channel] = []
    for c in channels_by_contrast([band(k, False) for k in range(4)], len(scan.channels), reach):
        name = scan.channels[c]
        measured = measure_channel(
            name, band, c, guess.polarity, reach, _GAP_MM * scale, forms, options.curves
        )
        for other in earlier:
            measured = measured.doubted(other)
        earlier.append(measured)
        result = replace(_judged(scan, guess, measured, corners, shape, options), curves=measured.curves)
        # Channels are ordered by contrast: a later one must show more edges, or more accurate ones.
        if best is None or _seen(result) > _seen(best):
            best = result
        if best.status == "oriented" and not best.why:
            break  # other channels show the same edges with less contrast
    assert best is not None
    return replace(best, place=corners, formats=tuple(formats))


def _full_scale(scan: Scan, band: Callable[[int, bool], Band | None]) -> float:
    """Grey value of full scale: numbers in floating point may be those of 8 or 16 bits."""
    if scan.dtype.kind != "f":
        return scan.full_scale
    seen = (band(k, False) for k in range(4))
    top = max((float(np.nanmax(each.grey)) for each in seen if each is not None), default=1.0)
    return next((most for most in (1.0, 255.0, 65535.0) if top < 2 * most), top)


def _candidates(curves: CurveEvidence | None) -> tuple[CurveCandidate, ...]:
    """The curves of the grey values that are probable; none if these are only proportional to the light."""
    if curves is None:
        return ()
    order = [int(k) for k in np.argsort(-curves.share, kind="stable") if curves.share[k] > _STATED[0]]
    return tuple(
        CurveCandidate(what=CURVES[k][0], probability=float(curves.share[k]), moved_px=float(curves.moved[k]))
        for k in order
        if order != [0]
    )


def _seen(result: FrameResult) -> tuple[int, float]:
    """Rank of a result: status, then accuracy of its worst corner."""
    lines = result.lines
    return _STATUS[result.status], -np.inf if lines is None else -float(np.diag(lines.covariance).max())


def _resolution(scan: Scan, options: FrameOptions, size: tuple[float, float]) -> float | None:
    """Pixels per millimetre that are given, or stated in the file if they can be those of the scan.

    A camera states a number that has nothing to do with the film: a frame of that resolution would be far
    smaller than its picture, or larger, whichever way it lies in the scan.
    """
    if options.dpi is not None:
        return options.dpi / 25.4
    if scan.dpi is None:
        return None
    long, short = sorted((scan.width, scan.height), reverse=True)
    share = max(max(size) / long, min(size) / short) * scan.dpi / 25.4
    return scan.dpi / 25.4 if _FITS[0] < share < _FITS[1] else None


def _unproven(
    scan: Scan,
    lines: Lines,
    measured: Channel,
    missing: int,
    shape: FrameShape,
    options: FrameOptions,
) -> str:
    """Why three edges are not those of a frame; empty if they are.

    Any three lines of a picture make a frame with a fourth edge that nobody sees. That edge must lie where
    the given corners are; or outside a scan of which the frame covers a large part, or where the resolution
    of the scan puts it, and then the two edges that end there must be seen up to it.
    """
    corners = lines.corners
    ends = corners[[missing, (missing + 1) % 4]]
    if options.near is not None:
        away = np.abs(ends - options.near[[missing, (missing + 1) % 4]]).max()
        return "" if away < _NEAR * np.ptp(options.near) else "the given corners are elsewhere"
    known = _resolution(scan, options, (shape.width, shape.height))
    last = np.array([scan.width, scan.height]) - 1.0
    within = ((ends > 0) & (ends < last)).all(axis=1)
    if within.any():
        if known is None:
            return "without it three lines are no frame; give --dpi, or scan it with more contrast"
        opposite = float(np.hypot(*(corners[(missing + 3) % 4] - corners[(missing + 2) % 4])))
        off = opposite / (known * (shape.height if missing % 2 else shape.width)) - 1
        if abs(off) > _AGREES:
            return f"the edge opposite to it is {100 * abs(off):.1f} % off the resolution of the scan"
    left = []
    for k, towards in (((missing + 1) % 4, -1), ((missing - 1) % 4, 1)):
        data = measured.data[k]
        assert data is not None
        start, stop = (corners[k], corners[(k + 1) % 4])[::towards]
        place = (data.xy - start) @ (stop - start) / ((stop - start) @ (stop - start))
        t = np.linspace(0, 1, 400)
        at = start + t[:, None] * (stop - start)
        end = float(t[((at > 0) & (at < last)).all(axis=1)].max(initial=0.0))
        left.append(start + end * (stop - start))
        parts = np.unique(np.floor(place[(place > 0) & (place < end)] / max(end, 0.1) * _SAMPLES))
        if place.max() < (1 - _REACHED) * end or len(parts) < _SEEN * _SAMPLES:
            return f"the {EDGES[k]} edge is not seen up to it"
    x, y = np.clip(corners, 0, last).T
    covered = float(np.abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 / np.prod(last))
    if known is None and covered < _COVERED:
        return (
            f"the lines enclose only {100 * covered:.0f} % of the scan; give --dpi or the approximate corners"
        )
    if not within.all() and not _cut(scan, measured, *left):
        return "the scan shows unexposed film there, not the picture"
    return ""


def _cut(scan: Scan, measured: Channel, first: Array, second: Array) -> bool:
    """Whether picture lies at the border of the scan between two edges that leave it."""
    borders = [border for border in measured.borders if border is not None]
    film = float(np.median(np.concatenate([border.level for border in borders])))
    least = max(
        _LEAST_TONE * float(np.median([border.contrast for border in borders])),
        4 * float(np.median([border.spread for border in borders])),
    )
    size = np.array([scan.width, scan.height])
    t = np.linspace(0.05, 0.95, 60)[:, None]
    at = np.clip(np.rint(first + t * (second - first)), 3, size - 4).astype(int)
    tones = [
        np.mean(scan.window(y - 2, y + 3, x - 2, x + 3)[:, :, measured.number]) * measured.polarity
        for x, y in at
    ]
    return bool(np.mean(np.array(tones) - film > least) > _LEAST_CUT)


def _judged(
    scan: Scan,
    guess: FrameGuess,
    measured: Channel,
    corners: Array,
    shape: FrameShape,
    options: FrameOptions,
) -> FrameResult:
    """Adjust the edges found; decline the frame if they contradict the format."""
    missing = [EDGES[k] for k in range(4) if measured.data[k] is None]
    base = FrameResult(scan.name, "declined", "", guess.format_mm, measured.name, None, {})
    if len(missing) > 1:
        why = "; ".join(f"{EDGES[k]} edge: {measured.why[k]}" for k in range(4) if measured.why[k])
        return replace(base, why=why, edges=_reports(measured, None), code=Code.NOT_FOUND)
    lines = adjust_lines(corners, measured.data, shape, measured.rejected)
    if isinstance(lines, Failure):
        return replace(base, why=lines.reason, edges=_reports(measured, None), code=lines.code)
    (w, h), slant, code = guess.format_mm, "", None
    known = _resolution(scan, options, guess.format_mm)
    contenders, tilted = ([], 0.0) if missing else explained_shape(corners, measured.data, shape, known)
    another = sum(each.probability for each in contenders)
    if tilted > _MORE_PROBABLE and (seen := _slanted(corners, measured, shape)):
        lines, code = seen[0], Code.TILTED
        slant = f"seen at an angle: opposite edges converge by {np.rad2deg(seen[1]):.1f}°"
    elif another > _STATED[0]:
        measured = measured.contended(contenders)
        again = adjust_lines(corners, measured.data, shape, measured.rejected)
        lines = lines if isinstance(again, Failure) else again
    base = replace(base, lines=lines, edges=_reports(measured, lines), why=slant, code=code)
    if another > _MORE_PROBABLE:
        lie = " or the ".join(str(each) for each in contenders if each.probability > _STATED[0])
        return replace(
            base,
            lines=None,
            why=f"the four edges do not form a frame of {w:g}x{h:g} mm; another line is the {lie}; give the "
            "approximate corners, or the correct --format-mm",
            code=Code.INCONSISTENT,
        )
    if missing:
        reason = measured.why[EDGES.index(missing[0])]
        if doubt := _unproven(scan, lines, measured, EDGES.index(missing[0]), shape, options):
            why = f"{missing[0]} edge: {reason}; {doubt}"
            return replace(base, lines=None, why=why, code=Code.EDGE_MISSING)
        why = f"{missing[0]} edge: {reason}; its position follows from the format"
        return replace(base, status="three-edges", why=why, code=Code.EDGE_MISSING)
    own = float(np.mean(base.px_per_mm or (1.0, 1.0)))
    if known is not None and abs(own / known - 1) > _AGREES:
        w, h = (side * own / known for side in guess.format_mm)
        what = f"at the {25.4 * known:.0f} dpi of the scan it has {w:.2f} mm × {h:.2f} mm"
        if abs(own / known - 1) > _CONTRADICTS:
            why = f"{what}, which is not the format; give the correct --format-mm or --dpi"
            return replace(base, lines=None, why=why, code=Code.INCONSISTENT)
        # The opening of a mount hides the edges of the frame and is smaller: its size gives no scale.
        why = "; ".join(
            part for part in (base.why, f"{what}: the opening of a mount? The scale is that") if part
        )
        why += " of the scan, not of the format"
        return replace(base, status="oriented", why=why, code=Code.UNEQUAL_SCALES, resolution=known)
    return replace(
        base, status="oriented", why="; ".join([base.why] * bool(base.why) + _doubts(measured, lines))
    )


def _doubts(measured: Channel, lines: Lines) -> list[str]:
    """What else the edges may be, with probabilities, and edges that are not straight."""
    least, said = _STATED[1] * float(np.sqrt(np.diag(lines.covariance)).max()), []
    for name, data in zip(EDGES, measured.data, strict=True):
        if data is not None and data.departs > max(least, measured.width):
            said.append(
                f"the {name} edge departs from an evenly bowed line by {data.departs:.2g} px; hold the film "
                "flat and parallel to the sensor"
            )
        rival = None if data is None else data.rival
        if rival is None or rival.probability < _STATED[0]:
            continue
        if np.sqrt(rival.probability) * abs(rival.moved_px) > least:
            said.append(f"{name} edge: {rival}")
    return said


def _slanted(corners: Array, measured: Channel, shape: FrameShape) -> tuple[Lines, float] | None:
    """Four edges as seen by a tilted copying camera, and the convergence of opposite edges, radians."""
    free = replace(shape, angle_sigma=_SLANT, aspect_sigma=3 * shape.aspect_sigma)
    lines = adjust_lines(corners, measured.data, free, measured.rejected)
    if isinstance(lines, Failure):
        return None
    ur, lr, ll, _ = shape_of(lines.corners, shape) - np.array(shape.deviation)
    return lines, float(max(abs(ur + lr), abs(lr + ll)))


def _reports(measured: Channel, lines: Lines | None) -> dict[str, MeasuredEdge]:
    reports = {}
    for k, name in enumerate(EDGES):
        found = measured.data[k] is not None
        # An insignificant bow is reported as zero.
        bow = 0.0
        if lines is not None and found and abs(lines.bow[k]) > 3 * lines.bow_sigma[k]:
            bow = float(lines.bow[k])
        reports[name] = MeasuredEdge(
            found=found,
            points=int(lines.used[k]) if lines is not None and found else 0,
            rejected=int(lines.rejected[k]) if lines is not None else measured.rejected[k],
            rms_px=float(lines.rms[k]) if lines is not None and np.isfinite(lines.rms[k]) else None,
            curvature_px=bow if found else None,
            why=measured.why[k],
            rival=_rival(measured.data[k]),
        )
    return reports


def _rival(data: EdgeData | None) -> RivalEdge | None:
    if data is None or data.rival is None:
        return None
    rival = data.rival
    return RivalEdge(what=rival.what, probability=rival.probability, moved_px=rival.moved_px)
