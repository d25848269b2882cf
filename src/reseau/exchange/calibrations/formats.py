"""The formats, by name; writing a calibration to one, and reading a file of any."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from ...bundle import Camera
from ...calibration import Calibration, CameraMapping, read_calibration, required_use
from ...calibration.document import CameraModel, Covariance, Quantity
from ...core.errors import FormatError, UsageError
from ...core.provenance import Provenance, sha256_of
from ...io import read_text, write_whole
from ...optics import PixelGrid
from ...optics.cameras import convert
from ...optics.cameras.registry import camera_model, unit_of
from ...optics.cameras.splined import SplinedStereographic, SplineGrid
from ...optics.poses import rotation_matrix
from ..micmac import interior_text, read_interior
from . import basalt, brown, colmap, matlab, metashape, mrcal, opencv, openptv, yamls
from .plain import CENTRE, FISHEYE, RADIAL_TANGENTIAL, RATIONAL, THIN_PRISM, TILTED, Mounted

_RADTAN, _FIVE = (*CENTRE, *RADIAL_TANGENTIAL), (*CENTRE, *RADIAL_TANGENTIAL, "k3")
_EIGHT, _TWELVE = (*CENTRE, *RATIONAL), (*CENTRE, *THIN_PRISM)
# The most specific formats are tried first.
_ORDER = (
    "ros", "kalibr", "basalt", "mrcal", "dbat", "micmac", "metashape", "opencv", "matlab", "openptv",
    "photomodeler", "colmap",
)  # fmt: skip
# Pixel size where none is known: models in mm have only ratios to it.
_NOMINAL_MM = 0.005
# Differences (px) below which a simpler model of a format is not replaced by a more general one.
_SAME = 1e-3
# Differences (px) up to which a spline surface, with hundreds of parameters, does not replace a simple model.
_POOR = 0.05
# Intervals of a spline surface across the image, which hold a usual fisheye to 0.01 px, and its margin.
_INTERVALS, _MARGIN = 15, 1.05
# Root mean square difference, in widths of the image, beyond which a file would be of no use.
_USELESS = 0.01


@dataclass(frozen=True)
class CalibrationFormat:
    """A format of calibrations.

    Parameters
    ----------
    name : str
        Its name, as in ``reseau export --to``.
    suffixes : tuple of str
        Usual suffixes of its files.
    models : tuple of (str, tuple of str)
        Registered models that it holds, the simplest first, with the parameters it has of each.
    write : callable
        Text of the file of a camera.
    recognises : callable
        Whether a text is of this format.
    read : callable
        Camera of a text.
    beside : mapping of str to callable
        Texts of further files, by the suffixes with which they lie beside the first.
    comment : str
        Beginning of a line with a comment, or its place; empty where the format has no comments.
    splined : bool
        Whether it also holds cameras with a spline surface, which describe every lens.
    sides : tuple of str
        Sides of Brown's distortion that it holds, the usual one first.
    square : bool
        Whether pixels are square.
    rig : callable, optional
        Text of the file of cameras that are fixed to each other.

    Examples
    --------
    >>> calibration_formats()["colmap"].suffixes
    ('.txt',)
    """

    name: str
    suffixes: tuple[str, ...]
    models: tuple[tuple[str, tuple[str, ...]], ...]
    write: Callable[[Camera], str]
    recognises: Callable[[str], bool]
    read: Callable[[str, Path], Camera]
    beside: Mapping[str, Callable[[Camera], str]] = field(default_factory=dict)
    splined: bool = False
    sides: tuple[str, ...] = ("image",)
    square: bool = False
    comment: Literal["", "#", "%", "after the head"] = ""
    rig: Callable[[Sequence[Mounted]], str] | None = None


def calibration_formats() -> dict[str, CalibrationFormat]:
    """Return the formats by name.

    Examples
    --------
    >>> "micmac" in calibration_formats()
    True
    """
    wide, fisheye = (("opencv", _FIVE), ("opencv", _EIGHT)), ("fisheye", (*CENTRE, *FISHEYE))
    spheres = ("double_sphere", (*CENTRE, "xi", "alpha")), ("eucm", (*CENTRE, "alpha", "beta"))
    formats = (
        CalibrationFormat(
            "opencv", (".yml", ".yaml", ".xml", ".json"),
            (*wide, ("opencv_full", _TWELVE), ("opencv_full", (*CENTRE, *TILTED)), fisheye),
            opencv.write, opencv.recognises, opencv.read, comment="after the head", rig=opencv.write_pair,
        ),
        CalibrationFormat(
            "ros", (".yaml",), (*wide, fisheye), yamls.write_ros, yamls.is_ros, yamls.read_ros,
            comment="#",
        ),
        CalibrationFormat(
            "kalibr", (".yaml",),
            (("opencv", _RADTAN), fisheye, ("omni", (*_RADTAN, "xi")),
             *spheres),
            yamls.write_kalibr, yamls.is_kalibr, yamls.read_kalibr, comment="#", rig=yamls.write_kalibr_rig,
        ),
        CalibrationFormat(
            "basalt", (".json",), (("opencv", _EIGHT), fisheye, *spheres),
            basalt.write, basalt.recognises, basalt.read,
        ),
        CalibrationFormat(
            "colmap", (".txt",), (("opencv", _RADTAN), ("opencv", _EIGHT), fisheye),
            colmap.write, colmap.recognises, colmap.read, comment="#", rig=colmap.write_rig,
        ),
        CalibrationFormat(
            "mrcal", (".cameramodel",),
            (("opencv", _RADTAN), *wide, ("opencv_full", _TWELVE), ("stereographic", CENTRE)), mrcal.write,
            mrcal.recognises, mrcal.read, splined=True, comment="#",
        ),
        CalibrationFormat(
            "metashape", (".xml",), (("opencv", _FIVE), fisheye),
            metashape.write, metashape.recognises, metashape.read, comment="after the head",
        ),
        CalibrationFormat(
            "photomodeler", (".txt",), (("brown", brown.BROWN),),
            brown.write_photomodeler, brown.is_photomodeler, brown.read_photomodeler,
        ),
        CalibrationFormat(
            "dbat", (".xml",), (("brown", brown.BROWN),), brown.write_dbat, brown.is_dbat, brown.read_dbat,
            comment="after the head",
        ),
        CalibrationFormat(
            "micmac", (".xml",), (("brown", (*brown.BROWN, "B1", "B2")),),
            interior_text, brown.is_micmac, lambda _, path: read_interior(path), comment="after the head",
            sides=("image", "object"), square=True,
        ),
        CalibrationFormat(
            "matlab", (".m",), (("opencv", _FIVE),), matlab.write, matlab.recognises, matlab.read,
            comment="%",
        ),
        CalibrationFormat(
            "openptv", (".ori",), (("openptv", openptv.OPENPTV),),
            openptv.write, openptv.recognises, openptv.read, {openptv.BESIDE: openptv.write_beside},
        ),
    )  # fmt: skip
    return {entry.name: entry for entry in formats}


class Exported(NamedTuple):
    """A camera as it was written.

    Parameters
    ----------
    camera : Camera
        In the model that the format holds.
    rms_px, greatest_px : float
        Differences from the calibration over the image: root mean square, and largest; 0 where the model is
        the same.
    share : float
        Share of the image where the calibration has directions; the rest was not compared.
    notes : tuple of str
        That it has no verdict, or is usable for less than measurement.

    Examples
    --------
    >>> Exported(Camera.of("front", (640, 480), "opencv", {"fx": 800.0, "fy": 800.0}), 0.0, 0.0, 1.0).rms_px
    0.0
    """

    camera: Camera
    rms_px: float
    greatest_px: float
    share: float
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        off = f"at most {self.greatest_px:.2g} px off"
        return f"<Exported: {self.camera.id}, model {self.camera.model}, {off}>"


def export_calibration(
    calibration: Calibration, to: str, path: Path | str, *, anyway: bool = False
) -> Exported:
    """Write the calibration of a camera in the format of another program.

    A model that the format lacks is converted: of the models that it has, the simplest that differs by less
    than 0.001 px is written, otherwise that with the smallest largest difference.

    Parameters
    ----------
    calibration : Calibration
        Calibration of a camera.
    to : str
        Name of the format; see :func:`calibration_formats`.
    path : path
        File to write; its verdict is in a comment where the format has comments.
    anyway : bool
        Whether to go on with a calibration that is usable for nothing.

    Raises
    ------
    UsageError
        When the format is unknown, the calibration is not that of a camera or, unless `anyway`, usable for
        nothing, or no model describes it.
    InputError
        When the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> values = {"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5}
    >>> camera = Camera.of("front", (640, 480), "opencv", values)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "front.m"
    ...     done = export_calibration(_calibration(camera, {}), "matlab", file)
    ...     import_calibration(file).values()["cx"]
    319.5
    """
    formats = calibration_formats()
    if to not in formats:
        raise UsageError(f"is not one of {', '.join(formats)}", where=to)
    lens = calibration.mapping()
    if not isinstance(lens, CameraMapping):
        raise UsageError(calibration.not_of("camera"), where=calibration.name)
    form = formats[to]
    notes = _notes([calibration], anyway)
    found = _in_a_model_of(form, calibration, lens)._replace(notes=notes)
    path = Path(path)
    for suffix, write in form.beside.items():
        if path.suffix == suffix:
            raise UsageError(f"has the suffix of the file beside it, use {form.suffixes[0]}", where=path)
        write_whole(path.with_suffix(suffix), write(found.camera))
    write_whole(path, _commented(form, form.write(found.camera), [calibration]))
    return found


def _notes(calibrations: Sequence[Calibration], anyway: bool) -> tuple[str, ...]:
    return required_use([(each.name, each.assessment) for each in calibrations], "exported", anyway=anyway)


def _commented(form: CalibrationFormat, text: str, calibrations: Sequence[Calibration]) -> str:
    """The text with the verdicts in a comment."""
    said = [f"{each.name}: {each.assessment.short}" for each in calibrations if each.assessment is not None]
    comment = " ".join("; ".join(said).split())
    if not form.comment or not said:
        return text
    if form.comment != "after the head":
        return f"{form.comment} {comment}\n{text}"
    if text.lstrip().startswith("<"):
        head, _, rest = text.partition("\n")
        # Two hyphens would end a comment of XML.
        return f"{head}\n<!-- {comment.replace('--', '- -')} -->\n{rest}"
    # After the two lines of the YAML of OpenCV.
    head, mark, rest = text.partition("---\n")
    return f"{head}{mark}# {comment}\n{rest}"


def export_calibrations(
    calibrations: Sequence[Calibration], to: str, path: Path | str, *, anyway: bool = False
) -> tuple[Exported, ...]:
    """Write one calibration as :func:`export_calibration` does, and several as :func:`export_rig`.

    Examples
    --------
    >>> export_calibrations([], "kalibr", "chain.yaml")
    Traceback (most recent call last):
    ...
    reseau.core.errors.UsageError: calibrations: are not those of one rig: 0 have no place; give ...
    """
    if len(calibrations) == 1:
        return (export_calibration(calibrations[0], to, path, anyway=anyway),)
    return export_rig(calibrations, to, path, anyway=anyway)


def export_rig(
    calibrations: Sequence[Calibration], to: str, path: Path | str, *, anyway: bool = False
) -> tuple[Exported, ...]:
    """Write the calibrations of cameras that are fixed to each other in one file of another program.

    Parameters
    ----------
    calibrations : sequence of Calibration
        One of them is the reference, all others have a `place` with respect to it.
    to : str
        ``opencv``, for two cameras, ``kalibr``, or ``colmap``: a ``rig_config.json``.
    path : path
        File to write; OpenCV's translation is in mm, those of Kalibr and COLMAP are in m.
    anyway : bool
        Whether to go on with a calibration that is usable for nothing.

    Returns
    -------
    tuple of Exported
        The cameras, the reference first.

    Raises
    ------
    UsageError
        When the format has no rigs, the calibrations are not those of one rig, or, unless `anyway`, one is
        usable for nothing.
    InputError
        When the file cannot be written.

    Examples
    --------
    >>> export_rig([], "kalibr", "chain.yaml")
    Traceback (most recent call last):
    ...
    reseau.core.errors.UsageError: calibrations: are not those of one rig: 0 have no place; give ...
    """
    formats = calibration_formats()
    form = formats.get(to)
    if form is None or form.rig is None:
        known = ", ".join(name for name, each in formats.items() if each.rig is not None)
        raise UsageError(f"has no cameras that are fixed to each other; use {known}", where=to)
    first = [each for each in calibrations if each.place is None]
    placed = [each for each in calibrations if each.place is not None]
    units = {each.place.unit for each in placed if each.place is not None}
    if len(first) != 1 or not placed or len({each.place.reference for each in placed if each.place}) > 1:
        raise UsageError(
            f"are not those of one rig: {len(first)} have no place", where="calibrations",
            do="give its reference and the cameras placed with respect to it",
        )  # fmt: skip
    if units != {"mm"}:
        raise UsageError(f"have places in {', '.join(sorted(units))}, not in mm", where="calibrations")
    notes = _notes(calibrations, anyway)
    done, rig = list[Exported](), list[Mounted]()
    for each in (*first, *placed):
        lens = each.mapping()
        if not isinstance(lens, CameraMapping):
            raise UsageError(each.not_of("camera"), where=each.name)
        done.append(_in_a_model_of(form, each, lens))
        place = each.place
        turn = np.eye(3) if place is None else rotation_matrix(np.array(place.rotation))
        rig.append(Mounted(done[-1].camera, turn, np.zeros(3) if place is None else np.array(place.base)))
    text = form.rig(rig)
    write_whole(Path(path), text if text.startswith("[") else _commented(form, text, calibrations))
    return (done[0]._replace(notes=notes), *done[1:])


def _in_a_model_of(form: CalibrationFormat, calibration: Calibration, lens: CameraMapping) -> Exported:
    """The camera in one of the models of a format.

    Raises
    ------
    UsageError
        When none describes it, even roughly.
    """
    found = exported_lens(form, calibration.name, lens, cast(dict[str, Any], calibration.model))
    if found.rms_px > _USELESS * max(lens.size):
        known = ", ".join(formats_holding(calibration))
        raise UsageError(
            f"cannot be written as {form.name}: its nearest model differs by {found.rms_px:.0f} px rms",
            where=f"calibration {calibration.name}",
            do=f"use one of {known}" if known else "undistort the images, and give their camera",
        )
    return found


def _splined(lens: CameraMapping) -> str:
    """Name of the spline surface over the image of a camera, in mrcal's stereographic plane."""
    grid = PixelGrid(*lens.size, (1.0, 1.0))
    along = np.linspace(0, 1, 33)
    rim = np.concatenate([np.stack([along, 0 * along + k], 1) for k in (0, 1)])
    rim = np.concatenate([rim, rim[:, ::-1]]) * (np.array([grid.width, grid.height]) - 1.0)
    uv = lens.mapping.inverse(rim)
    uv = uv[np.isfinite(uv).all(axis=1)]
    r = np.hypot(*uv.T)
    plane = uv * (2 * np.tan(np.arctan(r) / 2) / np.maximum(r, 1e-12))[:, None]
    across, down = _MARGIN * np.abs(plane).max(axis=0, initial=1e-3)
    fov = int(np.ceil(np.rad2deg(4 * np.arctan(across / 2))))
    rows = int(np.ceil(_INTERVALS * down / across)) + 3
    return SplineGrid(3, _INTERVALS + 3, rows, fov).name


def _as_it_is(
    form: CalibrationFormat, name: str, lens: CameraMapping, stored: Mapping[str, Any]
) -> Camera | None:
    """The camera without conversion; None where the format lacks its model or one of its parameters."""
    model, given = str(stored["model"]), tuple(float(v) for v in stored["pitch_mm"])
    if model == "mapping":
        return None
    registered = camera_model(model)
    values = dict(zip(lens.mapping.names, lens.mapping.values.tolist(), strict=True))
    own = {key: value for key, value in values.items() if value or key in CENTRE}
    options = registered.checked_options(
        {o.name: stored[o.name] for o in registered.options if o.name in stored}
    )
    plain = not stored.get("additional")
    if form.square and given[0] != given[1]:
        return None
    if plain and model == "brown" and options.get("side") == "object" and "object" not in form.sides:
        # The same model in pixels.
        if not set(own) <= {*brown.BROWN}:
            return None
        model, own, given, options = (
            "opencv",
            brown.in_pixels(own, lens.size, (given[0], given[1])),
            (1.0, 1.0),
            {},
        )
    for wanted, names in form.models:
        same = wanted.partition("_full")[0] == model.partition("_full")[0] and set(own) <= set(names)
        if plain and same and any(options == _options(wanted, side) for side in form.sides):
            return Camera.of(name, lens.size, wanted, own, pitch_mm=(given[0], given[1]), options=options)
    if form.splined and isinstance(lens.mapping, SplinedStereographic):
        return Camera.of(name, lens.size, model, own)
    return None


def formats_holding(calibration: Calibration) -> tuple[str, ...]:
    """Names of the formats that hold the calibration of a camera without conversion.

    Examples
    --------
    >>> camera = Camera.of("front", (640, 480), "fisheye", {"fx": 300.0, "fy": 300.0, "k1": 0.1})
    >>> formats_holding(_calibration(camera, {}))
    ('opencv', 'ros', 'kalibr', 'basalt', 'colmap', 'metashape')
    """
    lens = calibration.mapping()
    if not isinstance(lens, CameraMapping):
        return ()
    forms, stored = calibration_formats(), cast(dict[str, Any], calibration.model)
    return tuple(
        name for name, form in forms.items() if _as_it_is(form, calibration.name, lens, stored) is not None
    )


def exported_lens(
    form: CalibrationFormat, name: str, lens: CameraMapping, stored: Mapping[str, Any]
) -> Exported:
    """The camera as it is, or converted to the model of a format that describes it best.

    Parameters
    ----------
    form : CalibrationFormat
        The format.
    name : str
        Name of the camera.
    lens : CameraMapping
        Its mapping.
    stored : mapping
        Its ``model``, ``pitch_mm`` (1 where it is not known), options of the model, and ``additional`` if it
        has such parameters, as in a :class:`~reseau.calibration.Calibration`.

    Raises
    ------
    UsageError
        When no model of the format describes it.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> from reseau.bundle.diagnostics.fields import camera_mapping
    >>> lens = camera_mapping(adjust_network(example_network()), 0)
    >>> brown = {"model": "brown", "pitch_mm": (0.01, 0.01)}
    >>> exported_lens(calibration_formats()["colmap"], "camera", lens, brown).camera.model
    'opencv'
    """
    own = _as_it_is(form, name, lens, stored)
    if own is not None:
        return Exported(own, 0.0, 0.0, 1.0)
    pitch_mm = float(stored["pitch_mm"][0])
    best: Exported | None = None
    rays = "parallel" if lens.mapping.parallel else "central"
    why = f"its rays are {rays}, which no model of the format describes"
    splined = ((_splined(lens), ()),) if form.splined else ()
    for wanted, names in (*form.models, *splined):
        if camera_model(wanted).parallel != lens.mapping.parallel:
            continue
        if not names and best is not None and best.greatest_px < _POOR:
            break
        pitch = _pitch(lens, pitch_mm) if camera_model(wanted).needs_pitch else (1.0, 1.0)
        pitch = (pitch[0], pitch[0]) if form.square else pitch
        try:
            done = convert(lens.mapping, PixelGrid(*lens.size, pitch), wanted, _options(wanted), free=names)
        except UsageError as error:
            why = error.reason
            continue
        values = dict(zip(done.mapping.names, done.mapping.values.tolist(), strict=True))
        held = {key: values[key] for key in names or values if key in values}
        camera = Camera.of(name, lens.size, wanted, held, pitch_mm=pitch, options=_options(wanted))
        trial = Exported(camera, done.rms_px, done.greatest_px, done.share)
        if best is None or trial.greatest_px < best.greatest_px:
            best = trial
        if best.greatest_px < _SAME:
            break
    if best is None:
        raise UsageError(f"cannot be written as {form.name}: {why}", where=f"calibration {name}")
    return best


def _options(model: str, side: str = "image") -> dict[str, str | float]:
    """Options of a model in the files of other programs: Brown's distortion is that of measured points."""
    given = {"side": side} if model == "brown" else {}
    return camera_model(model).checked_options(given)


def _pitch(lens: CameraMapping, given: float) -> tuple[float, float]:
    """Pixel size for models in mm: that of the calibration, or a nominal one, in the ratio of the scales."""
    slope = lens.mapping.derivatives(np.zeros((1, 2))).d_xy[0]
    across = _NOMINAL_MM if given == 1.0 else given
    return across, float(across * slope[0, 0] / slope[1, 1])


def import_calibration(path: Path | str) -> Calibration:
    """Read the calibration of a camera from a file of another program, recognised by its content.

    Its parameters have no uncertainty: they are held fixed.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is of no known format, or incomplete.

    Examples
    --------
    >>> import_calibration("missing.yaml")
    Traceback (most recent call last):
    reseau.core.errors.InputError: missing.yaml: cannot be read (No such file or directory)
    """
    path = Path(path)
    text = read_text(path)
    for form in (calibration_formats()[name] for name in _ORDER):
        if form.recognises(text):
            source = Provenance({path.name: sha256_of(path)}, {"format": form.name})
            return _calibration(form.read(text, path), source.to_dict())
    known = ", ".join(calibration_formats())
    raise FormatError(f"is not a calibration of one of the formats {known}", where=path)


def any_calibration(path: Path | str) -> Calibration:
    """Read a calibration: ours of any kind, or that of a camera in a file of another program.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is of no known format, or incomplete.

    Examples
    --------
    >>> any_calibration("missing.json")
    Traceback (most recent call last):
    reseau.core.errors.InputError: missing.json: cannot be read (No such file or directory)
    """
    path = Path(path)
    ours = path.suffix.lower() == ".json" and '"reseau-' in read_text(path)[:4096]
    return read_calibration(path) if ours else import_calibration(path)


def _calibration(camera: Camera, provenance: dict[str, Any]) -> Calibration:
    scales = (*CENTRE, *camera_model(camera.model).required)
    entry: CameraModel = {
        "model": camera.model, "width": camera.width, "height": camera.height,
        "pitch_mm": list(camera.pitch_mm),
    }  # fmt: skip
    entry = cast(CameraModel, entry | dict(camera.options))
    return Calibration(
        kind="camera",
        name=camera.id,
        model=entry,
        parameters={
            name: Quantity(value=value, sigma=0.0, unit=unit_of(name, camera.model))
            for name, value in camera.parameters.items()
            if value or name in scales
        },
        covariance=Covariance(names=(), matrix=()),
        sigma0=None,
        redundancy=0,
        provenance=provenance,
    )
