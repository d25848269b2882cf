"""Images in formats of web pages and archives: WebP, GIF, AVIF, JPEG 2000, and the plain PGM and PPM.

They are decoded by Pillow. The first picture of an animation is read, with a note. Pixels are those that the
file stores: a rotation for viewers is not applied.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ImageError

_JP2, _J2K = b"\0\0\0\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51"


def coded_kind(magic: bytes) -> str:
    """The format of a file by its first bytes, at least 32; empty for any other.

    Examples
    --------
    >>> coded_kind(b"RIFF\\0\\0\\0\\0WEBPVP8 ")
    'WebP'
    """
    if magic[:4] == b"RIFF" and magic[8:12] == b"WEBP":
        return "WebP"
    if magic[:6] in (b"GIF87a", b"GIF89a"):
        return "GIF"
    if magic[4:8] == b"ftyp" and (b"avif" in magic[8:32] or b"avis" in magic[8:32]):
        return "AVIF"
    if magic.startswith((_JP2, _J2K)):
        return "JPEG 2000"
    if magic[:2] in (b"P5", b"P6") and magic[2:3].isspace():
        return "PGM"
    return ""


def decoded_coded(path: Path, kind: str, largest: int) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Pixels of an image, and notes about it.

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        Its format, as :func:`coded_kind` gives it.
    largest : int
        Number of pixels that it may have.

    Returns
    -------
    pixels : ndarray (h, w) or (h, w, 3)
        Grey values or colours, of 8 or 16 bit; a PGM of 10 or 12 bit is scaled to 16.
    notes : tuple of str
        Says that it has several pictures.

    Raises
    ------
    ImageError
        When it is damaged or too large.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings(), _whole_files():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                width, height = image.size
                if width * height <= largest:
                    return _pixels(image), _notes(image)
        raise ImageError(f"has {width}×{height} pixels, more than {largest:,}", where=path, do="crop it")
    except Image.DecompressionBombError as error:
        raise ImageError(
            "has more pixels than a file of its kind may have", where=path, do="crop it"
        ) from error
    except (OSError, ValueError, SyntaxError, EOFError, RuntimeError) as error:
        raise ImageError(f"is a damaged {kind} image", where=path, do="copy it again") from error


@contextmanager
def _whole_files() -> Iterator[None]:
    """Refuse files that end too early, also where another library (WeasyPrint) has Pillow fill them up."""
    from PIL import ImageFile

    before, ImageFile.LOAD_TRUNCATED_IMAGES = ImageFile.LOAD_TRUNCATED_IMAGES, False
    try:
        yield
    finally:
        ImageFile.LOAD_TRUNCATED_IMAGES = before


def _pixels(image: Any) -> NDArray[Any]:
    """Grey values or colours, without transparency."""
    if image.mode in ("I;16", "I;16B", "I"):
        return np.asarray(image).astype(np.uint16)
    grey = image.mode in ("1", "L", "LA")
    return np.asarray(image.convert("L" if grey else "RGB"))


def _notes(image: Any) -> tuple[str, ...]:
    several = getattr(image, "n_frames", 1) > 1
    return ("has several pictures, of which the first is used",) if several else ()
