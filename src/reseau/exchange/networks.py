"""Networks from files: of this project with their calibrations, and of other programs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from ..bundle import Network, calibrated_camera
from ..calibration import read_calibration
from ..core.errors import FormatError, InputError
from ..io import read_text
from ..io.network import CalibratedCameraEntry, Network1
from .bal import read_bal
from .colmap import read_colmap
from .photomodeler import read_photomodeler

__all__ = ["calibration_files", "read_foreign", "read_network"]


def read_network(path: Path | str, calibrations: Mapping[str, Path | str] | None = None) -> Network:
    """Read a network of this project or of another program, recognised by its content.

    Parameters
    ----------
    path : path
        ``reseau-network/1``, or a file that :func:`read_foreign` reads.
    calibrations : mapping of str to path, optional
        Calibration files by the id of a camera, in place of its entry in the network. Their parameters are
        observations with their joint covariance.

    Raises
    ------
    InputError
        When a file cannot be read.
    FormatError
        When the file is no network, or a calibration is none.
    UsageError
        When a calibration is given for a camera that the network does not have.

    Examples
    --------
    >>> read_network("missing.json")
    Traceback (most recent call last):
    reseau.core.errors.InputError: missing.json: cannot be read (No such file or directory)
    """
    path, given = Path(path), dict(calibrations or {})
    if path.is_dir() or path.suffix.lower() != ".json":
        network = read_foreign(path)
        return network.with_cameras(
            {name: calibrated_camera(name, read_calibration(file)) for name, file in given.items()}
        )
    document = Network1.read(path)
    cameras = {
        entry.id: calibrated_camera(
            entry.id, read_calibration(path.parent / entry.calibration), held=entry.use == "held"
        )
        for entry in document.cameras
        if isinstance(entry, CalibratedCameraEntry) and entry.id not in given
    }
    cameras |= {name: calibrated_camera(name, read_calibration(file)) for name, file in given.items()}
    return Network.from_document(document, cameras)


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
    """A network of another program, told apart by what the file holds.

    Parameters
    ----------
    path : Path or str
        Text export of PhotoModeler, a BAL file, or a folder of COLMAP's text files.

    Raises
    ------
    InputError
        When it cannot be read.
    FormatError
        When it is none of these.
    """
    path = Path(path)
    if path.is_dir():
        return read_colmap(path)
    if not path.exists():
        raise InputError("does not exist", where=path)
    lines = read_text(path).splitlines()
    first = lines[0].split() if lines else []
    if len(first) == 3 and all(word.isdigit() for word in first):
        return read_bal(path)
    if len(lines) > 4 and len(lines[1].split()) == 4 and len(lines[3].split()) == 10:
        return read_photomodeler(path)
    raise FormatError(
        "is no network of a program known here",
        where=path,
        do="give reseau-network/1, PhotoModeler, BAL, COLMAP",
    )
