"""Learn marks from one example: their images in a scan become the models by which others are measured.

Where the rest of the camera's marks lies shows the scale of the scan and how the film lies in it; no
resolution is needed. The point of a mark that looks the same when it is turned is its centre of symmetry;
that of another one is the place that was given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ...core.overlaid import Overlaid
from ...io import FiducialDesign, FiducialMark, LearntMark
from ...io.scans import Scan
from ..matching import Matches, match
from ..matching.patches import MatchOptions
from .forms import reach_of
from .learnt import OWN_PSF, LearntShape
from .search import (
    Attitude,
    Candidates,
    Pattern,
    attitudes,
    find_patterns,
    least_scales,
    odds_of_same,
    overview_size,
    same_places,
    turned,
)
from .windows import grey_window, quiet

if TYPE_CHECKING:
    from ...core.overlay import Layer

_CLICK_PX = float(np.sqrt(1 / 12))
"""Standard deviation of a place that is given to the pixel."""
_AIM_PX = 3.0
"""Largest distance of a centre of symmetry from the place that was given for it, one sigma."""
_RIM = 0.85
"""Share of the radius beyond which the surroundings of a mark are seen."""
_WITHIN, _STEP = 0.09, 0.16
"""Relative uncertainty of a scale that is tried, and distance to the next."""


@dataclass(frozen=True, eq=False)
class LearntDesign(Overlaid):
    """A camera with marks that were learnt.

    Parameters
    ----------
    design : FiducialDesign
        The camera; its marks are images.
    pattern : Pattern
        The marks in the example, in pixels of the scan.
    folds : dict of str to int
        For each kind in how many positions it looks the same when it is turned; 1 if in one.
    others : tuple of Attitude
        Other ways in which the film of the example may lie: the places that were given do not tell.

    Examples
    --------
    >>> from reseau.measure.fiducials.search import Attitude
    >>> pattern = Pattern(Attitude(0, False), np.eye(2), np.zeros(2), np.zeros((4, 2)), np.ones(4))
    >>> from reseau.designs import aerial_camera
    >>> LearntDesign(aerial_camera("wild-rc8"), pattern, {"cross": 4}).folds
    {'cross': 4}
    """

    design: FiducialDesign
    pattern: Pattern
    folds: dict[str, int]
    others: tuple[Attitude, ...] = ()

    def lines(self) -> list[str]:
        """What was learnt: one line for each kind, and one for the scan."""
        scale = 25.4 * float(np.sqrt(abs(np.linalg.det(self.pattern.linear))))
        seen = int(np.isfinite(self.pattern.xy).all(axis=1).sum())
        lines = [f"{seen} of {len(self.design.points)} marks, {self.pattern.attitude}, about {scale:.0f} dpi"]
        for name, folds in self.folds.items():
            mark = self.design.marks[name]
            assert mark.learnt is not None
            at = float(np.sqrt(max(mark.learnt.covariance[:2])))
            how = (
                f"its centre of symmetry (the same in {folds} positions)" if folds > 1 else "the place given"
            )
            lines.append(f"{name}: a {mark.polarity} mark, measured at {how}, ± {at:.2g} px")
        if self.others:
            names = ", ".join(map(str, self.others))
            lines.append(f"note: the film may also lie {names}; give the places of three marks to decide")
        return lines

    def layers(self) -> list[Layer]:
        """What is drawn over the scan: marks that look like those that were learnt, and outlines of these."""
        from ...core.overlay import Layer

        xy, names = self.pattern.xy, self.design.ids
        radius = float(np.sqrt(abs(np.linalg.det(self.pattern.linear))))
        turn = np.linspace(0, 2 * np.pi, 73)
        circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        paths = [
            at + radius * reach_of(self.design.marks[point.mark]) * circle
            for at, point in zip(xy, self.design.points, strict=True)
            if np.isfinite(at).all()
        ]
        return [Layer(f"seen, {len(paths)}, in circles of what was learnt", xy, names, paths=paths)]

    def _heading(self) -> str:
        return f"marks of {self.design.name}"

    def _footnotes(self) -> list[str]:
        return self.lines()


def learn_marks(
    scan: Scan, design: FiducialDesign, places: Mapping[str, tuple[float, float]], mark_px: float
) -> LearntDesign | Failure:
    """Replace kinds of marks of a camera by their images in a scan.

    Parameters
    ----------
    scan : Scan
        The example.
    design : FiducialDesign
        The camera: coordinates of its marks, and which of them are of one kind.
    places : mapping of str to (float, float)
        For each kind that is to be learnt the name of one of its marks, and where this lies, in pixels. More
        marks of a kind tell how the film lies.
    mark_px : float
        Diameter of a mark with its even surroundings, pixels.

    Returns
    -------
    LearntDesign or Failure
        A failure if the marks do not recur in the scan as the design says.

    Raises
    ------
    UsageError
        When a name is not in the design, a place is not in the scan, or the diameter is not from 8 to
        900 px.

    Examples
    --------
    >>> from reseau.io import FiducialMark, FiducialPoint, MarkPart
    >>> from reseau.io.scans import scan_of
    >>> rng = np.random.default_rng(0)
    >>> grey = 40 + rng.normal(0, 2, (400, 500))
    >>> places = np.array([[50, 350], [450, 350], [450, 50], [50, 50]])
    >>> for x, y in places:
    ...     grey[y - 8 : y + 9, x - 2 : x + 3] += 100
    ...     grey[y - 2 : y + 3, x - 8 : x + 9] += 100
    >>> dot = FiducialMark(polarity="bright", parts=(MarkPart(shape="disk", size=1.0),))
    >>> camera = {"1": (-40, -30), "2": (40, -30), "3": (40, 30), "4": (-40, 30)}
    >>> points = tuple(FiducialPoint(id=k, x=x, y=y, mark="plus") for k, (x, y) in camera.items())
    >>> design = FiducialDesign(name="camera", marks={"plus": dot}, points=points)
    >>> found = learn_marks(scan_of(grey.astype(np.uint8)), design, {"1": (51, 349)}, 30)
    >>> found.folds, round(found.design.marks["plus"].learnt.px_per_mm, 1)
    ({'plus': 4}, 5.0)
    """
    if not 8 <= mark_px <= 900:
        raise UsageError(f"is {mark_px:g} px, not from 8 to 900", where="size of marks")
    rows = _rows(scan, design, places)
    images = {k: _example(scan, np.array(places[design.ids[k]]), mark_px / 2) for k in rows}
    for k, image in images.items():
        if isinstance(image, Failure):
            return Failure(f"{design.ids[k]}: {image.reason}", image.code, places=image.places)
    learnt = {k: image for k, image in images.items() if not isinstance(image, Failure)}
    known = {design.ids.index(name): np.array(place) for name, place in places.items()}
    fits = _placed(scan, design, learnt, known | {k: image.place for k, image in learnt.items()})
    if not fits:
        return Failure(
            f"the marks of {design.name!r} do not recur where its coordinates say; check the places, the "
            "kinds of marks and their rotations in the design",
            Code.NOT_FOUND,
        )
    placed, *rest = fits
    folds = {design.points[k].mark: image.folds for k, image in learnt.items()}
    others = tuple(each.attitude for each in rest if same_places(each, placed))
    return LearntDesign(_with_images(design, learnt, placed.linear), placed, folds, others)


def _rows(scan: Scan, design: FiducialDesign, places: Mapping[str, tuple[float, float]]) -> list[int]:
    """Indices of the marks from which kinds are learnt."""
    kinds: dict[str, str] = {}
    for name, (x, y) in places.items():
        if name not in design.ids:
            raise UsageError(f"has no mark {name!r}", where=design.name, do=f"it has {', '.join(design.ids)}")
        if not (0 <= x < scan.width and 0 <= y < scan.height):
            raise UsageError(f"mark {name}: ({x:g}, {y:g}) is outside the scan", where=scan.name)
        kinds.setdefault(design.points[design.ids.index(name)].mark, name)
    return [design.ids.index(name) for name in kinds.values()]


@dataclass(frozen=True, eq=False)
class _Example:
    """The image of a mark (h, w) over its contrast, and its point (2,) there and in the scan."""

    values: Array
    at: Array
    cov: Array
    place: Array
    bright: bool
    reach: float
    noise: float
    folds: int
    source: str

    def learnt(self, linear: Array) -> LearntMark:
        """As the design keeps it; `linear` is from the plane of the mark to pixels."""
        (a, b), (c, d) = linear.tolist()
        return LearntMark(
            values=tuple(tuple(row) for row in np.rint(1000 * self.values).astype(int).tolist()),
            at=(float(self.at[0]), float(self.at[1])),
            covariance=(float(self.cov[0, 0]), float(self.cov[1, 1]), float(self.cov[0, 1])),
            linear=((a, b), (c, d)),
            reach=self.reach,
            noise=1000 * self.noise,
            source=self.source,
        )

    def mark(self, linear: Array) -> FiducialMark:
        """As :meth:`learnt`, as a kind of mark."""
        return FiducialMark(polarity="bright" if self.bright else "dark", learnt=self.learnt(linear))


def _example(scan: Scan, place: Array, reach: float) -> _Example | Failure:
    """The image of a mark around an approximate place, and the point that it is measured at."""
    seen = _image(scan, np.rint(place), reach)
    found = None if isinstance(seen, Failure) else _symmetry(scan, seen, place)
    if found is not None:  # the image is taken again around the centre of symmetry
        seen = _image(scan, np.rint(found[1]), reach)
        found = None if isinstance(seen, Failure) else _symmetry(scan, seen, found[1])
    if isinstance(seen, Failure):
        return seen
    folds, place, cov = found or (1, place, _CLICK_PX**2 * np.eye(2))
    off = place - seen.place
    at, left = seen.at + off, reach - float(np.hypot(*off))
    values, noise = _averaged(seen.values, at, folds), seen.noise / np.sqrt(folds)
    return replace(seen, values=values, at=at, cov=cov, place=place, reach=left, noise=noise, folds=folds)


def _averaged(values: Array, at: Array, folds: int) -> Array:
    """Mean of an image (h, w) and of itself, turned about its centre of symmetry."""
    y, x = np.mgrid[: len(values), : values.shape[1]].astype(np.float64)
    off = np.stack([x, y], axis=-1) - at
    each = [values]
    for i in range(1, folds):
        places = off @ turned(360.0 * i / folds).T + at
        each.append(scipy.ndimage.map_coordinates(values, np.moveaxis(places, -1, 0)[::-1], order=3))
    return np.asarray(np.mean(each, axis=0))


def _image(scan: Scan, centre: Array, reach: float) -> _Example | Failure:
    """Grey values above a plane through the surroundings, in units of the contrast."""
    half = int(np.ceil(reach)) + 1
    grey, inside, _ = grey_window(scan, centre, half, 1)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    r = np.hypot(x, y)
    if not inside[r <= reach].all():
        return Failure("the window around it leaves the scan", Code.OUTSIDE, places=centre[None])
    design = np.stack([np.ones_like(x), x, y], axis=-1)
    rim = (r > _RIM * reach) & (r <= reach)
    weight = np.ones(int(rim.sum()))
    for _ in range(5):  # a robust plane: lines of a picture may cross the rim
        plane = np.linalg.lstsq(design[rim] * weight[:, None], grey[rim] * weight, rcond=None)[0]
        off = grey[rim] - design[rim] @ plane
        spread = max(1.4826 * float(np.median(np.abs(off))), 1e-6)
        weight = 1 / np.maximum(1.0, np.abs(off) / (2 * spread))
    above = np.where(r <= reach, grey - design @ plane, 0.0)
    smooth = scipy.ndimage.gaussian_filter(above, 1.0)
    low, high = float(smooth.min()), float(smooth.max())
    contrast = high if high > -low else low
    if abs(contrast) < 5 * max(quiet(grey, inside), 1e-6):
        return Failure("nothing there stands out from its surroundings", Code.NOT_FOUND, places=centre[None])
    at = np.array([half, half], dtype=np.float64)
    none = np.zeros((2, 2))
    return _Example(
        above / contrast, at, none, centre, contrast > 0, reach, spread / abs(contrast), 1, scan.name
    )


def _symmetry(scan: Scan, seen: _Example, place: Array) -> tuple[int, Array, Array] | None:
    """Positions in which a mark looks the same when it is turned, its centre (2,) with covariance, or None.

    The image is matched with itself, turned by half a turn, a third, or a quarter. Two explanations of the
    difference τ, beyond noise, of a mark from itself: it is made unevenly, τ = 5 % of the contrast; or it is
    another figure, and any τ up to the whole contrast is as probable.
    """
    grey, inside, first = grey_window(scan, seen.place, int(seen.at[0]), 1)
    mark = np.abs(scipy.ndimage.gaussian_filter(seen.values, 1.0)) > 0.1
    for folds in (4, 3, 2):
        turn = turned(360.0 / folds)
        matched = _turned_match(grey, inside, seen, turn, place - first)
        if not matched.converged[0]:
            continue
        contrast = abs(float(matched.contrast[0])) * (1.0 if seen.bright else float(matched.level[0]))
        used = np.isfinite(matched.residuals[0])
        off = np.where(used, matched.residuals[0], 0.0) / max(contrast, 1e-9)
        on, beside = used & mark, used & ~mark
        if not (on.any() and beside.any()):
            continue
        whole = float(np.sqrt((seen.values[on] ** 2).mean()))
        tau = float(np.sqrt(max((off[on] ** 2).mean() - (off[beside] ** 2).mean(), 0.0)))
        to = np.linalg.inv(np.eye(2) - turn)
        point = to @ (matched.xy[0] - turn @ seen.at) + first
        away = float(((point - place) ** 2).sum()) / (2 * _AIM_PX**2)
        if odds_of_same(tau, whole) * np.exp(-away) > 1:
            return folds, point, to @ matched.cov[0] @ to.T
    return None


def _turned_match(grey: NDArray[Any], inside: Mask, seen: _Example, turn: Array, near: Array) -> Matches:
    """Match of the window of a mark with its own image, turned about the middle of the window."""
    mark = seen.learnt(np.eye(2))
    shape = LearntShape(mark, turn, np.array([1e-4, 1e-4]))
    half = int(seen.at[0])
    # The image, turned about its middle, lies where its centre of symmetry moves to.
    start = near - turn @ (near - seen.at)
    options = MatchOptions(
        half_px=half,
        psf_log_sigma=0.05,
        psf_px=OWN_PSF,
        polarity="bright" if seen.bright else "dark",
        start_px=1.0,
        influence=True,
        background=1,
        within_px=seen.reach - 3.0,
    )
    level = max(seen.noise * float(np.ptp(grey)), 1e-3)
    return match(
        grey.astype(np.float32), inside, shape, start[None], options, noise=level, form_sigma=np.ones(2)
    )


def _placed(
    scan: Scan, design: FiducialDesign, learnt: dict[int, _Example], places: dict[int, Array]
) -> list[Pattern]:
    """Patterns of the marks in the example, in pixels of the scan, the best of each attitude at any scale."""
    low, high = least_scales(design, (scan.width, scan.height))
    steps = max(1, int(np.ceil(np.log(high / low) / np.log(1 + _STEP))))
    grid = np.geomspace(high, low, steps + 1)
    best: dict[Attitude, Pattern] = {}
    seen: dict[int, Candidates] = {}
    for scale in ((grid[1:] + grid[:-1]) / 2).tolist():
        for attitude in attitudes(None, None):
            own = _with_images(design, learnt, scale * attitude.matrix)
            size = overview_size(scan, own, scale)
            if size not in seen:
                seen[size] = Candidates.of_scan(scan, size)
            candidates, reduction = seen[size], seen[size].reduction
            known = {k: (place + 0.5) / reduction - 0.5 for k, place in places.items()}
            found = find_patterns(
                candidates, own, scale / reduction, _WITHIN, [(attitude, False)], 8.0, known
            )
            for pattern in found:
                if np.isnan(pattern.xy[list(known)]).any():
                    continue  # it explains the others only
                if attitude not in best or pattern.score > best[attitude].score:
                    best[attitude] = Pattern(
                        attitude,
                        reduction * pattern.linear,
                        (pattern.shift + 0.5) * reduction - 0.5,
                        (pattern.xy + 0.5) * reduction - 0.5,
                        pattern.likeness,
                    )
    return sorted(best.values(), key=lambda each: -each.score)


def _with_images(design: FiducialDesign, learnt: dict[int, _Example], linear: Array) -> FiducialDesign:
    """The design with images for marks; `linear` is from camera coordinates to pixels of the example."""
    marks = dict(design.marks)
    for k, image in learnt.items():
        marks[design.points[k].mark] = image.mark(linear @ turned(design.points[k].turn_deg))
    return design.model_copy(update={"marks": marks})
