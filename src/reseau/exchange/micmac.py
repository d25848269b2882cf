"""MicMac's orientations with homologous points and ground control: a folder ``Ori-NAME`` of a project.

``Orientation-IMAGE.xml`` has the projection centre and the rotation from the camera (x right, y down, z
forward) to object space, and names the file of its interior orientation. Beside the folder, ``Homol*`` has
the homologous points of pairs of images, in binary files (``.dat``) or as text (``Tapioca … ExpTxt=1``: x, y
in both images), and XML files
the measured (``SetOfMesureAppuisFlottants``) and given (``DicoAppuisFlottant``) control points. An integer
image coordinate is the centre of a pixel, as ours.

The distortion (``eConvApero_DistM2C``) is added to the ideal image point, as by Brown's camera with the
distortion on the object side; ``eConvApero_DistC2M`` is the reverse. The files say nothing of the pixel size:
lengths are in pixels. ``GCPConvert`` writes an uncertainty of 1 for all control points, and Campari
multiplies uncertainties by the factor of its option ``GCP``: it must be given then. Coefficients beyond the
fifth radial one, and a centre of distortion beside the principal point, are not read: the parameters are
approximate values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy

from ..bundle import Camera, Network
from ..core.data import Array, Mask, Rows
from ..core.errors import FormatError
from ..core.files import head_of
from ..io import read_text
from ..optics.poses import matrix_to_vector
from .lines import Control, network_of, numbers, read_bytes, require_said
from .markup import Node, read_markup

_PATTERN = "Orientation-*.xml"
_SIDES = {"eConvApero_DistM2C": "object", "eConvApero_DistC2M": "image"}
# Coefficients of Fraser's model, and their signs with y up.
_SIGNS = {"P1": 1.0, "P2": -1.0, "b1": 1.0, "b2": -1.0}
# Binary files of homologous points, little-endian.
_HEAD = np.dtype([("images", "<i4"), ("count", "<i4")])
_MOST_MB = 500
_PAIR = np.dtype([("images", "<i4"), ("weight", "<f8"), ("xy", "<f8", 4)])


def is_micmac(folder: Path) -> bool:
    """Whether a folder has orientations of MicMac.

    Examples
    --------
    >>> is_micmac(Path("missing"))
    False
    """
    return any(folder.glob(_PATTERN))


def read_micmac(path: Path | str, control_sigma: float | None = None) -> Network:
    r"""Read a network from a folder of orientations, and what lies beside it.

    Parameters
    ----------
    path : path
        The folder ``Ori-NAME``.
    control_sigma : float, optional
        Factor on the uncertainties of the control points, as in Campari.

    Raises
    ------
    InputError
        When a file cannot be read.
    FormatError
        When a file is not as described, the model of the distortion is another one, or there are no image
        points.
    UsageError
        When all uncertainties of control points are 1, and no factor is given.

    Examples
    --------
    >>> import tempfile
    >>> turn = "<L1>1 0 0</L1><L2>0 1 0</L2><L3>0 0 1</L3>"
    >>> interior = "<PP>320 240</PP><F>800</F><SzIm>640 480</SzIm>"
    >>> kind = "<KnownConv>eConvApero_DistM2C</KnownConv>"
    >>> def orientation(x):
    ...     outer = f"<Centre>{x} 0 -5</Centre><ParamRotation><CodageMatr>{turn}</CodageMatr></ParamRotation>"
    ...     return (
    ...         f"<ExportAPERO><OrientationConique><Interne>{kind}{interior}</Interne>"
    ...         f"<Externe>{outer}</Externe></OrientationConique></ExportAPERO>"
    ...     )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     own, pair = Path(folder) / "Ori-All", Path(folder) / "Homol" / "Pastisa.tif"
    ...     own.mkdir(), pair.mkdir(parents=True)
    ...     _ = [(own / f"Orientation-{name}.tif.xml").write_text(orientation(x)) for name, x in ("a0", "b1")]
    ...     _ = (pair / "b.tif.txt").write_text("320 240 160 240\n")
    ...     network = read_micmac(own)
    (None, None)
    >>> network
    <Network: 1 camera, 2 images, 1 point, 2 image points, datum free>
    """
    path = Path(path)
    images, centres, turns, cameras, camera_of = [], [], [], list[Camera](), []
    of_file = dict[str, int]()
    for file in sorted(path.glob(_PATTERN)):
        whole = read_markup(file).need("OrientationConique")
        inside = whole.find("Interne")
        where = "" if inside is None else file.name
        if inside is None:
            where = whole.need("FileInterne").text
            inside = read_markup(_interior_file(path, where, file)).need("CalibrationInternConique")
        camera = _camera(inside, Path(where).stem)
        same = (k for k, known in enumerate(cameras) if _alike(known, camera))
        if where not in of_file:
            of_file[where] = next(same, len(cameras))
            if of_file[where] == len(cameras):
                cameras.append(camera)
        camera_of.append(of_file[where])
        images.append(file.name.removeprefix("Orientation-").removesuffix(".xml"))
        outside = whole.need("Externe")
        centres.append(outside.need("Centre").numbers(3))
        rows = [outside.need(f"ParamRotation/CodageMatr/L{k}").numbers(3) for k in (1, 2, 3)]
        turns.append(np.array(rows).T)
    row_of = {name: k for k, name in enumerate(images)}
    tied, tie_names = _homologous(path.parent, row_of)
    measured, given = _control(path.parent, row_of)
    names = (*given, *tie_names)
    at = {name: k for k, name in enumerate(names)}
    seen = [(image, at[name], x, y) for image, name, x, y in (*measured, *tied)]
    if not seen:
        raise FormatError(
            "has no image points beside it", where=path,
            do="put homologous points to Homol, or add the measured control points",
        )  # fmt: skip
    sigma = np.array([spread for _, spread in given.values()]).reshape(-1, 3)
    if control_sigma is None:
        what = (
            "gives all control points the uncertainty 1, which is GCPConvert's default for Campari's factor"
        )
        require_said(sigma, path, what)
    return network_of(
        tuple(cameras), tuple(images), np.array(camera_of, dtype=np.intp),
        matrix_to_vector(np.array(turns)), np.array(centres), names, np.full((len(names), 3), np.nan), seen,
        control={
            name: Control(place, spread * (control_sigma or 1.0), "control")
            for name, (place, spread) in given.items() if np.isfinite(spread).all()
        },
    )  # fmt: skip


def read_interior(path: Path) -> Camera:
    """Read an interior orientation, ``AutoCal*.xml``.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is not as described, or the model of the distortion is another one.
    """
    return _camera(read_markup(path).need("CalibrationInternConique"), path.stem)


def interior_text(camera: Camera) -> str:
    """Return the text of an interior orientation.

    Parameters
    ----------
    camera : Camera
        Of Brown's model, with square pixels.

    Examples
    --------
    >>> camera = Camera.of("a", (640, 480), "brown", {"c": 8.0, "K1": 1e-4}, pitch_mm=(0.01, 0.01))
    >>> text = interior_text(camera)
    >>> "<PP>319.5 239.5</PP>" in text, "<F>800.0</F>" in text, "<CoeffDist>1e-08</CoeffDist>" in text
    (True, True, True)
    """
    in_pixels = replace(camera, pitch_mm=(1.0, 1.0)).in_millimetres(1 / camera.pitch_mm[0])
    v, width, height = in_pixels.parameters, camera.width, camera.height
    place = f"{v['x0'] + (width - 1) / 2!r} {(height - 1) / 2 - v['y0']!r}"
    radial = "".join(f"          <CoeffDist>{v[name]!r}</CoeffDist>\n" for name in ("K1", "K2", "K3"))
    signed = {name: 0.0 + sign * v[name.upper()] for name, sign in _SIGNS.items()}
    others = "".join(f"        <{name}>{value!r}</{name}>\n" for name, value in signed.items())
    convention = next(name for name, known in _SIDES.items() if known == camera.options["side"])
    return (
        f'<?xml version="1.0" ?>\n<ExportAPERO>\n  <CalibrationInternConique>\n'
        f"    <KnownConv>{convention}</KnownConv>\n    <PP>{place}</PP>\n    <F>{v['c']!r}</F>\n"
        f"    <SzIm>{width} {height}</SzIm>\n    <CalibDistortion>\n      <ModPhgrStd>\n"
        f"        <RadialePart>\n          <CDist>{place}</CDist>\n{radial}        </RadialePart>\n{others}"
        f"      </ModPhgrStd>\n    </CalibDistortion>\n  </CalibrationInternConique>\n</ExportAPERO>\n"
    )


def _interior_file(folder: Path, named: str, by: Path) -> Path:
    """Return the file of an interior orientation: beside the orientation, or from the project."""
    places = (folder / Path(named).name, folder.parent / named)
    for file in places:
        if file.exists():
            return file
    raise FormatError(f"names the interior orientation {named}, which is not there", where=by)


def _camera(inside: Node, name: str) -> Camera:
    """Brown's camera, held as Campari does, in pixels."""
    convention = inside.need("KnownConv").text
    if convention not in _SIDES:
        raise FormatError(f"has the convention {convention!r}", where=inside.where)
    width, height = inside.need("SzIm").numbers(2).astype(int).tolist()
    pp, focal = inside.need("PP").numbers(2), inside.value("F")
    if not (focal > 0 and width > 0 and height > 0):
        raise FormatError(f"has the focal length {focal:g}", where=inside.where)
    values = {"c": focal, "x0": pp[0] - (width - 1) / 2, "y0": (height - 1) / 2 - pp[1]}
    for element in inside.all("CalibDistortion"):
        values |= _distortion(element)
    model = "brown_higher" if values.get("K4", 0.0) or values.get("K5", 0.0) else "brown"
    return Camera.of(name, (width, height), model, values, options={"side": _SIDES[convention]})


def _distortion(element: Node) -> dict[str, float]:
    """Return the coefficients of a distortion, with y up."""
    if element.find("ModNoDist") is not None:
        return {}
    standard = element.find("ModPhgrStd")
    radial = element.find("ModRad") if standard is None else standard.find("RadialePart")
    if radial is None:
        kind = element.find("ModUnif/TypeModele")
        raise FormatError(
            f"has the distortion {'of another model' if kind is None else kind.text}", where=element.where,
            do="use a radial model, or Fraser's (Tapas RadialBasic, RadialStd, FraserBasic, Fraser)",
        )  # fmt: skip
    values = {f"K{k}": one.value(".") for k, one in enumerate(radial.all("CoeffDist"), start=1) if k <= 5}
    if standard is not None:
        for name, sign in _SIGNS.items():
            values[name.upper()] = sign * standard.value(name, 0.0)
    return values


def _alike(one: Camera, other: Camera) -> bool:
    """Whether two interior orientations are the same."""
    size = (one.width, one.height, one.model) == (other.width, other.height, other.model)
    return size and one.options == other.options and np.array_equal(one.values, other.values)


def _homologous(
    project: Path, row_of: Mapping[str, int]
) -> tuple[list[tuple[int, str, float, float]], tuple[str, ...]]:
    """Read the pairs of homologous points and join them to points: image, point, x, y."""
    ends = list[tuple[int, float, float]]()
    for file in sorted(project.glob("Homol*/Pastis*/*")):
        one, other = file.parent.name.removeprefix("Pastis"), file.stem
        if file.suffix not in (".txt", ".dat") or one not in row_of or other not in row_of:
            continue
        for x in _binary_pairs(file) if file.suffix == ".dat" else _text_pairs(file):
            ends += [(row_of[one], x[0], x[1]), (row_of[other], x[2], x[3])]
    if not ends:
        return [], ()
    unique, place = np.unique(np.array(ends), axis=0, return_inverse=True)
    pairs = place.reshape(-1, 2)
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), pairs.T), shape=(len(unique), len(unique)))
    count, track = scipy.sparse.csgraph.connected_components(graph, directed=False)
    # A point seen twice in an image joins different points by mistake.
    ambiguous = _twice(track.astype(np.intp), unique[:, 0], count)
    rows = np.flatnonzero(~ambiguous[track])
    named = tuple(f"tie{t}" for t in np.flatnonzero(~ambiguous).tolist())
    found = [(int(unique[r, 0]), f"tie{track[r]}", float(unique[r, 1]), float(unique[r, 2])) for r in rows]
    return found, named


def _text_pairs(file: Path) -> list[list[float]]:
    """Read x, y in both images of each pair."""
    lines = enumerate(read_text(file).splitlines(), start=1)
    return [numbers(line.split()[:4], 4, file, k) for k, line in lines if line.strip()]


def _binary_pairs(file: Path) -> list[list[float]]:
    """Read the same from a binary file: 2 and the number of pairs, then 2, a weight, and x, y of each."""
    content = read_bytes(file, _MOST_MB)
    size = len(content) - _HEAD.itemsize
    head = np.frombuffer(content, _HEAD, 1)[0] if size >= 0 else None
    if head is None or head["images"] != 2 or size != head["count"] * _PAIR.itemsize:
        raise FormatError(
            "is no binary file of homologous points of two images, or is not complete", where=file
        )
    pairs = np.frombuffer(content, _PAIR, offset=_HEAD.itemsize)
    if (pairs["images"] != 2).any() or not np.isfinite(pairs["xy"]).all():
        raise FormatError("has damaged homologous points", where=file)
    found: list[list[float]] = pairs["xy"].tolist()
    return found


def _twice(track: Rows, image: Array, count: int) -> Mask:
    """Which points (count,) are twice in an image."""
    pairs, times = np.unique(np.stack([track, image.astype(np.intp)], axis=1), axis=0, return_counts=True)
    bad: Mask = np.zeros(count, dtype=np.bool_)
    bad[pairs[times > 1, 0]] = True
    return bad


def _control(
    project: Path, row_of: Mapping[str, int]
) -> tuple[list[tuple[int, str, float, float]], dict[str, tuple[Array, Array]]]:
    """Read measured and given control points: image, point, x, y; coordinates and standard deviations."""
    measured, given = list[tuple[int, str, float, float]](), dict[str, tuple[Array, Array]]()
    for file in sorted(project.glob("*.xml")):
        head = head_of(file)
        if b"<SetOfMesureAppuisFlottants" in head:
            for image in read_markup(file).all("MesureAppuiFlottant1Im"):
                row = row_of.get(image.need("NameIm").text)
                for one in image.all("OneMesureAF1I"):
                    if row is not None:
                        x, y = one.need("PtIm").numbers(2).tolist()
                        measured.append((row, one.need("NamePt").text, x, y))
        elif b"<DicoAppuisFlottant" in head:
            for one in read_markup(file).all("OneAppuisDAF"):
                name, place = one.need("NamePt").text, one.need("Pt").numbers(3)
                if name in given and not np.array_equal(given[name][0], place):
                    raise FormatError(f"gives the point {name} again, with other coordinates", where=file)
                given[name] = (place, one.need("Incertitude").numbers(3))
    seen = {name for _, name, _, _ in measured}
    nothing = np.full(3, np.nan)
    return measured, {name: given.get(name, (nothing, nothing)) for name in sorted(seen)}
