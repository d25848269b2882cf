"""The folder in which a calibration ends: all that its user needs, in files."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ..calibration import Calibration, CameraMapping, CorrectedImage
from ..calibration.assessment import Use, two_digits
from ..calibration.raster import planes_of, write_corrected
from ..core.errors import UsageError
from ..core.files import writable
from ..exchange import export_calibration
from ..exchange.calibrations.formats import export_rig, formats_holding
from ..io import write_whole
from ..io.images import open_scan
from .calibrated import Calibrated

_FILES = {"opencv": "opencv.yml", "ros": "ros.yaml", "colmap": "colmap.txt"}
"""Files for other programs, by their formats."""
_RIG = {"kalibr": "camchain.yaml", "colmap": "rig_config.json"}
"""Files of cameras that are fixed to each other."""
_NAMES = {"opencv": "OpenCV", "ros": "ROS", "colmap": "COLMAP", "kalibr": "Kalibr"}
_SAMPLES = 3
"""Undistorted photographs of each camera."""
_HOLDING = {"uint8": ".jpg", "uint16": ".png"}
"""Suffixes of images by the type of their grey values; those of other types are TIFF."""


def folder_beside(photographs: Sequence[Path]) -> Path:
    """Folder of the results of photographs, beside the one that holds all of them.

    Examples
    --------
    >>> folder_beside([Path("/bench/photos/1.jpg"), Path("/bench/photos/2.jpg")]).as_posix()
    '/bench/photos-calibration'
    """
    shared = Path(os.path.commonpath([path.resolve().parent for path in photographs]))
    found = shared.with_name(f"{shared.name}-calibration")
    return found.relative_to(Path.cwd()) if found.is_relative_to(Path.cwd()) else found


def checked_output(path: Path) -> Path:
    """Return the path of the folder, or of the file of a calibration, if it can be written.

    Nothing is made: this is called before anything is computed.

    Raises
    ------
    InputError
        When nothing can be written there.
    UsageError
        When the suffix is that of another file.

    Examples
    --------
    >>> checked_output(Path("camera.yml"))
    Traceback (most recent call last):
    ...
    reseau.core.errors.UsageError: camera.yml: has the suffix '.yml'; use .json for the calibration alone, ...
    """
    if path.suffix.lower() not in ("", ".json") and not path.is_dir():
        raise UsageError(
            f"has the suffix {path.suffix!r}", where=path,
            do="use .json for the calibration alone, or a name without suffix for a folder with the files of "
            "all programs",
        )  # fmt: skip
    return writable(path, folder=path.is_dir() or not path.suffix)


def write_calibrated(
    path: Path, done: Calibrated, calibrations: Sequence[Calibration], page: str,
    step: Callable[[str], None] = lambda _: None,
) -> list[tuple[str, str]]:  # fmt: skip
    """Write calibrations into a folder, or with the suffix ``.json`` alone; all files or none.

    Parameters
    ----------
    path : Path
        See :func:`checked_output`. Files of the same name are replaced, those of an earlier calibration too.
    done : Calibrated
        What was calibrated.
    calibrations : sequence of Calibration
        Its documents.
    page, step
        See :func:`calibration_folder`.

    Returns
    -------
    list of (str, str)
        Files in the folder, and what they are, or why they are not written.

    Raises
    ------
    InputError
        When a file cannot be written.
    """
    if path.suffix.lower() == ".json" and not path.is_dir():
        for calibration, file in zip(calibrations, done.files(path).values(), strict=True):
            calibration.write(file)
        return []
    used = {name: done.photographs(name) for name in done.files(path)}
    with TemporaryDirectory(dir=path if path.is_dir() else path.parent, prefix=".reseau-") as place:
        written = calibration_folder(Path(place), calibrations, page, used, step)
        path.mkdir(exist_ok=True)
        names = [f"{name}-" * (len(used) > 1) + file for name in used for file in _FILES.values()]
        written += _rectified(Path(place), done, calibrations)
        # Of an earlier calibration.
        for old in (*(path / name for name in (*_RIG.values(), *names)), *path.glob("rectified*.npz")):
            old.unlink(missing_ok=True)
        for file in Path(place).iterdir():
            file.replace(path / file.name)
    return written


def calibration_folder(
    folder: Path,
    calibrations: Sequence[Calibration],
    page: str,
    photographs: Mapping[str, Sequence[Path]],
    step: Callable[[str], None] = lambda _: None,
) -> list[tuple[str, str]]:
    """Write the calibrations of one camera, or of several that are fixed to each other, into an empty folder.

    The report, and each calibration; where it is usable its files for OpenCV, ROS and COLMAP, as far as these
    have its model, those of the rig for Kalibr and COLMAP, and three undistorted photographs of each camera.

    Parameters
    ----------
    folder : Path
        The folder.
    calibrations : sequence of Calibration
        The cameras; of several the first is the reference of the rig.
    page : str
        The report.
    photographs : mapping of str to sequence of Path
        Photographs from which each camera was calibrated, by its name.
    step : callable
        Is called with what is written next.

    Returns
    -------
    list of (str, str)
        Files, relative to the folder, and what they are, or why they are not written.

    Raises
    ------
    InputError
        When a file cannot be written.
    """
    written = [("report.html", "report")]
    step("report")
    write_whole(folder / "report.html", page)
    for calibration, (name, files) in zip(calibrations, photographs.items(), strict=True):
        before = f"{name}-" if len(calibrations) > 1 else ""
        own = f"{name}.json" if before else "camera.json"
        calibration.write(folder / own)
        written.append((own, "calibration with its uncertainty"))
        if calibration.assessment is not None and calibration.assessment.use is Use.NOTHING:
            written.append(
                ("", "not usable: no files for other programs (reseau export --anyway writes them)")
            )
            continue
        holding = formats_holding(calibration)
        for to in (to for to in _FILES if to in holding):
            export_calibration(calibration, to, folder / f"{before}{_FILES[to]}")
            written.append((f"{before}{_FILES[to]}", f"camera for {_NAMES[to]}"))
        lacking = [_NAMES[to] for to in _FILES if to not in holding]
        if lacking:
            written.append(("", f"not for {' and '.join(lacking)}, which lack its model: see reseau export"))
        lens = calibration.mapping()
        if isinstance(lens, CameraMapping):
            written += _samples(folder, before, lens, files, step)
    if len(calibrations) > 1:
        written += _rig(folder, calibrations)
    return written


def _samples(
    folder: Path, before: str, lens: CameraMapping, files: Sequence[Path], step: Callable[[str], None]
) -> list[tuple[str, str]]:
    """Undistorted photographs, spread over all."""
    chosen = sorted(set(np.linspace(0, len(files) - 1, _SAMPLES).astype(int))) if files else []
    raster, names = CorrectedImage.undistorted(lens, "keep"), list[str]()
    for path in (files[k] for k in chosen):
        step(f"undistorting {path.name}")
        planes = planes_of(open_scan(path))
        lens.check_size(planes[0].shape[1], planes[0].shape[0], path)
        suffix = _HOLDING.get(str(planes[0].dtype), ".tif")
        name = f"{before}undistorted-{path.stem}{suffix}"
        write_corrected(folder / name, planes, raster)
        names.append(name)
    return [(name, "undistorted photograph") for name in names]


def _rig(folder: Path, calibrations: Sequence[Calibration]) -> list[tuple[str, str]]:
    """The cameras together, for programs that have their models, where all are usable."""
    if not _usable(calibrations):
        return []
    holding = set.intersection(*(set(formats_holding(each)) for each in calibrations))
    written = {to: name for to, name in _RIG.items() if to in holding}
    for to, name in written.items():
        export_rig(calibrations, to, folder / name)
    return [(name, f"cameras for {_NAMES[to]}") for to, name in written.items()]


def _usable(calibrations: Sequence[Calibration]) -> bool:
    return not any(each.assessment and each.assessment.use is Use.NOTHING for each in calibrations)


def _rectified(folder: Path, done: Calibrated, calibrations: Sequence[Calibration]) -> list[tuple[str, str]]:
    """Maps that rectify the images of each camera and of its reference, where all are usable."""
    written = list[tuple[str, str]]()
    placed = [name for name, each in zip(done.cameras, calibrations, strict=True) if each.place is not None]
    for name in placed if _usable(calibrations) else ():
        file = f"rectified-{name}.npz" if len(placed) > 1 else "rectified.npz"
        try:
            found = done.rectified(name)
        except UsageError as error:
            written.append(("", f"no rectified images: {error}"))
            continue
        found.write(folder / file)
        off, share = two_digits(found.greatest_px), 100 * found.common.mean()
        what = f"maps for cv2.remap: rows off by {off} px (σ) at most, {share:.0f} % seen by both"
        written.append((file, f"rectified images, {what}"))
    return written
