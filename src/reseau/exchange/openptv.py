"""OpenPTV's calibration of cameras before a tank: a folder with ``parameters``, orientations and targets.

``ptv.par`` names the images and gives their size, the size of the pixels and the media: n1 before the glass,
n2 of the glass, n3 behind it, and the thickness of the glass. An ``.ori`` file has the projection centre,
three angles, the rotation matrix from the camera (x right, y up, z backwards) to the object, the principal
point, the principal distance, and the vector from the origin to the near side of the glass; its neighbour
``.addpar`` has the distortion (model ``openptv``). ``cal_ori.par`` names the table of the target's points.
Detections (``_targets``) have no names of points: as in OpenPTV, each point takes the detection next to its
place by the given orientation, within the distance of ``sortgrid.par``. Here they must be nearest to each
other, with no other detection nearly as near, and not much farther apart than the points of the same image
usually are: detections of particles are among them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..bundle import Camera, Network
from ..core.data import Array, Rows
from ..core.errors import FormatError, InputError
from ..io import read_text
from ..optics.poses import matrix_to_vector
from ..optics.refraction import RefractedRays, Window
from ..optics.refraction.windows import Refraction, RefractiveIndex
from .calibrations.openptv import OPENPTV, read
from .lines import Control, network_of, numbers

# Second nearest detection, in the distance of the nearest (px, at least one), that leaves no doubt.
_DISTINCT = 2.0
_DEFAULT_PX = 20.0
# Distance of a point from its detection, in the median of its image, and in any case allowed (px).
_USUAL, _NEAR_PX = 5.0, 2.0
_MEDIA = ("air", "glass", "fluid")
_OUTSIDE = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class _Setup:
    """Content of ``ptv.par``: calibration images, indices (3,) of the media, thickness of the glass."""

    images: tuple[str, ...]
    indices: Array
    thickness: float


@dataclass(frozen=True, eq=False)
class _Oriented:
    """An orientation: centre (3,), rotation (3, 3) to our axes of the camera, vector to the glass (3,)."""

    x0: Array
    turn: Array
    glass: Array


def is_openptv(folder: Path) -> bool:
    """Whether a folder is a calibration of OpenPTV.

    Examples
    --------
    >>> is_openptv(Path("missing"))
    False
    """
    return (folder / "parameters" / "ptv.par").is_file()


def read_openptv(folder: Path | str) -> Network:
    """Read the network of a calibration of OpenPTV: one image of the target by each camera, through glass.

    Free parameters are those with a flag in ``orient.par``. The points of the target are held.

    Parameters
    ----------
    folder : path
        The folder that contains ``parameters``.

    Raises
    ------
    InputError
        When a file is missing or cannot be read.
    FormatError
        When a file does not have the numbers that it must have; for fields of video frames; when a camera is
        on the side of the glass where the target is, or its lens cannot be converted; when no point is found.

    Examples
    --------
    >>> read_openptv("missing")
    Traceback (most recent call last):
    reseau.core.errors.InputError: missing/parameters/ptv.par: cannot be read (No such file or directory)
    """
    folder = Path(folder)
    parameters = folder / "parameters"
    setup = _setup(parameters / "ptv.par")
    count = len(setup.images)
    table, orientations = _calibration(parameters / "cal_ori.par", folder, count)
    free = _free(parameters / "orient.par")
    names, xyz = _points(table)
    oriented = [_orientation(file) for file in orientations]
    files = [folder / name for name in setup.images]
    labels = tuple(file.stem for file in files)
    if len(set(labels)) < count:
        labels = tuple(f"cam{k + 1}" for k in range(count))
    cameras = tuple(
        replace(read(read_text(file), file, free), id=label)
        for label, file in zip(labels, orientations, strict=True)
    )
    turn, x0 = np.stack([one.turn for one in oriented]), np.stack([one.x0 for one in oriented])
    refraction = _refraction(setup, oriented, orientations)
    reach = _reach(parameters / "sortgrid.par")
    seen = [
        (i, *row)
        for i, file in enumerate(files)
        for row in _identified(
            _directions(refraction, turn, x0, xyz, i), cameras[i], _detections(file), reach
        )
    ]
    if not seen:
        raise FormatError(
            f"no detection is within {reach:g} px of a point of the target", where=folder,
            do="improve the orientations, or enlarge the distance in parameters/sortgrid.par",
        )  # fmt: skip
    network = network_of(
        cameras, labels, np.arange(count), matrix_to_vector(turn), x0, names, xyz,
        seen, files=tuple(file.name for file in files), unit="mm",
        control={name: Control(at, np.zeros(3), "control") for name, at in zip(names, xyz, strict=True)},
    )  # fmt: skip
    return replace(network, datum="control", refraction=refraction)


def _words(path: Path) -> list[str]:
    return [line.strip() for line in read_text(path).splitlines() if line.strip()]


def _setup(path: Path) -> _Setup:
    lines = _words(path)
    try:
        count = int(lines[0])
        rest = [float(word) for word in lines[1 + 2 * count : 13 + 2 * count]]
    except (ValueError, IndexError):
        raise FormatError("does not have the numbers of cameras, images and media", where=path) from None
    if count < 1 or len(rest) != 12 or min(rest[3:7]) <= 0 or min(rest[8:11]) < 1 or rest[11] < 0:
        raise FormatError("does not have the numbers of cameras, images and media", where=path)
    if rest[7]:
        raise FormatError("fields of video frames are not read", where=path, do="use whole frames")
    images = tuple(lines[2 + 2 * k] for k in range(count))
    return _Setup(images, np.array(rest[8:11]), rest[11])


def _calibration(path: Path, folder: Path, count: int) -> tuple[Path, list[Path]]:
    """The table of the points of the target, and the orientation of each camera."""
    lines = _words(path)
    if len(lines) < 1 + 2 * count:
        raise FormatError(f"does not name the orientations of {count} cameras", where=path)
    return folder / lines[0], [folder / lines[2 + 2 * k] for k in range(count)]


def _free(path: Path) -> tuple[str, ...]:
    """Parameters with a flag; the first line is the number of a point."""
    if not path.is_file():
        return ()
    flags = _words(path)[1:11]
    return tuple(name for name, flag in zip(OPENPTV, flags, strict=False) if flag == "1")


def _reach(path: Path) -> float:
    if not path.is_file():
        return _DEFAULT_PX
    return numbers(read_text(path).split()[:1], 1, path, 1)[0]


def _points(path: Path) -> tuple[tuple[str, ...], Array]:
    rows = [
        (line.split()[0], numbers(line.split()[1:], 3, path, k + 1))
        for k, line in enumerate(read_text(path).splitlines())
        if line.strip()
    ]
    names = tuple(name for name, _ in rows)
    if len(set(names)) < len(names):
        raise FormatError("has a point twice", where=path)
    return names, np.array([row for _, row in rows], dtype=np.float64).reshape(-1, 3)


def _orientation(path: Path) -> _Oriented:
    values = np.array(numbers(read_text(path).split()[:21], 21, path, 1))
    # The rotation has seven digits.
    u, _, vt = np.linalg.svd(_OUTSIDE @ values[6:15].reshape(3, 3).T)
    return _Oriented(values[:3], u @ vt, values[18:21])


def _refraction(setup: _Setup, oriented: list[_Oriented], files: list[Path]) -> Refraction | None:
    """A window for each pane of glass; None where all media are the same."""
    if np.ptp(setup.indices) == 0:
        return None
    panes = list(dict.fromkeys(tuple(one.glass.tolist()) for one in oriented))
    windows = []
    for k, pane in enumerate(panes):
        away = float(np.linalg.norm(pane))
        where = files[[tuple(one.glass.tolist()) for one in oriented].index(pane)]
        if not away > 0:
            raise FormatError("the vector of the glass is zero", where=where)
        normal = -np.array(pane) / away
        for one, file in zip(oriented, files, strict=True):
            if tuple(one.glass.tolist()) == pane and one.x0 @ normal > -(away + setup.thickness):
                raise FormatError("the camera is not outside the glass", where=file)
        windows.append(
            Window(
                f"glass {k + 1}" if len(panes) > 1 else "glass", "plane", "object",
                {"distance": -(away + setup.thickness), "thickness": setup.thickness}, _MEDIA,
                direction=tuple(normal.tolist()),
            )
        )  # fmt: skip
    media = tuple(RefractiveIndex(name, float(n)) for name, n in zip(_MEDIA, setup.indices, strict=True))
    path_of = np.array([panes.index(tuple(one.glass.tolist())) for one in oriented], dtype=np.intp)
    return Refraction(media, tuple(windows), tuple((k,) for k in range(len(panes))), path_of)


def _directions(refraction: Refraction | None, turn: Array, x0: Array, xyz: Array, i: int) -> Array:
    """Directions (p, 2) in which a camera sees the points; NaN where no ray leads to them."""
    every = np.arange(len(xyz))
    image = np.full(len(xyz), i, dtype=np.intp)
    if refraction is not None:
        columns = refraction.columns(refraction.values)
        rays = RefractedRays.of(columns, refraction.path_of, turn, x0, xyz, image, every)
        return np.where(rays.reached[:, None], rays.uv, np.nan)
    local = (xyz - x0[i]) @ turn[i].T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(local[:, 2:] > 0, local[:, :2] / local[:, 2:], np.nan)


def _detections(image: Path) -> Array:
    """Image coordinates (n, 2) of the detections of an image."""
    path = image.with_name(f"{image.name}_targets")
    if not path.is_file():
        what = f"does not exist: the targets of {image.name} have not been detected yet"
        raise InputError(what, where=path, do="run Detection of OpenPTV's calibration first, which writes it")
    lines = read_text(path).splitlines()
    rows = [numbers(line.split()[:8], 8, path, k + 2) for k, line in enumerate(lines[1:]) if line.strip()]
    # Counted from the corner of the first pixel.
    return np.array([row[1:3] for row in rows], dtype=np.float64).reshape(-1, 2) - 0.5


def _identified(uv: Array, camera: Camera, found: Array, reach: float) -> list[tuple[int, float, float]]:
    """Points, and the coordinates of the detections that are theirs."""
    known: Rows = np.flatnonzero(np.isfinite(uv).all(axis=1)).astype(np.intp)
    if not len(known) or not len(found):
        return []
    apart = np.linalg.norm(camera.bare_mapping()(uv[known])[:, None] - found[None], axis=2)
    nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
    order = np.sort(apart, axis=1)
    second = order[:, 1] if found.shape[0] > 1 else np.full(len(known), np.inf)
    good = (
        (order[:, 0] <= reach)
        & (back[nearest] == np.arange(len(known)))
        & (second > _DISTINCT * np.maximum(order[:, 0], 1.0))
    )
    if good.any():
        good &= order[:, 0] <= max(_NEAR_PX, _USUAL * float(np.median(order[good, 0])))
    return [(int(known[k]), *found[nearest[k]].tolist()) for k in np.flatnonzero(good)]
