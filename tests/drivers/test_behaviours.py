"""Behaviours of instruments from public threads and manuals: each row of ``behaviours.toml`` is a test."""

from __future__ import annotations

import errno
import re
import struct
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reseau.core.errors import ReseauError
from reseau.instruments import Deadline
from reseau_drivers.camera import v4l2
from reseau_drivers.codecs import v4l2 as uapi
from reseau_drivers.codecs.numbers import number
from reseau_drivers.codecs.pixels import GENICAM, VIDEO, decode
from reseau_drivers.environment import environment_line, environment_modbus
from reseau_drivers.oscilloscope import oscilloscope
from reseau_drivers.scanner import dicom_files
from reseau_drivers.turntable import AxisPlan, Grbl, Kinesis, Table, Zaber
from reseau_sims.serving import SimulatedCamera
from reseau_sims.serving.v4l2 import VideoCamera

from .behaviours import behaviours, counted
from .fakes import GrblBoard, Lines, Screen, TCube, Transcript, Wire, ZaberStage, transcripts

ROWS = behaviours()


def rows(kind: str) -> Any:
    return pytest.mark.parametrize("row", ROWS[kind], ids=[row["says"][:60] for row in ROWS[kind]])


def expected(row: dict[str, Any]) -> Any:
    """What is refused, with the words; otherwise nothing is raised."""
    return pytest.raises(ReseauError, match=re.escape(row["refuses"])) if "refuses" in row else nullcontext()


def test_there_are_as_many_behaviours_and_sources_as_were_asked() -> None:
    number, sources = counted()
    assert number.total() >= 120
    assert len(sources) >= 60
    assert all(
        ("refuses" in row) != ("gives" in row) for kind in ROWS.keys() - {"picture"} for row in ROWS[kind]
    )


REPORTED = Path(__file__).parents[2] / "docs" / "benchmarks" / "reported.md"


def test_each_reported_situation_has_its_test() -> None:
    rows_ = [
        line.split(" | ") for line in REPORTED.read_text("utf-8").splitlines() if re.match(r"\| \d", line)
    ]
    assert [int(row[0].strip("| ")) for row in rows_] == list(range(1, 45))
    written = "".join(path.read_text("utf-8") for path in Path(__file__).parent.rglob("test_*.py"))
    sources = [row["source"] for found in ROWS.values() for row in found]
    profiles = {told["profile"] for told in transcripts()}
    for row in rows_:
        for test in row[-1].strip("| ").split("; "):
            kind, _, name = test.partition(" ")
            if kind == "behaviours":
                assert any(source.startswith(name) for source in sources), test
            elif kind == "transcripts":
                assert name in profiles, test
            else:
                assert f"def {test.strip('`')}(" in written, test


class Pieces(Wire):
    """A wire that gives a number of bytes at a time."""

    size = 1 << 20

    def read(self, deadline: Any) -> bytes:
        """Return a piece."""
        said = super().read(deadline)
        self.said = said[self.size :]
        return said[: self.size]


@rows("picture")
def test_pictures(row: dict[str, Any]) -> None:
    screen, bitmap = Screen("png", 3), Screen("bmp", 3)
    if "large png" in row["answer"]:
        screen.colours = np.random.default_rng(1).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        screen.data = bytes(cv2.imencode(".png", screen.colours)[1])
    length = str(len(screen.data)).encode()
    parts = {
        "png": screen.data,
        "large png": screen.data,
        "bmp": bitmap.data,
        "block": b"#%d%b%b" % (len(length), length, screen.data),
        "bmp block": b"#9%09d%b" % (len(bitmap.data), bitmap.data),
        "long block": b"#(%b)%b" % (length, screen.data),
        "short bmp": bitmap.data[:2] + struct.pack("<I", len(bitmap.data) - 1000) + bitmap.data[6:],
    }
    fake = Transcript({"identity": "RIGOL TECHNOLOGIES,MSO5074,M,1", "lines": []})
    said = b"".join(
        parts[part[1:-1]] if part[1:-1] in parts and part[:1] == "{" else fake._said(part)
        for part in re.split(r"(\{[^}]+\})", row["answer"])
    )
    wire = Pieces(Lines({"*IDN?": b"RIGOL TECHNOLOGIES,MSO5074,M,1\n", ":DISPlay:DATA?": said}))
    wire.size = row.get("pieces", wire.size)
    with oscilloscope("scope", wire, seconds=0.3) as scope, expected(row):
        assert screen.shows(scope.screen().data)


@rows("identity")
def test_identities(row: dict[str, Any]) -> None:
    wire = Wire(Lines({"*IDN?": row["answer"].encode()}))
    scope = oscilloscope("scope", wire, seconds=0.3)
    with expected(row):
        scope.connect()
        assert scope.dialect is not None
        assert scope.dialect.name == row["gives"]
    scope.close()


@rows("number")
def test_numbers(row: dict[str, Any]) -> None:
    with expected(row):
        assert number(row["text"], row.get("unit", "")) == pytest.approx(row["gives"], rel=1e-12)


class Board(GrblBoard):
    """A board with a form of its status reports of its own."""

    form = ""

    def _report(self, said: bytes) -> bytes:
        if not self.form:
            return super()._report(said)
        text = self.form.format(state=self.state, place=self.place, homed=int(self.homed))
        return said + f"{text}\r\n".encode()


@rows("grbl")
def test_grbl(row: dict[str, Any]) -> None:
    told = {key: row[key] for key in ("banner", "version", "settings", "locks", "tells") if key in row}
    board = Board(**told)
    board.form = row.get("reports", "")
    board.answers = {line: said.encode() for line, said in row.get("answers", {}).items()}
    plan = AxisPlan(low=-90.0, high=90.0)
    with expected(row), Table("table", Grbl(Wire(board), 0.1), {"tilt": plan}, seconds=2.0) as table:
        table.home("tilt")
        if "during" in row:
            board.ends = board.start if row["during"] == "start" else lambda: row["during"].encode()
        assert table.move("tilt", 20.0).position == row["gives"]
        assert board.place == row["gives"]


@rows("zaber")
def test_zaber(row: dict[str, Any]) -> None:
    stage = ZaberStage()
    with Table("table", Zaber(Wire(stage), 0.2), {"tilt": AxisPlan(per_unit=1000.0)}) as table:
        table.home("tilt")
        stage.then = [row["flag"]] if "flag" in row else []
        with expected(row):
            assert table.move("tilt", 10.0).position == row["gives"]


@rows("apt")
def test_apt(row: dict[str, Any]) -> None:
    cube = TCube()
    cube.bits = row["bits"]
    state = Kinesis([Wire(cube)]).state(AxisPlan(), Deadline(1.0))
    assert {"homed": state.referenced, "moving": state.moving} == row["gives"]


def _bytes(text: str) -> bytes:
    """Bytes in hexadecimal; ``00*62`` are 62 of them."""
    parts = (part.partition("*") for part in text.split())
    return b"".join(bytes.fromhex(value) * int(times or 1) for value, _, times in parts)


@rows("pixels")
def test_pixels(row: dict[str, Any]) -> None:
    layout, data = (GENICAM | VIDEO)[row["format"]], _bytes(row["bytes"])
    width = row.get("width", len(row.get("gives", ())) or 2)
    height = len(row["gives"]) // width if "gives" in row else 1 if "stride" not in row else 2
    with expected(row):
        assert decode(layout, width, height, data, row.get("stride", 0)).ravel().tolist() == row["gives"]
    assert row.get("pattern", layout.pattern) == layout.pattern


class Node:
    """A node of a simulated camera, of which some answers are others."""

    def __init__(self, node: Any, row: dict[str, Any]) -> None:
        self._node, self._row = node, row

    def ioctl(self, request: int, data: bytearray) -> None:
        """Answer a request."""
        row = self._row
        if request == uapi.ENUM_FMT and "fourcc" in row:
            if int.from_bytes(data[:4], "little"):
                raise OSError(errno.EINVAL, "no more")
            data[44:48] = uapi.fourcc_of(row["fourcc"]).to_bytes(4, "little")
            return
        self._node.ioctl(request, data)
        if request in (uapi.S_FMT, uapi.G_FMT):
            struct.pack_into("<I", data, 8 + 12, row.get("field", 1))
            if "fourcc" in row:
                struct.pack_into("<I", data, 8 + 8, uapi.fourcc_of(row["fourcc"]))
        if request == uapi.DQBUF and "sequence" in row:
            struct.pack_into("<I", data, 56, row["sequence"])
        if request == uapi.DQBUF and "stamp" in row:
            struct.pack_into("<qq", data, 24, int(row["stamp"]), 0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._node, name)


@rows("video")
def test_video(row: dict[str, Any]) -> None:
    body = VideoCamera(SimulatedCamera())
    camera = v4l2("camera", lambda: Node(body.open(), row), settings={"exposure_us": 2000.0}, seconds=1.0)
    with expected(row), camera:
        for _ in range(2):
            camera.expose(1.0)


@rows("dicom")
def test_dicom(row: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("pydicom", reason="pydicom is not installed")
    from .test_dicom import file, region

    changes = {"SoftwareVersions": row["versions"]} if "versions" in row else {}
    path = file(tmp_path / "a.dcm", *(region(**each) for each in row["regions"]), **changes)
    settings = {"region": row["region"]} if "region" in row else {}
    with dicom_files("files", str(path), settings=settings) as scanner:
        said, mm = scanner.check()["pixels"], scanner.scan().mm_per_px
        if "versions" in row:
            assert str(scanner.connect()) == f"ACME Echo 3 {', '.join(row['versions'])}"
    if "gives" in row:
        assert mm == pytest.approx(row["gives"])
    else:
        assert mm is None
        assert row["refuses"] in said


class Registers:
    """A device of Modbus over TCP with the same registers everywhere."""

    def __init__(self, words: list[int]) -> None:
        self._data = b"".join(struct.pack(">H", word) for word in words)

    def receive(self, data: bytes) -> bytes:
        """Answer a request to read."""
        transaction, _, _, unit, function, _, count = struct.unpack(">HHHBBHH", data)
        content = self._data[: 2 * count]
        return (
            struct.pack(">HHHBBB", transaction, 0, 3 + len(content), unit, function, len(content)) + content
        )


@rows("register")
def test_registers(row: dict[str, Any]) -> None:
    asked = {"register": 0, "format": row["format"], "words": row.get("order", "big"), "scale": row["scale"]}
    wire: Any = Wire(Registers(row["words"]))
    with (
        expected(row),
        environment_modbus("air", wire, quantities={"temperature": asked}, framing="tcp") as air,
    ):
        assert air.environment().conditions["temperature"].value == pytest.approx(row["gives"])


@rows("line")
def test_lines(row: dict[str, Any]) -> None:
    humid = "RH=" in row["text"]
    pattern = r"T=(?P<temperature>\S+)" + (r" RH=(?P<humidity>\S+)" if humid else "")
    quantities: dict[str, dict[str, Any]] = {"temperature": {"high": row.get("high", 85.0)}}
    quantities |= {"humidity": {}} if humid else {}
    wire: Any = Wire(Lines({"?": f"{row['text']}\n".encode()}))
    with (
        expected(row),
        environment_line("air", wire, quantities=quantities, pattern=pattern, query="?\n") as air,
    ):
        air.environment()
