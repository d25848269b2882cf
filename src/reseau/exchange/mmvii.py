"""Projects of MMVII, the successor of MicMac: orientations with measured and given points, as XML.

A folder ``Ori/NAME`` has ``Ori-PerspCentral-IMAGE.xml`` (projection centre, and the axes of the camera, x
right, y down, z forward, in object space) and the files of interior orientations that they name. Points
measured in images are in ``MesIm-IMAGE.xml``, given ones in ``MesGCP-NAME.xml``, of a folder in
``PointsMeasure``, or in ``ObjMesInstr`` and ``ObjCoordWorld``, beside ``Ori``; older projects have these
folders beside that of the orientations. An integer image coordinate is the centre of a pixel, as ours.

The distortion is added to the ideal direction, in units of the focal length: this is Brown's camera with the
distortion on the object side and lengths in pixels; all its parameters are free, as in ``OriBundleAdj``.
Given points without variances are approximate values. Where all variances are 1, as ``ImportGCP`` writes
them, the standard deviation is asked for: ``OriBundleAdj`` has it in an option (``GCPW``, ``GCP3D``), not in
files. Tie points (``TieP``, ``MulTieP``) are not read.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..bundle import Camera, Network
from ..core.data import Array
from ..core.errors import FormatError
from ..optics.poses import matrix_to_vector
from .lines import Control, network_of, require_said
from .markup import Node, read_markup

_PATTERN = "Ori-PerspCentral-*.xml"
# Coefficients with their names here, and the power of the focal length by which they are divided.
_TERMS = {f"K{k}": (f"K{k}", 2 * k) for k in range(1, 6)} | {
    "p1": ("P1", 1), "p2": ("P2", 1), "b1": ("B1", 0), "b2": ("B2", 0), "a": ("B1", 0),
}  # fmt: skip
# Of these the sign changes with y up.
_ODD = ("p2", "b2")
_MEASURED, _GIVEN = "MesIm-*.xml", "MesGCP*.xml"


def is_mmvii(folder: Path) -> bool:
    """Whether a folder has orientations of MMVII.

    Examples
    --------
    >>> is_mmvii(Path("missing"))
    False
    """
    return any(folder.glob(_PATTERN))


def read_mmvii(path: Path | str, control_sigma: float | None = None) -> Network:
    """Read a network from a folder of orientations of MMVII, and the points beside it.

    Parameters
    ----------
    path : path
        The folder ``MMVII-PhgrProj/Ori/NAME``.
    control_sigma : float, optional
        Standard deviation of the given points.

    Raises
    ------
    InputError
        When a file cannot be read.
    FormatError
        When a file is not as described, the projection or the distortion is another one, or there are no
        measured points, or several sets of them.
    UsageError
        When all variances of given points are 1, and no standard deviation is given.

    Examples
    --------
    >>> read_mmvii("missing")
    Traceback (most recent call last):
    reseau.core.errors.FormatError: missing: has no orientations of MMVII
    """
    path = Path(path)
    images, centres, turns, camera_of, of_file = [], [], [], [], dict[str, Camera]()
    for file in sorted(path.glob(_PATTERN)):
        pose = read_markup(file)
        images.append(_name(pose.need(".//NameImage")))
        named = _name(pose.need(".//NameInternalCalib"))
        if named not in of_file:
            of_file[named] = _camera(read_markup(path / f"{named}.xml"), named)
        camera_of.append(list(of_file).index(named))
        centres.append(pose.need(".//Center").numbers(3))
        turns.append([pose.need(f".//RotMatrix/Axe{axis}").numbers(3) for axis in "IJK"])
    if not images:
        raise FormatError("has no orientations of MMVII", where=path)
    row_of, places = {name: i for i, name in enumerate(images)}, dict[str, int]()
    seen = []
    for file in _set_of(path, _MEASURED):
        whole = read_markup(file)
        row = row_of.get(_name(whole.need(".//NameIm")))
        for one in whole.all(".//Measures/el") if row is not None else ():
            j = places.setdefault(_name(one.need("Name")), len(places))
            xx, _, yy = one.need("Sigma2").numbers(3)
            seen.append([row, j, *one.need("Pt").numbers(2), np.sqrt(xx), np.sqrt(yy)])
    if not seen:
        raise FormatError(
            "has no measured points (MesIm-IMAGE.xml) beside it; multiple tie points are not read", where=path
        )
    given = {_name(one.need("Name")): one for file in _set_of(path, _GIVEN) for one in _points(file)}
    known = {name: _known(one, control_sigma) for name, one in given.items() if name in places}
    sigma = np.array([point.sigma for point in known.values()]).reshape(-1, 3)
    if control_sigma is None:
        require_said(
            sigma, path, "gives all points the variance 1, which is what ImportGCP writes by default"
        )
    xyz = np.array([known[name].xyz if name in known else np.full(3, np.nan) for name in places])
    return network_of(
        tuple(of_file.values()), tuple(images), np.array(camera_of, dtype=np.intp),
        matrix_to_vector(np.array(turns)), np.array(centres), tuple(places), xyz, seen,
        control={name: point for name, point in known.items() if np.isfinite(point.sigma).all()},
    )  # fmt: skip


def _name(node: Node) -> str:
    """The text of an element, without its quotation marks."""
    return node.text.strip('"')


def _set_of(path: Path, pattern: str) -> list[Path]:
    """The files of the one folder of a project that has some."""
    folders = [path, *path.parent.glob("*"), *path.parent.parent.glob("*/*")]
    found = {folder.resolve(): sorted(folder.glob(pattern)) for folder in folders if folder.is_dir()}
    found = {folder: files for folder, files in found.items() if files}
    if len(found) > 1:
        names = ", ".join(sorted(f"{folder.parent.name}/{folder.name}" for folder in found))
        raise FormatError(
            f"has several sets of points beside it: {names}",
            where=path,
            do="copy the folders of orientations and of the points that are meant to one of their own",
        )
    return next(iter(found.values()), [])


def _points(file: Path) -> Iterator[Node]:
    return read_markup(file).all(".//Measures/el")


def _known(one: Node, sigma: float | None) -> Control:
    """A given point; its standard deviations are NaN where it is free."""
    variances = one.find("__Opt__Sigma2") or one.find("Sigma2")
    spread: Array = np.full(3, np.nan)
    if variances is not None:
        spread = np.sqrt(variances.numbers(6)[[0, 3, 5]]) if sigma is None else np.full(3, sigma)
    return Control(one.need("Pt").numbers(3), spread, "control")


def _camera(whole: Node, name: str) -> Camera:
    """Brown's camera in pixels; free is what the file has."""
    projection = _name(whole.need(".//Projection"))
    if projection != "Stenope":
        raise FormatError(f"has the projection {projection}", where=whole.where, do="use Stenope")
    width, height = whole.need(".//PixelFrame/NbPix").numbers(2).astype(int).tolist()
    focal, place = whole.need(".//PerfectProj/F").value("."), whole.need(".//PerfectProj/PP").numbers(2)
    if not (focal > 0 and width > 0 and height > 0):
        raise FormatError(f"has the focal length {focal:g}", where=whole.where)
    values = {"c": focal, "x0": place[0] - (width - 1) / 2, "y0": (height - 1) / 2 - place[1]}
    for term in whole.all(".//Distorsion/*/*"):
        value = term.value(".")
        if term.tag not in _TERMS and value:
            raise FormatError(f"has the distortion {term.tag}", where=whole.where, do="use Fraser's model")
        if term.tag in _TERMS:
            ours, power = _TERMS[term.tag]
            values[ours] = (-value if term.tag in _ODD else value) / focal**power
    higher = bool(values.get("K4") or values.get("K5"))
    values = {term: value for term, value in values.items() if higher or term not in ("K4", "K5")}
    model = "brown_higher" if higher else "brown"
    return Camera.of(name, (width, height), model, values, tuple(values), options={"side": "object"})
