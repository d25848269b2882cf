"""Bundler's ``bundle.out``: cameras, points and their views in one text file.

Cameras and image coordinates are those of BAL (:mod:`reseau.exchange.bal`): along −z, from the centre of the
image, y up. Images that were not oriented have a focal length of 0.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np

from ..bundle import Network
from ..core.errors import FormatError
from ..io import read_text
from .bal import centred_network

_HEAD = "# Bundle file v0.3"


def is_bundler(first: str) -> bool:
    """Whether this is the first line of such a file."""
    return first.startswith("# Bundle file")


def read_bundler(path: Path | str) -> Network:
    r"""Read a network from Bundler's file.

    Names of the images are those of ``list.txt`` beside it, if there is one; otherwise numbers.

    Parameters
    ----------
    path : path
        The file, of version 0.3.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is of another version, or does not have the numbers that its second line announces.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "bundle.out"
    ...     camera = "800 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n"
    ...     _ = path.write_text(f"# Bundle file v0.3\n1 1\n{camera}0.1 0.2 -8\n9 9 9\n1 0 5 10.0 20.0\n")
    ...     read_bundler(path)
    <Network: 1 camera, 1 image, 1 point, 1 image point, datum free>
    """
    path = Path(path)
    head, _, rest = read_text(path).partition("\n")
    if head.strip() != _HEAD:
        raise FormatError(f"has the first line {head.strip()[:30]!r}, not {_HEAD!r}", where=path)
    words = iter(rest.split())

    def take(count: int) -> list[float]:
        found = [float(word) for word in islice(words, count)]
        if len(found) < count:
            raise FormatError("ends too early", where=path, do="write it again")
        return found

    try:
        cameras, points = (int(value) for value in take(2))
        poses = np.array(take(15 * cameras)).reshape(-1, 15)
        xyz, views = [], []
        for point in range(points):
            xyz.append(take(6)[:3])
            (count,) = take(1)
            table = np.array(take(4 * int(count))).reshape(-1, 4)
            views.append(np.column_stack([table[:, 0], np.full(len(table), point), table[:, 2:]]))
    except ValueError:
        raise FormatError("contains words that are not numbers", where=path) from None
    every = np.concatenate(views) if views else np.zeros((0, 4))
    image, point_of = every[:, 0].astype(np.intp), every[:, 1].astype(np.intp)
    if not (len(every) and image.min() >= 0 and image.max() < cameras):
        raise FormatError("has no views, or views in an undefined camera", where=path)
    if not (np.isfinite(poses).all() and np.isfinite(every).all() and np.isfinite(xyz).all()):
        raise FormatError("contains numbers that are not finite", where=path)
    used = np.flatnonzero(poses[:, 0] > 0)
    row = np.full(cameras, -1, dtype=np.intp)
    row[used] = np.arange(len(used))
    # A point seen twice in an image is a wrong match: only the first is used.
    _, first = np.unique(np.stack([image, point_of], axis=1), axis=0, return_index=True)
    keep = np.sort(first[row[image[first]] >= 0])
    listed = path.with_name("list.txt")
    lines = read_text(listed).splitlines() if listed.exists() else []
    files = [line.split()[0] for line in lines if line.strip()]
    named = len(files) == cameras and len(set(files)) == cameras
    names = tuple(files[i] if named else str(i) for i in used)
    return centred_network(
        poses[used, 3:12].reshape(-1, 3, 3),
        poses[used, 12:],
        poses[used, :3],
        np.array(xyz),
        np.column_stack([row[image[keep]], every[keep, 1:]]),
        names,
        names if named else None,
    )
