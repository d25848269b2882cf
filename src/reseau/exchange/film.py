"""Marks of scanned film for other programs: MicMac's files of fiducial marks, and a script for Metashape.

Film frames, fiducial marks and the crosses of a reseau are all points with pixel coordinates in the scan and
known coordinates in the camera (mm). MicMac reads them as ``MeasuresIm-IMAGE.xml`` and ``MeasuresCamera.xml``
in the folder ``Ori-InterneScan`` (its commands FFTKugelHupf and ReSampFid); Metashape through its Python
interface, which defines a film camera with fiducial marks.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration import FiducialMapping, FilmFrameMapping, calibration_of_fiducials, calibration_of_frame
from ..core.data import Array
from ..core.errors import FormatError, InputError, UsageError
from ..core.files import made_folder
from ..io import CORNERS, FiducialOrientation, FrameOrientation, ReseauDesign, ReseauMeasurement
from ..io.document import read_text, write_whole

_FOLDER, _CAMERA = "Ori-InterneScan", "MeasuresCamera.xml"
_SCHEMAS = (FiducialOrientation.SCHEMA, FrameOrientation.SCHEMA, ReseauMeasurement.SCHEMA)
_TO_CORNER = 0.5
"""Metashape's origin is the corner of the first pixel, here it is its centre."""
_SAME_MM = 1e-3
"""Differences up to which coordinates of one camera in several files count as the same."""


@dataclass(frozen=True, eq=False)
class FilmMarks:
    """Marks of one scan.

    Parameters
    ----------
    image : str
        Name of the scan.
    names : tuple of str (n,)
        Names of the measured marks.
    xy : ndarray (n, 2)
        Pixels; origin in the centre of the first pixel.
    mm : ndarray (n, 2)
        Coordinates in the camera, x right, y up.

    Examples
    --------
    >>> FilmMarks("7.tif", ("1",), np.array([[100.0, 200.0]]), np.array([[-106.0, 106.0]])).names
    ('1',)
    """

    image: str
    names: tuple[str, ...]
    xy: Array
    mm: Array


def read_film_marks(path: Path | str, design: ReseauDesign | None = None) -> FilmMarks:
    """Read the marks of a scan.

    Parameters
    ----------
    path : path
        ``reseau-fiducials/1``, ``reseau-orientation/1`` of a film frame, or ``reseau-measurement/1`` of a
        reseau.
    design : ReseauDesign, optional
        The reseau, which a measurement needs; in mm, with y up.

    Raises
    ------
    FormatError
        When the file is none of these, or was declined.
    UsageError
        When a design is missing, or is not in mm.

    Examples
    --------
    >>> import tempfile
    >>> corner = {"sx": 0.1, "sy": 0.1, "rho": 0.0}
    >>> at = {"ul": (10.0, 20.0), "ur": (370.0, 20.0), "lr": (370.0, 260.0), "ll": (10.0, 260.0)}
    >>> oriented = FrameOrientation.model_validate({
    ...     "image": "scan.tif", "status": "oriented", "why": "", "format_mm": (36.0, 24.0),
    ...     "channel": "grey",
    ...     "corners": {name: corner | {"x": x, "y": y} for name, (x, y) in at.items()},
    ...     "principal_point": corner | {"x": 190.0, "y": 140.0}, "angle_deg": 0.0, "angle_sigma_deg": 0.01,
    ...     "px_per_mm": (10.0, 10.0), "edges": {}})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     oriented.write(Path(folder) / "scan.json")
    ...     marks = read_film_marks(Path(folder) / "scan.json")
    >>> marks.names[0], marks.mm[0]
    ('ul', array([-18.,  12.]))
    """
    path = Path(path)
    text, content = _document(path)
    schema = content.get("schema")
    if schema == FiducialOrientation.SCHEMA:
        return _of_fiducials(FiducialOrientation.parse(text, where=path))
    if schema == FrameOrientation.SCHEMA:
        return _of_frame(FrameOrientation.parse(text, where=path))
    if schema == ReseauMeasurement.SCHEMA:
        return _of_reseau(ReseauMeasurement.parse(text, where=path), design, path)
    raise FormatError(f"has the schema {schema!r}", where=path, do=f"give one of {', '.join(_SCHEMAS)}")


def film_files(paths: Iterable[Path]) -> list[Path]:
    """Return files of marks; of a folder, as `reseau orient` writes it, those with a transformation.

    Parameters
    ----------
    paths : iterable of Path
        Files for :func:`read_film_marks`, or folders of them.

    Raises
    ------
    InputError
        When a folder has none.

    Examples
    --------
    >>> film_files([Path("1.json"), Path("2.json")]) == [Path("1.json"), Path("2.json")]
    True
    """
    found = list[Path]()
    for path in paths:
        inside = [path]
        if path.is_dir():
            contents = {each: _document(each)[1] for each in sorted(path.glob("*.json"))}
            inside = [
                each
                for each, content in contents.items()
                if content.get("schema") in _SCHEMAS and content.get("status") != "declined"
            ]
            if not inside:
                raise InputError("has no oriented scan", where=path, do="use `reseau orient --out`")
        found += inside
    return found


def _document(path: Path) -> tuple[str, dict[str, Any]]:
    """The text of a document, and its keys; none of another JSON value."""
    text = read_text(path)
    try:
        content = json.loads(text)
    except ValueError as error:
        raise FormatError(f"is not JSON ({error})", where=path) from None
    return text, content if isinstance(content, dict) else {}


def _of_fiducials(found: FiducialOrientation) -> FilmMarks:
    points, mapping = found.image_points(), calibration_of_fiducials(found).mapping()
    assert isinstance(mapping, FiducialMapping)
    assert found.transform is not None
    left = np.array([found.transform.residuals_mm[name] for name in points.names]).reshape(-1, 2)
    # Residuals are transformed minus calibrated coordinates.
    return FilmMarks(found.image, points.names, points.xy, mapping.apply(points).xy - left)


def _of_frame(found: FrameOrientation) -> FilmMarks:
    points, mapping = found.image_points(), calibration_of_frame(found).mapping()
    assert isinstance(mapping, FilmFrameMapping)
    if found.transform is None:
        w, h = mapping.format_mm
        mm = np.array([[-w, h], [w, h], [w, -h], [-w, -h]]) / 2
    else:
        mm = mapping.apply(points).xy - np.array([found.transform.residuals_mm[name] for name in CORNERS])
    return FilmMarks(found.image, points.names, points.xy, mm)


def _of_reseau(found: ReseauMeasurement, design: ReseauDesign | None, path: Path) -> FilmMarks:
    if design is None:
        raise UsageError("has no coordinates of the reseau", where=path, do="give --design")
    if design.unit != "mm":
        raise UsageError(f"has the unit {design.unit!r}, not mm", where=f"design {design.name}")
    points, row = found.image_points(), {name: k for k, name in enumerate(design.ids)}
    known = [name for name in points.names if name in row and np.isfinite(design.xy[row[name]]).all()]
    if not known:
        raise UsageError(f"has no mark of the design {design.name!r}", where=path)
    points = points.select(known)
    return FilmMarks(found.image or path.stem, points.names, points.xy, design.xy[[row[n] for n in known]])


def write_micmac(folder: Path | str, scans: Sequence[FilmMarks]) -> list[Path]:
    """Write the files of MicMac: marks of each scan, of the camera, and their names.

    MicMac's coordinates of the camera are in mm from the upper left corner of all marks, y down.

    Parameters
    ----------
    folder : path
        Folder of the images, in which ``Ori-InterneScan`` and ``id_fiducial.txt`` are written.
    scans : sequence of FilmMarks
        Scans of one camera.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    UsageError
        When scans have different coordinates for one mark, or there is none.
    InputError
        When a file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> xy, mm = np.array([[9.0, 8.0], [70.0, 9.0]]), np.array([[-3.0, 0.0], [3.0, 0.0]])
    >>> marks = FilmMarks("7.tif", ("a", "b"), xy, mm)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     files = write_micmac(folder, [marks])
    >>> [file.name for file in files]
    ['MeasuresIm-7.tif.xml', 'MeasuresCamera.xml', 'id_fiducial.txt']
    """
    camera = _camera(scans)
    names, mm = tuple(camera), np.array(list(camera.values()))
    down = np.stack([mm[:, 0] - mm[:, 0].min(), mm[:, 1].max() - mm[:, 1]], axis=1)
    inner = Path(folder) / _FOLDER
    made_folder(inner)
    files = [inner / f"MeasuresIm-{scan.image}.xml" for scan in scans]
    for file, scan in zip(files, scans, strict=True):
        write_whole(file, _xml(scan.image, scan.names, scan.xy))
    files += [inner / _CAMERA, Path(folder) / "id_fiducial.txt"]
    write_whole(files[-2], _xml("Glob", names, down))
    write_whole(files[-1], "\n".join(names) + "\n")
    return files


def _camera(scans: Sequence[FilmMarks]) -> dict[str, Array]:
    """Coordinates of all marks of the camera."""
    camera: dict[str, Array] = {}
    for scan in scans:
        for name, mm in zip(scan.names, scan.mm, strict=True):
            if np.abs(camera.setdefault(name, mm) - mm).max() > _SAME_MM:
                raise UsageError(
                    f"has other coordinates of the mark {name} than {scans[0].image}",
                    where=scan.image,
                    do="export the scans of each camera for themselves",
                )
    if not camera:
        raise UsageError("there are no marks to export")
    return camera


def _xml(image: str, names: Sequence[str], xy: Array) -> str:
    root = ET.Element("SetOfMesureAppuisFlottants")
    one = ET.SubElement(root, "MesureAppuiFlottant1Im")
    ET.SubElement(one, "NameIm").text = image
    for name, (x, y) in zip(names, xy, strict=True):
        point = ET.SubElement(one, "OneMesureAF1I")
        ET.SubElement(point, "NamePt").text = name
        ET.SubElement(point, "PtIm").text = f"{x:.5f} {y:.5f}"
    ET.indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


_SCRIPT = '''\
"""Fiducial marks for Metashape: open the project with the scans, then Tools, Run Script."""

import Metashape

# Marks of the camera: millimetres, x right, y up.
CAMERA = {camera}

# Marks of each scan: pixels from the upper left corner of the image.
SCANS = {scans}

chunk = Metashape.app.document.chunk
labels = {{camera.label: camera for camera in chunk.cameras}}
markers = {{}}
for image, marks in SCANS.items():
    camera = labels.get(image) or labels.get(image.rpartition(".")[0])
    if camera is None:
        print("not in the chunk:", image)
        continue
    sensor = camera.sensor
    sensor.film_camera = True
    for name, place in marks.items():
        key = (sensor.key, name)
        if key not in markers:
            marker = chunk.addMarker()
            marker.type = Metashape.Marker.Type.Fiducial
            marker.sensor = sensor
            marker.label = name
            marker.reference.location = Metashape.Vector([*CAMERA[name], 0])
            markers[key] = marker
        markers[key].projections[camera] = Metashape.Marker.Projection(Metashape.Vector(place), True)
print(len(markers), "fiducial marks,", len(SCANS), "scans")
'''


def metashape_script(scans: Sequence[FilmMarks]) -> str:
    """A script that defines the marks in an open project of Metashape.

    Metashape imports fiducial marks through its Python interface; the script contains all coordinates, in
    Metashape's convention (centre of the first pixel at 0.5, 0.5).

    Parameters
    ----------
    scans : sequence of FilmMarks
        Scans of one camera.

    Raises
    ------
    UsageError
        As :func:`write_micmac`.

    Examples
    --------
    >>> xy, mm = np.array([[9.0, 8.0], [70.0, 9.0]]), np.array([[-3.0, 0.0], [3.0, 0.0]])
    >>> marks = FilmMarks("7.tif", ("a", "b"), xy, mm)
    >>> "'a': (9.5, 8.5)" in metashape_script([marks])
    True
    """
    camera = {name: _rounded(mm) for name, mm in _camera(scans).items()}
    places = {
        scan.image: {name: _rounded(xy + _TO_CORNER) for name, xy in zip(scan.names, scan.xy, strict=True)}
        for scan in scans
    }
    return _SCRIPT.format(camera=_listed(camera, 0), scans=_listed(places, 0))


def _rounded(values: Array) -> tuple[float, float]:
    x, y = (round(float(v), 5) + 0.0 for v in values)
    return x, y


def _listed(content: object, depth: int) -> str:
    """A dictionary as Python text, one entry per line."""
    if not isinstance(content, dict):
        return repr(content)
    inner = "    " * (depth + 1)
    lines = [f"{inner}{key!r}: {_listed(value, depth + 1)},\n" for key, value in content.items()]
    return "{\n" + "".join(lines) + "    " * depth + "}"
