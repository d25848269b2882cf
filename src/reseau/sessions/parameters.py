"""Parameters of sessions: one model for each plan, read strictly from the archive.

A model describes what the archive stores as `parameters` of a session. The archived JSON has no key `schema`:
the plan and the software version of a session stand beside it. Defaults apply to keys that a session does not
have, so that sessions of older versions stay readable.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import Field, model_validator

from ..capture import Bench, Goal, SensorSeriesPlan, Step
from ..capture.bench import ROLES
from ..capture.by_hand import check_reach
from ..capture.steps import HEIGHT, paper_steps, parse_steps
from ..core import vocabulary as v
from ..core.errors import FormatError, StateError, UsageError
from ..core.options import Group, Option
from ..instruments import Camera, CameraRig, EnvironmentSensor, Turntable
from ..io import Document

if TYPE_CHECKING:
    from ..procedures.calibration_options import CameraOptions
    from ..procedures.film_frame import FrameOptions


_FORMERLY = {
    "pitch": "pitch_mm", "row_jitter": "row_jitter_px", "psf": "psf_px", "search": "search_px",
    "format": "format_mm",
}  # fmt: skip
"""Keys that archives of older versions have."""


def present_keys(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return archived parameters of any version with the keys of the present one.

    Examples
    --------
    >>> present_keys({"pitch": 0.027, "fill": 0.8})
    {'pitch_mm': 0.027, 'fill': 0.8}
    """
    return {_FORMERLY.get(key, key): value for key, value in parameters.items()}


_Poses = Annotated[
    tuple[tuple[str, dict[str, float]], ...],
    Option(
        "CSV of poses, one column for each axis, and one for the name if they have some.",
        parse=lambda text: tuple((s.name, dict(s.position)) for s in parse_steps(text, "poses")),
    ),
]


class SessionParameters(Document):
    """Parameters that all plans share.

    Parameters
    ----------
    retakes : int
        Number of additional attempts after a bad frame.
    park : dict of str to float
        Position of the table after a complete plan; empty: it stays at the last pose.
    retreat : dict of str to float, optional
        Position of the table after a stop or a failure.
    home : bool
        Whether axes without a reference are homed first.
    camera, table, oscilloscope, scanner : str, optional
        Names of instruments on the bench. Default: the only one of its kind, if the plan uses one. A table
        that is named is recorded with every frame, also if the plan does not move it.
    seed : int, optional
        Seed of a simulated bench.

    Examples
    --------
    >>> FramesParameters.from_archive({"count": 3}, where="monday").expected
    3
    """

    SCHEMA: ClassVar[str] = "reseau-session-parameters/1"
    NEEDS: ClassVar[tuple[str, ...]] = ()
    """Instruments that the bench must have."""
    USES: ClassVar[tuple[str, ...]] = ()
    """Instruments that the bench may have; the operator replaces them."""
    RIGS: ClassVar[bool] = False
    """Whether the camera may be a rig."""

    retakes: v.Retakes = 2
    park: v.Park = Field(default_factory=dict)
    retreat: v.Retreat | None = None
    home: v.Home = False
    camera: v.Camera | None = None
    table: v.Table | None = None
    oscilloscope: v.Oscilloscope | None = None
    scanner: v.Scanner | None = None
    seed: v.Seed | None = None

    @classmethod
    def from_archive(cls, parameters: Mapping[str, Any], *, where: object) -> Self:
        """Read the parameters of a session; `where` names it in messages.

        Raises
        ------
        FormatError
            If a key is missing, unknown or has a value of a wrong type.
        """
        try:
            text = json.dumps({**parameters, "schema": cls.SCHEMA})
        except (TypeError, ValueError) as error:
            raise FormatError(f"not JSON ({error})", where=where) from None
        return cls.parse(text, where=where)

    @classmethod
    def defaults(cls, bench: Bench) -> dict[str, Any]:
        """Return what a new session on a bench has where it is not given."""
        return {}

    def to_archive(self) -> dict[str, Any]:
        """Return the JSON values that the archive stores: those keys that were given."""
        return self.model_dump(mode="json", exclude_unset=True)

    @property
    def expected(self) -> int | None:
        """Number of frames (or sections) that the plan takes; None if it is not known in advance."""
        return None

    @property
    def units(self) -> Mapping[str, str]:
        """Units of the standard deviations that the procedure reports, by parameter."""
        return {}

    @property
    def positions(self) -> tuple[Step, ...]:
        """Positions to which the plan moves the table."""
        given = (Step("park", self.park), Step("retreat", self.retreat or {}))
        return tuple(step for step in given if step.position)

    def part_of(self, bench: Bench) -> Bench:
        """Return the part of a bench that the plan uses; its other instruments need not even answer.

        The sensors of the environment belong to it, but need not answer: frames then say so.

        Raises
        ------
        UsageError
            If an instrument is missing, or there are several of its kind and none is named.
        """
        used = self._used(bench)
        sensors = [name for name, each in bench.instruments.items() if isinstance(each, EnvironmentSensor)]
        return bench.part([*used, *sensors], required=bench.part(used).instruments)

    def _used(self, bench: Bench) -> list[str]:
        """Names of the instruments that the plan uses."""
        moves = self.home or bool(self.positions)
        roles = [
            role
            for role, kind in ROLES.items()
            if role in self.NEEDS
            or getattr(self, role) is not None
            or (role in self.USES and bench.has(kind))
            or (role == "table" and moves)
        ]
        return [str(bench.one(self._kind(role, bench), getattr(self, role)).name) for role in roles]

    def _kind(self, role: str, bench: Bench) -> type:
        """Kind of the instrument of a role."""
        return CameraRig if role == "camera" and self.RIGS and self.has_rig(bench) else ROLES[role]

    def frames_on(self, bench: Bench) -> int | None:
        """Number of frames (or sections) on a bench: each camera of a rig takes one at each pose."""
        count = self.expected
        if count is None or not self.RIGS or not self.has_rig(bench):
            return count
        rig: CameraRig = bench.one(CameraRig, self.camera)
        return count * len(rig.cameras)

    def has_rig(self, bench: Bench) -> bool:
        """Return whether the camera of the session is a rig of the bench."""
        return self.camera is not None and isinstance(bench[self.camera], CameraRig)

    def check_bench(self, bench: Bench) -> None:
        """Check that a bench can carry out the plan, before it is connected.

        Raises
        ------
        UsageError
            If an instrument is missing, or a pose is out of its range.
        """
        self._used(bench)
        if self.positions:
            table = bench.one(Turntable, self.table)
            for step in self.positions:
                check_reach(table, step.position, step.name)

    def check_homed(self, bench: Bench) -> None:
        """Check on a connected bench that all axes that the plan moves have their reference.

        Raises
        ------
        StateError
            If one has none.
        """
        if not self.positions:
            return
        table: Turntable = bench.one(Turntable, self.table)
        moved = dict.fromkeys(axis for step in self.positions for axis in step.position)
        lost = [axis for axis in moved if not table.state(axis).homed]
        if lost:
            have = "have no reference" if len(lost) > 1 else "has no reference"
            do = "home them first, or have the session do it (--home)"
            raise StateError(f"{', '.join(lost)} {have}", where=table.name, do=do)


class FramesParameters(SessionParameters):
    """Parameters of the plan `frames`: frames one after the other.

    Parameters
    ----------
    count : int
        Number of frames.
    average : int
        Exposures averaged to a frame.
    checks : int
        Frames for the checks before the first frame; 0: no checks.

    Examples
    --------
    >>> FramesParameters(count=2).to_archive()
    {'count': 2}
    """

    SCHEMA: ClassVar[str] = "reseau-frames-parameters/1"
    RIGS: ClassVar[bool] = True
    NEEDS: ClassVar[tuple[str, ...]] = ("camera",)

    retakes: v.Retakes = 0
    count: v.Count = 1
    average: v.Average = 1
    checks: v.Checks = 0

    @property
    def expected(self) -> int:
        """Number of frames."""
        return self.count


class ScanParameters(SessionParameters):
    """Parameters of the plan `scan`: sections of the ultrasonic scanner.

    Parameters
    ----------
    count : int
        Number of sections.

    Examples
    --------
    >>> ScanParameters().expected
    1
    """

    SCHEMA: ClassVar[str] = "reseau-scan-parameters/1"
    NEEDS: ClassVar[tuple[str, ...]] = ("scanner",)
    USES: ClassVar[tuple[str, ...]] = ("oscilloscope",)

    retakes: v.Retakes = 0
    count: v.Count = 1

    @property
    def expected(self) -> int:
        """Number of sections."""
        return self.count


class OwnParameters(SessionParameters):
    """Parameters of the plan `own`: a generator in a Python file of the user.

    Parameters
    ----------
    set : dict
        Arguments of the generator.

    Examples
    --------
    >>> OwnParameters(set={"tilts": [10, 20]}).to_archive()
    {'set': {'tilts': [10, 20]}}
    """

    SCHEMA: ClassVar[str] = "reseau-own-parameters/1"

    retakes: v.Retakes = 0
    set: dict[str, Any] = Field(default_factory=dict)

    def part_of(self, bench: Bench) -> Bench:
        """Return the bench with all its instruments, of which only the named ones must answer."""
        return bench.part(bench.instruments, required=self._used(bench))


class OscilloscopeParameters(SessionParameters):
    """Parameters of the plan `oscilloscope`: PHOTO I, II and III.

    Parameters
    ----------
    body : bool
        Whether PHOTO III is taken.
    average, checks : int
        As for :class:`FramesParameters`.
    check : tuple of str
        Marks of the reseau used as check points only.

    Examples
    --------
    >>> OscilloscopeParameters(body=False).check
    ()
    """

    SCHEMA: ClassVar[str] = "reseau-oscilloscope-parameters/1"
    NEEDS: ClassVar[tuple[str, ...]] = ("camera",)
    USES: ClassVar[tuple[str, ...]] = ("scanner", "oscilloscope")

    body: v.Body = True
    average: v.Average = 1
    checks: v.Checks = 0
    check: v.Check = ()


class BlurredParameters(SessionParameters):
    """Parameters of the plan `blurred`: targets on a frame, measured by rays through lens and windows.

    Parameters
    ----------
    steps : tuple of (str, dict of str to float)
        Names and positions of the poses; the names are those of images of the network.
    psf_px : float
        Blur of sensor and diffraction beside that of the rays (px, one sigma).
    search_px : float
        Largest distance from the predicted position (px).
    rounds : int
        Largest number of rounds.
    initial : {"given", "centroid", "edge"}
        Ordinary coordinates; see :class:`reseau.procedures.blurred_network.NetworkOptions`.
    average, checks : int
        As for :class:`FramesParameters`.

    Examples
    --------
    >>> BlurredParameters(steps=(("frontal", {"tilt": 0.0}),)).expected
    1
    """

    SCHEMA: ClassVar[str] = "reseau-blurred-parameters/1"
    NEEDS: ClassVar[tuple[str, ...]] = ("camera", "table")

    steps: _Poses
    psf_px: v.PsfPx = 0.5
    search_px: v.SearchPx = 6.0
    rounds: v.Rounds = 6
    initial: v.Initial = "centroid"
    average: v.Average = 1
    checks: v.Checks = 0

    @property
    def expected(self) -> int:
        """Number of poses."""
        return len(self.steps)

    def poses(self) -> tuple[Step, ...]:
        """Return the poses as steps."""
        return tuple(Step(name, position) for name, position in self.steps)

    @property
    def positions(self) -> tuple[Step, ...]:
        """Positions to which the plan moves the table."""
        return (*self.poses(), *super().positions)


class TestfieldParameters(SessionParameters):
    """Parameters of the plan `testfield`: a camera calibrated by images of a target from many poses.

    Parameters
    ----------
    steps : tuple of (str, dict of str to float)
        Names and positions of the poses; with `until`, the candidates.
    pitch_mm : float or None
        Size of a pixel (mm), for Brown's model; None: OpenCV's model.
    free : tuple of str
        Parameters to estimate; empty: the usual ones of the model.
    row_jitter_px : float
        Standard deviation of the start of a row of the sensor (px).
    fill : float
        Light-sensitive part of a pixel, as a share of its area.
    until : str
        Goal; poses are chosen until it is reached. See :class:`reseau.capture.Goal`.
    first : int
        Number of poses taken before poses are chosen.
    sigmas : (float, float, float), optional
        Standard deviations of a height of the z-stage (mm), of the direction of its axis (rad) and of the
        coordinates of the design (mm); None: each image has its own orientation.
    average, checks : int
        As for :class:`FramesParameters`.

    Examples
    --------
    >>> steps = (("frontal", {"tilt": 0.0}), ("tilted", {"tilt": 30.0}))
    >>> given = TestfieldParameters(steps=steps, pitch_mm=0.027, free=("c",), row_jitter_px=0.0, fill=0.8)
    >>> given.expected, given.camera_options().model
    (2, 'brown')
    """

    __test__: ClassVar[bool] = False  # not a class of tests
    SCHEMA: ClassVar[str] = "reseau-testfield-parameters/1"
    RIGS: ClassVar[bool] = True
    NEEDS: ClassVar[tuple[str, ...]] = ("camera", "table")

    steps: _Poses
    pitch_mm: v.PitchMm | None
    free: v.Free
    row_jitter_px: v.RowJitterPx
    fill: v.Fill
    until: v.Until = ""
    first: v.First = 5
    sigmas: (
        Annotated[
            tuple[float, float, float],
            Option(
                "On a z-stage: standard deviations of a height (mm), of the direction of the stage (rad), "
                "and of the coordinates of the design (mm).",
                Group.TARGET,
                value="0.01,0.01,0.05",
            ),
        ]
        | None
    ) = None
    average: v.Average = 1
    checks: v.Checks = 0

    @classmethod
    def defaults(cls, bench: Bench) -> dict[str, Any]:
        """Return the poses of the paper, as far as the table has their axes, and the usual model."""
        steps = paper_steps(axes=tuple(bench.one(Turntable).axes)) if bench.has(Turntable) else ()
        poses = tuple((step.name, dict(step.position)) for step in steps)
        return {"steps": poses, "pitch_mm": None, "free": (), "row_jitter_px": 0.0, "fill": 1.0}

    @property
    def expected(self) -> int | None:
        """Number of poses; None if poses are chosen."""
        return None if self.until else len(self.steps)

    @property
    def units(self) -> Mapping[str, str]:
        """Units of the parameters of the camera."""
        from ..optics.cameras.registry import unit_of

        options = self.camera_options()
        return {name: unit_of(name, options.model) for name in options.chosen}

    @property
    def goal(self) -> Goal | None:
        """The goal, if poses are chosen."""
        return Goal.parse(self.until) if self.until else None

    def poses(self) -> tuple[Step, ...]:
        """Return the poses as steps."""
        return tuple(Step(name, position) for name, position in self.steps)

    def camera_options(self) -> CameraOptions:
        """Return the camera model and the parameters to estimate."""
        from ..procedures.calibration_options import CameraOptions

        return CameraOptions(free=self.free, pitch_mm=self.pitch_mm)

    @staticmethod
    def lifted(steps: Sequence[Step]) -> bool:
        """Return whether the target is recorded at several heights."""
        return len({step.position.get(HEIGHT, 0.0) for step in steps}) > 1

    @property
    def positions(self) -> tuple[Step, ...]:
        """Positions to which the plan moves the table."""
        return (*self.poses(), *super().positions)

    def check_bench(self, bench: Bench) -> None:
        """Check instruments, the range of all poses, and that the goal is about an estimated parameter."""
        super().check_bench(bench)
        self._check_goal()
        if not self.has_rig(bench):
            return
        for option, given in (("--until", bool(self.until)), ("--heights", self.sigmas is not None)):
            if given:
                raise UsageError("requires one camera", where=option, do="omit it, or choose one of the rig")
        uses = getattr(bench[self.camera or ""], "uses", ())
        wet = [name for name in uses if bench.file.instruments[name].refraction is not None]
        if wet:
            raise UsageError(
                "has `refraction`: a rig is calibrated in air only", where=wet[0], do="calibrate it alone"
            )

    def _check_goal(self) -> None:
        model, goal = self.camera_options(), self.goal
        if goal is None:
            return
        name = f"sigma_{goal.parameter}"
        if goal.parameter not in model.chosen:
            raise UsageError("is not estimated", where=name, do=f"use {', '.join(model.chosen)}")
        unit = self.units[goal.parameter]
        if goal.unit and goal.unit != unit:
            raise UsageError(f"has the unit {unit or '1'}, not {goal.unit}", where=name)


class PhotographsParameters(SessionParameters):
    """Parameters of the plan `photographs`: a camera calibrated by photographs that were taken by hand.

    Parameters
    ----------
    model : str
        Camera model; empty: Brown's with `pitch_mm`, else OpenCV's.
    pitch_mm : float, optional
        Size of a pixel (mm).
    free : tuple of str
        Parameters to estimate; empty: the usual ones of the model.
    row_jitter_px, fill : float
        As for :class:`TestfieldParameters`.

    Examples
    --------
    >>> PhotographsParameters(pitch_mm=0.005).camera_options().model
    'brown'
    """

    SCHEMA: ClassVar[str] = "reseau-photographs-parameters/1"

    retakes: v.Retakes = 0
    model: v.Model = ""
    pitch_mm: v.PitchMm | None = None
    free: v.Free = ()
    row_jitter_px: v.RowJitterPx = 0.0
    fill: v.Fill = 1.0

    @model_validator(mode="after")
    def _possible(self) -> Self:
        try:
            self.camera_options()
        except UsageError as error:
            raise ValueError(str(error)) from None
        return self

    @property
    def sigmas(self) -> None:
        """There is no z-stage."""
        return

    def camera_options(self) -> CameraOptions:
        """Return the camera model and the parameters to estimate.

        Raises
        ------
        UsageError
            If the model or a parameter is unknown, or the size of a pixel is missing.
        """
        from ..procedures.calibration_options import CameraOptions

        return CameraOptions(self.model, self.free, self.pitch_mm)


class FilmParameters(SessionParameters):
    """Parameters of the plan `film`: the inner orientation of the scans of a roll of film.

    Parameters
    ----------
    format_mm : (float, float), optional
        Width and height of a frame (mm). Default: the usual formats are tried.
    dpi : float, optional
        Resolution of the scans (pixels per inch), if that in the files is missing or wrong.
    transform : str
        Transformation to calibrated corners, which are the input ``corners.json`` if there is one.

    Examples
    --------
    >>> FilmParameters(format_mm=(36, 24)).options().formats
    ((36.0, 24.0),)
    """

    SCHEMA: ClassVar[str] = "reseau-film-parameters/1"

    retakes: v.Retakes = 0
    format_mm: tuple[Annotated[float, Field(gt=1, lt=400)], Annotated[float, Field(gt=1, lt=400)]] | None = (
        None
    )
    dpi: v.Dpi | None = None
    transform: v.Transform = "affine"

    def options(self) -> FrameOptions:
        """Return the prior knowledge of the frames."""
        from ..procedures.film_frame import FrameOptions

        if self.format_mm is None:
            return FrameOptions(dpi=self.dpi)
        return FrameOptions(formats=(self.format_mm,), dpi=self.dpi)


class SensorParameters(SessionParameters):
    """Parameters of the plan `sensor`: the sensor series of a camera.

    Parameters
    ----------
    region : (int, int, int, int) or None
        Left, top, width and height of the slanted edge (px); None: the whole image.
    levels, frames, longest_us, edge_us
        As for :class:`reseau.capture.SensorSeriesPlan`.
    count : int, optional
        Number of frames.
    settings : dict
        Settings of the camera at the start.

    Examples
    --------
    >>> SensorParameters.from_archive({}, where="mine: parameters of plan `sensor`")
    Traceback (most recent call last):
        ...
    reseau.core.errors.FormatError: mine: parameters of plan `sensor`: missing key `region`
    """

    SCHEMA: ClassVar[str] = "reseau-sensor-parameters/1"
    NEEDS: ClassVar[tuple[str, ...]] = ("camera",)

    region: v.Region | None
    levels: v.Levels = 14
    frames: v.Frames = 8
    longest_us: Annotated[float, Option("Longest exposure time (µs).", least=1)] = 1e6
    edge_us: Annotated[float, Option("Exposure time of a slanted edge (µs); none: no edge.")] | None = None
    count: v.Count | None = None
    settings: dict[str, Any] = Field(default_factory=dict)

    @classmethod
    def defaults(cls, bench: Bench) -> dict[str, Any]:
        """Return the whole image as region of an edge."""
        return {"region": None}

    @classmethod
    def on_bench(
        cls,
        bench: Bench,
        *,
        camera: str | None = None,
        levels: int = 14,
        frames: int = 8,
        longest_us: float = 1e6,
        edge: bool = False,
        region: tuple[int, int, int, int] | None = None,
        retakes: int = 2,
    ) -> Self:
        """Return the parameters for a camera of a bench, with its current settings.

        Parameters
        ----------
        bench : Bench
            The bench.
        camera : str, optional
            Name of the camera. Default: the only one.
        levels, frames, longest_us
            As for :class:`reseau.capture.SensorSeriesPlan`.
        edge : bool
            Whether a slanted edge is taken, at the current exposure of the camera.
        region, retakes
            As for the class.
        """
        device = bench.one(Camera, camera)
        settings = device.settings.to_dict()
        edge_us = float(settings["exposure_us"]) if edge else None
        plan = SensorSeriesPlan(levels, frames, longest_us, edge_us)
        return cls(
            **vars(plan), count=plan.count, camera=device.name, settings=settings, region=region,
            retakes=retakes, park={},
        )  # fmt: skip

    @property
    def series(self) -> SensorSeriesPlan:
        """The frames to take."""
        return SensorSeriesPlan(self.levels, self.frames, self.longest_us, self.edge_us)

    @property
    def expected(self) -> int:
        """Number of frames."""
        return self.count or self.series.count
