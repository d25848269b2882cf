"""DBAT's projects: an XML script whose input names tables of images, image points, control and check points.

Each table is text, separated by commas, with the columns that its ``format`` names; lines that start with #
are comments. Pixel coordinates have their origin at the corner of the top-left pixel, ours at its centre. The
camera is the one of PhotoModeler's export: principal point in mm from the upper left corner, y down, K and P
on the image side (Börlin & Grussenmeyer 2013, Bundle adjustment with and without damping, Photogrammetric
Record 28). The operations tell which parameters are estimated.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..bundle import Camera, Network
from ..core.data import Array
from ..core.errors import FormatError
from ..io import read_text
from ..optics.poses import angles_to_matrix, matrix_to_vector
from .lines import Control, network_of
from .markup import Node, read_markup

_OPENING = re.compile(rb"<document\b[^>]*\bdbat_script_version")
_TURN = {"radian": 1.0, "degrees": np.pi / 180, "gon": np.pi / 200}
# DBAT's lens model of photogrammetry whose corrections belong to coordinates after the affinity.
_MODEL = 3.0
_INTERIOR = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2")


def is_dbat(content: bytes) -> bool:
    """Whether this is the beginning of a project of DBAT.

    Examples
    --------
    >>> is_dbat(b'<?xml version="1.0"?><document dbat_script_version="1.0">')
    True
    """
    return bool(_OPENING.search(content))


def read_dbat(path: Path | str) -> Network:
    """Read a network from an XML project of DBAT and the files that it names.

    Control points have their standard deviations, or are held without; check points are estimated and
    compared. Poses are approximate values from ``prior_eo``, and are computed without it. A camera without
    ``cc`` starts at its nominal focal length.

    Parameters
    ----------
    path : path
        The script.

    Raises
    ------
    InputError
        When it, or a file that it names, cannot be read.
    FormatError
        When an element or a column is missing or invalid; or for what is not read: skew, lens models other
        than 3, more than three radial coefficients, path variables other than ``$HERE``.

    Examples
    --------
    >>> import tempfile
    >>> camera = "<sensor>6.4,4.8</sensor><image>640,480</image><focal>8</focal>"
    >>> tables = "<images><file format='id,path'>i.txt</file></images>"
    >>> tables += "<image_pts><file format='im,id,x,y' sxy='0.5'>p.txt</file></image_pts>"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "project.xml"
    ...     _ = file.write_text("<document dbat_script_version='1.0'><input base_dir='$HERE'>" + tables +
    ...                         f"<cameras><camera>{camera}</camera></cameras></input></document>")
    ...     _ = (Path(folder) / "i.txt").write_text("1, a.jpg")
    ...     _ = (Path(folder) / "p.txt").write_text("# marks\\n1, 7, 10.5, 20.5")
    ...     network = read_dbat(file)
    >>> network.images, network.points, network.xy, network.cameras[0].parameters["c"]
    (('a.jpg',), ('7',), array([[10., 20.]]), 8.0)
    """
    path = Path(path)
    root = read_markup(path)
    if root.tag != "document" or not root.get("dbat_script_version"):
        raise FormatError("is not a project of DBAT", where=path)
    given = root.need("input")
    base = _folder(given, path)
    free = _free(root)
    cameras = _cameras(given.need("cameras"), base, free)
    images = _table(given.need("images/file"), base)
    if not len(images):
        raise FormatError("contains no images", where=path)
    ids = images.column("id")
    which = images.column("cam") if "cam" in images.names else [next(iter(cameras))] * len(ids)
    for name in which:
        if name not in cameras:
            raise FormatError(f"has an image of the camera {name}, which is not defined", where=images.where)
    files = images.column("path") if "path" in images.names else ids
    labels = images.column("label") if "label" in images.names else [_last(file) for file in files]
    if len(set(labels)) < len(labels):
        labels = ids
    marks = [_marks(node, base) for node in given.all("image_pts/file")]
    if not any(marks):
        raise FormatError("contains no image points", where=path)
    known = {name: i for i, name in enumerate(ids)}
    if len(known) < len(ids):
        raise FormatError("has an image twice", where=images.where)
    seen, order = dict[tuple[str, str], list[float]](), dict[str, int]()
    for image, point, *values in (row for table in marks for row in table):
        if image not in known:
            raise FormatError(f"has a mark in image {image}, which is not in the list", where=path)
        row = order.setdefault(point, len(order))
        seen.setdefault((image, point), [known[image], row, values[0] - 0.5, values[1] - 0.5, *values[2:]])
    control, check = (_control(given.find(f"{kind}_pts"), base) for kind in ("ctrl", "check"))
    twice = control.keys() & check.keys()
    if twice:
        raise FormatError(f"has the point {min(twice)} as control and as check point", where=path)
    x0, turns = _poses(given.find("prior_eo/file"), base, known)
    chosen = list(dict.fromkeys(which))
    network = network_of(
        tuple(cameras[name] for name in chosen),
        tuple(labels),
        np.array([chosen.index(name) for name in which], dtype=np.intp),
        turns,
        x0,
        tuple(order),
        np.full((len(order), 3), np.nan),
        list(seen.values()),
        # Check points are compared with their coordinates, which are no observations.
        control={name: Control(xyz, sigma, "control") for name, (xyz, sigma) in control.items()}
        | {name: Control(xyz, np.full(3, np.nan), "check") for name, (xyz, _) in check.items()},
        files=tuple(files),
        unit=_unit(root),
    )
    return replace(network, datum="control") if network.role.count("control") >= 3 else network


def _last(file: str) -> str:
    return re.split(r"[/\\]", file)[-1]


def _unit(root: Node) -> str:
    found = root.find("meta/project_unit")
    return "" if found is None else found.text


def _folder(node: Node, path: Path) -> Path:
    """Folder of relative names; ``$HERE`` is that of the script."""
    text = node.get("base_dir").replace("\\", "/")
    first, _, rest = text.partition("/")
    if first == "$HERE":
        return path.parent / rest
    if first.startswith("$"):
        raise FormatError(
            f"has the base_dir {first}, which is not known here", where=node.where, do="use $HERE"
        )
    return path.parent / text


class _Table:
    """Rows of words, with the names of their columns."""

    def __init__(self, names: list[str], rows: list[list[str]], where: str) -> None:
        self.names, self.rows, self.where = names, rows, where

    def __len__(self) -> int:
        return len(self.rows)

    def column(self, name: str) -> list[str]:
        """Words of a column."""
        if name not in self.names:
            raise FormatError(f"has no column `{name}` in its format", where=self.where)
        k = self.names.index(name)
        return [row[k] for row in self.rows]

    def numbers(self, *names: str) -> Array:
        """Finite numbers of columns (k, n)."""
        columns = []
        for name in names:
            words = self.column(name)
            try:
                values = np.array(words, dtype=np.float64)
            except ValueError:
                values = np.full(len(words), np.nan)
            if not np.isfinite(values).all():
                raise FormatError(f"has a `{name}` that is not a number", where=self.where)
            columns.append(values)
        return np.stack(columns, axis=-1) if columns else np.zeros((len(self), 0))

    def sigmas(self, axes: str) -> Array | None:
        """Standard deviations of axes (k, n), from the most to the least special column; None without."""
        columns = []
        for axis in axes:
            names = [f"s{axis}", *(["sxy"] if axis in "xy" else []), "sxyz"]
            found = next((name for name in names if name in self.names), None)
            if found is None:
                return None
            columns.append(self.numbers(found)[:, 0])
        values = np.stack(columns, axis=-1)
        if (values < 0).any():
            raise FormatError("has a negative standard deviation", where=self.where)
        return values


def _table(node: Node, base: Path) -> _Table:
    """A table in the file that an element names."""
    if not node.text:
        raise FormatError("names no file", where=node.where)
    file = base / node.text.replace("\\", "/")
    names = [word.strip() for word in node.attribute("format").split(",")]
    rows = []
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            words = [word.strip() for word in line.split(",")]
            if len(words) != len(names):
                raise FormatError(
                    f"line {number}: has {len(words)} fields, not {len(names)} ({','.join(names)})",
                    where=file,
                )
            rows.append(words)
    return _Table(names, rows, str(file))


def _marks(node: Node, base: Path) -> list[tuple[str, str, float, float, float, float]]:
    """Image, point, x, y and sigmas; an attribute of the element replaces the columns."""
    table = _table(node, base)
    xy, sigma = table.numbers("x", "y"), table.sigmas("xy")
    every = node.number("sxy", -1.0)
    for k, axis in enumerate(("sx", "sy")):
        given = node.number(axis, every)
        if given >= 0:
            sigma = np.full(xy.shape, np.nan) if sigma is None else sigma
            sigma[:, k] = given
    if sigma is None or not (sigma > 0).all():
        raise FormatError(
            "has image points without a positive standard deviation",
            where=table.where,
            do="add `sxy` to the format or to the element",
        )
    return [
        (image, point, float(at[0]), float(at[1]), float(accuracy[0]), float(accuracy[1]))
        for image, point, at, accuracy in zip(table.column("im"), table.column("id"), xy, sigma, strict=True)
    ]


def _control(node: Node | None, base: Path) -> dict[str, tuple[Array, Array]]:
    """Coordinates and sigmas by name, after the filters; held without sigmas."""
    if node is None:
        return {}
    table = _table(node.need("file"), base)
    names, xyz, sigma = table.column("id"), table.numbers("x", "y", "z"), table.sigmas("xyz")
    sigma = np.zeros(xyz.shape) if sigma is None else sigma
    if len(set(names)) < len(names):
        raise FormatError("has a point twice", where=table.where)
    found = {name: (xyz[j], sigma[j]) for j, name in enumerate(names)}
    for rule in node.all("filter"):
        chosen = {word.strip() for word in rule.attribute("id").split(",")}
        if rule.text not in ("keep", "remove"):
            raise FormatError(f"has the filter `{rule.text}`, not keep or remove", where=rule.where)
        found = {name: found[name] for name in found if (name in chosen) == (rule.text == "keep")}
    return found


def _poses(node: Node | None, base: Path, known: dict[str, int]) -> tuple[Array, Array]:
    """Projection centres and rotation vectors, NaN where none are given."""
    x0, turns = np.full((len(known), 3), np.nan), np.full((len(known), 3), np.nan)
    if node is None:
        return x0, turns
    table = _table(node, base)
    if not {"omega", "phi", "kappa"} <= set(table.names):
        return x0, turns
    unit = node.get("units")
    if unit not in _TURN:
        raise FormatError(f"has angles in `{unit}`, not in {', '.join(_TURN)}", where=node.where)
    centres, angles = table.numbers("x", "y", "z"), table.numbers("omega", "phi", "kappa") * _TURN[unit]
    vectors = matrix_to_vector(angles_to_matrix(*angles.T))
    for name, centre, vector in zip(table.column("id"), centres, vectors, strict=True):
        if name in known:
            x0[known[name]], turns[known[name]] = centre, vector
    return x0, turns


def _free(root: Node) -> tuple[str, ...]:
    """Parameters of the interior orientation that the operations estimate."""
    chosen = set[str]()
    groups = {"all": (*_INTERIOR, "B1", "B2"), "cc": ("c",), "pp": ("x0", "y0"), "px": ("x0",), "py": ("y0",),
              "K": ("K1", "K2", "K3"), "P": ("P1", "P2"), "aspect": ("B1",), "skew": ("B2",)}  # fmt: skip
    for rules in root.all("operations/operation/set_bundle_estimate_params/io"):
        entries = [("all", rules)] if rules.text else [(child.tag, child) for child in rules.all("*")]
        for name, entry in entries:
            if entry.text not in ("true", "false"):
                raise FormatError(f"`{entry.text}` is not true or false", where=entry.where)
            names = set(groups.get(name, (name,)))
            if not names <= {*_INTERIOR, "B1", "B2"}:
                raise FormatError(f"estimates `{name}`, which no camera here has", where=entry.where)
            chosen = chosen | names if entry.text == "true" else chosen - names
    return tuple(name for name in (*_INTERIOR, "B1", "B2") if name in chosen)


def _cameras(node: Node, base: Path, free: tuple[str, ...]) -> dict[str, Camera]:
    """Cameras by id, of the element or of the file that it names."""
    file = node.find("file")
    if file is not None:
        node = read_markup(base / file.text.replace("\\", "/")).need("cameras")
    found = dict[str, Camera]()
    for k, entry in enumerate(node.all("camera"), start=1):
        key = entry.find("id")
        name = str(k) if key is None else key.text
        if name in found:
            raise FormatError(f"has the camera {name} twice", where=entry.where)
        found[name] = camera_of(entry, name, free)
    if not found:
        raise FormatError("defines no camera", where=node.where)
    return found


def _values(node: Node, path: str) -> Array:
    found = node.find(path)
    return np.zeros(0) if found is None or not found.text else found.numbers()


def camera_of(node: Node, name: str, free: tuple[str, ...]) -> Camera:
    """A camera of its element, with the parameters that are free.

    Raises
    ------
    FormatError
        When it is incomplete, or of a lens model that is not read.
    """
    unit = node.find("unit")
    if unit is not None and unit.text not in ("mm", ""):
        raise FormatError(f"has the unit `{unit.text}`, not mm", where=node.where)
    width, height = (int(v) for v in node.need("image").numbers(2))
    aspect_text = node.find("aspect")
    aspect = 1.0 if aspect_text is None or aspect_text.text == "auto" else aspect_text.numbers(1)[0]
    first, _, second = node.need("sensor").text.partition(",")
    try:
        tall = float(second)
        wide = tall / height * width / aspect if first.strip() == "auto" else float(first)
    except (ValueError, ZeroDivisionError):
        raise FormatError("is not two lengths, or `auto` and one", where=f"{node.where}, sensor") from None
    if not (wide > 0 and tall > 0):
        raise FormatError("is not positive", where=f"{node.where}, sensor")
    focal, constant = node.value("focal", 0.0), node.find("cc")
    c = focal if constant is None or constant.text == "focal" else constant.numbers(1)[0]
    if not c > 0:
        c = focal
    if not c > 0:
        raise FormatError("has neither a camera constant nor a focal length", where=node.where)
    centre = node.find("pp")
    middle = centre is None or centre.text == "default"
    pp = np.array([wide * aspect, tall]) / 2 if centre is None or middle else centre.numbers(2)
    radial, tangential = _values(node, "K"), _values(node, "P")
    if len(radial) > 3 or len(tangential) > 2:
        raise FormatError("has more than three K or two P", where=node.where)
    if node.value("skew", 0.0) or "B2" in free:
        raise FormatError("has skew, or estimates it, which is not read", where=node.where)
    if node.value("model", _MODEL) != _MODEL:
        raise FormatError(
            f"has the lens model {node.value('model'):g}, only 3 is read",
            where=node.where,
        )
    values = np.zeros(10)
    pitch = wide / width, tall / height
    # The affinity acts about the principal point, which is given in square pixels.
    values[:3] = c, pp[0] * pitch[0] / pitch[1] - wide / 2, tall / 2 - pp[1]
    values[3 : 3 + len(radial)], values[6 : 6 + len(tangential)] = radial, tangential
    return Camera(name, width, height, pitch, "brown", values, free, {"side": "image"})
