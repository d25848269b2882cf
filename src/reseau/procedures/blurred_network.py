"""Blurred targets of a whole network: Meid's procedure (1992, section 3, figure 3).

Approximate image coordinates give the orientation by a multi-media bundle adjustment. From it follow the
images of all targets by rays through windows and lens; matching them with the photographs gives better image
coordinates, these a better orientation, and so on until sigma0 no longer falls. Where a target is sharp and
its ordinary coordinates do not differ significantly, these are kept: given ones always, those that the
procedure measured itself where they are as certain.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ..bundle import Network, Result, adjust_network
from ..bundle import Options as BundleOptions
from ..bundle.diagnostics.checks import listed
from ..bundle.network.settings import observation_columns
from ..core import vocabulary as v
from ..core.data import Array, Frame, Mask, Rows
from ..core.display import Display
from ..core.errors import UsageError
from ..core.executors import Executor, Here
from ..core.failure import Code, Failure, Remark
from ..io.network import Network1
from ..io.targets import SpaceTargets
from ..measure.blurred import BlurredOptions, measure_blurred
from ..measure.blurred.measure import BlurredResult
from ..measure.blurred.motion import Explained, measure_explained
from ..measure.ordinary import ordinary_coordinates
from ..optics.lenses import RayMap, ThinLens
from ..optics.lenses.images import PlaneTarget, image_scale
from ..optics.lenses.ray_maps import CalibratedLens, LensCamera
from ..optics.lenses.windows import behind_windows
from ..optics.refraction import RefractedRays
from ..optics.refraction.windows import Refraction
from .blurred import SPACING_PX, alterable

_NODES = 150
"""Largest number of nodes along the size of a target."""
_DIFFERS = 9.21
"""Quantile 0.99 of χ² with two degrees of freedom: a larger difference of coordinates is significant."""
_SHARP_PX = 1.0
"""Blur (rms radius) up to which ordinary coordinates may be kept."""
_FAR_MM = 1e6
"""Distance of a far point."""
_FOLLOWED = 0.5
"""Part of the sigmas to which the camera of the network must follow the distortion of the lens."""
_FITS = 4
"""Corrections of its parameters: images are linear in most of them."""
_FALLS = 0.99
"""Another round must lower sigma0 to less than this part."""


@dataclass(frozen=True)
class NetworkOptions:
    """Options of the procedure.

    Parameters
    ----------
    matching : BlurredOptions
        Measurement of the targets; its polarity is that of the targets.
    rounds : int
        Largest number of rounds. What a lens does not explain is explained from the second on, or where the
        first fails.
    keep_sharp : bool
        Whether ordinary coordinates of sharp targets are kept where they do not differ significantly from
        those by rays. Coordinates that `initial` measures must not be less certain either.
    initial : {"given", "centroid", "edge"}
        Ordinary coordinates: those of the network, or measured near these as centres of gravity or of
        ellipses through the edges. A target that this does not find keeps the coordinates given.
    bundle : reseau.bundle.Options
        Options of the adjustments.

    Examples
    --------
    >>> NetworkOptions(rounds=3).keep_sharp
    True
    """

    matching: BlurredOptions = field(default_factory=BlurredOptions)
    rounds: v.Rounds = 6
    keep_sharp: bool = True
    initial: v.Initial = "given"
    bundle: BundleOptions = field(default_factory=BundleOptions)

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise UsageError("must be at least 1", where="NetworkOptions.rounds")


@dataclass(frozen=True, eq=False)
class BlurredRound:
    """One round: the adjustment, and what the measurement before it changed.

    Parameters
    ----------
    result : Result
        The adjustment; its network has the image coordinates of the round.
    measured : mapping of str to BlurredResult
        By image; empty in the first round, which has the ordinary coordinates.
    replaced, kept, declined : ndarray of bool (n,)
        Image points of the first network: measured by rays; with their ordinary coordinates; left out
        because they are blurred and could not be measured.
    shift_px : float
        Mean distance of the replaced coordinates from the ordinary ones.

    Examples
    --------
    See :class:`BlurredNetwork`.
    """

    result: Result
    measured: Mapping[str, BlurredResult]
    replaced: Mask
    kept: Mask
    declined: Mask
    shift_px: float

    def rms_px(self, rows: Mask | None = None) -> float:
        """Root mean square of the residuals of image coordinates, px; of some rows of its network only."""
        v = self.result.residuals
        v = v if rows is None else v[rows]
        return float(np.sqrt(np.nanmean(v**2))) if np.isfinite(v).any() else float("nan")


@dataclass(frozen=True, eq=False, repr=False)
class BlurredNetwork(Display):
    """A network whose blurred targets were measured by rays; truthy.

    Parameters
    ----------
    rounds : tuple of BlurredRound
        The adjustment of the ordinary coordinates, and every round after it.
    chosen : int
        The round with the smallest sigma0 of those that were measured by rays, and with what explains the
        photographs where that is more than their lens: the result.
    notes : tuple of Remark
        What a user should know.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> none = np.zeros(160, dtype=bool)
    >>> first = BlurredRound(adjust_network(example_network()), {}, none, ~none, none, 0.0)
    >>> BlurredNetwork((first,), 0)
    <BlurredNetwork: 1 round, sigma0 1.005>
    """

    rounds: tuple[BlurredRound, ...]
    chosen: int
    notes: tuple[Remark, ...] = ()

    @property
    def result(self) -> Result:
        """The final adjustment."""
        return self.rounds[self.chosen].result

    @property
    def network(self) -> Network:
        """The final network: an ordinary one."""
        return self.result.network

    def _facts(self) -> list[tuple[str, str]]:
        count = len(self.rounds)
        return [(f"{count} round{'s' * (count != 1)}", ""), ("sigma0", f"{self.result.sigma0:.4g}")]


def measure_blurred_network(
    network: Network,
    frames: Mapping[str, Frame],
    targets: SpaceTargets,
    cameras: LensCamera | ThinLens | Mapping[str, LensCamera | ThinLens],
    options: NetworkOptions | None = None,
    *,
    watch: Callable[[str], None] | None = None,
    executor: Executor | None = None,
) -> BlurredNetwork | Failure:
    """Measure the blurred targets of a network, and adjust it.

    Parameters
    ----------
    network : Network
        With approximate image coordinates of the targets, measured in any way, and their covariances; its
        refraction describes windows and media.
    frames : mapping of str to Frame
        Photographs by the names of the images; images without one keep their coordinates.
    targets : SpaceTargets
        Shape, size and direction of the targets, by the names of the points; points without one keep their
        coordinates.
    cameras : LensCamera or ThinLens, or mapping of str to these
        Lens and sensor, of all cameras or by their names; in the medium next to the camera. A thin lens
        stands in for a lens whose design is not known: images lie where the camera of the network has them,
        and are blurred as by defocus.
    options : NetworkOptions, optional
    watch : callable, optional
        Called with a line about what is done.
    executor : Executor, optional
        What measures the photographs of each round; by default this process.

    Returns
    -------
    BlurredNetwork or Failure
        A failure where the first network cannot be adjusted, or no target can be measured.

    Raises
    ------
    UsageError
        When the unit of the network is not that of a length, or a camera has no lens.

    Notes
    -----
    Position, direction and windows of each round are those of its adjustment. The principal point of the
    lens is put where the camera of the network images the direction of the view. A target that is blurred
    and cannot be measured by rays is left out: its ordinary coordinates would be biased. The coordinates of
    the final network are reduced to its projection centre (see :class:`NetworkOptions`).

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> from reseau.io.targets import TargetColumns
    >>> from reseau.optics.lenses import AIR, Prescription, glass, in_order
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> lens = Prescription(in_order([(0.1, 1.0, glass("N-BK7")), (-0.1, 9.0, AIR)]), 0, 0.5)
    >>> camera = LensCamera(lens, SensorPlane((0.01, 0.01), (319.5, 239.5)))
    >>> one = TargetColumns(id=("none",), shape=("disk",), size=(0.1,), normal=((0.0, 0.0, 1.0),))
    >>> targets = SpaceTargets(unit="m", polarity="dark", targets=one)
    >>> print(measure_blurred_network(example_network(), {}, targets, camera))
    no target of the network could be measured by rays
    """
    chosen, say = options or NetworkOptions(), watch or (lambda line: None)
    network = _ordinary(network, frames, targets, chosen)
    first = adjust_network(network, chosen.bundle)
    if isinstance(first, Failure):
        return first
    run = _Run(network, frames, targets, cameras, chosen, executor)
    none = np.zeros(len(network.xy), dtype=bool)
    rounds = [BlurredRound(first, {}, none, ~none, none, 0.0)]
    say(f"ordinary coordinates: sigma0 {first.sigma0:.4g}")
    for number in range(1, chosen.rounds + 1):
        # The ordinary coordinates of blurred targets turn the photographs: what the first measurement by rays
        # corrects needs no explanation.
        found = run.round(rounds[-1].result, explain=number > 1)
        if isinstance(found, Failure) and number == 1:
            found = run.round(first, explain=True)
        if isinstance(found, Failure):
            if number == 1:
                return found
            break
        rounds.append(found)
        say(
            f"round {number}: {int(found.replaced.sum())} by rays, {int(found.kept.sum())} kept, "
            f"{int(found.declined.sum())} left out; sigma0 {found.result.sigma0:.4g}"
        )
        before = rounds[-2]
        same = bool(_explained(found)) == bool(_explained(before))
        if number > 1 and same and found.result.sigma0 >= _FALLS * before.result.sigma0:
            break
    # What was measured with another lens than that of the photographs has other sigmas.
    explained = [k for k, entry in enumerate(rounds) if _explained(entry)]
    best = min(explained or range(1, len(rounds)), key=lambda k: rounds[k].result.sigma0)
    return BlurredNetwork(tuple(rounds), best, run.notes(rounds, best))


def final_document(document: Network1, found: BlurredNetwork) -> Network1:
    """The document of a network with the final image coordinates.

    Parameters
    ----------
    document : Network1
        The network that was measured.
    found : BlurredNetwork

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> from reseau.bundle.network.settings import network_document
    >>> network, none = example_network(), np.zeros(160, dtype=bool)
    >>> found = BlurredNetwork((BlurredRound(adjust_network(network), {}, none, ~none, none, 0.0),), 0)
    >>> bool(final_document(network_document(network), found).observations.x[0] == network.xy[0, 0])
    True
    """
    return document.model_copy(update={"observations": observation_columns(found.network)})


def _ordinary(
    network: Network, frames: Mapping[str, Frame], targets: SpaceTargets, options: NetworkOptions
) -> Network:
    """The network with ordinary coordinates, measured where that is asked for."""
    if options.initial == "given":
        return network
    xy = network.xy.copy()
    for i, image in enumerate(network.images):
        if image in frames:
            rows = _rows_of(network, i, set(targets.targets.id))
            found = ordinary_coordinates(
                frames[image], xy[rows], polarity=targets.polarity, method=options.initial
            )
            xy[rows] = np.where(np.isfinite(found), found, xy[rows])
    return replace(network, xy=xy)


def _usual_reason(measured: Mapping[str, BlurredResult]) -> str:
    """Why most of the targets that were not measured were not."""
    why = Counter(str(reason) for found in measured.values() for reason in found.why if reason)
    # Image points without a target are left out as well where no ray passes the lens.
    return why.most_common(1)[0][0] if why else "no ray to it passes the lens"


def _too_few(failure: Failure, measured: Mapping[str, BlurredResult], left_out: int) -> Failure:
    """Say first that targets were not measured, where the rest cannot be adjusted."""
    missed = sum(int((~found.ok).sum()) for found in measured.values())
    if not missed:
        text = f"{left_out} image points to which no ray passes the lens are left out; {failure.reason}"
        return replace(failure, reason=text)
    text = (
        f"{missed} of {sum(len(found.ok) for found in measured.values())} targets were not measured by rays, "
        f"most often: {_usual_reason(measured)}; what is left: {failure.reason}"
    )
    return replace(failure, reason=text)


def _explained(entry: BlurredRound) -> list[Remark]:
    """What explains photographs beside their lens."""
    return [
        replace(note, text=f"{name}: {note.text}")
        for name, found in entry.measured.items()
        for note in found.notes
        if note.code == Code.BLURRED
    ]


def _misfits(entry: BlurredRound) -> tuple[Remark, ...]:
    """Say in which photographs the targets are not like their images by the lens.

    The adjustment cannot tell: another lens shifts coordinates smoothly over the image, which distortion and
    object points take up. The matching can, as it compares the form of the images.
    """
    unlike = {
        name: found.uneven
        for name, found in entry.measured.items()
        if any(note.code == Code.INCONSISTENT for note in found.notes)
    }
    by_residuals, by_widths = (
        [name for name in unlike if unlike[name] is uneven] for uneven in (False, True)
    )
    said = []
    if by_residuals:
        values = [entry.measured[name].misfit for name in by_residuals]
        said.append(
            f"residuals of the targets in {listed(by_residuals, 8)} are {min(values):.3g} to "
            f"{max(values):.3g} times the noise beside them"
        )
    if by_widths:
        said.append(f"what blurs beside the rays differs from target to target in {listed(by_widths, 8)}")
    text = (
        "lens, focus or aperture are not theirs, and object points may be wrong by more than their sigmas, "
        "also where sigma0 is good"
    )
    return tuple(Remark(f"{each}: {text}", Code.INCONSISTENT) for each in said)


def _far(uv: Array) -> Array:
    """Far points (n, 3) in directions (n, 2)."""
    return _FAR_MM * np.column_stack([uv, np.ones(len(uv))])


def _rows_of(network: Network, image: int, named: Collection[str]) -> list[int]:
    """Rows of the coordinates of an image whose points are among those named."""
    rows = np.flatnonzero(network.image_of == image).tolist()
    return [k for k in rows if network.points[network.point_of[k]] in named]


class _Job(NamedTuple):
    """A photograph, its camera, and names and planes of the targets that are measured in it."""

    frame: Frame
    camera: RayMap
    names: list[str]
    planes: list[PlaneTarget]
    options: BlurredOptions


class _Known(NamedTuple):
    """A photograph for which no explanation is sought, with the one that it has beside its lens."""

    job: _Job
    reason: Explained | None


def _measured(job: _Job | _Known) -> tuple[BlurredResult, Explained | None]:
    if isinstance(job, _Job):
        return measure_explained(*job, altered=alterable(job.camera))
    job, reason = job
    if reason is None:
        return measure_blurred(*job), None
    return reason.told(measure_blurred(*job._replace(camera=reason.on(job.camera)))), reason


class _Run:
    """What stays the same in all rounds."""

    def __init__(
        self,
        network: Network,
        frames: Mapping[str, Frame],
        targets: SpaceTargets,
        cameras: LensCamera | ThinLens | Mapping[str, LensCamera | ThinLens],
        options: NetworkOptions,
        executor: Executor | None = None,
    ) -> None:
        unit = {"mm": 1.0, "m": 1000.0}.get(network.unit)
        if unit is None:
            raise UsageError(f"the network is in {network.unit!r}, lenses are in mm", do="use m or mm")
        self.network, self.frames, self.targets, self.options = network, frames, targets, options
        self.unit_mm, self.executor = unit, executor or Here()
        self.row = {name: k for k, name in enumerate(targets.targets.id)}
        self.cameras: dict[str, LensCamera | ThinLens] = {}
        for camera in network.cameras:
            lens = cameras.get(camera.id) if isinstance(cameras, Mapping) else cameras
            if lens is None:
                raise UsageError("has no lens", where=f"camera {camera.id}")
            self.cameras[camera.id] = lens
        self.xyz, self.reasons = network.xyz.copy(), dict[str, Explained | None]()
        self.matching = replace(options.matching, polarity=targets.polarity)

    def round(self, last: Result, *, explain: bool) -> BlurredRound | Failure:
        """Measure all targets with the images that follow from an adjustment, and adjust again.

        Where asked to, photographs whose targets are not like these images are explained.
        """
        network, n = self.network, len(self.network.xy)
        xy, cov = network.xy.copy(), network.cov.copy()
        replaced, declined = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        measured, of_image = dict[str, BlurredResult](), dict[str, list[int]]()
        # Points that were left out stay where they were: their images may touch others.
        usable = last.fit.usable.points[:, None]
        self.xyz = np.where(usable, last.fit.values.xyz, self.xyz)
        for i, image in enumerate(network.images):
            if image not in self.frames or not last.fit.usable.images[i]:
                continue
            rows = _rows_of(network, i, self.row)
            rows = [k for k in rows if np.isfinite(self.xyz[network.point_of[k]]).all()]
            if rows:
                of_image[image] = rows
        jobs = ((image, self._job(last, image, rows)) for image, rows in of_image.items())
        # A photograph is explained once: another orientation changes its images hardly.
        known = (
            (image, job if explain and image not in self.reasons else _Known(job, self.reasons.get(image)))
            for image, job in jobs
        )
        for image, outcome in self.executor.outcomes(_measured, known):
            if isinstance(outcome, Failure):
                return outcome
            measured[image], reason = outcome
            found = measured[image]
            if explain:
                self.reasons[image] = reason
            for k, own in enumerate(of_image[image]):
                if self._stays(found, k, own):
                    continue
                if found.ok[k]:
                    xy[own], cov[own], replaced[own] = found.xy[k], found.cov[k], True
                else:
                    declined[own] = True
        if not any(found.ok.any() for found in measured.values()):
            return Failure("no target of the network could be measured by rays", Code.NOT_FOUND)
        shift = np.hypot(*(xy - network.xy)[replaced].T) if replaced.any() else np.zeros(1)
        reduction = self._reduction(last)
        # Without a ray through the lens the coordinates cannot be reduced.
        declined |= ~np.isfinite(reduction).all(axis=1)
        xy = xy - np.nan_to_num(reduction)
        start = replace(network, xy=xy, cov=cov).select(~declined)
        result = adjust_network(start, self.options.bundle)
        if isinstance(result, Failure):
            return _too_few(result, measured, int(declined.sum())) if declined.any() else result
        return BlurredRound(
            result, measured, replaced & ~declined, ~replaced & ~declined, declined, float(shift.mean())
        )

    def _job(self, last: Result, image: str, rows: list[int]) -> _Job:
        """The targets of an image at the estimates of an adjustment, and what they are measured with."""
        network, values, i = self.network, last.fit.values, self.network.images.index(image)
        _, camera = self._camera(last, i)
        rotation, x0 = values.rotation[i], values.x0[i]
        points = network.point_of[rows]
        named = [self.row[network.points[j]] for j in points]
        centres = self.unit_mm * (self.xyz[points] - x0) @ rotation.T
        axes = rotation @ np.array([self.targets.axes(k) for k in named])
        scales = image_scale(camera, centres, axes) * self.targets.unit_mm
        planes = []
        for k, centre, across, scale in zip(named, centres, axes, scales, strict=True):
            # A target that is predicted too near, by a bad orientation, has no more nodes than others; one
            # out of the field of the lens will not be measured.
            least = self.targets.targets.size[k] / _NODES
            spacing = max(SPACING_PX / scale, least) if scale > 0 else self.targets.targets.size[k]
            outline = self.targets.outline(k, spacing)
            scaled = replace(
                outline,
                xy=self.targets.unit_mm * outline.xy,
                dxy=self.targets.unit_mm * outline.dxy,
            )
            planes.append(PlaneTarget(centre, across, scaled))
        names = [network.points[j] for j in points]
        return _Job(self.frames[image], camera, names, planes, self.matching)

    def _reduction(self, last: Result) -> Array:
        """What aberrations of the pupil shift corresponding rays by, beside a fixed projection centre (n, 2).

        The principal ray of a near point does not pass the projection centre of the network, but it arrives
        where that of a far point does, whose ray is nearly the same line. The difference of the image of the
        point and that of a far point in the direction of the ray through the projection centre is taken from
        the image coordinates; what is left depends on that direction only, as in the bundle.
        """
        reduction = np.zeros((len(self.network.xy), 2))
        for i, rows, x, uv in self._seen(last):
            lens, wet = self._camera(last, i)
            reduction[rows] = wet.corresponding(self.unit_mm * x) - lens.corresponding(_far(uv))
        return reduction

    def _seen(self, last: Result) -> Iterator[tuple[int, Rows, Array, Array]]:
        """Each image, its rows, their points (n, 3) in camera axes, and directions (n, 2) before windows."""
        network, values = self.network, last.fit.values
        known: Mask = np.asarray(np.isfinite(self.xyz).all(axis=1))
        for i in np.flatnonzero(last.fit.usable.images).tolist():
            rows = np.flatnonzero((network.image_of == i) & known[network.point_of])
            if not len(rows):
                continue
            rotation, x0 = values.rotation[i], values.x0[i]
            xyz = self.xyz[network.point_of[rows]]
            x = (xyz - x0) @ rotation.T
            uv, refraction = x[:, :2] / x[:, 2:], self._windows(last)
            if refraction is not None and refraction.path_of[i] >= 0:
                rays = RefractedRays.of(
                    refraction.columns(refraction.values), refraction.path_of[[i]], rotation[None], x0[None],
                    xyz, np.zeros(len(rows), np.intp), np.arange(len(rows)),
                )  # fmt: skip
                uv = rays.uv
            yield i, rows, x, uv

    def _unfollowed(self, last: Result) -> tuple[Remark, ...]:
        """Say which cameras of the network cannot follow the distortion of their lenses.

        The images of far points in the directions of all targets, by the design, are fitted with the free
        parameters of the camera. What is left goes into residuals and object points.
        """
        found, seen = list[Remark](), list(self._seen(last))
        for c, entry in enumerate(self.network.cameras):
            mine = [(self._camera(last, i)[0], uv) for i, _, _, uv in seen if self.network.camera_of[i] == c]
            if not (mine and entry.free):
                continue
            uv = np.concatenate([uv for _, uv in mine])
            wanted = np.concatenate([lens.corresponding(_far(uv)) for lens, uv in mine])
            good = np.isfinite(uv).all(axis=1) & np.isfinite(wanted).all(axis=1)
            columns = [entry.names.index(name) for name in entry.free]
            values = last.fit.values.cameras[c, : len(entry.names)].copy()
            for _ in range(_FITS):
                at = entry.bare_mapping(values).derivatives(uv[good])
                off, by = (wanted[good] - at.value).ravel(), at.d_parameters[:, :, columns]
                by = by.reshape(len(off), -1)
                scale = np.linalg.norm(by, axis=0) + 1e-300
                values[columns] += np.linalg.lstsq(by / scale, off, rcond=None)[0] / scale
            left = float(np.sqrt(np.mean((wanted[good] - entry.bare_mapping(values)(uv[good])) ** 2)))
            own = self.network.camera_of[last.network.image_of] == c
            sigma = float(np.sqrt(np.einsum("nii->ni", last.network.cov[own]).mean()))
            if left > _FOLLOWED * sigma:
                text = (
                    f"{entry.label}: its free parameters ({', '.join(entry.free)}) follow the distortion "
                    f"of the lens to {left:.2g} px (rms), where sigmas are {sigma:.2g} px: object points are "
                    "worse than their sigmas; use more coefficients of distortion"
                )
                found.append(Remark(text, Code.UNMODELLED))
        return tuple(found)

    def _camera(self, last: Result, i: int) -> tuple[RayMap, RayMap]:
        """Lens of an image, and the same behind its windows, with the principal point of the adjustment.

        A stand-in has no distortion: its images lie where the camera of the adjustment has them.
        """
        network, values = self.network, last.fit.values
        c = int(network.camera_of[i])
        entry = network.cameras[c]
        mapping = entry.bare_mapping(values.cameras[c, : len(entry.names)])
        lens, windows = self.cameras[entry.id], self._windows(last)
        path = -1 if windows is None else int(windows.path_of[i])
        pose = values.rotation[i], values.x0[i]
        if isinstance(lens, ThinLens):
            dry = CalibratedLens(lens, mapping)
            if windows is None:
                return dry, dry
            thin = behind_windows(lens, windows, path, *pose, unit_mm=self.unit_mm)
            return dry, CalibratedLens(thin, mapping, thin.directions)
        middle = mapping(np.zeros((1, 2)))[0]
        sensor = replace(lens.sensor, principal_px=(float(middle[0]), float(middle[1])))
        lens = replace(lens, sensor=sensor)
        if windows is None:
            return lens, lens
        return lens, behind_windows(lens, windows, path, *pose, unit_mm=self.unit_mm)

    def _windows(self, last: Result) -> Refraction | None:
        """Windows and media of an adjustment; those of a rig as windows of its cameras."""
        refraction, rig = self.network.refraction, last.fit.values.rig
        if refraction is None:
            return None
        refraction = refraction.with_values(last.fit.values.refraction)
        return refraction if rig is None else refraction.on_cameras(self.network.camera_of, *rig)

    def _stays(self, found: BlurredResult, k: int, own: int) -> bool:
        """Whether a target keeps its ordinary coordinates."""
        sharp = bool(found.blur_px[k] <= _SHARP_PX)
        if not found.ok[k]:
            return sharp
        # Coordinates given by hand are kept, as in Meid's figure 6; those measured here need not be.
        given = self.options.initial == "given"
        worthy = given or np.trace(self.network.cov[own]) <= np.trace(found.cov[k])
        if not (sharp and worthy and self.options.keep_sharp):
            return False
        difference = found.xy[k] - self.network.xy[own]
        both = found.cov[k] + self.network.cov[own]
        return bool(difference @ np.linalg.solve(both, difference) <= _DIFFERS)

    def _stand_ins(self) -> tuple[Remark, ...]:
        """Say which cameras have a stand-in for their lens, and what it does not know."""
        found = []
        for entry in self.network.cameras:
            lens = self.cameras[entry.id]
            if isinstance(lens, ThinLens):
                text = (
                    f"{entry.label}: a thin lens stands in for its design: aberrations are not known; sigmas "
                    f"contain {lens.unknown:.0%} of the blur for them, but distortion and object points take "
                    "up unseen what they shift smoothly over the image"
                )
                found.append(Remark(text, Code.UNMODELLED))
        return tuple(found)

    def notes(self, rounds: list[BlurredRound], best: int) -> tuple[Remark, ...]:
        """Return what a user should know."""
        last = rounds[best]
        found = [*self._stand_ins(), *_explained(last), *_misfits(last), *self._unfollowed(last.result)]
        missing = [name for name in self.network.images if name not in self.frames]
        if missing:
            found.append(
                Remark(
                    f"no photograph of {', '.join(missing)}: ordinary coordinates are kept",
                    Code.PREREQUISITE_MISSING,
                )
            )
        if last.declined.any():
            rows = np.flatnonzero(last.declined)
            network = self.network
            names = (
                f"{network.points[network.point_of[k]]} in {network.images[network.image_of[k]]}"
                for k in rows
            )
            found.append(
                Remark(
                    f"{len(rows)} blurred targets were not measured and are left out: "
                    f"{listed(names, 8)}; most often: {_usual_reason(last.measured)}",
                    Code.DECLINED,
                )
            )
        return tuple(found)
