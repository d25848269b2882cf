"""The result of the calibration of a camera, or of several fixed to each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..bundle import (
    BoardChoice,
    CameraEstimate,
    Explanation,
    ImageEstimates,
    Misnamed,
    ModelChoice,
    PointEstimates,
    Result,
    calibration_of,
    camera_mapping,
    explain,
    model_search_entries,
)
from ..calibration import Calibration
from ..core.data import Frame, ImagePoints
from ..core.display import Display
from ..core.failure import Remark
from .assessment import Assessment, assess

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["ONE_CAMERA", "Calibrated"]

ONE_CAMERA = "camera"
"""Name of a camera that is alone."""


@dataclass(frozen=True, eq=False, repr=False)
class Calibrated(Display):
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
    """

    result: Result
    measured: dict[str, ImagePoints]
    declined: dict[str, str]
    choices: Mapping[str, ModelChoice] = field(default_factory=dict)
    board: BoardChoice | None = None
    notes: tuple[str, ...] = ()
    misnamed: Misnamed | None = None

    def __bool__(self) -> bool:
        return True

    def required(self) -> Calibrated:
        """Return the calibration itself; see :meth:`~reseau.core.failure.Failure.required`."""
        return self

    @property
    def choice(self) -> ModelChoice | None:
        """How the model of the only camera was chosen; None where it was given."""
        return self.choices.get(ONE_CAMERA)

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight; NaN without redundancy."""
        return self.result.sigma0

    @property
    def warnings(self) -> tuple[Remark, ...]:
        """Warnings about the adjustment."""
        return self.result.warnings

    @property
    def cameras(self) -> dict[str, CameraEstimate]:
        """Estimated parameters of the cameras, by their names; one that is alone is called ``camera``."""
        return self.result.cameras

    @cached_property
    def explanation(self) -> Explanation:
        """What is wrong, if anything."""
        return explain(self.result, self.misnamed)

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
            more |= {"assessment": assessed.entries()}
        if (camera or ONE_CAMERA) in self.choices:
            more |= {"camera_models": self.choices[camera or ONE_CAMERA].entries()}
        if self.board is not None:
            more |= {"target": self.board.entries()}
        return found.model_copy(update={"validity": found.validity | more}) if more else found

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
        """Draw residuals over the image and the uncertainty of the projection side by side, with matplotlib.

        Parameters
        ----------
        photo : Frame, optional
            One of the photographs; drawn first, with the points measured in it.

        Returns
        -------
        sequence of matplotlib Axes
            Of the panels: one for each camera, one or two before them.
        """
        import matplotlib.pyplot as plt

        from ..core.figures import BLUE

        cameras = len(self.cameras)
        count = cameras + (1 if photo is None else 2)
        _, row = plt.subplots(1, count, figsize=(4.6 * count, 3.9), layout="constrained")
        panels = list(row)
        if photo is not None:
            photo.plot(panels[0])
            points = self.measured.get(photo.name)
            if points is not None:
                panels[0].plot(*points.xy.T, "o", color=BLUE, markerfacecolor="none", markersize=4)
                panels[0].set_title(f"{photo.name}: {len(points)} points", loc="left")
        self.result.plot(panels[-1 - cameras])
        for c, axes in enumerate(panels[-cameras:]):
            camera_mapping(self.result, c).plot(axes)
        return panels

    def _facts(self) -> list[tuple[str, str]]:
        count = sum(len(points) for points in self.measured.values())
        return [
            (f"{len(self.measured)} images", ""),
            (f"{count} image points", ""),
            (f"{len(self.declined)} declined", ""),
            ("sigma0", f"{self.sigma0:.3f}"),
            *(fact for camera in self.cameras.values() for fact in camera._facts()[len(self.cameras) == 1 :]),
        ]

    def _columns(self) -> dict[str, list[object]]:
        each = [camera._columns() for camera in self.cameras.values()]
        columns = {key: [value for one in each for value in one[key]] for key in each[0]}
        if len(each) == 1:
            return columns
        names = [name for name, one in zip(self.cameras, each, strict=True) for _ in next(iter(one.values()))]
        return {"camera": [*names], **columns}
