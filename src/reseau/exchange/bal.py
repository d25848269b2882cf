"""Bundle Adjustment in the Large: one file of cameras, points and observations.

A BAL camera looks along −z, y up. Image coordinates are in pixels from the centre of the image, y up:
f·(1 + k1 r² + k2 r⁴)·p with p = −(X, Y)/Z (Agarwal, Snavely, Seitz & Szeliski 2010, *Bundle adjustment in the
large*). This is Brown's camera on the object side with a pitch of one and K1 = k1/f², K2 = k2/f⁴.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..bundle import Camera, Network, Result
from ..bundle.diagnostics.fields import camera_mapping
from ..core.data import Array
from ..core.errors import FormatError, UsageError
from ..io import read_text, write_whole
from ..optics.poses import matrix_to_vector, rotation_matrix
from .lines import network_of

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
        table,
        tuple(str(i) for i in range(cameras)),
    )


def write_bal(result: Result, path: Path | str) -> None:
    """Write an adjusted network as a BAL file, with one camera for each image.

    BAL has no principal point and two radial coefficients only. Brown's camera without others is written as
    it is, with image coordinates from its principal point; image coordinates of other cameras are corrected
    for their distortion.

    Parameters
    ----------
    result : Result
        The adjustment; rejected image points, and what is not determined, are left out.
    path : path
        File to write.

    Raises
    ------
    UsageError
        When the network has windows, or a camera has parallel rays.
    InputError
        When the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.bundle import adjust_network, example_network
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_bal(adjust_network(example_network()), f"{folder}/block.bal")
    ...     read_bal(f"{folder}/block.bal")
    <Network: 8 cameras, 8 images, 20 points, 160 image points, datum free>
    """
    network, fit = result.network, result.fit
    if network.refraction is not None or network.parallel.any():
        raise UsageError("cannot be written as BAL", where="network with windows or parallel rays")
    part = fit.usable
    rows = np.flatnonzero(result.used & part.points[network.point_of] & part.images[network.image_of])
    image, point = (np.unique(of[rows], return_inverse=True) for of in (network.image_of, network.point_of))
    turns = fit.values.rotation
    xy, interior = np.full((len(rows), 2), np.nan), np.zeros((len(image[0]), 3))
    for c, camera in enumerate(network.cameras):
        mine = np.flatnonzero(network.camera_of[network.image_of[rows]] == c)
        lens = camera_mapping(result, c)
        radial = _radial(camera, result)
        uv = lens.mapping.inverse(network.xy[rows[mine]])
        f = float(np.sqrt(abs(np.linalg.det(lens.mapping.derivatives(np.zeros((1, 2))).d_xy[0]))))
        if radial is None:
            xy[mine], radial = f * uv * [1.0, -1.0], (f, 0.0, 0.0)
        else:
            centre = lens.mapping.derivatives(np.zeros((1, 2))).value[0]
            xy[mine] = (network.xy[rows[mine]] - centre) * [1.0, -1.0]
        interior[network.camera_of[image[0]] == c] = radial
    good = np.isfinite(xy).all(axis=1)
    lines = [f"{len(image[0])} {len(point[0])} {int(good.sum())}"]
    for i, j, at in zip(image[1][good], point[1][good], xy[good], strict=True):
        lines.append(f"{i} {j} {float(at[0])!r} {float(at[1])!r}")
    numbers = list[float]()
    for k, i in enumerate(image[0]):
        turn = _VIEW @ turns[i]
        numbers += [*matrix_to_vector(turn[None])[0], *(-turn @ fit.values.x0[i]), *interior[k]]
    numbers += fit.values.xyz[point[0]].ravel().tolist()
    lines += [repr(float(number)) for number in numbers]
    write_whole(Path(path), "\n".join(lines) + "\n")


def _radial(camera: Camera, result: Result) -> tuple[float, float, float] | None:
    """f, k1 and k2 of Brown's camera on the object side with square pixels and no other distortion."""
    if camera.model != "brown" or camera.additional is not None or camera.options.get("side") != "object":
        return None
    c = result.network.cameras.index(camera)
    names = () if camera.registered is None else camera.registered.names
    values = dict(zip(names, result.fit.values.cameras[c, : len(names)].tolist(), strict=True))
    others = [value for name, value in values.items() if name not in ("c", "x0", "y0", "K1", "K2")]
    if any(others) or camera.pitch_mm[0] != camera.pitch_mm[1]:
        return None
    # Radii are in mm: K1 r² with r = c·ρ.
    c_mm = values["c"]
    return c_mm / camera.pitch_mm[0], values["K1"] * c_mm**2, values["K2"] * c_mm**4


def centred_network(
    matrices: Array,
    shifts: Array,
    interior: Array,
    xyz: Array,
    seen: Array,
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
    seen : ndarray (n, 4)
        Row of the image, row of the point, x, y.
    """
    half = int(np.ceil(np.abs(seen[:, 2:]).max()))
    seen = np.column_stack([seen[:, :2], seen[:, 2] + half, half - seen[:, 3]])
    return network_of(
        tuple(_camera(str(i), 2 * half + 1, *row) for i, row in enumerate(interior)),
        images,
        np.arange(len(images)),
        matrix_to_vector(_VIEW @ matrices),
        -np.einsum("mji,mj->mi", matrices, shifts),
        tuple(str(j) for j in range(len(xyz))),
        xyz,
        seen,
        files=files,
    )


def _camera(name: str, size: int, f: float, k1: float, k2: float) -> Camera:
    values = {"c": f, "K1": k1 / f**2, "K2": k2 / f**4}
    return Camera.of(name, (size, size), "brown", values, tuple(values))
