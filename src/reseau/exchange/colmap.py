"""COLMAP's files: ``cameras``, ``images`` and ``points3D`` in one folder, as text or binary.

COLMAP's pixel coordinates have their origin at the corner of the top-left pixel, ours at its centre: half a
pixel is subtracted. Poses are quaternions (scalar first) and translations, x_c = R X + t.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from ..bundle import Camera, Network, Result
from ..bundle.diagnostics.fields import camera_mapping
from ..core.data import Array
from ..core.errors import FormatError, UsageError
from ..core.files import made_folder
from ..io import read_text, write_whole
from ..optics.poses import quaternions
from .calibrations import calibration_formats
from .calibrations.colmap import MODELS
from .calibrations.formats import Exported, exported_lens
from .lines import Binary, network_of, numbers

# Their numbers in binary files; 7 has another projection (FOV).
_NUMBERS = dict(zip((*range(7), 8, 9), MODELS, strict=True))


def read_colmap(folder: Path | str) -> Network:
    r"""Read a network from a folder of COLMAP's files, text (``.txt``) or binary (``.bin``).

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
        When a line is invalid, which the message names, or a binary file ends too early.

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
    binary = not (folder / "cameras.txt").exists() and (folder / "cameras.bin").exists()
    cameras, points, images = _binary(folder) if binary else _text(folder)
    if not images or not points:
        raise FormatError("contains no images or no points", where=folder)
    rows, order = {name: j for j, name in enumerate(points)}, {name: c for c, name in enumerate(cameras)}
    seen, twice = list[tuple[float, ...]](), 0
    for i, image in enumerate(images):
        known = set[str]()
        for at, name in zip(image.xy, image.points, strict=True):
            # A point with two observations in an image is a wrong match: only the first is used; features
            # without a point are not.
            if name not in rows:
                continue
            if name in known:
                twice += 1
            else:
                known.add(name)
                seen.append((i, rows[name], at[0] - 0.5, at[1] - 0.5))
    if not seen:
        raise FormatError("contains no observations of points", where=folder)
    table, names = np.array([image.pose for image in images]), tuple(image.name for image in images)
    turns = scipy.spatial.transform.Rotation.from_quat(table[:, [1, 2, 3, 0]])
    return network_of(
        tuple(cameras.values()),
        names,
        np.array([order[image.camera] for image in images], dtype=np.intp),
        turns.as_rotvec(),
        -turns.apply(table[:, 4:], inverse=True),
        tuple(points),
        np.array(list(points.values())),
        seen,
        files=names,
        notes=(f"{folder}: {twice} second observations of a point in the same image left out",)
        if twice
        else (),
    )


def write_colmap(result: Result, folder: Path | str) -> dict[str, Exported]:
    """Write an adjusted network as COLMAP's text files.

    Image points that were rejected, and points and images that are not determined, are left out. A camera
    model that COLMAP lacks is converted, as by :func:`~reseau.exchange.export_calibration`.

    Parameters
    ----------
    result : Result
        The adjustment.
    folder : path
        Folder for ``cameras.txt``, ``images.txt`` and ``points3D.txt``; it is made.

    Returns
    -------
    dict of str to Exported
        The cameras as they were written, with the differences of converted models.

    Raises
    ------
    UsageError
        When no model of COLMAP describes a camera, or the network has windows.
    InputError
        When a file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.bundle import adjust_network, example_network
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     done = write_colmap(adjust_network(example_network()), folder)
    ...     again = read_colmap(folder)
    >>> again
    <Network: 1 camera, 8 images, 20 points, 160 image points, datum free>
    """
    network, fit, folder = result.network, result.fit, Path(folder)
    if network.refraction is not None:
        raise UsageError("cannot be written: COLMAP has no windows", where="network with windows")
    form, written, cameras = calibration_formats()["colmap"], dict[str, Exported](), list[str]()
    for c, camera in enumerate(network.cameras):
        stored = {"model": camera.model, "pitch_mm": camera.pitch_mm, "additional": camera.additional}
        lens = camera_mapping(result, c)
        written[camera.id] = exported_lens(form, camera.id, lens, {**camera.options, **stored})
        line = form.write(written[camera.id].camera).splitlines()[-1]
        cameras.append(f"{c + 1} {line.split(maxsplit=1)[1]}")
    turns = fit.values.rotation
    seen = result.used & fit.usable.points[network.point_of] & fit.usable.images[network.image_of]
    lines, place = list[str](), np.full(len(network.xy), -1)
    for i in np.flatnonzero(fit.usable.images):
        rows = network.rays_of_images[i]
        rows = rows[seen[rows]]
        place[rows] = np.arange(len(rows))
        pose = [*quaternions(turns[i : i + 1])[0], *(-turns[i] @ fit.values.x0[i])]
        name = network.images[i]
        lines.append(f"{i + 1} {_words(pose)} {network.camera_of[i] + 1} {name}")
        marks = zip(network.xy[rows] + 0.5, network.point_of[rows] + 1, strict=True)
        lines.append(" ".join(f"{_words(xy)} {point}" for xy, point in marks))
    size = np.linalg.norm(np.nan_to_num(result.residuals), axis=1)
    points = []
    for j in np.flatnonzero(fit.usable.points):
        rows = network.rays_of_points[j]
        rows = rows[seen[rows]]
        track = " ".join(f"{network.image_of[k] + 1} {place[k]}" for k in rows)
        error = float(size[rows].mean()) if len(rows) else -1.0
        points.append(f"{j + 1} {_words(fit.values.xyz[j])} 128 128 128 {error!r} {track}")
    made_folder(folder)
    for name, text in (("cameras", cameras), ("images", lines), ("points3D", points)):
        write_whole(folder / f"{name}.txt", "".join(f"{line}\n" for line in text))
    return written


def _words(values: Sequence[float] | Array) -> str:
    return " ".join(repr(float(value)) for value in values)


class _Image(NamedTuple):
    """An image: quaternion and translation (7), and its features (k, 2) with the names of their points."""

    name: str
    camera: str
    pose: Sequence[float]
    xy: Array
    points: Sequence[str]


_Content = tuple[dict[str, Camera], dict[str, Sequence[float]], list[_Image]]


def _text(folder: Path) -> _Content:
    """Cameras and points by name, and images, of text files."""
    cameras: dict[str, Camera] = {}
    path = folder / "cameras.txt"
    for number, words in _lines(path):
        if len(words) < 4 or words[1] not in MODELS:
            known = ", ".join(MODELS)
            raise FormatError(f"line {number}: not a camera of a known model: {known}", where=path)
        width, height, *values = numbers(words[2:], 2 + len(MODELS[words[1]]), path, number)
        cameras[words[0]] = _camera(words[0], words[1], (int(width), int(height)), values)
    points: dict[str, Sequence[float]] = {}
    path = folder / "points3D.txt"
    for number, words in _lines(path):
        points[words[0]] = numbers(words[1:4], 3, path, number)
    images, path, head = list[_Image](), folder / "images.txt", list[str]()
    for number, words in _lines(path, every=True):
        if not head:
            if words and (len(words) < 10 or words[8] not in cameras):
                raise FormatError(f"line {number}: not an image of a camera in cameras.txt", where=path)
            head, pose = words, numbers(words[1:8], 7, path, number) if words else []
        else:
            if len(words) % 3:
                raise FormatError(f"line {number}: not triples of x, y, point", where=path)
            xy = numbers([w for k, w in enumerate(words) if k % 3 < 2], len(words) // 3 * 2, path, number)
            images.append(_Image(" ".join(head[9:]), head[8], pose, np.array(xy).reshape(-1, 2), words[2::3]))
            head = []
    return cameras, points, images


def _binary(folder: Path) -> _Content:
    """Cameras and points by name, and images, of binary files."""
    file = Binary(folder / "cameras.bin")
    cameras: dict[str, Camera] = {}
    for _ in range(file.count()):
        number, kind, width, height = file.take("<iiQQ")
        model = _NUMBERS.get(kind)
        if model is None:
            known = ", ".join(MODELS)
            raise FormatError(
                f"camera {number} has the model number {kind}; known are {known}", where=file.path
            )
        values = file.take(f"<{len(MODELS[model])}d")
        cameras[str(number)] = _camera(str(number), model, (width, height), values)
    file = Binary(folder / "points3D.bin")
    points: dict[str, Sequence[float]] = {}
    for _ in range(file.count()):
        number, *xyz = file.take("<Q3d")
        points[str(number)] = xyz
        (length,) = file.take("<3xdQ")[1:]
        file.skip(8 * length)
    file, images = Binary(folder / "images.bin"), []
    for _ in range(file.count()):
        _, *pose, camera = file.take("<i7di")
        name = file.text()
        (length,) = file.take("<Q")
        table = file.table(length, np.dtype([("xy", "<f8", 2), ("point", "<i8")]))
        if str(camera) not in cameras:
            raise FormatError(f"image {name} has a camera that is not in cameras.bin", where=file.path)
        images.append(_Image(name, str(camera), pose, table["xy"], [str(p) for p in table["point"].tolist()]))
    return cameras, points, images


def _lines(path: Path, *, every: bool = False) -> Iterator[tuple[int, list[str]]]:
    """Words of each line except comments; empty lines only with `every`."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if (words or every) and not line.startswith("#"):
            yield number, words


def _camera(name: str, model: str, size: tuple[int, int], values: Sequence[float]) -> Camera:
    given = dict(zip(MODELS[model], values, strict=True))
    cx, cy = given["cx"] - 0.5, given["cy"] - 0.5
    kind = "fisheye" if model.endswith("FISHEYE") else "opencv"
    f = given.get("f", 0.0)
    if "f" in given and kind == "opencv":
        # One principal distance for both axes: Brown's model with a pitch of one.
        brown = {"c": f, "x0": cx - (size[0] - 1) / 2, "y0": (size[1] - 1) / 2 - cy}
        radial = {f"K{k}": given[f"k{k}"] / f ** (2 * k) for k in (1, 2) if f"k{k}" in given}
        return Camera.of(name, size, "brown", brown | radial, ("c", *radial))
    given = {"fx": f, "fy": f} | given | {"cx": cx, "cy": cy}
    return Camera.of(name, size, kind, given, given.keys() - {"cx", "cy"})
