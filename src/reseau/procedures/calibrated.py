"""The result of the calibration of a camera, or of several fixed to each other."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from ..bundle import Result, calibration_of, explain
from ..bundle.diagnostics.estimates import CameraEstimate, ImageEstimates, PointEstimates
from ..bundle.diagnostics.evidence import in_camera
from ..bundle.diagnostics.fields import pair_of
from ..bundle.document import model_search_entries
from ..bundle.explanations.explain import Explanation
from ..bundle.explanations.names import Misnamed
from ..bundle.modelling.board import BoardChoice
from ..bundle.modelling.choice import ModelChoice
from ..calibration import Calibration, FieldDifference
from ..calibration.assessment import Assessment
from ..calibration.document import Covariance
from ..calibration.rectification import Rectification, rectified
from ..core.data import Array, Frame, ImagePoints
from ..core.display import Display, Table, html_table
from ..core.errors import InputError, UsageError
from ..core.failure import Estimated, Remark
from ..core.files import writable
from ..core.lazy import above
from ..core.provenance import Provenance
from ..core.warned import warn_user
from ..exchange.calibrations.formats import Exported, export_calibrations
from ..io import BoardDesign, write_whole
from ..io.images import Channel, read_image
from ..io.photographs import Exif, read_exif
from ..io.reading import is_points
from .assessment import assess, sorted_remarks

if TYPE_CHECKING:
    from matplotlib.axes import Axes


ONE_CAMERA = "camera"
"""Name of a camera that is alone."""


class ReportOptions(TypedDict, total=False):
    """Options of a report; see :func:`reseau.report.bundle.bundle_report`.

    Parameters
    ----------
    title : str
        Heading of the page.
    photograph : callable
        Returns the photograph of an image by its name, or None; those with the largest residuals are shown.
        By default their files are read, as far as they are there.
    provenance : Provenance
        Inputs, options, version.
    against : mapping of str to FieldDifference
        Differences from other calibrations, by their names.
    distances : sequence of float
        Distances at which the uncertainty of the projection is mapped.
    declined : mapping of str to str
        Further photographs that were left out, and why.
    exif : collection of Exif
        What the camera says about the photographs; by default as their files have it.

    Examples
    --------
    >>> ReportOptions(title="Camera 4711")
    {'title': 'Camera 4711'}
    """

    title: str
    photograph: Callable[[str], Frame | None]
    provenance: Provenance
    against: Mapping[str, FieldDifference]
    distances: Sequence[float]
    declined: Mapping[str, str]
    exif: Collection[Exif]


@dataclass(frozen=True, eq=False, repr=False)
class Calibrated(Estimated, Display):
    """A camera calibration with its measurements; truthy.

    Parameters
    ----------
    result : Result
        Result of the adjustment; a camera that is alone has the name ``camera``.
    measured : dict
        Measured image points, by image.
    declined : dict
        Reasons why images were left out, by image.
    choices : mapping of str to ModelChoice
        How the models of the cameras were chosen, by their names; empty where the model was given.
    board : BoardChoice, optional
        How the model of the target was chosen.
    notes : tuple of str
        How photographs were read.
    misnamed : Misnamed, optional
        Image points that were left out because they lie elsewhere than the others of their image say.
    corrected : BoardDesign, optional
        The board that the photographs show, where it is not the one that was told.
    target : str
        Name of the target.
    sources : mapping of str to Path
        Files of the photographs, or of their image coordinates, by image.
    channel : str
        Channel of colour images that was read.
    """

    result: Result
    measured: dict[str, ImagePoints]
    declined: dict[str, str]
    choices: Mapping[str, ModelChoice] = field(default_factory=dict)
    board: BoardChoice | None = None
    notes: tuple[str, ...] = ()
    misnamed: Misnamed | None = None
    corrected: BoardDesign | None = None
    target: str = ""
    sources: Mapping[str, Path] = field(default_factory=dict)
    channel: Channel = "luma"

    def __getitem__(self, camera: str) -> Calibration:
        """The calibration of a camera by its name."""
        if camera not in self.cameras:
            raise UsageError("is not a camera", where=camera, do=f"name one of {', '.join(self.cameras)}")
        if camera not in self._documents:
            self._documents[camera] = self.calibration(camera, camera=camera)
        return self._documents[camera]

    @cached_property
    def _documents(self) -> dict[str, Calibration]:
        return {}

    def _only(self, asked: str) -> Calibration:
        """The calibration of the only camera."""
        if len(self.cameras) > 1:
            names = ", ".join(repr(name) for name in self.cameras)
            raise UsageError(
                f"is that of one camera, and there are {names}", where=asked,
                do=f"take [{next(iter(self.cameras))!r}].{asked}",
            )  # fmt: skip
        return self[next(iter(self.cameras))]

    @property
    def choice(self) -> ModelChoice | None:
        """How the model of the only camera was chosen; None where it was given."""
        return self.choices.get(ONE_CAMERA)

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight; NaN without redundancy."""
        return self.result.sigma0

    @property
    def rms(self) -> float:
        """Root mean square of the residuals of an image coordinate, px."""
        return self.result.rms_px()

    @property
    def warnings(self) -> tuple[Remark, ...]:
        """Warnings about the adjustment; what the verdicts say is not repeated."""
        return self._remarks[0]

    @property
    def tests(self) -> tuple[Remark, ...]:
        """Remarks of statistical tests, whose effect is contained in the errors of the verdicts."""
        return self._remarks[1]

    @cached_property
    def _remarks(self) -> tuple[tuple[Remark, ...], tuple[Remark, ...]]:
        return sorted_remarks(self.result.warnings, assessed=bool(self.assessments))

    @property
    def cameras(self) -> dict[str, CameraEstimate]:
        """Estimated parameters of the cameras, by their names; one that is alone is called ``camera``."""
        return self.result.cameras

    @cached_property
    def explanation(self) -> Explanation:
        """What is wrong, if anything."""
        return explain(self.result, self.misnamed)

    def described(self, **changes: Any) -> Calibrated:
        """The same result with other notes, names or files; what is wrong with it is not looked for again."""
        found = replace(self, **changes)
        if "explanation" in self.__dict__:
            found.__dict__["explanation"] = self.explanation
        return found

    @cached_property
    def assessments(self) -> dict[str, Assessment]:
        """What the calibration of each camera is good for; of those with one set of parameters."""
        network = self.result.network
        one = {c for c, entry in enumerate(network.cameras) if entry.has_plane_mapping}
        return {
            entry.id: assess(self.result, c, self.explanation)
            for c, entry in enumerate(network.cameras)
            if c in one and (entry.additional is None or entry.additional.per == "camera")
        }

    def photograph(self, image: str) -> Frame | None:
        """Read the photograph of an image again; None where it is gone, or was never a file."""
        path = self.sources.get(image)
        if path is None or is_points(path):
            return None
        with suppress(InputError):
            return read_image(path, self.channel)
        return None

    def photographs(self, camera: str) -> list[Path]:
        """Return the files of a camera that are used, without those of image coordinates."""
        network = self.result.network
        c = [entry.id for entry in network.cameras].index(camera)
        own = [self.sources.get(network.images[i]) for i in np.flatnonzero(network.camera_of == c)]
        return [path for path in own if path is not None and not is_points(path)]

    @property
    def assessment(self) -> Assessment | None:
        """What the calibration of the only camera is good for."""
        return self._only("assessment").assessment

    @property
    def camera_matrix(self) -> Array:
        """OpenCV's camera matrix (3, 3) of the only camera; see :attr:`reseau.Calibration.camera_matrix`."""
        return self._only("camera_matrix").camera_matrix

    @property
    def dist_coeffs(self) -> Array:
        """OpenCV's coefficients of the only camera; see :attr:`reseau.Calibration.dist_coeffs`."""
        return self._only("dist_coeffs").dist_coeffs

    @property
    def covariance(self) -> Covariance:
        """Covariance of the parameters of the only camera, with what the points of each image have in common.

        An array by ``numpy.asarray``; the formal one is that of :attr:`cameras`.
        """
        return self._only("covariance").covariance

    def residuals(self, by: Literal["point", "image"] = "point") -> Table:
        """Return the residuals of the image points, with their tests, or those of each image.

        Parameters
        ----------
        by : {"point", "image"}
            What the rows are.
        """
        if by == "image":
            return self.result.residuals_by_image()
        if by != "point":
            raise UsageError(f"is {by!r}", where="by", do="use point or image")
        return Table("image points", self.result._columns())

    def undistort(
        self,
        image: NDArray[Any],
        fov: Literal["keep", "all"] | float = "keep",
        *,
        scale: float = 1.0,
        alpha: float | None = None,
        anyway: bool = False,
    ) -> NDArray[Any]:
        """Return an image of the only camera without distortion; see :meth:`reseau.Calibration.undistort`."""
        return self._only("undistort").undistort(image, fov, scale=scale, alpha=alpha, anyway=anyway)

    def compare(self, other: Calibrated | Calibration | Path | str) -> FieldDifference:
        """Return the difference of another calibration of the camera over the image.

        Parameters
        ----------
        other : Calibrated, Calibration or path
            The other one, independent of this, or its file.
        """
        second = other._only("compare") if isinstance(other, Calibrated) else other
        return self._only("compare").compare(second)

    def rectified(self, camera: str, distance: float | None = None) -> Rectification:
        """Return how the images of a camera and of the reference of its rig are rectified, and how well.

        Parameters
        ----------
        camera : str
            A camera that has a place with respect to another one.
        distance : float, optional
            Depth of points, in the unit of object space, for which the error is given; by default that of the
            target.

        Raises
        ------
        UsageError
            When the camera has no place, or both do not see the same.
        """
        result, ids = self.result, [each.id for each in self.result.network.cameras]
        if camera not in ids:
            raise UsageError(f"is none of {', '.join(ids)}", where=f"camera {camera}")
        if distance is None:
            z = in_camera(result.fit)[:, 2]
            distance = float(np.median(z[np.isfinite(z) & (z > 0)]))
        return rectified(pair_of(result, ids.index(camera)), distance)

    def export(self, path: Path | str, *, to: str, anyway: bool = False) -> tuple[Exported, ...]:
        """Write the calibration for another program; of several cameras one file of their rig.

        Parameters
        ----------
        path : path
            File to write.
        to : str
            Name of the format; see :meth:`reseau.Calibration.export`.
        anyway : bool
            Whether to go on with a calibration that is usable for nothing.

        Returns
        -------
        tuple of Exported
            The cameras as they were written.
        """
        done = export_calibrations([self[name] for name in self.cameras], to, path, anyway=anyway)
        warn_user(done[0].notes)
        return done

    def report(self, path: Path | str, **options: Unpack[ReportOptions]) -> None:
        """Write the report, an HTML page.

        Parameters
        ----------
        path : path
            File to write, ``.html``.
        **options
            See :class:`ReportOptions`.

        Raises
        ------
        UsageError
            When the suffix is another one.
        InputError
            When the file cannot be written.
        """
        write_whole(writable(Path(path), ".html"), self.report_page(**options))

    def report_page(self, **options: Unpack[ReportOptions]) -> str:
        """Return the page that :meth:`report` writes."""
        declined = dict(options.pop("declined", {})) | self.declined
        usual: ReportOptions = {
            "title": f"Calibration with {self.target}" if self.target else "Calibration",
            "photograph": self.photograph,
            "exif": [read_exif(path) for path in self.sources.values()],
        }
        page: str = above("reseau.report.bundle:bundle_report")(
            self.result, **(usual | options), assessments=self.assessments, declined=declined
        )
        return page

    def summary(self) -> str:
        """What it is good for, and the parameters with their standard deviations, in lines of text."""
        declined = [f"left out: {name}: {why}" for name, why in self.declined.items()]
        points = sum(len(points) for points in self.measured.values())
        rms = f"residuals {self.rms:.3g} px rms, sigma0 {self.sigma0:.3f}"
        head = f"{len(self.measured)} images, {points} image points, {rms}"
        return "\n".join((*(self[name].summary() for name in self.cameras), head, *declined))

    @property
    def images(self) -> ImageEstimates:
        """Exterior orientations."""
        return self.result.images

    @property
    def points(self) -> PointEstimates:
        """Points of the target."""
        return self.result.points

    def calibration(
        self,
        name: str = "camera",
        provenance: Mapping[str, Any] | None = None,
        camera: str | None = None,
    ) -> Calibration:
        """Return the calibration of a camera as a document, with how its model was found.

        Parameters
        ----------
        name : str
            Name of the calibration.
        provenance : mapping, optional
            Inputs and options, see :class:`reseau.core.provenance.Provenance`.
        camera : str, optional
            Name of the camera; required with several.

        Raises
        ------
        UsageError
            When there is no such camera.
        """
        found = calibration_of(self.result, camera or ONE_CAMERA, name=name, provenance=provenance)
        more = model_search_entries(self.result)
        assessed = self.assessments.get(camera or ONE_CAMERA)
        if assessed is not None:
            more |= {
                "warnings": [remark.text for remark in (*self.warnings, *self.tests)],
                "warning_codes": [remark.code.value for remark in (*self.warnings, *self.tests)],
            }
        if (camera or ONE_CAMERA) in self.choices:
            more |= {"camera_models": self.choices[camera or ONE_CAMERA].entries()}
        if self.board is not None:
            more |= {"target": self.board.entries()}
        if self.corrected is not None:
            more |= {"corrected_design": self.corrected.to_dict()}
        return found.model_copy(update={"validity": found.validity | more, "assessment": assessed})

    def documents(self, provenance: Mapping[str, Any] | None = None) -> list[Calibration]:
        """Return the calibration of each camera, which has its name."""
        return [self.calibration(one.id, provenance, one.id) for one in self.result.network.cameras]

    def write(self, path: Path | str) -> None:
        """Write the calibration, ``reseau-calibration/1``; of several cameras one file each.

        With several cameras their names are appended to that of the file: ``rig.json`` becomes
        ``rig-left.json`` and ``rig-right.json``.

        Raises
        ------
        InputError
            When a file cannot be written.
        """
        for camera, file in self.files(Path(path)).items():
            self.calibration(file.stem, camera=camera).write(file)

    def files(self, path: Path) -> dict[str, Path]:
        """Return the file of each camera, for the path given to all; see :meth:`write`."""
        names = [entry.id for entry in self.result.network.cameras]
        if len(names) == 1:
            return {names[0]: path}
        return {name: path.with_name(f"{path.stem}-{name}{path.suffix}") for name in names}

    def plot(self, photo: Frame | None = None) -> Sequence[Axes]:
        """Draw residuals, the total error of the projection and its formal part, with matplotlib.

        Each camera is a row.

        Parameters
        ----------
        photo : Frame, optional
            One of the photographs; drawn first, with the points measured in it.

        Returns
        -------
        sequence of matplotlib Axes
            Of the panels, row by row.
        """
        import matplotlib.pyplot as plt

        from ..core.figures import BLUE

        first = 0 if photo is None else 1
        names = [entry.id for entry in self.result.network.cameras]
        size = (4.6 * (first + 3), 3.9 * len(names) + 0.3)
        figure, grid = plt.subplots(len(names), first + 3, figsize=size, layout="constrained", squeeze=False)
        if photo is not None:
            panel = photo.plot(grid[0, 0])
            points = self.measured.get(photo.name)
            if points is not None:
                panel.plot(*points.xy.T, "o", color=BLUE, markerfacecolor="none", markersize=4)
                panel.set_title(f"{photo.name}: {len(points)} points", loc="left")
        shown = [] if photo is None else [grid[0, 0]]
        verdicts = []
        for c, (name, row) in enumerate(zip(names, grid, strict=True)):
            shown.append(self.result.plot(row[first], camera=c))
            assessed = self.assessments.get(name)
            if assessed is not None and assessed.errors is not None:
                shown += [assessed.errors.plot(row[first + 1]), assessed.errors.plot(row[-1], formal=True)]
                verdicts.append(f"{name}: {assessed.short}" if len(names) > 1 else assessed.short)
        figure.suptitle("\n".join(verdicts), x=0.01, ha="left", fontsize="medium")
        for axes in set(grid.flat) - set(shown):
            axes.remove()
        return shown

    def _facts(self) -> list[tuple[str, str]]:
        count = sum(len(points) for points in self.measured.values())
        several = len(self.cameras) > 1
        verdicts = [f"{name}: " * several + each.short for name, each in self.assessments.items()]
        return [
            *((verdict, "") for verdict in verdicts),
            (f"{len(self.measured)} images", ""),
            (f"{count} image points", ""),
            (f"{len(self.declined)} declined", ""),
            ("sigma0", f"{self.sigma0:.3f}"),
            *(fact for camera in self.cameras.values() for fact in camera._facts()[len(self.cameras) == 1 :]),
        ]

    def _repr_html_(self) -> str:
        verdicts = "".join(each._repr_html_() for each in self.assessments.values())
        return verdicts + html_table(type(self).__name__, self._facts()[len(self.assessments) :])

    def _columns(self) -> dict[str, list[object]]:
        each = [camera._columns() for camera in self.cameras.values()]
        columns = {key: [value for one in each for value in one[key]] for key in each[0]}
        if len(each) == 1:
            return columns
        names = [name for name, one in zip(self.cameras, each, strict=True) for _ in next(iter(one.values()))]
        return {"camera": [*names], **columns}
