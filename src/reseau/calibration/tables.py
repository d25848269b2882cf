"""Tables that undistort images in other programs, and videos undistorted with them.

A table gives, for each pixel of the undistorted image, its place in the image. OpenCV's ``cv2.remap`` takes
two of floats; the filter ``remap`` of ffmpeg takes two images of 16-bit integers, rounded to whole pixels.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ImageError, InputError, UsageError
from ..io import write_whole
from ..io.stacks import open_video
from ..optics.resampling import on_lattice
from .raster import CorrectedImage

_CODECS = {".avi": "MJPG", ".mkv": "mp4v", ".mp4": "mp4v", ".mov": "mp4v", ".m4v": "mp4v"}
_NOWHERE = 65535
"""Beyond every image: ffmpeg fills such pixels."""


def remap_tables(raster: CorrectedImage) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Columns and rows in the image of each pixel of an undistorted image, as ``cv2.remap`` takes them.

    Parameters
    ----------
    raster : CorrectedImage
        By :meth:`CorrectedImage.undistorted`.

    Returns
    -------
    x, y : ndarray of float32 (height, width)
        -1 where the image has no such place.

    Examples
    --------
    >>> from reseau.calibration import CameraMapping
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 80.0, "fy": 80.0, "cx": 31.5, "cy": 23.5, "k1": -0.1})
    >>> camera = CameraMapping(lens, 64, 48, np.zeros(0, dtype=np.intp), np.zeros((0, 0)))
    >>> x, y = remap_tables(CorrectedImage.undistorted(camera))
    >>> x.shape, round(float(x[0, 0]), 1), round(float(y[0, 0]), 1)
    ((48, 64), 0.8, 0.6)
    """
    columns, rows = (np.arange(n, dtype=np.float64) for n in (raster.width, raster.height))
    x, y = on_lattice(raster.to_source, columns, rows)
    known = np.isfinite(x) & np.isfinite(y)
    return np.where(known, x, -1.0).astype(np.float32), np.where(known, y, -1.0).astype(np.float32)


def write_tables(path: Path, raster: CorrectedImage) -> tuple[Path, ...]:
    """Write the tables of an undistorted image.

    Parameters
    ----------
    path : Path
        ``.npz``, or ``.yml``, ``.yaml`` or ``.xml`` of OpenCV's FileStorage, with ``map_x`` and ``map_y``; or
        ``.pgm`` for ffmpeg: two files, ``NAME-x.pgm`` and ``NAME-y.pgm``.
    raster : CorrectedImage
        By :meth:`CorrectedImage.undistorted`.

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    UsageError
        For another suffix.
    InputError
        When a file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.calibration import CameraMapping
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 80.0, "fy": 80.0, "cx": 31.5, "cy": 23.5, "k1": -0.1})
    >>> camera = CameraMapping(lens, 64, 48, np.zeros(0, dtype=np.intp), np.zeros((0, 0)))
    >>> raster = CorrectedImage.undistorted(camera)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in write_tables(Path(folder) / "maps.pgm", raster)]
    ['maps-x.pgm', 'maps-y.pgm']
    """
    x, y = remap_tables(raster)
    suffix = path.suffix.lower()
    if suffix == ".pgm":
        files = tuple(path.with_name(f"{path.stem}-{axis}.pgm") for axis in "xy")
        for file, table in zip(files, (x, y), strict=True):
            whole = np.where((x < -0.5) | (y < -0.5), _NOWHERE, np.clip(np.rint(table), 0, _NOWHERE))
            head = f"P5\n{raster.width} {raster.height}\n65535\n".encode()
            write_whole(file, head + whole.astype(">u2").tobytes())
        return files
    if suffix == ".npz":
        import io

        stream = io.BytesIO()
        np.savez_compressed(stream, map_x=x, map_y=y)
        write_whole(path, stream.getvalue())
    elif suffix in (".yml", ".yaml", ".xml"):
        import cv2

        kind = ".xml" if suffix == ".xml" else ".yml"
        storage = cv2.FileStorage(kind, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        storage.write("map_x", x)
        storage.write("map_y", y)
        write_whole(path, storage.releaseAndGetString())
    else:
        raise UsageError(
            f"has the suffix {suffix!r}", where=path, do="use .npz, .yml or .xml (OpenCV), or .pgm (ffmpeg)"
        )
    return (path,)


def undistort_video(
    source: Path, out: Path, raster: CorrectedImage, step: Callable[[], None] = lambda: None
) -> int:
    """Undistort a video, frame by frame; the file appears whole or not at all.

    Parameters
    ----------
    source : Path
        Video that OpenCV can read. Its frames are taken as the sensor recorded them, like photographs: a turn
        that the file prescribes to players is not made.
    out : Path
        Video to write; its suffix gives the format: MPEG-4, or Motion JPEG in ``.avi``. Sound is left out.
    raster : CorrectedImage
        By :meth:`CorrectedImage.undistorted`.
    step : callable
        Called after each frame.

    Returns
    -------
    int
        Number of frames.

    Raises
    ------
    ImageError
        When the video cannot be read, or is of another size than the calibrated camera.
    InputError
        When it cannot be written.
    UsageError
        When the suffix is not that of a video.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.calibration import CameraMapping
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 80.0, "fy": 80.0, "cx": 31.5, "cy": 23.5, "k1": -0.1})
    >>> camera = CameraMapping(lens, 64, 48, np.zeros(0, dtype=np.intp), np.zeros((0, 0)))
    >>> raster = CorrectedImage.undistorted(camera)
    >>> import cv2
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     bent, flat = Path(folder) / "bent.avi", Path(folder) / "flat.avi"
    ...     video = cv2.VideoWriter(str(bent), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    ...     for level in (50, 100, 150):
    ...         _ = video.write(np.full((48, 64, 3), level, dtype=np.uint8))
    ...     _ = video.release()
    ...     undistort_video(bent, flat, raster)
    3
    """
    import cv2

    suffix = out.suffix.lower()
    if suffix not in _CODECS:
        raise UsageError(f"has the suffix {suffix!r}", where=out, do=f"use {', '.join(_CODECS)}")
    video = open_video(source)
    draft = out.with_name(f".{out.stem}.{os.getpid()}{suffix}")
    try:
        width, height = (int(video.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        raster.mapping.check_size(width, height, source)
        rate = video.get(cv2.CAP_PROP_FPS) or 25.0
        code = cv2.VideoWriter.fourcc(*_CODECS[suffix])
        written: Any = cv2.VideoWriter(str(draft), code, rate, (raster.width, raster.height))
        if not written.isOpened():
            raise InputError("cannot be written", where=out)
        (x, y), count = remap_tables(raster), 0
        while True:
            good, frame = video.read()
            if not good:
                break
            written.write(cv2.remap(frame, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT))
            count += 1
            step()
        written.release()
        if not count:
            raise ImageError("has no frame that can be read", where=source)
        draft.replace(out)
        return count
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=out) from None
    finally:
        video.release()
        with suppress(OSError):
            draft.unlink(missing_ok=True)
