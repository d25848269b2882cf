"""Bundle Adjustment in the Large: one file of cameras, points and observations.

A BAL camera looks along −z, y up. Image coordinates are in pixels from the centre of the image, y up:
f·(1 + k1 r² + k2 r⁴)·p with p = −(X, Y)/Z (Agarwal, Snavely, Seitz & Szeliski 2010, *Bundle adjustment in the
large*). This is Brown's camera on the object side with a pitch of one and K1 = k1/f², K2 = k2/f⁴.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..bundle import Camera, Network
from ..core.data import Array, Rows
from ..core.errors import FormatError
from ..io import read_text
from ..optics.poses import matrix_to_vector, rotation_matrix
from .lines import network_of

__all__ = ["centred_network", "read_bal"]

_VIEW = np.diag([1.0, -1.0, -1.0])


def read_bal(path: Path | str) -> Network:
    """Read a network from a BAL file.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When the content does not match the numbers in the first line.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "block.bal"
    ...     _ = path.write_text("1 1 1  0 0 10.0 20.0  0 0 0 0 0 0 800 0 0  0.1 0.2 -8")
    ...     read_bal(path)
    <Network: 1 camera, 1 image, 1 point, 1 image point, datum free>
    """
    path = Path(path)
    words = read_text(path).split()
    try:
        cameras, points, observations = (int(word) for word in words[:3])
        values = np.array(words[3:], dtype=np.float64)
    except ValueError:
        raise FormatError("contains words that are not numbers", where=path) from None
    expected = 4 * observations + 9 * cameras + 3 * points
    if min(cameras, points, observations) < 1 or len(values) != expected:
        raise FormatError(f"has {len(values)} numbers after the first line, not {expected}", where=path)
    if not np.isfinite(values).all():
        raise FormatError("contains numbers that are not finite", where=path)
    table = values[: 4 * observations].reshape(-1, 4)
    poses = values[4 * observations : 4 * observations + 9 * cameras].reshape(-1, 9)
    image, point = table[:, 0].astype(np.intp), table[:, 1].astype(np.intp)
    if not (0 <= image.min() <= image.max() < cameras and 0 <= point.min() <= point.max() < points):
        raise FormatError("has an observation of an undefined camera or point", where=path)
    return centred_network(
        rotation_matrix(poses[:, :3]),
        poses[:, 3:6],
        poses[:, 6:],
        values[4 * observations + 9 * cameras :].reshape(-1, 3),
        (image, point, table[:, 2:]),
        tuple(str(i) for i in range(cameras)),
    )


def centred_network(
    matrices: Array,
    shifts: Array,
    interior: Array,
    xyz: Array,
    seen: tuple[Rows, Rows, Array],
    images: tuple[str, ...],
    files: tuple[str | None, ...] | None = None,
) -> Network:
    """Network of cameras that look along −z, with image coordinates from the centre of the image, y up.

    Parameters
    ----------
    matrices, shifts : ndarray (m, 3, 3), (m, 3)
        From object space to the camera.
    interior : ndarray (m, 3)
        f, k1, k2 of each image, which has a camera of its own.
    xyz : ndarray (p, 3)
    seen : tuple
        Rows of images and of points (n,), coordinates (n, 2).
    """
    image, point, table = seen
    half = int(np.ceil(np.abs(table).max()))
    xy = np.column_stack([table[:, 0] + half, half - table[:, 1]])
    return network_of(
        tuple(_camera(str(i), 2 * half + 1, *row) for i, row in enumerate(interior)),
        images,
        np.arange(len(images)),
        matrix_to_vector(_VIEW @ matrices),
        -np.einsum("mji,mj->mi", matrices, shifts),
        tuple(str(j) for j in range(len(xyz))),
        xyz,
        (image, point, xy, np.ones(xy.shape)),
        files=files,
    )


def _camera(name: str, size: int, f: float, k1: float, k2: float) -> Camera:
    values = np.array([f, 0.0, 0.0, k1 / f**2, k2 / f**4, 0.0, 0.0, 0.0, 0.0, 0.0])
    return Camera(name, size, size, (1.0, 1.0), "brown", values, ("c", "K1", "K2"))
