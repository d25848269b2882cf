"""All frames of a file: an image, the pages of a TIFF, the frames of a DICOM file, or of a video."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.data import Frame
from ..core.errors import ImageError, InputError
from ..core.files import head_of, split_frame
from ..core.provenance import sha256_of
from .dicom import count_dicom, is_dicom
from .images import Channel, count_pages, grey_of, read_image

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
"""Suffixes of videos."""
_LOSSLESS = ("FFV1", "HFYU", "FFVH", "MPNG", "PNG ", "RAW ", "DIB ", "Y800", "GREY", "\0\0\0\0")
"""Codes of video formats that keep grey values."""


def frames_of(path: Path | str, channel: Channel = "luma") -> Iterator[Frame]:
    """Read the frames of a file one after another.

    Parameters
    ----------
    path : path
        As for :func:`reseau.io.images.read_image`, or a video; ``scan.tif#2`` is one page.
    channel : {"luma", "red", "green", "blue", "interpolated"}
        Channel of a colour image.

    Yields
    ------
    Frame
        Named ``file`` or ``file#2``; the digest is that of the file.

    Raises
    ------
    InputError
        When the file cannot be read.
    ImageError
        When it is not an image or a video, or damaged.

    Examples
    --------
    >>> import tempfile, tifffile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "dark.tif"
    ...     tifffile.imwrite(file, np.zeros((3, 4, 6), np.uint16), photometric="minisblack")
    ...     [frame.name for frame in frames_of(file)]
    ['dark.tif#1', 'dark.tif#2', 'dark.tif#3']
    """
    path = Path(path)
    whole, number = split_frame(path)
    if whole.suffix.lower() in VIDEOS:
        yield from _of_video(whole, number, channel)
        return
    count = 1 if number is not None else _count(path)
    if count == 1:
        yield read_image(path, channel)
        return
    digest = sha256_of(path)
    for k in range(count):
        yield read_image(path.with_name(f"{path.name}#{k + 1}"), channel, digest)


def open_video(path: Path) -> Any:
    """Open a video; its frames are as the sensor recorded them, without the turn that a player makes.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    cv2.VideoCapture
        To be released by the caller.

    Raises
    ------
    InputError
        When there is no such file.
    ImageError
        When it is not a video that OpenCV can read.
    """
    import cv2

    if not path.is_file():
        raise InputError("cannot be read (No such file or directory)", where=path)
    # Otherwise the decoder prints a line of its own before ours.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    video: Any = cv2.VideoCapture(str(path))
    if not video.isOpened():
        video.release()
        raise ImageError("is no video that can be read", where=path)
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return video


def _count(path: Path) -> int:
    if is_dicom(path, head := head_of(path)):
        return count_dicom(path)
    return count_pages(path) if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+") else 1


def _of_video(path: Path, number: int | None, channel: Channel) -> Iterator[Frame]:
    import cv2

    video = open_video(path)
    try:
        code = int(video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("latin-1").upper()
        notes: tuple[str, ...] = ()
        if code not in _LOSSLESS:
            notes = (f"{path.name} is compressed as {code.strip()}: its noise is not that of the sensor",)
        digest, k = sha256_of(path), 0
        while True:
            good, pixels = video.read()
            if not good:
                break
            k += 1
            if number is None or number == k:
                grey = pixels if pixels.ndim == 2 else grey_of(np.asarray(pixels)[:, :, ::-1], channel)
                yield replace(Frame(grey, 255.0, f"{path.name}#{k}", digest), notes=notes)
        if not k or (number is not None and number > k):
            what = "has no frame that can be read" if number is None else f"has {k} frames"
            raise ImageError(what, where=path)
    finally:
        video.release()
