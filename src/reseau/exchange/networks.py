"""Read networks of this project, with their calibrations, and of other programs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Set
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..bundle import Camera, Network, Result, calibrated_camera, film_camera, with_estimates
from ..bundle.network import network_document
from ..calibration import read_calibration
from ..core.errors import FormatError, InputError, UsageError
from ..io import FrameOrientation, read_text
from ..io.network import CalibratedCameraEntry, CameraEntry, FilmCameraEntry, Network1
from .bal import read_bal, write_bal
from .bundler import is_bundler, read_bundler
from .calibrations import Exported
from .colmap import read_colmap, write_colmap
from .dbat import is_dbat, read_dbat
from .libmv import is_libmv, read_libmv
from .lines import read_head
from .metashape import is_metashape, read_metashape
from .micmac import is_micmac, read_micmac
from .openptv import is_openptv, read_openptv
from .photomodeler import read_photomodeler

__all__ = ["calibration_files", "read_foreign", "read_network", "write_network"]

# Formats that the first bytes tell, and their readers.
_BINARY_OR_XML: tuple[tuple[Callable[[bytes], bool], Callable[[Path], Network]], ...] = (
    (is_metashape, read_metashape),
    (is_dbat, read_dbat),
    (is_libmv, read_libmv),
)


def read_network(
    path: Path | str,
    calibrations: Mapping[str, Path | str] | None = None,
    *,
    control_sigma: float | None = None,
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
    if path.is_dir() or path.suffix.lower() != ".json":
        if path.is_dir() and is_micmac(path):
            network = read_micmac(path, control_sigma)
        else:
            network = _with_control_sigma(read_foreign(path), control_sigma)
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
    return _with_control_sigma(Network.from_document(document, cameras), control_sigma)


def _with_control_sigma(network: Network, sigma: float | None) -> Network:
    """The network with one standard deviation of all known coordinates of points."""
    if sigma is None:
        return network
    return replace(network, sigma=np.where(np.isnan(network.sigma), np.nan, sigma))


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


def read_foreign(path: Path | str) -> Network:
    r"""Read a network of another program; its format is recognised by the content.

    Parameters
    ----------
    path : Path or str
        Text export of PhotoModeler, BAL or Bundler file, XML or ``.psz`` of Metashape, project of DBAT,
        problem of libmv, or folder with COLMAP's text or binary files, a calibration of OpenPTV, or
        orientations of MicMac.

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
    if path.is_dir():
        if is_micmac(path):
            return read_micmac(path)
        if is_openptv(path):
            return read_openptv(path)
        if not any((path / f"cameras.{kind}").exists() for kind in ("txt", "bin")):
            raise FormatError(
                "is not a folder of a known program",
                where=path,
                do="give a folder of COLMAP (cameras, images, points3D), of OpenPTV (with `parameters`), or "
                "of MicMac (Ori-NAME)",
            )
        return read_colmap(path)
    if not path.exists():
        raise InputError("does not exist", where=path)
    head = read_head(path)
    for recognise, read in _BINARY_OR_XML:
        if recognise(head):
            return read(path)
    lines = read_text(path, "latin-1").splitlines()
    first = lines[0].split() if lines else []
    if lines and is_bundler(lines[0]):
        return read_bundler(path)
    if len(first) == 3 and all(word.isdigit() for word in first):
        return read_bal(path)
    if len(lines) > 4 and len(lines[1].split()) in (2, 4) and len(lines[3].split()) == 10:
        return read_photomodeler(path)
    raise FormatError(
        "is not a network of a known program",
        where=path,
        do="use reseau-network/1 or a network of PhotoModeler, BAL, Bundler, COLMAP, Metashape, DBAT, libmv, "
        "OpenPTV or MicMac",
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
