"""Parameters of the optics from all blurred targets of a frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ...core.data import Array, Frame
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ...optics.lenses import RayMap
from ...optics.lenses.images import PlaneTarget
from .measure import RINGS, BlurredOptions, Run, Varied

_ROUNDS = 20
"""Largest number of corrections of common parameters."""
_UNCHANGED = 1e-4
"""Share of the sum of squares below which corrections end."""
_DAMPING, _STUCK = 1e-2, 1e6
"""First and largest damping of these corrections (Levenberg and Marquardt)."""


@dataclass(frozen=True, eq=False)
class EstimatedOptics:
    """Parameters of the optics, estimated from all targets of a frame.

    Parameters
    ----------
    names : tuple of str (p,)
    values : ndarray (p,)
    cov : ndarray (p, p)
    camera : RayMap
        With these values.
    costs : mapping of int to float
        Sum of squares of each target that was used, over the variance of the noise.
    free : mapping of int to int
        Degrees of freedom of these.
    shifts : mapping of int to ndarray (p, 2)
        Displacement of their places with each parameter.

    Examples
    --------
    :func:`estimate_optics` returns it.

    >>> from reseau.optics.lenses import ThinLens
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> lens = ThinLens(50.0, 12.5, 52.1, SensorPlane((0.01, 0.01), (40.0, 40.0)))
    >>> EstimatedOptics(("focus_mm",), np.array([0.1]), np.array([[4e-4]]), lens).sigma
    array([0.02])
    """

    names: tuple[str, ...]
    values: Array
    cov: Array
    camera: RayMap = field(repr=False)
    costs: Mapping[int, float] = field(default_factory=dict, repr=False)
    free: Mapping[int, int] = field(default_factory=dict, repr=False)
    shifts: Mapping[int, Array] = field(default_factory=dict, repr=False)

    @property
    def used(self) -> int:
        """Number of targets."""
        return len(self.costs)

    @property
    def sigma(self) -> Array:
        """Standard deviations (p,)."""
        return np.sqrt(np.diagonal(self.cov))


def estimate_optics(
    frame: Frame,
    targets: Sequence[PlaneTarget],
    varied: Varied,
    options: BlurredOptions | None = None,
    start: Array | None = None,
    halves: dict[int, int] | None = None,
) -> EstimatedOptics | Failure:
    """Estimate parameters of the optics that all targets of a frame have in common.

    The targets are measured with the present values; the forms of their images, without what position, light
    and width of the remaining blur of each explain, give corrections of the values, until these no longer
    change. So focus, an index, or the aberrations of a stand-in (:class:`AberratedLens`) become known.

    Parameters
    ----------
    frame : Frame
    targets : sequence of PlaneTarget (n,)
        In camera axes. Where the stand-in has another scale or distortion than the lens, they must be
        predicted within the range of search all the same.
    varied : Varied
        The parameters with their prior standard deviations.
    options : BlurredOptions, optional
        Without a number of rings, the values are estimated with few rays, and then with as many as the images
        need.
    start : ndarray (p,), optional
        Values from which corrections begin; by default zeros.
    halves : dict of int to int, optional
        Half sides of the windows of targets; those that are missing are added.

    Returns
    -------
    EstimatedOptics or Failure

    Examples
    --------
    The distance of the sensor, from one disk:

    >>> from reseau.optics.formation import Outline, coverage
    >>> from reseau.optics.lenses import PupilElements, ThinLens, ray_image
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> sensor = SensorPlane((0.01, 0.01), (40.0, 40.0))
    >>> disk = PlaneTarget(np.array([0.0, 0, 1000]), np.eye(3)[:, :2], Outline.circle(2.0, 0.05))
    >>> image = ray_image(ThinLens(50.0, 12.5, 52.9, sensor), disk, PupilElements.gauss(12))
    >>> placed, pixels = Outline(image.outline.xy + 40.2, image.outline.dxy), np.arange(81.0)
    >>> noise = np.random.default_rng(0).normal(0.0, 1.0, (81, 81))
    >>> frame = Frame(200 - 150 * coverage(placed, pixels, pixels, 0.5) + noise, 255.0)
    >>> focus = Varied(("focus_mm",), (0.2,), lambda by: ThinLens(50.0, 12.5, 52.8 + by[0], sensor))
    >>> estimate_optics(frame, [disk], focus).values.round(2)
    array([0.1])
    """
    chosen, halves = replace(options or BlurredOptions(), varied=None), {} if halves is None else halves
    values = np.zeros(len(varied.names)) if start is None else start

    def estimated(rings: int, values: Array) -> EstimatedOptics | Failure:
        """The same rays and pixels throughout, so that sums of squares can be compared."""
        few = replace(chosen, rings=rings)
        return _estimated(varied, partial(_Common.of, frame, tuple(targets), varied, few, halves), values)

    found = estimated(chosen.rings or RINGS[0], values)
    if isinstance(found, Failure) or chosen.rings:
        return found
    needed = Run(frame, found.camera, ("",) * len(targets), tuple(targets), chosen).result().rings
    finer = estimated(needed, found.values) if needed > RINGS[0] else found
    return found if isinstance(finer, Failure) else finer


def _estimated(
    varied: Varied, equations: Callable[[Array], _Common], values: Array
) -> EstimatedOptics | Failure:
    """Parameters from the normal equations of all targets for their values."""
    prior, at = np.diag(1 / np.square(varied.sigma)), equations(values)
    damping = _DAMPING
    for _ in range(_ROUNDS):
        if not at.costs:
            return Failure("no target is like its image: check lens, focus and aperture", Code.NOT_FOUND)
        normal, right = at.normal + prior, at.right - prior @ values
        cost = sum(at.costs.values())
        newton = np.linalg.solve(normal, right)
        if newton @ right < _UNCHANGED * cost:
            cov: Array = np.asarray(
                np.linalg.inv(normal) * max(cost / sum(at.free.values()), 1.0), dtype=np.float64
            )
            fit = at.costs, at.free, at.shifts
            return EstimatedOptics(varied.names, values, cov, varied.camera(values), *fit)
        step = np.linalg.solve(normal + damping * np.diag(np.diagonal(normal)), right)
        try:
            trial = equations(values + step)
        except UsageError:  # such a lens forms no image
            damping *= 10
            continue
        if trial.better(at, prior, values, values + step):
            at, values, damping = trial, values + step, damping / 5
        elif damping > _STUCK:
            break
        else:
            damping *= 10
    return Failure("the parameters of the optics do not converge", Code.NOT_CONVERGED)


@dataclass(frozen=True, eq=False)
class _Common:
    """Normal equations of all targets for common parameters, and the sum of squares of each target."""

    normal: Array
    right: Array
    costs: dict[int, float]
    free: dict[int, int]
    shifts: dict[int, Array]

    @classmethod
    def of(
        cls,
        frame: Frame,
        targets: tuple[PlaneTarget, ...],
        varied: Varied,
        options: BlurredOptions,
        halves: dict[int, int],
        values: Array,
    ) -> _Common:
        around = replace(varied, camera=partial(_moved, varied.camera, values))
        names = tuple(str(k) for k in range(len(targets)))
        run = Run(frame, varied.camera(values), names, targets, options)
        parts = list(run.equations(run.result(), around, halves))
        normal, right = np.zeros((len(values),) * 2), np.zeros(len(values))
        for part in parts:
            normal, right = normal + part.normal, right + part.right
        costs = {part.row: part.cost for part in parts}
        free = {part.row: part.freedom for part in parts}
        return cls(normal, right, costs, free, {part.row: part.shifts for part in parts})

    def better(self, before: _Common, prior: Array, old: Array, new: Array) -> bool:
        """Whether more targets are like their images, or the same ones more alike."""
        if not set(before.costs) <= set(self.costs):
            return False
        gain = sum(cost - self.costs[row] for row, cost in before.costs.items())
        gain += float(old @ prior @ old - new @ prior @ new)
        return len(self.costs) > len(before.costs) or gain > 0


def _moved(camera: Callable[[Array], RayMap], values: Array, by: Array) -> RayMap:
    """The map of rays with parameters that differ from their present values."""
    return camera(values + by)
