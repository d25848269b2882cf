r"""Motion during the exposure, and other physical reasons of blur that compete for a photograph.

Relative to the camera the targets move as a rigid body, or with the small twist ξ (rotation vector and
translation) by ξ × P. Two ways in time τ, from −1 to 1 during the exposure, are modelled:

- a *path* ξ(τ) = τ a + τ² b, straight and even without b, otherwise accelerated or curved;
- a *vibration* ξ(τ) = cos(πτ) a + sin(πτ) b of one period or more, along a line without b.

The coordinate is that of the mean time τ = 0 of a path, and that of the place of rest of a vibration. Where
the lines of a sensor are exposed one after the other, it is that of the mean time of the line on which it
lies. A photograph tells neither the direction of time nor, of a vibration, its phase.

Explanations are compared by the likelihood of all pixels of the targets, each parameter at the price of
Schwarz (1978, *Annals of Statistics* 6, 461). They grow by one thing at a time while something is left that
none of them explains.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeAlias

import numpy as np

from ...core.data import Array, Frame
from ...core.failure import Code, Failure, Remark
from ...optics.lenses import PupilElements, RayMap
from ...optics.lenses.images import PlaneTarget, ray_images
from .estimate import EstimatedOptics, estimate_optics
from .measure import RINGS, BlurredOptions, BlurredResult, Run, Varied, measure_blurred

_APART_PX = 0.6
"""Largest distance between places of a moving image: smaller than what blurs beside it (pixel and sensor)."""
_PRIOR_PX = 5.0
"""Standard deviation of an amplitude: motions are pixels, rather than hundreds of them."""
_STARTS_PX = (1.0, 2.5, 6.0)
"""Amplitudes from which an estimate begins; at rest no direction is better than another."""
_DIRECTIONS = 4
_OF_LENS = {"focus": 0.2, "stop": 0.2}
"""Standard deviations of what a lens may have another of: the place of its image surface, mm, and the
logarithm of the radius of its stop."""
_MOST, _FEW = 8, 3
"""Targets by which explanations are compared, and by which approximate values are found."""
_COARSE = 2
"""Rings of elements of the stop for these."""
_STEP_RAD, _STEP_MM = 1e-5, 1e-3
"""Steps of twists for their derivatives."""
Altered: TypeAlias = Callable[[RayMap, float, float], RayMap]
"""A lens with its image surface moved by millimetres and another stop, see :func:`explained`."""


@dataclass(frozen=True, eq=False)
class Motion:
    """How targets move relative to the camera.

    Parameters
    ----------
    first, second : ndarray (6,)
        Twists: rotation vector (rad) and translation (mm), in camera axes.
    vibration : bool
        Whether they are those of cos(πτ) and sin(πτ), rather than of τ and τ².
    per_line : float
        Time between the exposures of adjacent lines, in halves of the exposure; 0 if all are exposed at once.
    middle : float
        Line that is exposed at the time 0.

    Examples
    --------
    >>> motion = Motion(np.array([0, 0.001, 0, 0, 0, 0]), np.zeros(6))
    >>> motion.moved(np.array([[0.0, 0.0, 1000.0]]), np.array([[0.0], [1.0]]))[:, 0].round(6).tolist()
    [[0.0, 0.0, 1000.0], [1.0, 0.0, 1000.0]]
    """

    first: Array
    second: Array
    vibration: bool = False
    per_line: float = 0.0
    middle: float = 0.0

    def moved(self, points: Array, time: Array) -> Array:
        """Points (m, n, 3) in camera axes of points (n, 3) at times (m, n) or (m, 1)."""
        if self.vibration:
            by = np.cos(np.pi * time)[..., None] * self.first + np.sin(np.pi * time)[..., None] * self.second
        else:
            by = time[..., None] * self.first + time[..., None] ** 2 * self.second
        return np.asarray(points + np.cross(by[..., :3], points) + by[..., 3:])


@dataclass(frozen=True, eq=False)
class Moving:
    """A map of rays during whose exposure the targets move.

    Parameters
    ----------
    camera : RayMap
    motion : Motion
    steps : int
        Parts of the exposure whose images are added.

    Examples
    --------
    >>> from reseau.optics.lenses import ThinLens
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> still = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (0.0, 0.0)))
    >>> moving = Moving(still, Motion(np.array([0, 0.0004, 0, 0, 0, 0]), np.zeros(6)), 9)
    >>> moving.spots(np.array([[0.0, 0.0, 1000.0]]), PupilElements.gauss(2))[0].shape
    (9, 1, 5, 2)
    >>> round(moving.extent_px(np.array([[0.0, 0.0, 1000.0]])), 2)
    4.16
    """

    camera: RayMap
    motion: Motion
    steps: int

    @property
    def unknown(self) -> float:
        """See :class:`reseau.optics.lenses.RayMap`."""
        return self.camera.unknown

    def corresponding(self, points: Array) -> Array:
        """See :class:`reseau.optics.lenses.RayMap`: at the mean time of the line on which they lie."""
        if not self.motion.per_line or self.motion.vibration:
            return self.camera.corresponding(points)
        return np.asarray(self._at(points, np.zeros((1, 1)))[0])

    def spots(self, points: Array, elements: PupilElements) -> tuple[Array, Array]:
        """See :class:`reseau.optics.lenses.RayMap`."""
        time, share = self._times()
        away = self._at(points, time[:, None]) - self.camera.corresponding(points)
        # A part of the elements at each place, others at the next: those of all places together are dense.
        xy, light = self.camera.spots(points, elements)
        parts = next(n for n in (4, 3, 2, 1) if len(elements.xy) % n == 0)
        found = []
        for k, (step, part) in enumerate(zip(away, share, strict=True)):
            some = slice(k % parts, None, parts)
            part = part * elements.weights.sum() / elements.weights[some].sum()
            found.append((xy[:, :, some] + step[:, None], light[:, :, some] * part))
        return np.concatenate([xy for xy, _ in found]), np.concatenate([light for _, light in found])

    def extent_px(self, points: Array) -> float:
        """Return the largest way of the image of points (n, 3) during the exposure, pixels."""
        way = self._at(points, np.linspace(-1, 1, 33)[:, None])
        return float(np.nanmax(np.hypot(*np.moveaxis(np.diff(way, axis=0), -1, 0)).sum(axis=0)))

    def _times(self) -> tuple[Array, Array]:
        """Times (m,) whose images are added, and their shares: Gauss's quadrature, or equal parts."""
        if self.motion.vibration:
            return np.arange(1 - self.steps, self.steps, 2) / self.steps, np.full(self.steps, 1 / self.steps)
        time, weight = np.polynomial.legendre.leggauss(self.steps)
        return time, weight / 2

    def _at(self, points: Array, time: Array) -> Array:
        """Pixels (m, n, 2) of points (n, 3) at times (m, 1) of the exposure of each line."""
        late: Array = np.zeros((1, len(points)))
        if self.motion.per_line:
            late = self.motion.per_line * (self.camera.corresponding(points)[None, :, 1] - self.motion.middle)
        moved = self.motion.moved(points, time + late)
        pixels = self.camera.corresponding(moved.reshape(-1, 3))
        return np.asarray(pixels.reshape(len(moved), len(points), 2))


@dataclass(frozen=True)
class Kind:
    """What an explanation of the blur of a frame contains beside the lens.

    Parameters
    ----------
    lens : tuple of str
        ``focus``: another place of the image surface; ``stop``: another radius of the stop.
    way : {"", "path", "vibration"}
    degree : int
        Of the motion: along one direction, or two.
    twists : int
        2 if the whole image moves alike, 6 if its parts move as those of a rigid body.

    Examples
    --------
    >>> Kind(way="path").parameters, [kind.lens or kind.way for kind in Kind().larger(True)]
    (2, [('focus',), ('stop',), 'path', 'vibration'])
    """

    lens: tuple[str, ...] = ()
    way: Literal["", "path", "vibration"] = ""
    degree: int = 1
    twists: int = 2

    @property
    def parameters(self) -> int:
        """Their number."""
        return len(self.lens) + (self.degree * self.twists if self.way else 0)

    def larger(self, lens: bool) -> list[Kind]:
        """Return explanations with one thing more; of the lens only if it is in question."""
        more = [name for name in _OF_LENS if lens and name not in self.lens]
        found = [replace(self, lens=(*self.lens, name)) for name in more]
        if not self.way:
            return [*found, replace(self, way="path"), replace(self, way="vibration")]
        # What looks like one way along a line may be a part of the other.
        found += (
            [replace(self, way=way, degree=2) for way in ("path", "vibration")] if self.degree == 1 else []
        )
        return found + ([replace(self, twists=6)] if self.twists == 2 else [])


@dataclass(frozen=True, eq=False)
class Explained:
    """A frame whose blur is explained by more than its lens.

    Parameters
    ----------
    kind : Kind
    optics : EstimatedOptics
        With the map of rays that contains it.
    extent_px : float
        Largest way of an image during the exposure.
    altered : callable, optional
        See :func:`explained`.
    """

    kind: Kind
    optics: EstimatedOptics
    extent_px: float
    altered: Altered | None = None

    def on(self, camera: RayMap) -> RayMap:
        """Return the map of rays of another estimate of the orientation, with the same explanation."""
        view, camera = self.optics.camera, _altered(camera, self.kind, self.optics.values, self.altered)
        return replace(view, camera=camera) if isinstance(view, Moving) else camera

    def told(self, found: BlurredResult) -> BlurredResult:
        """Return what was measured with it, with what is said of it, and with its uncertainty."""
        # Errors of common parameters displace all targets about alike.
        shift = np.mean(list(self.optics.shifts.values()), axis=0)
        cov = found.cov + shift.T @ self.optics.cov @ shift
        return replace(found, cov=cov, notes=(*self._said(), *found.notes))

    def _said(self) -> list[Remark]:
        kind, optics, said = self.kind, self.optics, []
        if kind.way:
            rest = kind.way == "vibration"
            how, when = ("vibrated", "rest") if rest else ("moved", "the mean time of the exposure")
            over = f"the image {how} over {self.extent_px:.2g} px during the exposure"
            said.append(Remark(f"{over}: coordinates are those at {when}", Code.BLURRED))
        for name, value, sigma in zip(kind.lens, optics.values.tolist(), optics.sigma.tolist(), strict=False):
            said.append(focus_remark(value, sigma) if name == "focus" else _stop_remark(value, sigma))
        return said


def focus_remark(by_mm: float, sigma_mm: float) -> Remark:
    """Return what is said of an estimated focus."""
    text = f"the focus was estimated: {by_mm:.4f} ± {sigma_mm:.4f} mm behind the stated image surface"
    return Remark(text, Code.BLURRED)


def _altered(camera: RayMap, kind: Kind, values: Array, by: Altered | None) -> RayMap:
    """A lens with what it has another of, the first of the values of an explanation."""
    if not kind.lens or by is None:
        return camera
    known = dict(zip(kind.lens, values.tolist(), strict=False))
    return by(camera, known.get("focus", 0.0), known.get("stop", 0.0))


def _stop_remark(log: float, sigma: float) -> Remark:
    percent, error = 100 * np.expm1(log), 100 * np.exp(log) * sigma
    text = f"the stop was estimated: its radius is {percent:+.1f} ± {error:.1f} % from the stated one"
    return Remark(text, Code.BLURRED)


def _steps(extent_px: float) -> int:
    """Parts of an exposure by whose images a way is as good as continuous."""
    # Gauss's are most apart in the middle, those of a vibration where it is fastest.
    return int(np.ceil(np.pi / 2 * extent_px / _APART_PX)) + 2


class _Compared:
    """Explanations of the blur of one frame, compared by the same pixels of the same targets."""

    def __init__(
        self,
        frame: Frame,
        camera: RayMap,
        targets: Sequence[PlaneTarget],
        options: BlurredOptions,
        altered: Altered | None,
        per_line: float,
    ) -> None:
        centres = np.array([target.centre for target in targets])
        at = camera.corresponding(centres)
        inside = np.flatnonzero(((at >= 0) & (at < [frame.width, frame.height])).all(axis=1))
        some = (
            inside[np.unique(np.linspace(0, len(inside) - 1, _MOST).astype(int))] if len(inside) else inside
        )
        self.frame, self.camera, self.altered, self.per_line = frame, camera, altered, per_line
        self.targets, self.centres = [targets[int(k)] for k in some], centres[some]
        self.settled = replace(options, varied=None)
        self.options = replace(self.settled, rings=options.rings or RINGS[0])
        self.basis = self._basis() if len(some) else np.zeros((6, 6))
        self.halves: dict[int, int] = {}

    def _basis(self) -> Array:
        """Twists (6, 6) in columns that move the images of the targets by one pixel, root mean square."""
        # Rotations that shift the image along x and y come first.
        units = np.eye(6)[[1, 0, 2, 3, 4, 5]]
        steps = np.where(np.arange(6) < 3, _STEP_RAD, _STEP_MM)[:, None] * units
        still = self.camera.corresponding(self.centres)
        rms = []
        for step in steps:
            moved = Motion(step, np.zeros(6)).moved(self.centres, np.ones((1, 1)))[0]
            rms.append(np.sqrt(np.nanmean(((self.camera.corresponding(moved) - still) ** 2).sum(axis=1))))
        # A single target on the axis is not moved by a rotation about it: such a twist stays zero.
        scale = np.divide(1.0, rms, out=np.zeros(6), where=np.array(rms) > 1e-6 * max(rms))
        return np.asarray((steps * scale[:, None]).T)

    def view(self, kind: Kind, steps: int, values: Array) -> RayMap:
        """The map of rays with values of the parameters."""
        camera = _altered(self.camera, kind, values, self.altered)
        if not kind.way:
            return camera
        amplitudes = np.zeros((2, 6))
        amplitudes[: kind.degree] = (
            values[len(kind.lens) :].reshape(kind.degree, kind.twists) @ self.basis[:, : kind.twists].T
        )
        middle = (self.frame.height - 1) / 2
        motion = Motion(amplitudes[0], amplitudes[1], kind.way == "vibration", self.per_line, middle)
        return Moving(camera, motion, steps)

    def look(self) -> None:
        """Choose the windows of the targets, for all explanations: those of the motion that seems best."""
        path = Kind(way="path")
        start = self._start(path, None)
        view = self.view(path, _steps(self._extent(self.view(path, 2, start))), start)
        run = Run(self.frame, view, ("",) * len(self.targets), tuple(self.targets), self.options)
        for k, image in enumerate(ray_images(view, self.targets, PupilElements.gauss(_COARSE))):
            if not isinstance(image, Failure):
                self.halves[k] = run.half(image)

    def fitted(
        self, kind: Kind, before: Explained | None, options: BlurredOptions | None = None
    ) -> Explained | None:
        """Estimate the parameters of an explanation, beginning with those of a smaller one."""
        start = self._start(kind, before)
        motions = kind.parameters - len(kind.lens)
        names = (*kind.lens, *(f"motion_{k + 1}_px" for k in range(motions)))
        sigma = (*(_OF_LENS[name] for name in kind.lens), *(_PRIOR_PX,) * motions)
        extent = self._extent(self.view(kind, 2, start))
        while True:
            # Room for a motion that is found to be larger than it is when the estimate begins.
            room = 1.5 * extent + 1.0
            view = partial(self.view, kind, _steps(room))
            varied = Varied(names, sigma, view)
            found = estimate_optics(
                self.frame, self.targets, varied, options or self.options, start, self.halves
            )
            if isinstance(found, Failure):
                return None
            extent, start = self._extent(found.camera), found.values
            if extent <= room:
                return Explained(kind, found, extent, self.altered)

    def _extent(self, view: RayMap) -> float:
        """Way of the images, pixels; 0 at rest."""
        return view.extent_px(self.centres) if isinstance(view, Moving) else 0.0

    def _start(self, kind: Kind, before: Explained | None) -> Array:
        """Approximate values: of those around, the ones whose images correlate best with the photograph."""
        old, values = Kind() if before is None else before.kind, np.zeros(kind.parameters)
        known = np.zeros(0) if before is None else before.optics.values
        values[: len(old.lens)] = known[: len(old.lens)]
        own = values[len(kind.lens) :].reshape(-1, kind.twists) if kind.way else np.zeros((0, 2))
        if old.way:
            given = known[len(old.lens) :].reshape(old.degree, old.twists)
            own[: old.degree, : old.twists] = given
        if not kind.way or (old.way and kind.degree == old.degree):
            return values
        # The way of a motion has no sense of direction; its bend has.
        angle = np.pi / _DIRECTIONS * np.arange(2 * _DIRECTIONS if kind.degree == 2 else _DIRECTIONS)
        tried = []
        for amplitude in _STARTS_PX:
            for each in amplitude * np.stack([np.cos(angle), np.sin(angle)], axis=1):
                own[kind.degree - 1, :2] = each
                view = self.view(kind, _steps(self._extent(self.view(kind, 2, values))), values)
                tried.append((self._likeness(view), values.copy()))
        return max(tried, key=lambda each: each[0])[1]

    def _likeness(self, view: RayMap) -> float:
        """Mean correlation of a few targets with their images."""
        some = np.unique(np.linspace(0, len(self.targets) - 1, _FEW).astype(int))
        targets = tuple(self.targets[k] for k in some)
        run = Run(self.frame, view, ("",) * len(targets), targets, replace(self.options, rings=_COARSE))
        images = ray_images(view, targets, PupilElements.gauss(_COARSE))
        return float(
            np.mean([0.0 if isinstance(image, Failure) else run.correlated(image)[0] for image in images])
        )

    def finest(self, reason: Explained) -> tuple[Explained, bool]:
        """The explanation by as many rays as images need, and whether nothing is left to explain."""
        reason = self.fitted(reason.kind, reason, self.settled) or reason
        names, camera = ("",) * len(self.targets), reason.optics.camera
        found = measure_blurred(self.frame, camera, names, self.targets, self.settled)
        return reason, bool(found.ok.any()) and not found.notes

    def gain(self, small: Explained, large: Explained) -> float:
        """By how much the logarithm of the likelihood of the larger explanation is better than it costs."""
        a, b = small.optics, large.optics
        both = a.costs.keys() & b.costs.keys()
        if 2 * len(both) < max(len(a.costs), len(b.costs)):
            return float(len(b.costs) - len(a.costs))
        count = sum(a.free[row] for row in both)
        ratio = sum(a.costs[row] for row in both) / sum(b.costs[row] for row in both)
        price = (large.kind.parameters - small.kind.parameters) * np.log(count)
        return float(0.5 * (count * np.log(ratio) - price))


def explained(
    frame: Frame,
    camera: RayMap,
    targets: Sequence[PlaneTarget],
    options: BlurredOptions | None = None,
    *,
    altered: Altered | None = None,
    per_line: float = 0.0,
) -> Explained | None:
    """Explain the blur of a frame by motion during the exposure, by focus, by the stop, or by several.

    Parameters
    ----------
    frame : Frame
    camera : RayMap
        The lens with its sensor, at rest.
    targets : sequence of PlaneTarget (n,)
        In camera axes.
    options : BlurredOptions, optional
    altered : callable, optional
        The lens with its image surface moved by millimetres, and with the radius of its stop multiplied by
        the exponential of a number; without it neither is in question.
    per_line : float
        Time between the exposures of adjacent lines, in halves of the exposure.

    Returns
    -------
    Explained or None
        None if the lens alone explains the frame as well, or no target is like its image in any way.

    Examples
    --------
    A disk moves by four pixels while it is photographed; it is drawn at 33 places:

    >>> from reseau.optics.formation import Outline, coverage
    >>> from reseau.optics.lenses import ThinLens, ray_image
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> camera = ThinLens(50.0, 12.5, 52.6, SensorPlane((0.01, 0.01), (40.0, 40.0)))
    >>> disk = PlaneTarget(np.array([0.0, 0, 1000]), np.eye(3)[:, :2], Outline.circle(2.0, 0.05))
    >>> image, pixels = ray_image(camera, disk, PupilElements.gauss(8)).outline, np.arange(81.0)
    >>> places = [Outline(image.xy + [40.0 + x, 40.0], image.dxy) for x in np.linspace(-2, 2, 33)]
    >>> share = np.mean([coverage(place, pixels, pixels, 0.5) for place in places], axis=0)
    >>> noise = np.random.default_rng(0).normal(0.0, 1.0, share.shape)
    >>> found = explained(Frame(200 - 150 * share + noise, 255.0), camera, [disk])
    >>> found.kind.way, round(found.extent_px, 1)
    ('path', 4.1)
    """
    compared = _Compared(frame, camera, targets, options or BlurredOptions(), altered, per_line)
    if not compared.targets:
        return None
    compared.look()
    best, finest = compared.fitted(Kind(), None), None
    while True:
        larger = [
            found
            for kind in (Kind() if best is None else best.kind).larger(altered is not None)
            if (found := compared.fitted(kind, best)) is not None
        ]
        if best is None:
            if not larger:
                return None
            best = max(larger, key=lambda each: len(each.optics.costs))
            finest, _ = compared.finest(best)
            continue
        winner = max(larger, key=partial(compared.gain, best), default=best)
        if winner is best or compared.gain(best, winner) <= 0:
            return finest
        best = winner
        finest, like = compared.finest(best)
        if like:
            return finest


def measure_explained(
    frame: Frame,
    camera: RayMap,
    ids: Sequence[str],
    targets: Sequence[PlaneTarget],
    options: BlurredOptions,
    *,
    altered: Altered | None = None,
    per_line: float = 0.0,
) -> tuple[BlurredResult, Explained | None]:
    """Measure blurred targets; where the lens alone does not explain their images, with what does.

    Parameters
    ----------
    frame, camera, ids, targets, options
        See :func:`reseau.measure.blurred.measure_blurred`.
    altered, per_line
        See :func:`explained`.

    Returns
    -------
    (BlurredResult, Explained or None)
        With a note on what was explained, and the explanation.

    Examples
    --------
    See :func:`explained`.
    """
    found = measure_blurred(frame, camera, ids, targets, options)
    like = bool(found.ok.any()) and not found.notes
    # A stand-in does not know the form of an image: what it leaves says nothing about a motion.
    if like or camera.unknown > 0 or options.varied is not None:
        return found, None
    reason = explained(frame, camera, targets, options, altered=altered, per_line=per_line)
    if reason is None:
        return found, None
    return reason.told(measure_blurred(frame, reason.optics.camera, ids, targets, options)), reason
