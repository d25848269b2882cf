"""Options of the calibration of a camera from photographs of a plane target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

from ..bundle import Options
from ..bundle.network.network import ControlPoints
from ..bundle.network.shutter import Shutter
from ..core import vocabulary as v
from ..core.data import Array
from ..core.errors import UsageError
from ..io.network import TurntableEntry
from ..io.refraction import RefractionEntry
from ..optics import camera_model
from ..optics.cameras.registry import CameraModel, default_camera_model
from .z_stage import Heights


class PlaneDesign(Protocol):
    """A plane target: names and coordinates of its points."""

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the points (p)."""

    @property
    def xy(self) -> Array:
        """Coordinates (p, 2), x right and y up."""

    @property
    def unit(self) -> str:
        """Unit of the coordinates; a label."""


@dataclass(frozen=True)
class CameraOptions:
    """Camera model of a calibration, and the parameters to estimate.

    Parameters
    ----------
    model : str, optional
        Name of a registered model, see :func:`reseau.optics.camera_models`, or ``auto``: it is chosen for
        each camera, see :func:`reseau.bundle.choose_models`. By default ``brown`` if the pixel size is given,
        otherwise ``opencv``.
    free : tuple of str
        Parameters to estimate; by default the usual ones of the model.
    pitch_mm : float or (float, float), optional
        Size of a pixel, one number where it is a square; required for models whose parameters are in
        millimetres.
    options : mapping of str to str or float
        Options of the model, such as the side of Brown's distortion.
    shutter : Shutter, optional
        For images that are read line by line while the camera moves; of the mode ``rolling``.

    Raises
    ------
    UsageError
        When the shutter is that of a line camera, the model, a parameter or an option is unknown, or the
        pixel size is missing.

    Examples
    --------
    >>> CameraOptions().model, CameraOptions(pitch_mm=0.005).chosen
    ('opencv', ('c', 'x0', 'y0', 'K1', 'K2', 'P1', 'P2'))
    """

    model: str = ""
    free: tuple[str, ...] = ()
    pitch_mm: tuple[float, float] | float | None = None
    options: Mapping[str, str | float] = field(default_factory=dict)
    shutter: Shutter | None = None

    def __post_init__(self) -> None:
        if isinstance(self.pitch_mm, int | float):
            object.__setattr__(self, "pitch_mm", (float(self.pitch_mm), float(self.pitch_mm)))
        if not self.model:
            object.__setattr__(self, "model", default_camera_model(self.pitch_mm is not None).name)
        model = self.registered
        if self.shutter is not None and self.shutter.mode == "line":
            # Approximate values of a line camera need points that are not in one plane.
            raise UsageError(
                "cannot be calibrated with a plane target", where="a line camera", do="adjust a network of it"
            )
        if self.automatic and (self.free or self.options):
            raise UsageError("has no parameters or options of its own", where="camera model auto")
        if model.needs_pitch and self.pitch_mm is None:
            raise UsageError("requires the pixel size", where=model.name, do="give pitch_mm (--pitch-mm)")
        unknown = [name for name in self.free if name not in model.names]
        if unknown:
            raise UsageError(f"is not one of {', '.join(model.names)}", where=unknown[0])
        if not self.automatic:
            object.__setattr__(self, "options", model.checked_options(self.options))

    @property
    def automatic(self) -> bool:
        """Whether the model is to be chosen."""
        return self.model == "auto"

    @property
    def registered(self) -> CameraModel:
        """The registered model; the default one where it is to be chosen."""
        return default_camera_model(self.pitch_mm is not None) if self.automatic else camera_model(self.model)

    @property
    def chosen(self) -> tuple[str, ...]:
        """Parameters to be estimated."""
        return self.free or self.registered.usual


@dataclass(frozen=True, eq=False)
class CalibrationOptions:
    """Options of a camera calibration.

    Parameters
    ----------
    adjustment : Options
        Options of the adjustment.
    sigma_px : float, optional
        Standard deviation of all image coordinates. Replaces the measured ones where the residuals are
        larger, because the target or the lens deviates from its model.
    control : ControlPoints, optional
        Control points for the datum; by default inner constraints over all points.
    leave_out : tuple of (str, str)
        Image points to leave out, by image and point.
    components : {"axes", "images", "cameras"}, optional
        Groups with separate factors on their standard deviations; see :func:`reseau.bundle.search_model`.
    eliminate : float, optional
        Significance level of the tests by which distortion parameters are dropped.
    heights : Heights, optional
        Heights of the target on a z-stage.
    refraction : RefractionEntry, optional
        Windows and media between the camera, whose name is ``camera`` if it is alone, and the target. The
        calibration is that of the camera in air. Without control points the diagonals of the target are
        distances of the design, known to a ten-thousandth: windows have dimensions, and the scale is not
        free.
    focal_35_mm : float, optional
        Approximate focal length as the camera says, for the format of 36 × 24 mm: taken for the start where
        that of the homographies is far from it.
    turntable : TurntableEntry, optional
        Turntable that carried the target, or the cameras; the axis is estimated. Photographs that are not in
        it were taken without.
    reject : bool, optional
        Whether gross errors among the image points are left out; by default where nothing explains as well
        what the adjustment leaves, see :mod:`reseau.bundle.explanations`. The notes of the result name them.
    target : {"free", "flat", "auto"}
        Whether all points of the target are unknowns, or are held as designed; ``auto`` holds them where
        :func:`reseau.bundle.choose_board` finds the target flat and as designed.

    Raises
    ------
    UsageError
        When the target is not one of these, or is defined otherwise.
    """

    adjustment: Options = field(default_factory=Options)
    sigma_px: v.SigmaPx | None = None
    control: ControlPoints | None = None
    leave_out: tuple[tuple[str, str], ...] = ()
    components: v.Components | None = None
    eliminate: v.Eliminate | None = None
    heights: Heights | None = None
    refraction: RefractionEntry | None = None
    focal_35_mm: float | None = None
    turntable: TurntableEntry | None = None
    reject: v.Reject | None = None
    target: Literal["free", "flat", "auto"] = "free"

    def __post_init__(self) -> None:
        if self.target not in ("free", "flat", "auto"):
            raise UsageError(f"is {self.target!r}, not `free`, `flat` or `auto`", where="target")
        if self.turntable is not None and self.heights is not None:
            raise UsageError("cannot be combined with heights", where="turntable")
        if self.target != "free" and (self.control or self.heights or self.refraction):
            raise UsageError(
                f"cannot be {self.target!r} with control points, heights, or windows and media",
                where="target",
            )
