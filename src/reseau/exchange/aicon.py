"""Projects of AICON 3D Studio: text files of the same name.

``.phc`` has the image coordinates: image, point, x, y, their standard deviations and residuals (mm), method,
status, an internal value. ``.obc`` has the object points: name, X, Y, Z, their standard deviations, number of
rays, status, whether the point is new, whether it defines the datum. ``.eor`` has the exterior orientations:
image, camera, X, Y, Z, omega, phi, kappa (rad), order of the rotations, status, kind of orientation. ``.ior``
has five lines for each camera: number, an internal value, c (negative), xh, yh, A1, A2, R0; A3; B1, B2; C1,
C2; format (mm) and pixels. ``.scale``, which may be missing, has scale bars: number, name, two points,
length, standard deviation, status. Lines that begin with # are comments; what has the status 0 is left out.

This is Brown's camera with the distortion on the object side, balanced at R0; photo-coordinates have their
origin in the middle of the format, y up. The files do not tell which parameters were estimated: c, xh, yh,
A1, A2, B1 and B2 are free, as is usual; A3, C1 and C2 are held. Nor do they tell the weights: the residuals
decide between those by the standard deviations in the file and equal ones. Points that are not new are
control points with their standard deviations. The columns are described by the readers of JAiCov
(https://github.com/applied-geodesy/bundle-adjustment).
"""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..bundle import Camera, Network
from ..core.data import Array, Mask
from ..core.errors import FormatError, InputError
from ..io import read_text
from ..optics.poses import angles_to_matrix, matrix_to_vector, rotation_matrix, seen_by
from .lines import Control, network_of, numbers

_SUFFIXES = (".phc", ".obc", ".ior", ".eor")
_FREE = ("c", "x0", "y0", "K1", "K2", "P1", "P2")
# Numbers in the lines of a camera.
_LINES = (8, 1, 2, 2, 4)
# Number of columns of each file, and column of the status; entries with 0 are not active.
_COLUMNS = {".phc": (11, 9), ".obc": (11, 8), ".eor": (11, 9), ".scale": (7, 6)}
# Orientations that are not computed, in the last column of ``.eor``.
_NOT_ORIENTED = "1"

_Row = tuple[int, list[str]]


def is_aicon(path: Path) -> bool:
    """Whether a file has a suffix of AICON's.

    Examples
    --------
    >>> is_aicon(Path("pipe.phc")), is_aicon(Path("pipe.txt"))
    (True, False)
    """
    return path.suffix.lower() in _SUFFIXES


def read_aicon(path: Path | str) -> Network:
    r"""Read a network from the files of a project of AICON 3D Studio.

    Parameters
    ----------
    path : path
        One of the files ``.phc``, ``.obc``, ``.ior``, ``.eor``; the others are beside it.

    Raises
    ------
    InputError
        When one of the files is missing or cannot be read.
    FormatError
        When a line is not as described; the message names it.

    Examples
    --------
    >>> import tempfile
    >>> files = {
    ...     "phc": "1 7 0.01 -0.02 0.0005 0.0005 0 0 1 1 1\n",
    ...     "obc": "7 0 0 0 0.01 0.01 0.01 1 1 1 0\n",
    ...     "eor": "1 1 0 0 500 0 0 0 0 1 3\n",
    ...     "ior": "1 -999 -8 0.1 0 0 0 3\n0\n0 0\n0 0\n6.4 4.8 640 480\n",
    ... }
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = [(Path(folder) / f"block.{end}").write_text(text) for end, text in files.items()]
    ...     network = read_aicon(Path(folder) / "block.phc")
    >>> network, network.xy, network.cameras[0].parameters["c"]
    (<Network: 1 camera, 1 image, 1 point, 1 image point, datum free>, array([[320.5, 241.5]]), 8.0)
    """
    path = Path(path)
    cameras = _cameras(_beside(path, ".ior"))
    order = {camera.id: c for c, camera in enumerate(cameras)}
    file = _beside(path, ".eor")
    images = [(at, words) for at, words in _rows(file) if words[10] != _NOT_ORIENTED]
    for at, words in images:
        if words[1] not in order or words[8] != "0":
            what = f"the order of rotations {words[8]}" if words[1] in order else f"the camera {words[1]}"
            raise FormatError(f"line {at}: has {what}, which is not known", where=file)
    poses = np.array([numbers(words[2:8], 6, file, at) for at, words in images]).reshape(-1, 6)
    row_of = {words[0]: i for i, (_, words) in enumerate(images)}
    camera_of = np.array([order[words[1]] for _, words in images], dtype=np.intp)
    file = _beside(path, ".obc")
    points, known = dict[str, list[float]](), dict[str, Control]()
    for at, words in _rows(file):
        values = numbers(words[1:7], 6, file, at)
        points[words[0]] = values[:3]
        if words[9] == "0":
            known[words[0]] = Control(np.array(values[:3]), np.array(values[3:]), "control")
    at_point = {name: j for j, name in enumerate(points)}
    table = _seen(_beside(path, ".phc"), row_of, at_point)
    for c, camera in enumerate(cameras):
        own = camera_of[table[:, 0].astype(np.intp)] == c
        table[own, 2:4] = camera.grid.to_pixels(table[own, 2:4])
        table[own, 4:] /= np.tile(camera.pitch_mm, 2)
    # The sense of y in pixels.
    table[:, 7] *= -1
    network = network_of(
        cameras, tuple(row_of), camera_of, matrix_to_vector(angles_to_matrix(*poses[:, 3:].T)), poses[:, :3],
        tuple(points), np.array(list(points.values())), table[:, :6], control=known, unit="mm",
    )  # fmt: skip
    return _with_scale_bars(_with_weights_of_residuals(network, table[:, 6:]), path)


def _with_weights_of_residuals(network: Network, residuals: Array) -> Network:
    """The network with the weights that its program used: those of the file, or one for all image points.

    At the minimum of a sum of weighted squares the residuals v of the rays of a point fulfil ΣAᵀPv = 0, with
    the derivatives A by its coordinates; with other weights they do not.
    """
    turn = rotation_matrix(network.rotation)[network.image_of]
    x = np.einsum("nij,nj->ni", turn, network.xyz[network.point_of] - network.x0[network.image_of])
    by_point = np.zeros((len(x), 2, 3))
    for camera, rows in zip(network.cameras, network.rays_of_cameras, strict=True):
        by_point[rows] = seen_by(camera.bare_mapping(), x[rows])[1] @ turn[rows]
    new: Mask = np.asarray(~(network.observed | network.held).any(axis=1))
    left = []
    for weight in (1 / np.diagonal(network.cov, axis1=1, axis2=2), np.ones((len(x), 2))):
        each, total = np.einsum("nik,ni->nk", by_point, weight * residuals), np.zeros(network.xyz.shape)
        each[~new[network.point_of]] = 0.0
        np.add.at(total, network.point_of, each)
        left.append(float((total**2).sum() / max((each**2).sum(), 1e-300)))
    if not left[1] < left[0]:
        return network
    redundancy = residuals.size - 6 * len(network.images) - 3 * int(new.sum())
    variance = (residuals**2).sum() / max(redundancy, 1)
    note = (
        f"all image points have the standard deviation {np.sqrt(variance):.2g} px: the residuals in the file "
        "are those of equal weights"
    )
    return replace(network, cov=np.tile(variance * np.eye(2), (len(x), 1, 1)), notes=(note,))


def _beside(path: Path, suffix: str) -> Path:
    """Return the file of a project with another suffix, in either case."""
    for end in (suffix, suffix.upper()):
        if path.with_suffix(end).exists():
            return path.with_suffix(end)
    raise InputError(f"is missing beside {path.name}", where=path.with_suffix(suffix))


def _rows(path: Path) -> list[_Row]:
    """Numbers and words of the lines of entries that are active."""
    found, (count, status) = [], _COLUMNS[path.suffix.lower()]
    for number, line in enumerate(read_text(path, "latin-1").splitlines(), start=1):
        words = [] if line.startswith("#") else shlex.split(line) if '"' in line else line.split()
        if words and len(words) < count:
            raise FormatError(f"line {number}: has {len(words)} of {count} columns", where=path)
        if words and words[status] != "0":
            found.append((number, words))
    return found


def _cameras(path: Path) -> tuple[Camera, ...]:
    """Read five lines for each camera."""
    text = enumerate(read_text(path, "latin-1").splitlines(), start=1)
    lines = [(at, line.split()) for at, line in text if line.strip() and not line.startswith("#")]
    if not lines or len(lines) % len(_LINES):
        raise FormatError("has not five lines for each camera", where=path)
    found = []
    for begin in range(0, len(lines), len(_LINES)):
        record = zip(lines[begin : begin + len(_LINES)], _LINES, strict=True)
        own = [numbers(words[:count], count, path, at) for (at, words), count in record]
        (_, _, c, x0, y0, a1, a2, r0), (a3,), b, shear, (wide, high, width, height) = own
        if not (wide > 0 and high > 0 and width >= 1 and height >= 1):
            raise FormatError(f"line {lines[begin + 4][0]}: has no format or no pixels", where=path)
        values = {
            "c": abs(c), "x0": x0, "y0": y0, "K1": a1, "K2": a2, "K3": a3,
            "P1": b[0], "P2": b[1], "B1": shear[0], "B2": shear[1],
        }  # fmt: skip
        found.append(
            Camera.of(
                lines[begin][1][0],
                (int(width), int(height)),
                "brown",
                values,
                _FREE,
                pitch_mm=(wide / width, high / height),
                options={"side": "object", "balance_radius_mm": r0},
            )
        )
    return tuple(found)


def _seen(file: Path, row_of: dict[str, int], at_point: dict[str, int]) -> Array:
    """Image, point, x, y, standard deviations and residuals of image points (n, 8), mm."""
    rows = _rows(file)
    found = [
        [row_of[words[0]], at_point[words[1]], *numbers(words[2:8], 6, file, at)]
        for at, words in rows
        if words[0] in row_of and words[1] in at_point
    ]
    table = np.array(found, dtype=np.float64).reshape(-1, 8)
    if not len(table) or not (table[:, 4:6] > 0).all():
        what = "image points without standard deviations" if len(table) else "no image points of known points"
        raise FormatError(f"has {what}", where=file)
    return table


def _with_scale_bars(network: Network, path: Path) -> Network:
    """The network with the scale bars of a project, where it has some."""
    file = path.with_suffix(".scale")
    if not file.exists():
        return network
    row_of = {name: j for j, name in enumerate(network.points)}
    bars = [
        (row_of[words[2]], row_of[words[3]], *numbers(words[4:6], 2, file, at))
        for at, words in _rows(file)
        if words[2] in row_of and words[3] in row_of
    ]
    table = np.array(bars, dtype=np.float64).reshape(-1, 4)
    return replace(network, distance_of=table[:, :2].astype(np.intp), distance=table[:, 2:])
