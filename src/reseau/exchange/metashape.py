"""Agisoft Metashape and PhotoScan: exported cameras and markers (XML), and projects in one file (``.psz``).

A camera looks along +z, x right, y down; its ``transform`` maps from the camera to the chunk, and the
transformation of the chunk (or of the component) from there to the reference system: X = s·R·x + T. Pixel
coordinates have their origin at the corner of the top-left pixel, ours at its centre.

With x = X/Z, y = Y/Z, r² = x² + y² (Agisoft Metashape User Manual, Appendix D, *Camera models*)::

    x' = x(1 + K1r² + K2r⁴ + K3r⁶ + K4r⁸) + P1(r²+2x²) + 2·P2·xy,   u = w/2 + cx + x'f + x'B1 + y'B2
    y' = y(1 + K1r² + K2r⁴ + K3r⁶ + K4r⁸) + P2(r²+2y²) + 2·P1·xy,   v = h/2 + cy + y'f

P1 and P2 are those of OpenCV exchanged. A fisheye has x = θX/R, y = θY/R with R² = X² + Y² and the angle θ to
the axis. Files of PhotoScan before 1.2 have ``fx`` and ``fy``, a principal point from the corner of the image
(before version 1.4.0 of the format), and P1 and P2 in the order of OpenCV.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..bundle import Camera, Network
from ..core.data import Array
from ..core.errors import FormatError
from ..optics.poses import matrix_to_vector
from .lines import Control, network_of, read_bytes
from .markup import Node, read_markup

_RADIAL = ("k1", "k2", "k3", "k4")
_DISTORTION = (*_RADIAL, "p1", "p2")
_MOST_MB = 1000
# Metashape's own, where the file has none: image points of markers and of tie points (px), markers (m).
_ACCURACY = {"accuracy_projections": 0.5, "accuracy_tiepoints": 1.0, "accuracy_markers": 0.005}
_OPENING = re.compile(rb"<document\b[^>]*>\s*<chunks?\b")


def is_metashape(content: bytes) -> bool:
    """Whether this is the beginning of such an XML file, or of a ``.psz``.

    Examples
    --------
    >>> is_metashape(b'<?xml version="1.0"?><document version="1.2.0"><chunk label="a">')
    True
    """
    return bool(_OPENING.search(content[:4000])) or content[:4] == b"PK\x03\x04"


def read_metashape(path: Path | str) -> Network:
    r"""Read a network from Metashape's XML file of cameras or markers, or from a ``.psz`` project.

    The first chunk is read. Markers with a reference in local coordinates are control points with their
    accuracies; those that are not enabled are check points. Tie points are only in a ``.psz``. Sensors that
    are not fixed have f, cx, cy and all distortion parameters that are not zero as unknowns.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is incomplete, has no image points, or has what no camera of this project describes: skew
        (b2), p3 and p4, k4 together with b1, tangential distortion of a fisheye, other projections, rolling
        shutter, film, cameras fixed to each other; or markers in geographic or projected coordinates.

    Examples
    --------
    >>> import tempfile
    >>> head = '<document version="2.0.0"><chunk><sensors><sensor id="0" type="frame">'
    >>> size = '<resolution width="640" height="480"/>'
    >>> sensor = f'{size}<calibration>{size}<f>800</f><cx>1</cx></calibration></sensor></sensors>'
    >>> pose = "1 0 0 5 0 1 0 0 0 0 1 0 0 0 0 1"
    >>> cameras = f'<cameras><camera id="0" label="a" sensor_id="0"><transform>{pose}</transform></camera>'
    >>> markers = '</cameras><markers><marker id="0" label="A"/></markers><frames><frame><markers>'
    >>> marker = '<marker marker_id="0"><location camera_id="0" x="10.5" y="20.5"/></marker>'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "cameras.xml"
    ...     tail = "</markers></frame></frames></chunk></document>"
    ...     _ = file.write_text(head + sensor + cameras + markers + marker + tail)
    ...     network = read_metashape(file)
    >>> network.x0, network.xy, network.cameras[0].parameters["cx"]
    (array([[5., 0., 0.]]), array([[10., 20.]]), 320.5)
    """
    path = Path(path)
    content = read_bytes(path, _MOST_MB)
    part: Callable[[str], bytes] | None = None
    if content[:4] == b"PK\x03\x04":
        try:
            archive = zipfile.ZipFile(io.BytesIO(content))
        except zipfile.BadZipFile:
            raise FormatError("is not a whole .psz project", where=path, do="save it again") from None

        def part(name: str) -> bytes:
            try:
                return archive.read(name)
            except (KeyError, zipfile.BadZipFile, RuntimeError, NotImplementedError):
                raise FormatError(f"has no readable part {name}", where=path, do="save it again") from None

        content = part("doc.xml")
    root = read_markup(path, content)
    chunk = root.find("chunk") or root.find("chunks/chunk")
    if root.tag != "document" or chunk is None or chunk.find("cameras") is None:
        raise FormatError(
            "contains no chunk with cameras", where=path, do="export cameras or markers of one chunk as XML"
        )
    before = _version(root.get("version")) < (1, 4, 0)
    return _Chunk(chunk, before, part, path).network()


def _version(text: str) -> tuple[int, ...]:
    words = re.findall(r"\d+", text)
    return tuple(int(word) for word in words) if words else (9,)


def _on(node: Node) -> bool:
    return node.get("enabled", "true").lower() in ("true", "1")


def _properties(node: Node) -> dict[str, str]:
    return {p.get("name"): p.get("value") for p in node.all("property")}


@dataclass
class _Image:
    """An image that is used."""

    key: str
    label: str
    sensor: str
    component: str
    transform: Array | None
    file: str


_Seen = list[tuple[str, str, float, float, float]]
"""Image points: key of the image, name of the point, x, y and their standard deviation."""


@dataclass
class _Chunk:
    """A chunk and the other parts of its project."""

    node: Node
    corner: bool
    part: Callable[[str], bytes] | None
    path: Path

    def network(self) -> Network:
        node, cameras, images = self.node, self.sensors(), self.images()
        accuracy = _ACCURACY | {
            name: float(value)
            for name, value in _properties(node.find("settings") or node).items()
            if name in _ACCURACY and value
        }
        control = self.control(accuracy["accuracy_markers"])
        placed = node.find("transform/rotation") is not None or node.find("components") is not None
        similarity = {image.component: self.similarity(image.component) for image in images.values()}
        seen, tie = self.markers(images, accuracy["accuracy_projections"]), dict[str, Array]()
        if self.part is not None:
            tie = self.ties(images, seen, accuracy["accuracy_tiepoints"])
        if not seen:
            raise FormatError(
                "contains no image points of markers in aligned images",
                where=self.path,
                do="export markers as XML (File > Export > Export Markers), or save the project as .psz",
            )
        shown = {key for key, *_ in seen}
        used = [key for key in images if key in shown]
        missing = [key for key in used if images[key].sensor not in cameras]
        if missing:
            raise FormatError(f"camera {images[missing[0]].label} has no sensor", where=self.path)
        names = _unique([images[key].label for key in used])
        points = list(dict.fromkeys(name for _, name, *_ in seen))
        sensors = list(dict.fromkeys(images[key].sensor for key in used))
        row = {key: i for i, key in enumerate(used)}
        order = {name: j for j, name in enumerate(points)}
        x0, turns = np.full((len(used), 3), np.nan), np.full((len(used), 3), np.nan)
        known = any(name in control for name in points)
        for i, key in enumerate(used):
            matrix = images[key].transform
            # Control points without a transformation to their system: the poses are in another one.
            if matrix is None or (known and not placed):
                continue
            s, r, t = similarity[images[key].component]
            x0[i] = s * r @ matrix[:3, 3] + t
            turns[i] = matrix_to_vector((r @ matrix[:3, :3]).T)
        xyz = np.full((len(points), 3), np.nan)
        s, r, t = self.similarity(next(iter(similarity)))
        for j, name in enumerate(points):
            if name in tie and not (known and not placed):
                xyz[j] = s * r @ tie[name] + t
        plain = [name.partition(":")[2] for name in points]
        labels = _unique([self.labels.get(name, plain[j]) for j, name in enumerate(points)])
        network = network_of(
            tuple(replace(cameras[key], id=name)
                  for key, name in zip(sensors, _unique([cameras[k].id for k in sensors]), strict=True)),
            tuple(names),
            np.array([sensors.index(images[key].sensor) for key in used], dtype=np.intp),
            turns,
            x0,
            tuple(labels),
            xyz,
            [(row[key], order[name], x - 0.5, y - 0.5, sigma, sigma) for key, name, x, y, sigma in seen],
            control={labels[j]: control[name] for j, name in enumerate(points) if name in control},
            files=tuple(images[key].file for key in used),
            unit="m",
        )  # fmt: skip
        return replace(network, datum="control") if network.role.count("control") >= 3 else network

    def sensors(self) -> dict[str, Camera]:
        """Cameras by the id of the sensor."""
        return {node.attribute("id"): _camera(node, self.corner) for node in self.node.all("sensors/sensor")}

    def images(self) -> dict[str, _Image]:
        """Enabled images by the id of the camera, also those in groups."""
        files = {
            node.get("camera_id"): photo.get("path")
            for node in self.node.all("frames/frame/cameras/camera")
            if (photo := node.find("photo")) is not None
        }
        found = dict[str, _Image]()
        for path in ("cameras/camera", "cameras/group/camera"):
            for node in self.node.all(path):
                key = node.attribute("id")
                if node.get("master_id"):
                    raise FormatError(
                        "belongs to a multi-camera system, which is not read",
                        where=node.where,
                        do="export the images as single cameras",
                    )
                if not _on(node):
                    continue
                pose = node.find("transform")
                matrix = None if pose is None else pose.numbers(16).reshape(4, 4)
                label = node.get("label") or key
                file = files.get(key) or label
                found[key] = _Image(key, label, node.get("sensor_id"), node.get("component_id"), matrix, file)
        return found

    def similarity(self, component: str) -> tuple[float, Array, Array]:
        """Scale, rotation and translation from the chunk, or a component of it, to the reference system."""
        for node in self.node.all("components/component"):
            if node.get("id") == component and (found := node.find("transform")) is not None:
                return _similarity(found)
        found = self.node.find("transform")
        return (1.0, np.eye(3), np.zeros(3)) if found is None else _similarity(found)

    @property
    def labels(self) -> dict[str, str]:
        """Names of markers."""
        return {
            f"marker:{node.attribute('id')}": node.get("label") or node.attribute("id")
            for node in self.node.all("markers/marker")
        }

    def control(self, usual: float) -> dict[str, Control]:
        """Coordinates, sigmas and role of markers with a reference; `usual` is their standard deviation."""
        system = self.node.find("reference")
        if system is not None and system.text and not system.text.startswith("LOCAL_CS"):
            kind = "geographic" if system.text[:6] == "GEOGCS" else "projected"
            if any(node.find("reference[@x]") is not None for node in self.node.all("markers/marker")):
                raise FormatError(
                    f"has markers in a {kind} system, whose coordinates are not Cartesian",
                    where=system.where,
                    do="convert the reference to local coordinates in Metashape, then export again",
                )
        found = dict[str, Control]()
        for node in self.node.all("markers/marker"):
            given = node.find("reference")
            if given is None or not all(given.get(axis) for axis in "xyz"):
                continue
            every = given.number("sxyz", usual)
            plane = given.number("sxy", every)
            sigma = [given.number("sx", plane), given.number("sy", plane), given.number("sz", every)]
            if min(sigma) <= 0:
                raise FormatError("has an accuracy that is not positive", where=given.where)
            found[f"marker:{node.attribute('id')}"] = Control(
                np.array([given.number(axis) for axis in "xyz"]),
                # A check point is compared with its coordinates, which are no observations.
                np.array(sigma) if _on(given) else np.full(3, np.nan),
                "control" if _on(given) else "check",
            )
        return found

    def markers(self, images: dict[str, _Image], sigma: float) -> _Seen:
        """Image points of markers; those of images that are not enabled are left out."""
        seen, twice = _Seen(), set[tuple[str, str]]()
        first = self.node.find("frames/frame")
        known = self.labels
        for node in [] if first is None else first.all("markers/marker"):
            name = f"marker:{node.attribute('marker_id')}"
            if name not in known:
                raise FormatError("is not in the list of markers", where=node.where)
            for at in node.all("location"):
                key = at.attribute("camera_id")
                if key not in images or at.get("valid", "true") == "false" or (key, name) in twice:
                    continue
                twice.add((key, name))
                seen.append((key, name, at.number("x"), at.number("y"), sigma))
        return seen

    def ties(self, images: dict[str, _Image], seen: _Seen, sigma: float) -> dict[str, Array]:
        """Add image points of tie points, and return coordinates in the chunk by name."""
        cloud = self.node.find("frames/frame/point_cloud")
        points = None if cloud is None else cloud.find("points")
        if cloud is None or points is None or self.part is None:
            return {}
        table = _ply(self.part(points.attribute("path")), f"{self.path}, {points.attribute('path')}")
        xyz = {f"tie:{k}": np.array(row, dtype=np.float64)
               for k, row in zip(table["id"].tolist(), _columns(table, "xyz"), strict=True)}  # fmt: skip
        for node in cloud.all("projections"):
            key = node.attribute("camera_id")
            if key not in images:
                continue
            file = node.attribute("path")
            table = _ply(self.part(file), f"{self.path}, {file}")
            _, first = np.unique(table["id"], return_index=True)
            table = table[np.sort(first)]
            for k, (x, y) in zip(table["id"].tolist(), _columns(table, "xy").tolist(), strict=True):
                if f"tie:{k}" in xyz:
                    seen.append((key, f"tie:{k}", x, y, sigma))
        return xyz


def _similarity(node: Node) -> tuple[float, Array, Array]:
    """Of an element ``transform``: rotation, translation and scale, each optional, or a matrix (4, 4)."""
    if node.find("rotation") is None and node.find("translation") is None and node.text:
        matrix = node.numbers(16).reshape(4, 4)
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        if not scale > 0:
            raise FormatError("is not a similarity transformation", where=node.where)
        return scale, matrix[:3, :3] / scale, matrix[:3, 3]
    turn, shift = node.find("rotation"), node.find("translation")
    return (
        node.value("scale", 1.0),
        np.eye(3) if turn is None else turn.numbers(9).reshape(3, 3),
        np.zeros(3) if shift is None else shift.numbers(3),
    )


def _unique(names: list[str]) -> list[str]:
    """Names; those that appear earlier get a number."""
    taken, result = set[str](), []
    for name in names:
        chosen, k = name, 1
        while chosen in taken:
            k += 1
            chosen = f"{name} ({k})"
        taken.add(chosen)
        result.append(chosen)
    return result


def _camera(sensor: Node, corner: bool) -> Camera:
    """Camera of a sensor; with `corner`, of an old file with the principal point from the corner."""
    kinds = {node.get("class"): node for node in sensor.all("calibration")}
    given = kinds.get("adjusted") or next(iter(kinds.values()), None)
    properties, name = _properties(sensor), sensor.get("label") or sensor.attribute("id")
    size = sensor.need("resolution")
    width, height = size.pixels("width"), size.pixels("height")
    where, values = sensor.where, dict[str, float]()
    kind = sensor.get("type", "frame")
    if given is not None:
        kind, where = given.get("type", kind), given.where
        for key in ("f", "fx", "fy", "cx", "cy", "b1", "b2", "skew", *_DISTORTION, "p3", "p4"):
            values[key] = given.value(key, 0.0)
    elif "focal_length" in properties and float(properties.get("pixel_width") or 0) > 0:
        values["f"] = float(properties["focal_length"]) / float(properties["pixel_width"])
    values = {key: values.get(key, 0.0) for key in ("f", "fx", "fy", "cx", "cy", "b1", "b2", "skew",
                                                    *_DISTORTION, "p3", "p4")}  # fmt: skip
    old = values["fx"] > 0
    fx, fy = (values["fx"], values["fy"]) if old else (values["f"] + values["b1"], values["f"])
    if not (fx > 0 and fy > 0):
        raise FormatError("has no focal length in pixels", where=where, do="calibrate the sensor first")
    cx, cy = values["cx"], values["cy"]
    if not (old and corner):
        cx, cy = cx + width / 2, cy + height / 2
    p1, p2 = (values["p1"], values["p2"]) if old else (values["p2"], values["p1"])
    _refuse(kind, values, properties, abs(fx - fy) > 1e-9 * fy, where)
    free = properties.get("fixed", "false").lower() not in ("true", "1")
    used = [key for key in _DISTORTION if values[key] != 0]
    if kind == "fisheye" or not values["k4"]:
        named = {"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5, "p1": p1, "p2": p2}
        # k4 of a fisheye is the fourth coefficient, of OpenCV's plain model the first of the denominator.
        named |= {key: values[key] for key in (_RADIAL if kind == "fisheye" else _RADIAL[:3])}
        chosen = ("fx", "fy", "cx", "cy", *used) if free else ()
        return Camera.of(name, (width, height), "fisheye" if kind == "fisheye" else "opencv", named, chosen)
    # With a pitch of one, Brown's camera has pixels for millimetres; its y points up.
    named = {"c": fy, "x0": cx - width / 2, "y0": height / 2 - cy, "P1": p2 / fy, "P2": -p1 / fy}
    named |= {f"K{i}": values[f"k{i}"] / fy ** (2 * i) for i in range(1, 5)}
    chosen = ("c", "x0", "y0", *(key.upper() for key in used)) if free else ()
    return Camera.of(name, (width, height), "brown_higher", named, chosen, options={"side": "object"})


def _refuse(
    kind: str, values: dict[str, float], properties: dict[str, str], affine: bool, where: str
) -> None:
    """Refuse what no registered camera describes."""
    what = ""
    if kind not in ("frame", "fisheye"):
        what = f"the projection `{kind}`"
    elif values["b2"] or values["skew"]:
        what = "skew (b2)"
    elif values["p3"] or values["p4"]:
        what = "the tangential coefficients p3 and p4"
    elif kind == "fisheye" and (values["p1"] or values["p2"]):
        what = "tangential distortion of a fisheye"
    elif kind == "frame" and values["k4"] and affine:
        what = "k4 together with affinity (b1)"
    elif properties.get("rolling_shutter", "false").lower() in ("true", "1", "regularized", "full"):
        what = "a rolling shutter"
    elif properties.get("film_camera", "false").lower() in ("true", "1"):
        what = "scanned film with fiducial marks"
    if what:
        raise FormatError(
            f"has {what}, which no camera here describes",
            where=where,
            do="optimise the cameras in Metashape without it, then export again",
        )


_PLY = {"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4",
        "float": "<f4", "double": "<f8"}  # fmt: skip


def _ply(content: bytes, where: str) -> NDArray[np.void]:
    """Vertices of a binary PLY file (little-endian)."""
    head, mark, body = content.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    counts = [int(words[2]) for words in lines if words[:2] == ["element", "vertex"] and words[2].isdigit()]
    binary = ["format", "binary_little_endian", "1.0"] in lines
    columns = [words for words in lines if words[:1] == ["property"]]
    if not mark or not binary or len(counts) != 1 or any(words[1] not in _PLY for words in columns):
        raise FormatError("is not a table in binary PLY", where=where)
    kind = np.dtype([(words[2], _PLY[words[1]]) for words in columns])
    if len(body) < counts[0] * kind.itemsize or not {"x", "y", "id"} <= set(kind.names or ()):
        raise FormatError("ends too early, or has no columns x, y and id", where=where)
    return np.frombuffer(body, kind, counts[0])


def _columns(table: NDArray[np.void], names: str) -> Array:
    return np.stack([table[name].astype(np.float64) for name in names], axis=1)
