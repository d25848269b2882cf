"""PhotoModeler's text export, as read by DBAT.

The file has a title; tolerance, iterations, image width and height; default sigmas; the camera (c, principal
point from the upper left corner, format, K1, K2, K3, P1, P2; mm) and its sigmas. Then each image has three
lines (number and file; X, Y, Z, kappa, phi, omega in degrees; their sigmas) and two for its camera. Points
(id, X, Y, Z, sigmas) and observations (image, id, x, y, sigmas) follow, separated by blank lines. Pixel
coordinates have their origin at the corner of the top-left pixel, ours at its centre. Control points are in
another file: the network is read as a free network.

A camera whose sigmas are all 0 is fixed in the project and held. Otherwise the file does not tell which
parameters were estimated (that of c is always 0): all are free.

Marks without an object point are left out. A standard deviation of 0 means that none was set: the median of
the others is used, or 1 px without any.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..bundle import Camera, Network
from ..core.data import Array
from ..core.errors import FormatError
from ..io import read_text
from ..optics.poses import angles_to_matrix, matrix_to_vector
from .lines import is_number, network_of, numbers

_FREE = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2")


def read_photomodeler(path: Path | str) -> Network:
    r"""Read a network from PhotoModeler's text export.

    Images with equal camera parameters, to the printed digits, have one camera.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When a line is invalid; the message names it.

    Examples
    --------
    >>> import tempfile
    >>> camera = "35.0 18.0 12.0 36.0 24.0 0 0 0 0 0"
    >>> lines = ["title", "1e-6 20 3600 2400", "1", camera, "1 0 0 0 0 0 0 0 0 0 0", "0 a.jpg",
    ...          "0 0 0 1000 0 0 0", "0 0 0 0 0 0 0", f"1 {camera}", "1 0 0 0 0 0 0 0 0 0 0", "",
    ...          "7 0 0 0 1 1 1", "", "0 7 1800.5 1200.5 0.1 0.1"]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "block.txt"
    ...     _ = path.write_text("\n".join(lines))
    ...     network = read_photomodeler(path)
    >>> network.images, network.cameras[0].pitch_mm, network.xy
    (('1',), (0.01, 0.01), array([[1800., 1200.]]))
    """
    path = Path(path)
    lines = _Lines(path)
    lines.next()
    head = lines.next()
    if len(head) == 2:
        raise FormatError(
            "line 2 lacks the size of the images", where=path,
            do="add width and height in pixels at its end",
        )  # fmt: skip
    _, _, width, height = numbers(head, 4, path, lines.number)
    lines.next()
    default = numbers(lines.next(), 10, path, lines.number)
    free = _free(numbers(lines.next()[-10:], 10, path, lines.number))
    size = int(width), int(height)
    cameras, poses, files, camera_of, ids = (
        [camera_of_numbers("1", default, *size, free)],
        [],
        [],
        [],
        list[str](),
    )
    kept = [_printed(default)]
    while (words := lines.peek()) and len(words) >= 2 and not is_number(words[1]):
        ids.append(lines.next()[0])
        files.append(" ".join(words[1:]))
        poses.append(numbers(lines.next()[1:], 6, path, lines.number))
        lines.next()
        own = numbers(lines.next()[1:], 10, path, lines.number)
        own_free = _free(numbers(lines.next()[-10:], 10, path, lines.number))
        if _printed(own) not in kept:
            kept.append(_printed(own))
            cameras.append(camera_of_numbers(str(len(kept)), own, *size, own_free))
        camera_of.append(kept.index(_printed(own)))
    points, xyz = list[str](), []
    while (words := lines.peek()) and len(words) == 7:
        points.append(lines.next()[0])
        xyz.append(numbers(words[1:4], 3, path, lines.number))
    table: list[list[float]] = []
    rows, images = {name: j for j, name in enumerate(points)}, {name: i for i, name in enumerate(ids)}
    while words := lines.peek():
        if table and len(words) == 3:
            break  # tables of features follow, which are not needed
        lines.next()
        if len(words) != 6 or words[0] not in images:
            raise FormatError(
                f"line {lines.number}: `{' '.join(words)[:60]}` is not an observation of a known image",
                where=path,
            )
        if words[1] not in rows:
            # A mark without an object point, which the project does not use.
            numbers(words[2:], 4, path, lines.number)
            continue
        table.append([images[words[0]], rows[words[1]], *numbers(words[2:], 4, path, lines.number)])
    if not table:
        raise FormatError("contains no observations", where=path)
    values, seen = np.array(poses), np.array(table)
    seen[:, 2:4] -= 0.5
    seen[:, 4:] = _sigmas(seen[:, 4:], path)
    omega, phi, kappa = np.radians(values[:, [5, 4, 3]]).T
    # The file counts images from zero, the user interface of PhotoModeler from one.
    return network_of(
        tuple(cameras),
        tuple(str(int(name) + 1) if name.isdigit() else name for name in ids),
        np.array(camera_of, dtype=np.intp),
        matrix_to_vector(angles_to_matrix(omega, phi, kappa)),
        values[:, :3],
        tuple(points),
        np.array(xyz),
        seen,
        files=tuple(files),
    )


def _sigmas(sigma: Array, path: Path) -> Array:
    """Standard deviations (n, 2), px: zero means that none was set, which is the median of the others."""
    if (sigma < 0).any():
        raise FormatError("contains a negative standard deviation of an image point", where=path)
    given = sigma[sigma > 0]
    usual = float(np.median(given)) if len(given) else 1.0
    return np.where(sigma > 0, sigma, usual)


class _Lines:
    """Lines in order, without blank lines."""

    def __init__(self, path: Path) -> None:
        self.path, self.lines, self.number = path, read_text(path, "latin-1").splitlines(), 0

    def peek(self) -> list[str]:
        """Return the words of the next line; empty at the end."""
        while self.number < len(self.lines) and not self.lines[self.number].split():
            self.number += 1
        return self.lines[self.number].split() if self.number < len(self.lines) else []

    def next(self) -> list[str]:
        """Return the words of the next line and move on."""
        words = self.peek()
        if not words:
            raise FormatError("the file is incomplete", where=self.path)
        self.number += 1
        return words


def _printed(values: list[float]) -> tuple[float, ...]:
    """Camera parameters as printed for the images: three digits of c and the principal point."""
    return tuple(round(v, 3) if k < 3 else v for k, v in enumerate(values))


def _free(sigma: list[float]) -> tuple[str, ...]:
    """Free parameters by the line of sigmas of a camera: none where all are zero."""
    return _FREE if any(sigma) else ()


def camera_of_numbers(
    name: str, values: list[float], width: int, height: int, free: tuple[str, ...] = _FREE
) -> Camera:
    """A camera of its line: c, principal point, format, K1, K2, K3, P1, P2; mm.

    Examples
    --------
    >>> camera_of_numbers("1", [35.0, 18.0, 12.0, 36.0, 24.0, 0, 0, 0, 0, 0], 3600, 2400).pitch_mm
    (0.01, 0.01)
    """
    c, px, py, format_x, format_y, *distortion = values
    pitch = format_x / width, format_y / height
    brown = [c, px - format_x / 2, format_y / 2 - py, *distortion, 0.0, 0.0]
    return Camera(name, width, height, pitch, "brown", np.array(brown), free, {"side": "image"})
