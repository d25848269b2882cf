"""The functions of ``import reseau``: from files, arrays or frames to results, one call each.

Every function accepts what a user has at hand: paths, arrays of grey values, frames, image points. An
argument of a wrong kind is a :class:`~reseau.core.errors.UsageError` that names it. A failed estimate
is a falsy :class:`~reseau.core.failure.Failure` with its reason; its ``required()`` raises instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from .bundle import Network, Result, ResultDocument
from .bundle import Options as AdjustmentOptions
from .bundle import adjust_network as _adjust
from .calibration import Calibration
from .calibration import read_calibration as _read_calibration
from .calibration.sensor import SensorCorrection
from .core.data import Frame, ImagePoints
from .core.errors import UsageError
from .core.failure import Failure
from .exchange import read_lens as _read_lens
from .exchange import read_network
from .exchange.boards import read_target
from .exchange.lenses import Lens
from .io import BoardDesign, ReseauDesign, TestfieldDesign
from .io.images import Channel, grey_of, open_scan
from .io.images import read_image as _read_image
from .io.reading import is_points, read_measurement
from .io.scans import scan_of
from .measure import measure_board, measure_pins, measure_reseau, measure_testfield
from .measure.boards.measure import BoardOptions
from .measure.pins.detection import PinOptions
from .measure.points import Measured
from .measure.reseau.marks import ReseauOptions
from .measure.testfield.measure import TestfieldOptions
from .procedures.calibrated import Calibrated
from .procedures.calibrating import calibrate_photographs
from .procedures.calibration_options import CalibrationOptions, CameraOptions
from .procedures.exposures import Taken, exposures_of_files, photographs_named
from .procedures.film_frame import FrameOptions, FrameResult, orient_scan
from .procedures.refined import Refined
from .procedures.refining import Photographs, RefineOptions, refine_photographs
from .procedures.which_target import measured_or_shown

T = TypeVar("T")

PathLike = str | Path
Colours = Literal["bgr", "rgb"]
ImageLike = PathLike | NDArray[Any] | Frame
PhotoLike = ImageLike | ImagePoints
DesignLike = PathLike | ReseauDesign | TestfieldDesign | BoardDesign
CalibrationLike = PathLike | Calibration
LensLike = PathLike | Lens


def read_image(source: ImageLike, channel: Channel = "luma", *, colours: Colours | None = None) -> Frame:
    """Read an image as a frame of grey values.

    Parameters
    ----------
    source : str, Path, ndarray (h, w) or (h, w, 3), or Frame
        An image file (PNG, JPEG, TIFF, BMP; 8 or 16 bit), an array, or a frame, which is returned as it is.
    channel : {"luma", "red", "green", "blue", "interpolated"}
        What is taken of a colour image.
    colours : {"bgr", "rgb"}, optional
        Order of the channels of an array; required for arrays in colour: those of OpenCV are ``bgr``.

    Raises
    ------
    InputError
        When the file cannot be read.
    ImageError
        When it is no image that can be measured in.
    UsageError
        When `source` is of another kind.

    Examples
    --------
    >>> import numpy as np
    >>> import reseau
    >>> reseau.read_image(np.zeros((480, 640), np.uint8))
    <Frame: name frame, size 640 × 480 px, type uint8, full scale 255>
    """
    if isinstance(source, Frame):
        return source
    if isinstance(source, np.ndarray):
        if source.dtype.kind not in "uf":
            raise UsageError(
                f"has grey values of type {source.dtype}",
                where="source",
                do="give unsigned integers or floats",
            )
        scale = (
            float(np.iinfo(source.dtype).max) if source.dtype.kind == "u" else float(source.max(initial=1))
        )
        return Frame(_grey(source, channel, colours), scale)
    return _read_image(_path(source, "source", "a path, an array or a Frame"), channel)


def _grey(pixels: NDArray[Any], channel: Channel, colours: Colours | None) -> NDArray[Any]:
    """The grey values of an array, or those of its channels in colour."""
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        return pixels
    if colours not in ("bgr", "rgb"):
        raise UsageError(
            f"is {colours!r}, and the array has three channels", where="colours",
            do='give "bgr" for arrays of OpenCV, else "rgb"',
        )  # fmt: skip
    return grey_of(pixels if colours == "rgb" else pixels[:, :, ::-1], channel)


def read_design(source: DesignLike) -> ReseauDesign | TestfieldDesign | BoardDesign:
    """Read the design of a target: ``reseau-design/1``, ``testfield-design/1`` or ``reseau-board/1``.

    Parameters
    ----------
    source : str, Path, ReseauDesign, TestfieldDesign or BoardDesign
        A file, also one in which Kalibr or OpenCV describes a board; or a design, which is returned as it is.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is no design.

    Examples
    --------
    >>> import reseau
    >>> from reseau.designs import coded_sheet
    >>> len(reseau.read_design(coded_sheet(10, 8, 25.0)).ids)
    80
    """
    if isinstance(source, ReseauDesign | TestfieldDesign | BoardDesign):
        return source
    return read_target(_path(source, "source", "a path or a design"))


def read_calibration(source: CalibrationLike) -> Calibration:
    """Read a calibration of any kind: camera, oscilloscope, film frame, sensor.

    Parameters
    ----------
    source : str, Path or Calibration
        A file, or a calibration, which is returned as it is.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is no calibration.

    Examples
    --------
    >>> import tempfile
    >>> import reseau
    >>> from reseau.bundle import calibration_of, example_network
    >>> result = reseau.adjust_network(example_network())
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     calibration_of(result, "camera", name="example").write(f"{folder}/camera.json")
    ...     reseau.read_calibration(f"{folder}/camera.json")
    <Calibration: camera 'example', 4 of 10 parameters estimated, sigma0 1.005>
    """
    if isinstance(source, Calibration):
        return source
    return _read_calibration(_path(source, "source", "a path or a Calibration"))


def read_lens(source: LensLike) -> Lens:
    """Read the design of a lens: ``lens/1`` (TOML), Zemax ``.zmx``, CODE V ``.seq``.

    Parameters
    ----------
    source : str, Path or Lens
        A file, or a lens, which is returned as it is.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is no lens, or has something that is not supported, which is named.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import reseau
    >>> text = '''
    ... schema = "lens/1"
    ... name = "singlet"
    ... wavelengths_nm = [587.5618]
    ... stop_radius = 5.0
    ... surface = [
    ...     {radius = 50.0, distance = 5.0, medium = "N-BK7", stop = true},
    ...     {distance = 93.45, medium = "air"},
    ...     {},
    ... ]
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "lens.toml").write_text(text)
    ...     lens = reseau.read_lens(f"{folder}/lens.toml")
    >>> lens.prescription.name, lens.sensor
    ('singlet', None)
    """
    if isinstance(source, Lens):
        return source
    return _read_lens(_path(source, "source", "a path or a Lens"))


def measure(
    image: ImageLike,
    design: DesignLike,
    *,
    options: ReseauOptions | TestfieldOptions | BoardOptions | PinOptions | None = None,
    sensor: CalibrationLike | None = None,
    channel: Channel = "luma",
    colours: Colours | None = None,
) -> Measured | Failure:
    """Measure the marks of a target in an image to sub-pixel image coordinates with covariances.

    Parameters
    ----------
    image : str, Path, ndarray (h, w) or (h, w, 3), or Frame
        The image.
    design : str, Path, ReseauDesign, TestfieldDesign or BoardDesign
        The target: a reseau, a sheet of disks, the rods of a test object, a coded testfield, or a board.
    options : ReseauOptions, TestfieldOptions, BoardOptions or PinOptions, optional
        Options of the measurement of this kind of target.
    sensor : str, Path or Calibration, optional
        Calibration of the sensor, applied first.
    channel : {"luma", "red", "green", "blue", "interpolated"}
        What is taken of a colour image.
    colours : {"bgr", "rgb"}, optional
        Order of the channels of an array; required for arrays in colour: those of OpenCV are ``bgr``.

    Returns
    -------
    Measured or Failure
        Image coordinates in pixels, `ok` and `why` of every mark; a failure when the target is not found,
        which says what board the image shows in its place.

    Raises
    ------
    UsageError
        When `options` are those of another kind of target.
    """
    target = read_design(design)
    frame = _corrected(read_image(image, channel, colours=colours), sensor)
    if isinstance(target, TestfieldDesign):
        return measure_testfield(frame, target, _options(options, TestfieldOptions))
    if isinstance(target, BoardDesign):
        chosen = _options(options, BoardOptions)
        return measured_or_shown(frame, target, lambda each: measure_board(each, target, chosen))
    if target.mark.shape == "rod":
        return measure_pins(frame, target, _options(options, PinOptions))
    return measure_reseau(frame, target, _options(options, ReseauOptions))


def calibrate(
    images: PathLike | Iterable[PhotoLike] | Mapping[str, PathLike | Iterable[PhotoLike]],
    design: DesignLike = "auto",
    *,
    model: str | CameraOptions | Mapping[str, str | CameraOptions] | None = None,
    pitch_mm: float | None = None,
    free: Sequence[str] = (),
    image_size: tuple[int, int] | Mapping[str, tuple[int, int]] | None = None,
    options: CalibrationOptions | None = None,
    sensor: CalibrationLike | None = None,
    channel: Channel = "luma",
    colours: Colours | None = None,
) -> Calibrated | Failure:
    """Calibrate a camera, or cameras that are fixed to each other, from photographs of a target.

    Parameters
    ----------
    images : str or Path, or iterable of str, Path, ndarray, Frame or ImagePoints, or mapping of str to these
        A folder, or photographs of one size, folders of them, or the coordinates measured in them. Of several
        cameras by their names: files with the same name, or the same last number in it, were taken at once;
        of others as many in the same order.
    design : str, Path, ReseauDesign, TestfieldDesign or BoardDesign
        The target; ``auto`` looks for it, among the designs beside the photographs and the usual ones.
    model : str or CameraOptions, or mapping of str to these, optional
        Name of the camera model, of all cameras or of those named; by default it is chosen, see
        :func:`reseau.bundle.choose_models`. With `free` alone it is ``brown`` where the pixel size is given,
        else ``opencv``.
    pitch_mm : float, optional
        Size of a pixel in millimetres.
    free : sequence of str
        Parameters to estimate; by default the usual ones of the model.
    image_size : (int, int), or mapping of str to (int, int), optional
        Width and height in pixels, where no photograph gives them.
    options : CalibrationOptions, optional
        Options of the adjustment.
    sensor, channel, colours
        As for :func:`measure`.

    Returns
    -------
    Calibrated or Failure
        The calibration with everything it was made of; a failure when fewer than three images show the
        target, or the adjustment has no solution.

    Examples
    --------
    >>> import numpy as np
    >>> import reseau
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> from reseau.optics import OpenCV, Pose, project
    >>> design = regular_reseau(7, 5, 20.0, Mark(shape="disk", size=5.0), name="disks")
    >>> camera = OpenCV.from_parameters({"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5})
    >>> xyz = np.column_stack([design.xy, np.zeros(len(design.ids))])
    >>> images = []
    >>> for omega, phi, kappa in ((0.4, 0.0, 0.0), (-0.4, 0.1, 1.5), (0.0, 0.5, 3.0), (0.1, -0.4, 4.5)):
    ...     turned = Pose.from_angles(omega, phi, kappa, [0.0, 0.0, 0.0])
    ...     seen = project(camera, Pose(turned.rotation, -turned.matrix.T @ [0.0, 0.0, 300.0]), xyz)
    ...     images.append(reseau.ImagePoints.with_sigma(design.ids, seen.xy, 0.01))
    >>> reseau.calibrate(images, design, free=("fx", "fy", "cx", "cy"), image_size=(640, 480))
    <Calibrated: usable ..., 4 images, 140 image points, 0 declined, sigma0 0.000, fx 800.00... px, ...>
    """

    def lens(given: str | CameraOptions | None) -> CameraOptions:
        if isinstance(given, CameraOptions):
            return given
        return CameraOptions(given or ("" if free else "auto"), tuple(free), pitch_mm)

    taken = dict[str, Taken]()
    if isinstance(images, Mapping):
        photographs, taken = _of_cameras(images, channel, colours)
    else:
        photographs = _named(images, channel, colours)
    lenses: CameraOptions | dict[str, CameraOptions]
    if isinstance(model, Mapping):
        cameras = dict.fromkeys([*model, *(each.camera for each in taken.values())])
        lenses = {camera: lens(model.get(camera)) for camera in cameras}
    else:
        lenses = lens(model)
    return calibrate_photographs(
        photographs, None if design == "auto" else read_design(design), image_size, lenses, options, taken,
        channel=channel, correction=_correction(sensor),
    )  # fmt: skip


def orient(
    scan: ImageLike,
    *,
    format_mm: tuple[float, float] | None = None,
    dpi: float | None = None,
    options: FrameOptions | None = None,
) -> list[FrameResult]:
    """Orient the film frames of a scan by their edges.

    Parameters
    ----------
    scan : str, Path, ndarray (h, w) or (h, w, 3), or Frame
        The scan; files are read in windows, so they may be large.
    format_mm : (float, float), optional
        Width and height of a frame in millimetres; by default the usual formats are tried.
    dpi : float, optional
        Resolution, where the file does not give it or gives it wrongly.
    options : FrameOptions, optional
        All options; instead of the two above.

    Returns
    -------
    list of FrameResult
        One for each frame; falsy ones are declined, with the reason in `why`.

    Examples
    --------
    >>> import numpy as np
    >>> import reseau
    >>> reseau.orient(np.full((60, 90), 128, np.uint8))
    [<FrameResult: image scan, status declined, reason is of one tone; scan it with more exposure>]
    """
    if isinstance(scan, Frame):
        opened = scan_of(scan.pixels, scan.name)
    elif isinstance(scan, np.ndarray):
        opened = scan_of(scan)
    else:
        opened = open_scan(_path(scan, "scan", "a path, an array or a Frame"))
    if options is None:
        options = FrameOptions(dpi=dpi) if format_mm is None else FrameOptions(formats=(format_mm,), dpi=dpi)
    elif format_mm is not None or dpi is not None:
        raise UsageError("cannot be given together with `format_mm` or `dpi`", where="options")
    return orient_scan(opened, options)


def refine(
    photo_i: PhotoLike | None = None,
    reseau: DesignLike | None = None,
    *,
    photo_ii: PhotoLike | None = None,
    test_object: DesignLike | None = None,
    photo_iii: Iterable[PhotoLike] = (),
    calibration: CalibrationLike | None = None,
    check: Iterable[str] = (),
    alpha: float = 0.05,
) -> Refined | Failure:
    """Correct photographs of an instrument's display for the errors of camera and instrument.

    The oscilloscope procedure of Wishahy: PHOTO I shows a reseau alone, PHOTO II the section through a test
    object behind it, PHOTO III that through a body of unknown points.

    Parameters
    ----------
    photo_i : str, Path, ndarray, Frame or ImagePoints, optional
        PHOTO I, or the coordinates of its marks; not with `calibration`.
    reseau : str, Path or ReseauDesign, optional
        The reseau; not with `calibration`, which contains it.
    photo_ii : str, Path, ndarray, Frame or ImagePoints, optional
        PHOTO II, together with `test_object`.
    test_object : str, Path or ReseauDesign, optional
        The rods of the test object.
    photo_iii : iterable of str, Path, ndarray, Frame or ImagePoints
        Photographs of bodies; they need PHOTO II or a calibration.
    calibration : str, Path or Calibration, optional
        A stored calibration of groups A and B, for PHOTO III, or tested by a new PHOTO II.
    check : iterable of str
        Marks and rods that are held out for a check.
    alpha : float
        Level of the tests of coefficients.

    Returns
    -------
    Refined or Failure
        The result of each photograph; a failure when one of the targets is not found.

    Raises
    ------
    UsageError
        When arguments are missing or cannot be given together.
    """
    return refine_photographs(
        Photographs(photo_i, photo_ii, _several(photo_iii, "photo_iii")),
        None if reseau is None else _reseau_design(reseau, "reseau"),
        None if test_object is None else _reseau_design(test_object, "test_object"),
        None if calibration is None else read_calibration(calibration),
        RefineOptions(check=tuple(check), alpha=alpha),
        read=lambda photo: _photo(photo, "luma"),
    )


class Adjusted(Result):
    """The result of :func:`adjust_network`: a :class:`reseau.bundle.Result` that can be written."""

    def write(self, path: PathLike, *, covariances: bool = False) -> None:
        """Write the result, ``reseau-bundle/1``.

        Parameters
        ----------
        path : str or Path
            The file.
        covariances : bool
            Include the full covariances of the points.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        ResultDocument.of(self, covariances=covariances).write(path)


def adjust_network(
    network: PathLike | Network, options: AdjustmentOptions | None = None
) -> Adjusted | Failure:
    """Adjust a network of images by the bundle method.

    Parameters
    ----------
    network : str, Path or Network
        A network, or its file: ``reseau-network/1``, or that of another program (docs/formats/networks.md).
    options : reseau.bundle.Options, optional
        Options of the adjustment.

    Returns
    -------
    Adjusted or Failure
        Cameras, images and points with their covariances; a failure that names what is not determined.

    Examples
    --------
    >>> import reseau
    >>> from reseau.bundle import example_network
    >>> found = reseau.adjust_network(example_network())
    >>> found
    <Adjusted: 8 images, 20 points, sigma0 1.005, redundancy 215, 0 image points left out, 1 warning>
    >>> found.cameras["camera"].sigma.shape
    (4,)
    """
    if not isinstance(network, Network):
        network = read_network(_path(network, "network", "a path or a Network"))
    found = _adjust(network, options or AdjustmentOptions())
    if isinstance(found, Failure):
        return found
    return Adjusted(**{each.name: getattr(found, each.name) for each in fields(found)})


def _several(given: Iterable[PhotoLike], argument: str) -> tuple[PhotoLike, ...]:
    """The argument as a tuple of photographs.

    Raises
    ------
    UsageError
        When it is a single one, or of another kind.
    """
    if isinstance(given, str | Path | np.ndarray | Frame | ImagePoints) or not isinstance(given, Iterable):
        raise UsageError(f"is {_kind(given)}", where=argument, do="give a list of photographs")
    return tuple(given)


def _named(
    images: PathLike | Iterable[PhotoLike], channel: Channel, colours: Colours | None
) -> list[tuple[str, Path | Frame | ImagePoints]]:
    """Photographs of a calibration with their names; those of folders one by one."""
    given = (images,) if isinstance(images, str | Path) else _several(images, "images")
    named = list[tuple[str, Path | Frame | ImagePoints]]()
    for image in given:
        if isinstance(image, str | Path):
            named += [(path.name, path) for path in photographs_named([Path(image)])]
            continue
        photo = image.candidates if isinstance(image, Measured) else _photo(image, channel, colours)
        name = photo.name if isinstance(photo, Frame) and not isinstance(image, np.ndarray) else ""
        named.append((name or f"image {len(named) + 1}", photo))
    if not named:
        raise UsageError("is empty", where="images", do="give photographs, or their folder")
    return named


def _of_cameras(
    images: Mapping[str, PathLike | Iterable[PhotoLike]], channel: Channel, colours: Colours | None
) -> tuple[list[tuple[str, Path | Frame | ImagePoints]], dict[str, Taken]]:
    """Photographs of several cameras with their names, and which were taken at once."""
    every = {camera: _named(own, channel, colours) for camera, own in images.items()}
    files = {camera: [each for _, each in own if isinstance(each, Path)] for camera, own in every.items()}
    if all(len(files[camera]) == len(own) for camera, own in every.items()):
        found = exposures_of_files(files)
        return [(name, path) for name, (path, _) in found.items()], {k: at for k, (_, at) in found.items()}
    counts = {camera: len(own) for camera, own in every.items()}
    if len(set(counts.values())) > 1:
        raise UsageError(
            f"are {', '.join(f'{count} of {camera}' for camera, count in counts.items())}", where="images",
            do="give as many of each camera, those that were taken at once at the same place",
        )  # fmt: skip
    named = list[tuple[str, Path | Frame | ImagePoints]]()
    taken = {}
    for camera, own in every.items():
        for k, (name, photo) in enumerate(own):
            key = f"{camera}/{name}"
            named.append((key, replace(photo, name=key) if isinstance(photo, Frame) else photo))
            taken[key] = Taken(camera, str(k))
    return named, taken


def _path(given: object, argument: str, expected: str) -> Path:
    """The argument as a path.

    Raises
    ------
    UsageError
        When it is of another kind.
    """
    if isinstance(given, str | Path):
        return Path(given)
    raise UsageError(f"is {_kind(given)}", where=argument, do=f"give {expected}")


def _kind(given: object) -> str:
    return "None" if given is None else f"of type {type(given).__name__}"


def _photo(image: PhotoLike, channel: Channel, colours: Colours | None = None) -> Frame | ImagePoints:
    """A photograph, or the coordinates measured in it."""
    if isinstance(image, ImagePoints):
        return image
    if isinstance(image, Measured):
        return image.points
    if isinstance(image, str | Path) and is_points(image):
        return read_measurement(image).image_points()
    if not isinstance(image, str | Path | np.ndarray | Frame):
        raise UsageError(
            f"is {_kind(image)}", where="photograph", do="give a path, an array, a Frame or ImagePoints"
        )
    return read_image(image, channel, colours=colours)


def _reseau_design(given: DesignLike, argument: str) -> ReseauDesign:
    design = read_design(given)
    if not isinstance(design, ReseauDesign):
        raise UsageError("is the design of a testfield", where=argument, do="give a reseau-design/1")
    return design


def _corrected(frame: Frame, sensor: CalibrationLike | None) -> Frame:
    """The frame corrected by the calibration of its sensor, where there is one."""
    correction = _correction(sensor)
    return frame if correction is None else correction.correct(frame)


def _correction(sensor: CalibrationLike | None) -> SensorCorrection | None:
    return None if sensor is None else SensorCorrection.from_calibration(read_calibration(sensor))


def _options(given: object, kind: type[T]) -> T | None:
    if given is None or isinstance(given, kind):
        return given
    raise UsageError(f"is {_kind(given)}", where="options", do=f"give {kind.__name__} for this target")
