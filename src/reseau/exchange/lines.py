"""Numbers in lines of text files, and the network of such a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..bundle import Camera, Network
from ..core.data import Array, Rows
from ..core.errors import FormatError, InputError
from ..core.files import readable


def numbers(words: Sequence[str], count: int, path: Path, line: int) -> list[float]:
    """Convert words to `count` finite numbers.

    Raises
    ------
    FormatError
        When the words are not that; names the line, counted from one.
    """
    try:
        values = [float(word) for word in words]
        if len(values) != count or not np.isfinite(values).all():
            raise ValueError
    except ValueError:
        shown = " ".join(words)[:60]
        raise FormatError(f"line {line}: `{shown}` is not {count} numbers", where=path) from None
    return values


def read_bytes(path: Path, most_mb: int) -> bytes:
    """Content of a file of at most `most_mb` megabytes.

    Raises
    ------
    InputError
        When it cannot be read, or is larger.
    """
    with readable(path):
        if path.stat().st_size > most_mb * 1_000_000:
            raise InputError(f"is larger than {most_mb} MB", where=path)
        return path.read_bytes()


def network_of(
    cameras: tuple[Camera, ...],
    images: tuple[str, ...],
    camera_of: Rows,
    rotation: Array,
    x0: Array,
    points: tuple[str, ...],
    xyz: Array,
    observations: tuple[Rows, Rows, Array, Array],
    *,
    files: tuple[str | None, ...] | None = None,
    unit: str = "",
    notes: tuple[str, ...] = (),
) -> Network:
    """Create a free network with approximate coordinates and poses of another program.

    Parameters
    ----------
    rotation : ndarray (m, 3)
        Rotation vectors.
    observations : tuple
        Rows of images and of points (n,), coordinates (n, 2) and standard deviations (n, 2), px.
    notes : tuple of str
        What was assumed or left out.
    """
    image_of, point_of, xy, sigma = observations
    cov = np.zeros((len(xy), 2, 2))
    cov[:, [0, 1], [0, 1]] = sigma**2
    m, p = len(images), len(points)
    return Network(
        cameras=cameras,
        images=images,
        camera_of=camera_of,
        x0=x0,
        rotation=rotation,
        points=points,
        xyz=xyz,
        sigma=np.full((p, 3), np.nan),
        role=("tie",) * p,
        image_of=image_of,
        point_of=point_of,
        xy=xy,
        cov=cov,
        distance_of=np.zeros((0, 2), dtype=np.intp),
        distance=np.zeros((0, 2)),
        datum="free",
        datum_points=np.ones(p, dtype=bool),
        groups=(None,) * m,
        files=files or (None,) * m,
        notes=notes,
        unit=unit,
    )
