"""Scenes of OpenMVG (``sfm_data.json``) and AliceVision (``.sfm``): views, intrinsics, poses and structure.

Both are JSON with the same parts under other names. Rotations are from object space to the camera, in rows
(OpenMVG) or columns (AliceVision); an integer image coordinate is the centre of a pixel, as ours. AliceVision
gives the principal point from the corner, since version 1.2 from the middle of the image, and the focal
length in pixels, or in mm with the width of the sensor. Image coordinates have a standard deviation of one
pixel, as neither writes one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..bundle import Camera, Network
from ..core.data import Array
from ..core.errors import FormatError
from ..io import read_text
from ..optics.poses import matrix_to_vector
from .lines import network_of

# Coefficients of the models of distortion, by their names in both programs; others are refused by name.
_RADIAL, _BROWN, _FISHEYE = ("k1", "k2", "k3"), ("k1", "k2", "k3", "p1", "p2"), ("k1", "k2", "k3", "k4")
_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "pinhole": ("opencv", ()),
    "pinhole_radial_k1": ("opencv", _RADIAL[:1]),
    "pinhole_radial_k3": ("opencv", _RADIAL),
    "pinhole_brown_t2": ("opencv", _BROWN),
    "radial1": ("opencv", _RADIAL[:1]),
    "radial3": ("opencv", _RADIAL),
    "radialk1": ("opencv", _RADIAL[:1]),
    "radialk3": ("opencv", _RADIAL),
    "brown": ("opencv", _BROWN),
    "fisheye": ("fisheye", _FISHEYE),
    "fisheye4": ("fisheye", _FISHEYE),
}


class _Lens(NamedTuple):
    """Interior orientation: size, model of distortion, focal lengths, principal point, coefficients."""

    size: tuple[int, int]
    model: str
    focal: Array
    centre: Array
    coefficients: list[float]


class _Scene(NamedTuple):
    """Lenses; views with name, lens and pose; poses; points with the views that see them."""

    lenses: Iterator[tuple[str, _Lens]]
    views: Iterator[tuple[str, str, str, str]]
    poses: Iterator[tuple[str, Array, Array]]
    points: Iterator[tuple[str, list[float], list[tuple[str, list[float]]]]]


def is_sfm(head: bytes) -> bool:
    """Whether a file begins as one of OpenMVG or AliceVision.

    Examples
    --------
    >>> is_sfm(b'{"sfm_data_version": "0.3"'), is_sfm(b'{"schema": "reseau-network/1"')
    (True, False)
    """
    start = head.lstrip()
    return start.startswith(b"{") and (b'"sfm_data_version"' in head or b'"viewId"' in head)


def read_sfm(path: Path | str) -> Network:
    """Read a scene of OpenMVG or AliceVision with its structure.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When a part is missing, the model of the distortion is not known, or there are no observations.

    Examples
    --------
    >>> import tempfile
    >>> lens = {"intrinsicId": "1", "width": "640", "height": "480", "type": "radial1",
    ...         "pxFocalLength": "800", "principalPoint": ["320", "240"], "distortionParams": ["0.01"]}
    >>> view = {"viewId": "5", "poseId": "5", "intrinsicId": "1", "path": "a.jpg"}
    >>> turn = {"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "center": [0, 0, -5]}
    >>> point = {"landmarkId": "3", "X": [0, 0, 0], "observations": [{"observationId": "5", "x": [320, 240]}]}
    >>> scene = {"views": [view], "intrinsics": [lens], "structure": [point],
    ...          "poses": [{"poseId": "5", "pose": {"transform": turn}}]}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "sfm.json"
    ...     _ = path.write_text(json.dumps(scene))
    ...     read_sfm(path)
    <Network: 1 camera, 1 image, 1 point, 1 image point, datum free>
    """
    path = Path(path)
    try:
        content = json.loads(read_text(path))
        scene = (_openmvg if "sfm_data_version" in content else _alicevision)(content)
        return _network(scene, path)
    except KeyError as error:
        raise FormatError(f"lacks {error.args[0]!r}", where=path, do="export it with all parts") from None
    except (ValueError, TypeError, AttributeError, IndexError) as error:
        raise FormatError(f"is no complete scene of OpenMVG or AliceVision ({error})", where=path) from None


def _network(scene: _Scene, path: Path) -> Network:
    cameras = {name: _camera(name, lens, path) for name, lens in scene.lenses}
    poses = {name: (turn, centre) for name, turn, centre in scene.poses}
    order, views = list(cameras), {name: rest for name, *rest in scene.views}
    row_of = {name: k for k, name in enumerate(views)}
    turns, x0 = np.tile(np.eye(3), (len(views), 1, 1)), np.full((len(views), 3), np.nan)
    for k, (_, _, pose) in enumerate(views.values()):
        if pose in poses:
            turns[k], x0[k] = poses[pose]
    rotation = np.where(np.isfinite(x0), matrix_to_vector(turns), np.nan)
    names, xyz, seen = list[str](), list[list[float]](), list[tuple[int, int, float, float]]()
    for name, place, observations in scene.points:
        seen += [(row_of[view], len(names), x[0], x[1]) for view, x in observations]
        names.append(name)
        xyz.append(place)
    if not seen:
        raise FormatError(
            "has no observed points", where=path,
            do="export the structure with its observations",
        )  # fmt: skip
    files = tuple(str(name) for name, _, _ in views.values())
    plain = len(set(files)) == len(files)
    return network_of(
        tuple(cameras.values()),
        tuple(Path(file).name if plain else key for key, file in zip(views, files, strict=True)),
        np.array([order.index(lens) for _, lens, _ in views.values()], dtype=np.intp),
        rotation, x0, tuple(names), np.array(xyz, dtype=np.float64), seen,
        files=files, notes=(f"{path.name} has no standard deviations of image points: taken as 1 px",),
    )  # fmt: skip


def _camera(name: str, lens: _Lens, path: Path) -> Camera:
    if lens.model not in _MODELS:
        raise FormatError(
            f"has the camera model {lens.model!r}", where=path, do=f"known are {', '.join(_MODELS)}"
        )
    kind, names = _MODELS[lens.model]
    if not (lens.focal > 0).all() or min(lens.size) < 1:
        size = "×".join(map(str, lens.size))
        raise FormatError(f"has the focal length {lens.focal[0]:g} and the size {size}", where=path)
    values = {"fx": lens.focal[0], "fy": lens.focal[1], "cx": lens.centre[0], "cy": lens.centre[1]}
    values |= dict(zip(names, lens.coefficients, strict=True))
    return Camera.of(name, lens.size, kind, values, values.keys() - {"cx", "cy"})


def _size(entry: Mapping[str, Any]) -> tuple[int, int]:
    return int(entry["width"]), int(entry["height"])


def _wrapped(entry: Mapping[str, Any]) -> dict[str, Any]:
    """The data of an entry of OpenMVG; what a base class wrote is one level deeper."""
    data: dict[str, Any] = dict(entry["value"]["ptr_wrapper"]["data"])
    while "value0" in data:
        data |= data.pop("value0")
    return data


def _openmvg(content: Mapping[str, Any]) -> _Scene:
    def lens(entry: Mapping[str, Any]) -> _Lens:
        data = _wrapped(entry)
        given: Any = next((data[key] for key in data if key.startswith(("disto", "fisheye"))), [])
        focal, centre = np.full(2, float(data["focal_length"])), np.array(data["principal_point"], float)
        flat = [float(v) for v in np.atleast_1d(np.array(given, dtype=np.float64))]
        return _Lens(_size(data), str(entry["value"]["polymorphic_name"]), focal, centre, flat)

    views = (_wrapped(entry) for entry in content["views"])
    named = {entry["value"]["polymorphic_id"] % 2**31: entry["value"].get("polymorphic_name")
             for entry in reversed(content["intrinsics"])}  # fmt: skip
    for entry in content["intrinsics"]:
        # A name is written once, where its number first occurs.
        entry["value"].setdefault("polymorphic_name", named[entry["value"]["polymorphic_id"] % 2**31])
    return _Scene(
        ((str(entry["key"]), lens(entry)) for entry in content["intrinsics"]),
        ((str(v["id_view"]), v["filename"], str(v["id_intrinsic"]), str(v["id_pose"])) for v in views),
        ((str(entry["key"]), np.array(entry["value"]["rotation"], float),
          np.array(entry["value"]["center"], float)) for entry in content["extrinsics"]),
        ((str(entry["key"]), entry["value"]["X"],
          [(str(seen["key"]), seen["value"]["x"]) for seen in entry["value"]["observations"]])
         for entry in content["structure"]),
    )  # fmt: skip


def _alicevision(content: Mapping[str, Any]) -> _Scene:
    def pair(value: Any) -> Array:
        several = [value["x"], value["y"]] if isinstance(value, Mapping) else value
        return np.broadcast_to(np.array(several, dtype=np.float64), 2)

    def lens(entry: Mapping[str, Any]) -> _Lens:
        size = np.array(_size(entry), dtype=np.float64)
        if "pxFocalLength" in entry:
            focal = pair(entry["pxFocalLength"])
        else:
            across = float(entry["focalLength"]) / float(entry["sensorWidth"]) * size[0]
            focal = across * np.array([1.0, float(entry.get("pixelRatio", 1.0))])
        centre, middle = pair(entry["principalPoint"]), size / 2
        # From the corner or from the middle: the point is near the middle.
        if np.linalg.norm(centre) < np.linalg.norm(centre - middle):
            centre = centre + middle
        kind = str(entry["type"])
        if kind == "pinhole" and entry.get("distortionParams"):
            kind = str(entry.get("distortionType", "pinhole")).lower()
        return _Lens(_size(entry), kind, focal, centre, [float(v) for v in entry.get("distortionParams", [])])

    def transform(entry: Mapping[str, Any]) -> tuple[str, Array, Array]:
        found = entry["pose"]["transform"]
        turn = np.array(found["rotation"], dtype=np.float64).reshape(3, 3).T
        return str(entry["poseId"]), turn, np.array(found["center"], dtype=np.float64)

    def point(entry: Mapping[str, Any]) -> tuple[str, list[float], list[tuple[str, list[float]]]]:
        seen = [(str(one["observationId"]), [float(v) for v in one["x"]]) for one in entry["observations"]]
        return str(entry["landmarkId"]), [float(v) for v in entry["X"]], seen

    return _Scene(
        ((str(entry["intrinsicId"]), lens(entry)) for entry in content["intrinsics"]),
        ((str(v["viewId"]), v["path"], str(v["intrinsicId"]), str(v.get("poseId", v["viewId"])))
         for v in content["views"]),
        (transform(entry) for entry in content.get("poses", ())),
        (point(entry) for entry in content.get("structure", ())),
    )  # fmt: skip
