"""COLMAP's text files: ``cameras.txt``, ``images.txt``, ``points3D.txt`` in one folder.

COLMAP's pixel coordinates have their origin at the corner of the top-left pixel, ours at its centre: half a
pixel is subtracted. Poses are quaternions (scalar first) and translations, x_c = R X + t.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..bundle import Camera, Network
from ..core.data import Array
from ..core.errors import FormatError
from ..io import read_text
from ..optics import camera_model
from ..optics.poses import matrix_to_vector
from .lines import network_of, numbers

__all__ = ["read_colmap"]

# Parameters of each model, in COLMAP's order.
_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}


def read_colmap(folder: Path | str) -> Network:
    r"""Read a network from a folder of COLMAP's text files.

    Principal distance and distortion are free and the principal point is held, as in COLMAP by default; image
    coordinates have a standard deviation of one pixel.

    Parameters
    ----------
    folder : path
        Folder with the three files.

    Raises
    ------
    InputError
        When a file cannot be read.
    FormatError
        When a line is invalid; the message names it.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as name:
    ...     folder = Path(name)
    ...     _ = (folder / "cameras.txt").write_text("1 SIMPLE_RADIAL 640 480 800 320 240 0.01")
    ...     _ = (folder / "images.txt").write_text("1 1 0 0 0 0 0 5 1 a.jpg\n320.5 240.5 7")
    ...     _ = (folder / "points3D.txt").write_text("7 0 0 0 255 255 255 0.1")
    ...     network = read_colmap(folder)
    >>> network.cameras[0].free, network.x0[0, 2], network.xy
    (('c', 'K1'), np.float64(-5.0), array([[320., 240.]]))
    """
    folder = Path(folder)
    cameras: dict[str, Camera] = {}
    path = folder / "cameras.txt"
    for number, words in _lines(path):
        camera = _camera(words, path, number)
        cameras[camera.id] = camera
    points: dict[str, list[float]] = {}
    path = folder / "points3D.txt"
    for number, words in _lines(path):
        points[words[0]] = numbers(words[1:4], 3, path, number)
    rows = {name: j for j, name in enumerate(points)}
    cameras_of, poses, names = list[int](), list[list[float]](), list[str]()
    seen = _Seen(folder / "images.txt", rows)
    order = {name: c for c, name in enumerate(cameras)}
    for number, words in _lines(seen.path, every=True):
        if len(names) == len(seen.done):
            if not words:
                continue
            if len(words) < 10 or words[8] not in order:
                raise FormatError(f"line {number}: not an image of a camera in cameras.txt", where=seen.path)
            poses.append(numbers(words[1:8], 7, seen.path, number))
            cameras_of.append(order[words[8]])
            names.append(" ".join(words[9:]))
        else:
            seen.take(words, number)
    if not names or not points:
        raise FormatError("contains no images or no points", where=folder)
    table = np.array(poses)
    matrices = _rotations(table[:, :4])
    if len(seen.image) == 0:
        raise FormatError("contains no observations of points", where=seen.path)
    xy = np.array(seen.xy) - 0.5
    return network_of(
        tuple(cameras.values()),
        tuple(names),
        np.array(cameras_of, dtype=np.intp),
        matrix_to_vector(matrices),
        -np.einsum("mji,mj->mi", matrices, table[:, 4:]),
        tuple(points),
        np.array(list(points.values())),
        (np.array(seen.image, np.intp), np.array(seen.point, np.intp), xy, np.ones(xy.shape)),
        files=tuple(names),
    )


class _Seen:
    """Observations of the images, in order."""

    def __init__(self, path: Path, rows: dict[str, int]) -> None:
        self.path, self.rows = path, rows
        self.image: list[int] = []
        self.point: list[int] = []
        self.xy: list[list[float]] = []
        self.done: list[int] = []

    def take(self, words: list[str], number: int) -> None:
        """Read the observations of an image from its line; features without a point are ignored."""
        if len(words) % 3:
            raise FormatError(f"line {number}: not triples of x, y, point", where=self.path)
        known: set[str] = set()
        for x, y, name in zip(words[::3], words[1::3], words[2::3], strict=True):
            # A point with two observations in an image is a wrong match: only the first is used.
            if name in self.rows and name not in known:
                known.add(name)
                self.image.append(len(self.done))
                self.point.append(self.rows[name])
                self.xy.append(numbers([x, y], 2, self.path, number))
        self.done.append(number)


def _lines(path: Path, *, every: bool = False) -> Iterator[tuple[int, list[str]]]:
    """Words of each line except comments; empty lines only with `every`."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if (words or every) and not line.startswith("#"):
            yield number, words


def _camera(words: list[str], path: Path, number: int) -> Camera:
    if len(words) < 4 or words[1] not in _MODELS:
        known = ", ".join(_MODELS)
        raise FormatError(f"line {number}: not a camera of a known model: {known}", where=path)
    name, model = words[:2]
    names = _MODELS[model]
    width, height, *values = numbers(words[2:], 2 + len(names), path, number)
    given = dict(zip(names, values, strict=True))
    for key in ("cx", "cy"):
        given[key] -= 0.5
    size = int(width), int(height)
    if "f" in given:
        f = given["f"]
        # One principal distance for both axes: Brown's model with a pitch of one.
        brown = [f, given["cx"] - (width - 1) / 2, (height - 1) / 2 - given["cy"]]
        radial = [given.get("k1", 0.0) / f**2, given.get("k2", 0.0) / f**4]
        free = ("c", *(f"K{k}" for k in (1, 2) if f"k{k}" in given))
        all_values = np.array([*brown, *radial, *5 * [0.0]])
        return Camera(name, *size, (1.0, 1.0), "brown", all_values, free)
    full = camera_model("opencv")
    opencv = np.array([given.get(key, 0.0) for key in full.names])
    free = tuple(key for key in full.of_role("scale", "distortion") if key in given)
    return Camera(name, *size, (1.0, 1.0), "opencv", opencv, free)


def _rotations(quaternions: Array) -> Array:
    """Rotation matrices (m, 3, 3) of quaternions (m, 4), scalar first."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
