"""libmv's bundle adjustment problems, as Ceres' ``libmv_bundle_adjuster`` reads them: one binary file.

``V`` (big-endian) or ``v`` (little-endian); ``P`` (pixels) or ``N`` (normalised coordinates); eight floats:
focal length, principal point, k1, k2, k3, p1, p2 of OpenCV's model; then the numbers of cameras, points and
markers, each before its table: image, rotation by columns and translation, x_c = R X + t; track and X, Y, Z;
image, track and x, y. Numbers are 32 bit. Pixel coordinates have their origin at the corner of the top-left
pixel, ours at its centre: half a pixel is subtracted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..bundle import Camera, Network
from ..core.errors import FormatError
from ..core.files import head_of
from ..optics.poses import matrix_to_vector
from .lines import Binary, network_of

_CAMERA = [("image", "i4"), ("turn", "f4", (3, 3)), ("shift", "f4", 3)]
_POINT = [("track", "i4"), ("xyz", "f4", 3)]
_MARKER = [("image", "i4"), ("track", "i4"), ("xy", "f4", 2)]
_INTERIOR = ("cx", "cy", "k1", "k2", "k3", "p1", "p2")


def is_libmv(content: bytes) -> bool:
    """Whether this is the beginning of such a file.

    Examples
    --------
    >>> is_libmv(b"vP" + bytes(36)), is_libmv(b"vPlain text, long enough to be a header")
    (True, False)
    """
    if len(content) < 38 or content[:1] not in b"vV" or content[1:2] not in b"PN":
        return False
    # Text has no zero byte, the number of cameras has some.
    return b"\0" in content[34:38]


def read_libmv(path: Path | str) -> Network:
    """Read a network from a problem of libmv.

    Focal length, k1 and k2 are free, as in Ceres' example with ``radial``. The size of the image is not in
    the file: it is twice the principal point, or what the markers need.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it does not have the numbers that it announces, or its markers are without a camera (``N``).

    Examples
    --------
    >>> import tempfile
    >>> interior = np.array([800, 320, 240, 0, 0, 0, 0, 0], "<f4").tobytes()
    >>> one = np.array([1], "<i4").tobytes()
    >>> camera = np.array([7], "<i4").tobytes() + np.array([*np.eye(3).ravel(), 0, 0, 5], "<f4").tobytes()
    >>> point = np.array([3], "<i4").tobytes() + np.zeros(3, "<f4").tobytes()
    >>> marker = np.array([7, 3], "<i4").tobytes() + np.array([320, 240], "<f4").tobytes()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "problem.bin"
    ...     _ = file.write_bytes(b"vP" + interior + one + camera + one + point + one + marker)
    ...     network = read_libmv(file)
    >>> network.images, network.points, network.x0, network.xy
    (('7',), ('3',), array([[-0., -0., -5.]]), array([[319.5, 239.5]]))
    """
    path = Path(path)
    head = head_of(path)
    if not is_libmv(head):
        raise FormatError("is not a problem of libmv", where=path)
    if head[1:2] == b"N":
        raise FormatError(
            "has markers without the camera, in normalised coordinates",
            where=path,
            do="write markers in image space",
        )
    order: Literal["<", ">"] = "<" if head[:1] == b"v" else ">"
    file = Binary(path, begin=2)

    def table(kind: list[Any], count: int | None = None) -> NDArray[Any]:
        form = np.dtype(kind).newbyteorder(order)
        found = file.table(file.count(f"{order}i") if count is None else count, form)
        if not all(np.isfinite(found[name]).all() for name in form.names or ()):
            raise FormatError("contains numbers that are not finite", where=path)
        return found

    focal, *rest = table([("value", "f4")], 8)["value"].astype(np.float64).tolist()
    cameras, points, markers = (table(kind) for kind in (_CAMERA, _POINT, _MARKER))
    if file.left:
        raise FormatError(f"has {file.left} bytes after the last marker", where=path)
    for what, numbers in (("an image", cameras["image"]), ("a track", points["track"])):
        if len(np.unique(numbers)) != len(numbers):
            raise FormatError(f"has {what} twice", where=path)
    if not focal > 0:
        raise FormatError(f"has the focal length {focal:g}", where=path)
    # Markers of images or tracks that were not reconstructed are not used, as in Ceres' example.
    used = np.isin(markers["image"], cameras["image"]) & np.isin(markers["track"], points["track"])
    pairs = np.stack([markers["image"], markers["track"]], axis=1)
    _, first = np.unique(pairs, axis=0, return_index=True)
    keep = np.sort(first[used[first]])
    if not len(keep):
        raise FormatError("contains no markers of its cameras and points", where=path)
    markers, images, tracks = markers[keep], cameras["image"], points["track"]
    xy = markers["xy"].astype(np.float64)
    named = dict(zip(("fx", "fy", *_INTERIOR), (focal, focal, *rest), strict=True))
    width, height = (
        int(np.ceil(max(2 * named[key], xy[:, k].max() + 1))) for k, key in enumerate(("cx", "cy"))
    )
    # From the corner of the top-left pixel to its centre.
    xy, named["cx"], named["cy"] = xy - 0.5, named["cx"] - 0.5, named["cy"] - 0.5
    camera = Camera.of("camera", (width, height), "opencv", named, ("fx", "fy", "k1", "k2"))
    turns = cameras["turn"].astype(np.float64).transpose(0, 2, 1)
    return network_of(
        (camera,),
        tuple(str(i) for i in images.tolist()),
        np.zeros(len(images), dtype=np.intp),
        matrix_to_vector(turns),
        -np.einsum("mji,mj->mi", turns, cameras["shift"].astype(np.float64)),
        tuple(str(j) for j in tracks.tolist()),
        points["xyz"].astype(np.float64),
        np.column_stack([_rows(images, markers["image"]), _rows(tracks, markers["track"]), xy]),
    )


def _rows(keys: NDArray[np.int32], wanted: NDArray[np.int32]) -> NDArray[np.intp]:
    order = np.argsort(keys, kind="stable")
    return order[np.searchsorted(keys, wanted, sorter=order)].astype(np.intp)
