"""Calibration of a sensor from files: folders, or a list, of dark and lit exposures and of an edge."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from ..core.data import Frame
from ..core.errors import FormatError, InputError, UsageError
from ..core.files import head_of, split_frame
from ..io.dicom import exposure_of_dicom, is_dicom
from ..io.images import Channel
from ..io.photographs import PHOTOGRAPHS, read_exif
from ..io.stacks import VIDEOS, frames_of
from .sensor import Exposure, SensorProcedure

_KINDS = {
    "dark": "dark",
    "light": "light",
    "bright": "light",
    "lit": "light",
    "flat": "light",
    "edge": "edge",
}
"""Names of folders, and of kinds in lists."""
_UNITS = {"ns": 1e-3, "us": 1.0, "µs": 1.0, "μs": 1.0, "ms": 1e3, "s": 1e6}
_TIME = re.compile(r"(?<![A-Za-z0-9.])(\d+(?:[.,]\d+)?)\s?(ns|us|µs|μs|ms|s)(?![A-Za-z])")
_SAME = 0.05
"""Relative difference up to which a name and the data of a camera state the same exposure time."""
_HOW = "name its folder or file after it, as 5ms or 800us, or write a list"


@dataclass(frozen=True)
class FileExposure:
    """A file of a series: one frame, or a stack of them.

    Parameters
    ----------
    file : Path
        An image, ``stack.tif#2``, or a file with several frames.
    kind : str
        ``light``, ``dark`` or ``edge``.
    exposure_us : float
        Exposure time (µs).
    light : float, optional
        Amount of light in any unit, such as photons per pixel.

    Examples
    --------
    >>> FileExposure(Path("dark/5ms/1.tif"), "dark", 5000.0).light is None
    True
    """

    file: Path
    kind: str
    exposure_us: float
    light: float | None = None

    @property
    def level(self) -> tuple[str, float, float]:
        """What files of one level have in common."""
        order = {"light": "0", "dark": "1", "edge": "2"}
        # The light of dark files and of an edge does not matter.
        light = self.light if self.kind == "light" and self.light is not None else 0.0
        return order[self.kind], light, self.exposure_us


def read_exposures(path: Path | str) -> tuple[FileExposure, ...]:
    """Read a list of files, or find them in a folder with the folders ``dark``, ``light`` and ``edge``.

    A list is a descriptor of EMVA 1288 (lines ``b exposure_ns photons`` and ``d exposure_ns``, each followed
    by lines ``i file``), or a CSV file with the columns `file`, `kind` (dark, light, edge), `exposure_us` (or
    _ns, _ms, _s) and optionally `light`. Its files are relative to its folder.

    Parameters
    ----------
    path : path
        The list or the folder.

    Raises
    ------
    InputError
        When it cannot be read, or nothing is found.
    FormatError
        When it is no such list.
    UsageError
        When an exposure time is not known.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "series.csv"
    ...     _ = file.write_text("file,kind,exposure_ms\\na.tif,dark,5\\n")
    ...     [(each.file.name, each.kind, each.exposure_us) for each in read_exposures(file)]
    [('a.tif', 'dark', 5000.0)]
    """
    path = Path(path)
    if path.is_dir():
        roots = [
            (_KINDS[folder.name.lower()], folder)
            for folder in sorted(path.iterdir())
            if folder.is_dir() and folder.name.lower() in _KINDS
        ]
        if not roots:
            raise InputError(
                "has no folders `dark` and `light`", where=path, do="create them, or give a list of files"
            )
        return tuple(each for kind, folder in roots for each in exposures_in(folder, kind))
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None
    except UnicodeDecodeError:
        raise FormatError("is no list of exposures", where=path, do="give a folder, or a text file") from None
    rows = [line.strip() for line in text.splitlines()]
    first = next((row.split() for row in rows if row and not row.startswith("#")), [""])
    found = _descriptor(rows, path) if first[0] in ("v", "n", "b", "d") else _table(text, path)
    if not found:
        raise FormatError("lists no file", where=path)
    return found


def exposures_in(place: Path, kind: str) -> tuple[FileExposure, ...]:
    """Find the files of one kind in a folder and its folders, with the exposure times that they state.

    Parameters
    ----------
    place : Path
        The folder, or one file.
    kind : {"light", "dark", "edge"}
        What they show.

    Raises
    ------
    InputError
        When there is no image or video.
    UsageError
        When an exposure time is not known, or stated twice with different values.

    Examples
    --------
    >>> exposures_in(Path("no/such"), "dark")
    Traceback (most recent call last):
    ...
    reseau.core.errors.InputError: no/such: does not exist
    """
    whole, number = split_frame(place)
    if whole.is_file():
        return (FileExposure(place, kind, _exposure(whole, whole.parent)),)
    if number is not None or not place.is_dir():
        raise InputError("does not exist", where=place)
    files = [
        path
        for path in sorted(place.rglob("*"))
        if path.is_file()
        and path.suffix.lower() in (*PHOTOGRAPHS, *VIDEOS)
        and not any(part.startswith(".") for part in path.relative_to(place).parts)
    ]
    if not files:
        raise InputError("has no image or video", where=place)
    return tuple(FileExposure(path, kind, _exposure(path, place)) for path in files)


def _exposure(path: Path, root: Path) -> float:
    """Exposure time (µs) by the nearest name that states one, and by the data of the camera."""
    within = path.relative_to(root.parent) if root.parent in path.parents else path
    named = next((at for name in (path.stem, *reversed(within.parts[:-1])) if (at := _named(name))), None)
    said = _said(path)
    if named and said and abs(named - said) > _SAME * max(named, said):
        raise UsageError(
            f"has the exposure time {named:g} µs by its name and {said:g} µs by its header", where=path,
            do="rename it, or write a list",
        )  # fmt: skip
    if not (named or said):
        raise UsageError("has no exposure time", where=path, do=_HOW)
    return float(named or said or 0.0)


def _named(name: str) -> float | None:
    found = _TIME.findall(name.replace("_", " "))
    return float(found[-1][0].replace(",", ".")) * _UNITS[found[-1][1]] if found else None


def _said(path: Path) -> float | None:
    if path.suffix.lower() in VIDEOS:
        return None
    return exposure_of_dicom(path) if is_dicom(path, head_of(path)) else read_exif(path).exposure_us


def _descriptor(rows: Sequence[str], path: Path) -> tuple[FileExposure, ...]:
    """The descriptor of EMVA 1288's reference program: lines of a letter and values."""
    found: list[FileExposure] = []
    level: tuple[str, float, float | None] | None = None
    for number, row in enumerate(rows, 1):
        if not row or row.startswith("#"):
            continue
        letter, _, rest = row.partition(" ")
        values = rest.split()
        if letter in ("v", "n"):
            continue
        if letter == "i" and level is not None and rest.strip():
            file = path.parent.joinpath(*rest.strip().replace("\\", "/").split("/"))
            found.append(FileExposure(file, *level))
            continue
        try:
            numbers = [float(value.replace(",", ".")) for value in values]
            kind = {"b": "light", "d": "dark"}[letter]
            photons = numbers[1] if kind == "light" else None
            level = kind, _positive(numbers[0]) / 1e3, photons
        except (KeyError, ValueError, IndexError):
            what = f"line {number} is not of a descriptor of EMVA 1288: {row[:40]!r}"
            raise FormatError(
                what, where=path, do="write `b exposure_ns photons`, `d exposure_ns`, `i file`"
            ) from None
    return tuple(found)


def _positive(value: float) -> float:
    if not 0 <= value < 1e18:
        raise ValueError(value)
    return value


def _table(text: str, path: Path) -> tuple[FileExposure, ...]:
    try:
        dialect: Any = csv.Sniffer().sniff(text.splitlines()[0], ",;\t")
    except (csv.Error, IndexError):
        dialect = csv.excel
    table = csv.DictReader(io.StringIO(text), dialect=dialect, skipinitialspace=True)
    columns = [name.strip() for name in table.fieldnames or []]
    table.fieldnames = columns
    units = {f"exposure_{unit}": scale for unit, scale in _UNITS.items() if f"exposure_{unit}" in columns}
    if "file" not in columns or "kind" not in columns or len(units) != 1:
        raise FormatError(
            "has no header with the columns file, kind and exposure_us (or exposure_ms)", where=path,
            do="begin with `file,kind,exposure_us`",
        )  # fmt: skip
    (column, scale), found = next(iter(units.items())), []
    for number, row in enumerate(table, 2):
        kind = _KINDS.get(str(row["kind"]).strip().lower())
        if kind is None:
            raise FormatError(
                f"line {number}: {row['kind']!r} is no kind", where=path, do="use dark, light or edge"
            )
        try:
            exposure = _positive(float(row[column])) * scale
            light = float(row["light"]) if (row.get("light") or "").strip() else None
        except (ValueError, TypeError):
            raise FormatError(f"line {number}: exposure or light is no number", where=path) from None
        found.append(FileExposure(path.parent / str(row["file"]).strip(), kind, exposure, light))
    return tuple(found)


class _Level(NamedTuple):
    """Files of one level, in order."""

    kind: str
    number: int
    files: list[FileExposure]


def _levels(exposures: Iterable[FileExposure]) -> Iterator[_Level]:
    numbers: dict[str, int] = {}
    for _, group in groupby(sorted(exposures, key=lambda each: each.level), key=lambda each: each.level):
        files = list(group)
        kind = files[0].kind
        numbers[kind] = numbers.get(kind, -1) + 1
        yield _Level(kind, numbers[kind], files)


def add_files(
    procedure: SensorProcedure,
    exposures: Sequence[FileExposure],
    *,
    channel: Channel = "luma",
    root: Path | None = None,
    step: Callable[[str], object] = lambda name: None,
) -> tuple[str, ...]:
    """Add the frames of files to a calibration, level by level; each is read once and not kept.

    Parameters
    ----------
    procedure : SensorProcedure
        Takes the frames, as in an acquisition.
    exposures : sequence of FileExposure
        The files.
    channel : {"luma", "red", "green", "blue", "interpolated"}
        Channel of colour images.
    root : Path, optional
        Folder to which names of files are relative in the provenance.
    step : callable
        Called with the name of each file before it is read.

    Returns
    -------
    tuple of str
        Notes: frames that are not used, and how files were read.

    Raises
    ------
    InputError
        When a file cannot be read, or its frames differ in size from the others.
    UsageError
        When files of one series have different scales of grey values.

    Examples
    --------
    See ``reseau sensor``.
    """
    notes: dict[str, None] = {}
    first: Frame | None = None
    for level in _levels(exposures):
        count = 0
        for each in level.files:
            step(each.file.name)
            for frame in frames_of(each.file, channel):
                first = first or frame
                _check_alike(frame, first, each.file)
                notes |= dict.fromkeys(_notes(frame, channel))
                name = _relative(each.file, root)
                suffix = frame.name.rpartition("#")[2] if "#" in frame.name and "#" not in name else ""
                name = f"{level.kind} {level.number:02d} {name}{'#' + suffix if suffix else ''}"
                verdict = procedure.on_frame(frame, Exposure(name, each.exposure_us, each.light))
                if verdict.ok:
                    count += 1
                else:
                    notes[f"{each.file}: not used: {verdict.why}"] = None
        if count == 1:
            at = level.files[0]
            notes[f"{at.file}: not used: the only frame of its exposure ({at.exposure_us:g} µs)"] = None
    return tuple(notes)


def _relative(path: Path, root: Path | None) -> str:
    try:
        return (path.relative_to(root) if root is not None else path).as_posix()
    except ValueError:
        return path.as_posix()


def _check_alike(frame: Frame, first: Frame, where: Path) -> None:
    if frame.pixels.shape != first.pixels.shape or frame.full_scale != first.full_scale:
        raise InputError(
            f"has {frame.width}×{frame.height} pixels up to {frame.full_scale:g}, {first.name} "
            f"{first.width}×{first.height} up to {first.full_scale:g}",
            where=where,
            do="give files of one sensor, region and format",
        )


def _notes(frame: Frame, channel: Channel) -> Iterator[str]:
    """What about a file makes its grey values differ from those of the sensor; once for all frames."""
    suffix = Path(frame.name.partition("#")[0]).suffix.lower()
    yield from (note for note in frame.notes if "compressed" in note)
    if suffix in (".jpg", ".jpeg", ".heic", ".heif"):
        yield f"{suffix} files are compressed: their noise is not that of the sensor"
    if frame.curve is not None and not frame.curve.linear:
        yield (
            "files state that grey values are not proportional to the light "
            f"({frame.curve.source or frame.curve}); they are used as they are"
        )
