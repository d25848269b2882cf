"""Read networks of this project, with their calibrations, and of other programs."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..bundle import Camera, Network, Result, calibrated_camera, film_camera
from ..bundle.modelling.calibration import with_estimates
from ..bundle.network.settings import network_document
from ..calibration import read_calibration
from ..core.errors import FormatError, InputError, UsageError
from ..core.files import head_of
from ..io import FrameOrientation, read_text
from ..io.network import CalibratedCameraEntry, CameraEntry, FilmCameraEntry, Network1
from .aicon import is_aicon, read_aicon
from .bal import read_bal, write_bal
from .bundler import is_bundler, read_bundler
from .calibrations.formats import Exported
from .colmap import read_colmap, write_colmap
from .dbat import is_dbat, read_dbat
from .libmv import is_libmv, read_libmv
from .metashape import is_metashape, read_metashape
from .micmac import is_micmac, read_micmac
from .mmvii import is_mmvii, read_mmvii
from .openptv import is_openptv, read_openptv
from .photomodeler import read_photomodeler
from .sfm import is_sfm, read_sfm


@dataclass(frozen=True)
class _Peek:
    """A file or folder whose format is not known."""

    path: Path

    @cached_property
    def head(self) -> bytes:
        """First bytes of a file."""
        return b"" if self.path.is_dir() else head_of(self.path)

    @cached_property
    def counts(self) -> list[int]:
        """Numbers of words in the first lines."""
        return [len(line.split()) for line in self.head.decode("latin-1").splitlines()[:5]]

    def has(self, *names: str) -> bool:
        """Whether the folder has one of some files."""
        return any((self.path / name).exists() for name in names)


class _Format(NamedTuple):
    """A format of networks: the program, how it is recognised and read."""

    program: str
    recognises: Callable[[_Peek], bool]
    read: Callable[[Path, float | None], Network]


def _plain(read: Callable[[Path], Network]) -> Callable[[Path, float | None], Network]:
    """A reader, followed by one standard deviation of all known coordinates of points."""
    return lambda path, sigma: _with_control_sigma(read(path), sigma)


_THREE_COUNTS = re.compile(rb"\s*\d+[ \t]+\d+[ \t]+\d+[ \t]*[\r\n]")
# In the order in which they are tried; the last two are numbers in lines only.
_FORMATS = (
    _Format("MicMac", lambda at: is_micmac(at.path), read_micmac),
    _Format("MMVII", lambda at: is_mmvii(at.path), read_mmvii),
    _Format("OpenPTV", lambda at: is_openptv(at.path), _plain(read_openptv)),
    _Format("AICON", lambda at: is_aicon(at.path), _plain(read_aicon)),
    _Format("COLMAP", lambda at: at.has("cameras.txt", "cameras.bin"), _plain(read_colmap)),
    _Format("OpenMVG and AliceVision", lambda at: is_sfm(at.head), _plain(read_sfm)),
    _Format("Metashape", lambda at: is_metashape(at.head), _plain(read_metashape)),
    _Format("DBAT", lambda at: is_dbat(at.head), _plain(read_dbat)),
    _Format("libmv", lambda at: is_libmv(at.head), _plain(read_libmv)),
    _Format("Bundler", lambda at: is_bundler(at.head.decode("latin-1")), _plain(read_bundler)),
    _Format("BAL", lambda at: bool(_THREE_COUNTS.match(at.head)), _plain(read_bal)),
    _Format(
        "PhotoModeler", lambda at: at.counts[1:4:2] in ([2, 10], [4, 10]) and len(at.counts) > 4,
        _plain(read_photomodeler),
    ),
)  # fmt: skip


def read_network(
    path: Path | str,
    calibrations: Mapping[str, Path | str] | None = None,
    *,
    control_sigma: float | None = None,
    sensor_width: float | None = None,
) -> Network:
    """Read a network of this project or of another program, recognised by its content.

    Parameters
    ----------
    path : path
        ``reseau-network/1``, or a file that :func:`read_foreign` reads.
    calibrations : mapping of str to path, optional
        Calibration files by the id of a camera, in place of its entry in the network. Their parameters are
        observations with their joint covariance. The orientation of a film frame replaces pixel size and
        principal point of the entry; its other parameters stay.
    control_sigma : float, optional
        Standard deviation of control points, in the unit of the network; for MicMac the factor on their
        uncertainties, as in Campari.
    sensor_width : float, optional
        Width (mm) of the sensor of cameras whose lengths are in pixels: they are then in mm.

    Raises
    ------
    InputError
        When a file cannot be read.
    FormatError
        When the file is not a network, or a calibration is not one.
    UsageError
        When a calibration is given for a camera that is not in the network, is not that of a camera or a film
        frame, or the principal distance for a film frame is not known.

    Examples
    --------
    >>> read_network("missing.json")
    Traceback (most recent call last):
    reseau.core.errors.InputError: missing.json: cannot be read (No such file or directory)
    """
    path, given = Path(path), dict(calibrations or {})
    if path.is_dir() or path.suffix.lower() != ".json" or is_sfm(head_of(path)):
        network = _with_sensor_width(read_foreign(path, control_sigma), sensor_width)
        # With a pitch of one, the principal distance is in pixels.
        known = {camera.id: camera for camera in network.cameras}
        with_size = {name: camera for name, camera in known.items() if camera.pitch_mm != (1.0, 1.0)}
        return network.with_cameras(_chosen(given, set(known), with_size))
    document = Network1.read(path)
    with_size = {
        entry.id: Camera.from_entry(entry) for entry in document.cameras if isinstance(entry, CameraEntry)
    }
    cameras = {
        entry.id: _from_file(
            entry.id,
            path.parent / entry.calibration,
            with_size.get(entry.id),
            held=entry.use == "held",
            film=isinstance(entry, FilmCameraEntry),
        )
        for entry in document.cameras
        if isinstance(entry, CalibratedCameraEntry | FilmCameraEntry) and entry.id not in given
    }
    cameras |= _chosen(given, {entry.id for entry in document.cameras}, with_size)
    network = _with_control_sigma(Network.from_document(document, cameras), control_sigma)
    return _with_sensor_width(network, sensor_width)


def _with_control_sigma(network: Network, sigma: float | None) -> Network:
    """The network with one standard deviation of all known coordinates of points."""
    if sigma is None:
        return network
    return replace(network, sigma=np.where(np.isnan(network.sigma), np.nan, sigma))


def _with_sensor_width(network: Network, width: float | None) -> Network:
    """The network with cameras in millimetres whose lengths are in pixels."""
    if width is None:
        return network
    cameras = tuple(
        camera.in_millimetres(width / camera.width) if camera.in_pixels else camera
        for camera in network.cameras
    )
    if cameras == network.cameras:
        raise UsageError(
            "is given, but no camera has lengths in pixels that depend on it: pixel sizes are known, or the "
            "model has focal lengths in pixels",
            where="sensor width",
        )
    return replace(network, cameras=cameras)


def _chosen(
    given: Mapping[str, Path | str], ids: Set[str], with_size: Mapping[str, Camera]
) -> dict[str, Camera]:
    """Cameras from the calibration files that the caller gives."""
    for name in given:
        if name not in ids:
            raise UsageError("is not a camera of the network", where=name)
    return {name: _from_file(name, Path(file), with_size.get(name)) for name, file in given.items()}


def _from_file(
    name: str, file: Path, entry: Camera | None, *, held: bool = False, film: bool = False
) -> Camera:
    """Read a camera from a calibration file; `entry` has the principal distance for a film frame."""
    calibration = read_calibration(file)
    if calibration.kind not in ("film_frame", "fiducials"):
        if film and calibration.kind == "camera":
            raise UsageError(
                f"{file.name} {calibration.not_of('film_frame')}",
                where=f"camera {name}",
                do="use only the keys id, calibration and use",
            )
        return calibrated_camera(name, calibration, held=held)
    if entry is None:
        raise UsageError(
            f"the film frame {file.name} does not give the principal distance",
            where=f"camera {name}",
            do="add width, height and parameters with c in mm to the entry of the network",
        )
    oriented = json.loads(read_text(file))["schema"] == FrameOrientation.SCHEMA
    return film_camera(entry, FrameOrientation.read(file) if oriented else calibration, held=held)


def calibration_files(path: Path | str) -> tuple[Path, ...]:
    """Return the calibration files that a ``reseau-network/1`` names; none for other files.

    Examples
    --------
    >>> calibration_files("block.bal")
    ()
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        return ()
    cameras = json.loads(read_text(path)).get("cameras", ())
    return tuple(path.parent / entry["calibration"] for entry in cameras if "calibration" in entry)


def read_foreign(path: Path | str, control_sigma: float | None = None) -> Network:
    r"""Read a network of another program; its format is recognised by the content.

    Parameters
    ----------
    path : Path or str
        Text export of PhotoModeler, BAL or Bundler file, XML or ``.psz`` of Metashape, project of DBAT,
        problem of libmv, scene of OpenMVG or AliceVision, or folder with COLMAP's text or binary files, a
        calibration of OpenPTV, or orientations of MicMac or MMVII, or a file of AICON (``.phc``, ``.obc``,
        ``.ior``, ``.eor``), with the others beside it.
    control_sigma : float, optional
        See :func:`read_network`.

    Raises
    ------
    InputError
        When a file cannot be read.
    FormatError
        When the format is not known.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "block.txt"
    ...     _ = path.write_text("1 1 1\n0 0 10.0 20.0\n0 0 0 0 0 0 800 0 0\n0.1 0.2 -8\n")
    ...     read_foreign(path)
    <Network: 1 camera, 1 image, 1 point, 1 image point, datum free>
    """
    path = Path(path)
    if not path.exists():
        raise InputError("does not exist", where=path)
    at = _Peek(path)
    for form in _FORMATS:
        if form.recognises(at):
            return form.read(path, control_sigma)
    if path.is_dir():
        raise FormatError(
            "is not a folder of a known program",
            where=path,
            do="give a folder of COLMAP (cameras, images, points3D), of OpenPTV (with `parameters`), or "
            "of MicMac (Ori-NAME) or MMVII (Ori/NAME)",
        )
    raise FormatError(
        "is not a network of a known program",
        where=path,
        do=f"use reseau-network/1 or a network of {', '.join(form.program for form in _FORMATS)}",
    )


def write_network(result: Result, path: Path | str) -> dict[str, Exported]:
    """Write an adjusted network: its estimates, and the image points that were used.

    Parameters
    ----------
    result : Result
        The adjustment.
    path : path
        ``.json`` for ``reseau-network/1``, with the estimates as approximate values; ``.bal`` for BAL; a
        folder, without a suffix, for COLMAP's text files.

    Returns
    -------
    dict of str to Exported
        Cameras whose model was converted, with the differences.

    Raises
    ------
    UsageError
        When the suffix is another one, or the format lacks what the network has.
    InputError
        When a file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.bundle import adjust_network, example_network
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = write_network(adjust_network(example_network()), f"{folder}/block.json")
    ...     read_network(f"{folder}/block.json")
    <Network: 1 camera, 8 images, 20 points, 160 image points, datum free>
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".bal":
        write_bal(result, path)
        return {}
    if suffix == ".json":
        network_document(with_estimates(result).select(~result.rejected)).write(path)
        return {}
    if suffix:
        raise UsageError(
            f"has the suffix {suffix!r}", where=path,
            do="use .json (reseau-network/1), .bal, or a folder without a suffix (COLMAP)",
        )  # fmt: skip
    return write_colmap(result, path)
