"""Photographs of cameras that are fixed to each other: which were taken at once."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from glob import glob
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from ..archive.objects import LocalObjects, objects_at
from ..calibration.sensor import SensorCorrection
from ..core.data import Frame, ImagePoints
from ..core.errors import InputError, UsageError
from ..core.failure import Code, Failure
from ..core.files import readable
from ..io.images import Channel, read_image
from ..io.photographs import PHOTOGRAPHS, read_exif
from ..io.reading import is_points, read_measurement
from .target_measurement import MeasuredPhotograph, Photograph, Unread

_DESCRIBING = (".json", ".yaml", ".yml", ".xml")
"""Suffixes of designs and calibrations, which are kept beside photographs."""
_NUMBER = re.compile(r"\d+(?=\D*$)")


class Taken(NamedTuple):
    """The camera and the exposure of a photograph."""

    camera: str
    exposure: str


def files_of(pattern: str) -> list[Path]:
    """Photographs of a folder, or files that match a pattern such as ``left/*.png``, by their names.

    Raises
    ------
    InputError
        When there is none.

    Examples
    --------
    >>> files_of("no/such/folder/*.png")
    Traceback (most recent call last):
    ...
    reseau.core.errors.InputError: no/such/folder/*.png: matches no file
    """
    if Path(pattern).is_dir():
        return photographs_in(Path(pattern))
    found = sorted(path for path in map(Path, glob(pattern)) if path.is_file())
    if not found:
        raise InputError("matches no file", where=pattern)
    return found


def photographs_in(folder: Path) -> list[Path]:
    """Images in a folder, in the order of their names; without any, its files of image coordinates (CSV).

    Undistorted images that `reseau apply` wrote beside their photographs are left out.

    Raises
    ------
    InputError
        When there is neither.

    Examples
    --------
    >>> photographs_in(Path("src/reseau/optics"))
    Traceback (most recent call last):
    ...
    reseau.core.errors.InputError: src/reseau/optics: has no photograph; put some in: .jpg, .png, .tif, .heic
    """
    files = sorted(
        path
        for path in folder.iterdir()
        if path.is_file() and not path.name.startswith(".") and not _undistorted(path)
    )
    for suffixes in (PHOTOGRAPHS, (".csv",)):
        found = [path for path in files if path.suffix.lower() in suffixes]
        if found:
            return found
    raise InputError("has no photograph", where=folder, do="put some in: .jpg, .png, .tif, .heic")


def _undistorted(path: Path) -> bool:
    """Whether `reseau apply` wrote this file beside its photograph: it is by another camera."""
    beside = path.with_suffix(".json")
    return path.stem.endswith("-undistorted") and beside.is_file() and path.suffix.lower() in PHOTOGRAPHS


def files_left_out(folder: Path) -> str:
    """Name the files of a folder that :func:`photographs_in` leaves out, in one line; empty without any.

    Designs, and other documents, are not named.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("a.png", "board.json", "film.mp4", "notes.txt"):
    ...         (Path(folder) / name).touch()
    ...     files_left_out(Path(folder)).removeprefix(folder)
    ': film.mp4 and notes.txt are left out: no photographs by their suffixes'
    """
    used = set(photographs_in(folder))
    names = sorted(
        path.name
        for path in folder.iterdir()
        if path.is_file()
        and not path.name.startswith(".")
        and path not in used
        and path.suffix.lower() not in _DESCRIBING
    )
    undistorted = [name for name in names if _undistorted(folder / name)]
    if undistorted:
        rest = len(names) - len(undistorted)
        more = f", nor {rest} other files" if rest else ""
        return f"{folder}: {_listed(undistorted)}: not used, undistorted by `reseau apply`{more}"
    if not names:
        return ""
    if len(names) == 1:
        return f"{folder}: {names[0]} is left out: no photograph by its suffix"
    return f"{folder}: {_listed(names)} are left out: no photographs by their suffixes"


def _listed(names: list[str]) -> str:
    """Some names, the first of many."""
    if len(names) > 4:
        names = [*names[:3], f"{len(names) - 3} more files"]
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else names[0]


def photographs_named(paths: Iterable[Path]) -> list[Path]:
    """Photographs and folders of them as photographs, in this order.

    Raises
    ------
    InputError
        When a folder has no photograph.

    Examples
    --------
    >>> [path.name for path in photographs_named([Path("one.tif"), Path("two.tif#2")])]
    ['one.tif', 'two.tif#2']
    """
    return [file for path in paths for file in (photographs_in(path) if path.is_dir() else [path])]


def exposures_of_files(files: Mapping[str, Sequence[Path]]) -> dict[str, tuple[Path, Taken]]:
    """Tell which files of several cameras were taken at once.

    Files with the same name, without its suffix, belong to one exposure (``left/0001.png`` and
    ``right/0001.png``). Where no camera shares a name with another, the last number in the name counts
    (``left01.jpg`` and ``right01.jpg``). An exposure needs no image of every camera.

    Parameters
    ----------
    files : mapping of str to sequence of Path
        Files of each camera.

    Returns
    -------
    dict
        For each photograph, by its name ``camera/file``: the file, its camera and exposure.

    Raises
    ------
    UsageError
        With fewer than two cameras, or when the names of files do not tell which were taken at once.

    Examples
    --------
    >>> found = exposures_of_files({"left": [Path("l1.png"), Path("l2.png")], "right": [Path("r02.png")]})
    >>> {name: taken.exposure for name, (_, taken) in found.items()}
    {'left/l1.png': '1', 'left/l2.png': '2', 'right/r02.png': '2'}
    """
    if len(files) < 2:
        raise UsageError(f"{len(files)} is too few: at least two are required", where="cameras of a rig")
    same = Counter(stem for paths in files.values() for stem in {path.stem for path in paths})
    by_name = any(count > 1 for count in same.values())
    found: dict[str, tuple[Path, Taken]] = {}
    for camera, paths in files.items():
        known: dict[str, Path] = {}
        for path in paths:
            exposure = path.stem if by_name else _number(path)
            if exposure in known:
                raise UsageError(
                    f"has {known[exposure].name} and {path.name} of one exposure", where=f"camera {camera}",
                    do="name files that were taken at once alike, as left/0001.png and right/0001.png",
                )  # fmt: skip
            known[exposure] = path
            found[f"{camera}/{path.name}"] = path, Taken(camera, exposure)
    seen = Counter(taken.exposure for _, taken in found.values())
    if max(seen.values(), default=0) < 2:
        raise UsageError(
            "no file was taken together with one of another camera", where="cameras of a rig",
            do="name files that were taken at once alike, as left/0001.png and right/0001.png",
        )  # fmt: skip
    return found


def _number(path: Path) -> str:
    """The last number in a file's name, without leading zeros."""
    found = _NUMBER.search(path.stem)
    if found is None:
        raise UsageError(
            "has no number that tells with which others it was taken", where=path,
            do="name files that were taken at once alike, as left/0001.png and right/0001.png",
        )  # fmt: skip
    return str(int(found[0]))


def of_another_lens(photographs: Mapping[str, Path]) -> tuple[float | None, dict[str, str]]:
    """Find photographs that were taken with another focal length than most, as the camera says.

    Parameters
    ----------
    photographs : mapping of str to Path
        Files of one camera, by their names.

    Returns
    -------
    focal_35_mm : float or None
        Equivalent focal length of most of them; None where the camera does not say.
    others : dict of str to str
        Photographs with another focal length, and what is said about each.

    Examples
    --------
    >>> of_another_lens({"a.png": Path("a.png")})
    (None, {})
    """
    found = {name: read_exif(path) for name, path in photographs.items()}
    focal = {name: round(exif.focal_mm, 2) for name, exif in found.items() if exif.focal_mm}
    if not focal:
        return None, {}
    usual = Counter(focal.values()).most_common(1)[0][0]
    others = {
        name: f"was taken with a focal length of {length:g} mm, most with {usual:g} mm"
        for name, length in focal.items()
        if length != usual
    }
    said = [found[name].focal_35_mm for name, length in focal.items() if length == usual]
    return next((length for length in said if length), None), others


def photograph_reader(
    channel: Channel = "luma", correction: SensorCorrection | None = None
) -> Callable[[Path | Frame], Frame]:
    """Return the function that reads a photograph, or takes a frame, and corrects it; picklable.

    Parameters
    ----------
    channel : {"luma", "red", "green", "blue", "interpolated"}
        Channel of colour images.
    correction : SensorCorrection, optional
        Correction for the sensor.

    Examples
    --------
    >>> import numpy as np
    >>> photograph_reader()(Frame(np.zeros((2, 3), np.uint8), 255.0)).width
    3
    """
    return partial(_opened, channel, correction)


def _opened(channel: Channel, correction: SensorCorrection | None, image: Path | Frame) -> Frame:
    frame = read_image(image, channel) if isinstance(image, Path) else image
    return frame if correction is None else correction.correct(frame)


def photographs_of(
    images: Sequence[tuple[str, Path | Frame | ImagePoints]],
    read: Callable[[Path | Frame], Frame],
    *,
    one_lens: bool = True,
    store: str = "",
) -> tuple[float | None, Iterator[Photograph]]:
    """Return photographs to be read where they are measured; one that cannot be used does not end the series.

    Parameters
    ----------
    images : sequence of (str, Path or Frame or ImagePoints)
        Names, and files of photographs or of measured image coordinates, frames, or image points.
    read : callable
        Returns the frame of a file, or of a frame, with the corrections that are wanted; picklable, unless
        this process measures.
    one_lens : bool
        Whether all are of one camera: those that were taken with another focal length are left out.
    store : str, optional
        Folder or URL to copy the files to, and from which they are read by their SHA-256.

    Returns
    -------
    focal_35_mm : float or None
        Equivalent focal length, as the camera says.
    photographs : iterator
        Photographs to be read, image points, or why a photograph cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> frame = Frame(np.zeros((2, 3), np.uint8), 255.0)
    >>> focal, frames = photographs_of([("a", frame)], photograph_reader())
    >>> focal, [each.name for each in frames]
    (None, ['a'])

    Raises
    ------
    ArchiveError
        If the store cannot be used.
    """
    files = {name: image for name, image in images if isinstance(image, Path) and not is_points(image)}
    said, zoomed = of_another_lens(files if one_lens else {})

    def opened() -> Iterator[Photograph]:
        for name, image in images:
            if isinstance(image, ImagePoints):
                yield name, image
            elif isinstance(image, Path) and name in zoomed:
                yield name, Failure(zoomed[name], Code.DECLINED, where=name)
            elif isinstance(image, Path) and is_points(image):
                read_points = read_measurement(image)
                points = read_points.image_points(uncertain=True)
                yield MeasuredPhotograph(name, points, certain=not read_points.candidates)
            elif isinstance(image, Path) and objects is not None:
                with readable(image):
                    sha256, suffix = objects.put(image.read_bytes(), image.suffix), image.suffix
                source = partial(_of_store, read, store, sha256, suffix)
                yield Unread(name, partial(_named, source, name), {"image": sha256})
            else:
                yield Unread(name, partial(_named, partial(read, image), name))

    # Copies: the files themselves remain.
    objects = objects_at(store, durable=False) if store else None
    return said, opened()


def _named(read: Callable[[], Frame], name: str) -> Frame:
    return replace(read(), name=name)


def _of_store(read: Callable[[Path | Frame], Frame], place: str, sha256: str, suffix: str) -> Frame:
    store = objects_at(place)
    if isinstance(store, LocalObjects):
        store.open(sha256, suffix).close()  # checked: results are kept by this hash
        return read(store.path(sha256, suffix))
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{sha256}{suffix}"
        path.write_bytes(store.get(sha256, suffix))
        return read(path)
