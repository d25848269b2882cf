"""A sensor calibrated from files: the layouts of series, and the same result as from arrays."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from reseau.calibration import Calibration
from reseau.cli import run
from reseau.core.errors import FormatError, UsageError
from reseau.io.images import write_image
from reseau.procedures.sensor_files import exposures_in, read_exposures
from reseau.sensor import Level, SensorSeries, calibrate_sensor
from reseau_sims.pixels import PixelSensor

from ..io.test_dicom_images import file
from ..measure.test_mosaic import dng

LIGHT_US = (200.0, 1000.0, 4000.0, 8000.0, 12000.0, 16000.0, 40000.0)
DARK_US = (200.0, 40000.0)
Frames = NDArray[np.uint16]


@pytest.fixture(scope="module")
def levels() -> dict[tuple[str, float], Frames]:
    rng = np.random.default_rng(3)
    sensor = PixelSensor.drawn(rng, b2=0.0, b3=0.0)
    return {
        **{("light", t): exposed(sensor, 0.25, t, 3, rng) for t in LIGHT_US},
        **{("dark", t): exposed(sensor, 0.0, t, 4, rng) for t in DARK_US},
    }


def exposed(sensor: PixelSensor, light: float, us: float, count: int, rng: np.random.Generator) -> Frames:
    return np.array([sensor.expose(light, us, rng) for _ in range(count)]).astype(np.uint16)


@pytest.fixture(scope="module")
def expected(levels: dict[tuple[str, float], Frames]) -> dict[str, float]:
    dark, bright = (
        tuple(Level.of(t, frames) for (kind, t), frames in levels.items() if kind == wanted)
        for wanted in ("dark", "light")
    )
    found = calibrate_sensor(SensorSeries(dark, bright, 65535.0)).quantities()
    return {name: each.value for name, each in found.items()}


Write = Callable[[Path, dict[tuple[str, float], Frames]], Path]


def in_folders(root: Path, levels: dict[tuple[str, float], Frames]) -> Path:
    for (kind, us), frames in levels.items():
        folder = root / {"light": "Bright", "dark": "dark"}[kind] / f"{us / 1000:g}ms"
        folder.mkdir(parents=True)
        for k, frame in enumerate(frames):
            write_image(folder / f"{k}.png", frame)
    return root


def in_stacks(root: Path, levels: dict[tuple[str, float], Frames]) -> Path:
    for (kind, us), frames in levels.items():
        (root / kind).mkdir(exist_ok=True)
        tifffile.imwrite(root / kind / f"lamp_{us:g}us.tif", frames, photometric="minisblack")
    return root


def in_a_table(root: Path, levels: dict[tuple[str, float], Frames]) -> Path:
    rows = ["file;kind;exposure_ms"]
    for i, ((kind, us), frames) in enumerate(levels.items()):
        for k, frame in enumerate(frames):
            write_image(root / f"{i}-{k}.tif", frame)
            rows.append(f"{i}-{k}.tif;{kind};{us / 1000}")
    (root / "list.csv").write_text("\n".join(rows) + "\n")
    return root / "list.csv"


def in_a_descriptor(root: Path, levels: dict[tuple[str, float], Frames]) -> Path:
    rows = ["v 4.0", "n 12 96 64"]
    (root / "images").mkdir()
    for i, ((kind, us), frames) in enumerate(levels.items()):
        rows.append(f"b {us * 1000:.1f} {0.7 * us:.3f}" if kind == "light" else f"d {us * 1000:.1f}")
        for k, frame in enumerate(frames):
            write_image(root / "images" / f"{i}-{k}.png", frame)
            rows.append(f"i images\\{i}-{k}.png")
    (root / "EMVA1288descriptor.txt").write_text("\n".join(rows) + "\n")
    return root / "EMVA1288descriptor.txt"


def in_dicom(root: Path, levels: dict[tuple[str, float], Frames]) -> Path:
    for (kind, us), frames in levels.items():
        (root / kind).mkdir(exist_ok=True)
        for k, frame in enumerate(frames):
            file(root / kind / f"{us:g}-{k}.dcm", frame, 16, ExposureTimeInuS=us)
    return root


@pytest.mark.slow
@pytest.mark.parametrize("write", [in_folders, in_stacks, in_a_table, in_a_descriptor, in_dicom])
def test_every_layout_gives_the_result_of_the_arrays(
    write: Write,
    levels: dict[tuple[str, float], Frames],
    expected: dict[str, float],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    series, out, report = write(tmp_path, levels), tmp_path / "s.json", tmp_path / "s.html"
    assert run(["sensor", str(series), "-o", str(out), "--report", str(report)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    found = Calibration.read(out)
    assert set(found.parameters) == set(expected) >= {"gain", "full_well", "b2"}
    for name, value in expected.items():
        # The unit of the light cancels; what is left is rounding.
        assert found.parameters[name].value == pytest.approx(value, rel=1e-6, abs=1e-7), name
    assert len(found.provenance["inputs"]) == 3 * len(LIGHT_US) + 4 * len(DARK_US)
    assert "photon transfer" in report.read_text()


def test_frames_of_videos_and_of_an_edge_count(
    levels: dict[tuple[str, float], Frames], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(4)
    coarse = PixelSensor.drawn(rng, gain=60.0, read_noise=1.0, bits=8)
    for kind, us in levels:
        (tmp_path / kind).mkdir(exist_ok=True)
        frames = [coarse.expose(0.02 * (kind == "light"), us, rng) for _ in range(4)]
        video: Any = cv2.VideoWriter(
            str(tmp_path / kind / f"{us:g}us.avi"), cv2.VideoWriter.fourcc(*"FFV1"), 25.0, (96, 64), False
        )
        for frame in frames:
            video.write(frame)
        video.release()
    assert run(["sensor", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["validity"]["size"] == [96, 64]
    assert found["validity"]["full_scale"] == 255.0
    edge = tmp_path / "edge_4ms.png"
    write_image(edge, np.full((64, 96), 9, np.uint8))
    assert run(["sensor", str(tmp_path), "--edge", str(edge)]) == 1
    assert "edge" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "lists no file|no header"),
        ("file,kind,exposure_us\na.png,dim,3\n", "line 2: 'dim' is no kind"),
        ("file,kind,exposure_us\na.png,dark,soon\n", "line 2: exposure"),
        ("name,kind\na.png,dark\n", "no header with the columns"),
        ("v 4\nb 1000\ni a.png\n", "line 2 is not of a descriptor"),
        ("v 4\ni a.png\n", "line 2 is not of a descriptor"),
    ],
)
def test_lists_that_cannot_be_used_are_reported(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text(content)
    with pytest.raises(FormatError, match=message):
        read_exposures(tmp_path / "list.txt")


def test_missing_and_contradictory_exposure_times_are_reported(tmp_path: Path) -> None:
    from PIL import Image

    (tmp_path / "dark").mkdir()
    write_image(tmp_path / "dark" / "1.png", np.zeros((8, 8), np.uint8))
    with pytest.raises(UsageError, match="has no exposure time"):
        read_exposures(tmp_path)
    exif = Image.Exif()
    exif[0x8769] = {0x829A: 0.02}
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(tmp_path / "dark" / "1.png", exif=exif)
    assert exposures_in(tmp_path / "dark", "dark")[0].exposure_us == pytest.approx(20000.0)
    (tmp_path / "dark" / "1.png").rename(tmp_path / "dark" / "5ms.png")
    with pytest.raises(UsageError, match="5000 µs by its name and 20000 µs"):
        read_exposures(tmp_path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: write_image(root / "light/200us-x.png", np.zeros((9, 8), np.uint8)), "8×9"),
        (lambda root: (root / "light/1ms.tif").write_bytes(b"II*\0"), "1ms.tif"),
        (lambda root: (root / "light/1ms.avi").write_bytes(b"RIFF"), "1ms.avi"),
        (lambda root: shutil.rmtree(root / "dark"), "no dark exposures"),
    ],
)
def test_files_that_do_not_belong_together_are_reported(
    damage: Callable[[Path], object],
    message: str,
    levels: dict[tuple[str, float], Frames],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    in_stacks(tmp_path, levels)
    damage(tmp_path)
    assert run(["sensor", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err


def test_a_level_of_one_frame_is_not_used_with_a_note(
    levels: dict[tuple[str, float], Frames], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    in_stacks(tmp_path, levels)
    write_image(tmp_path / "light" / "2ms.tif", levels["light", 1000.0][0])
    assert run(["sensor", str(tmp_path)]) == 0
    assert "2ms.tif: not used: the only frame of its exposure" in capsys.readouterr().err


def test_raw_files_are_calibrated_without_interpolation(
    levels: dict[tuple[str, float], Frames],
    expected: dict[str, float],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The noise of a pixel is its own: interpolated ones have less, and their gain is wrong."""
    pytest.importorskip("rawpy", reason="no rawpy: pip install reseau[photographs]")
    for (kind, us), frames in levels.items():
        (tmp_path / kind).mkdir(exist_ok=True)
        for number, frame in enumerate(frames):
            dng(tmp_path / kind / f"{us:g}us-{number}.dng", frame.astype(np.uint16) + 500, black=500)
    assert run(["sensor", str(tmp_path), "--out", str(tmp_path / "s.json")]) == 0
    assert "behind colour filters (RGGB)" in capsys.readouterr().err
    found = Calibration.read(tmp_path / "s.json").parameters
    for name in ("gain", "read_noise"):
        assert found[name].value == pytest.approx(expected[name], rel=0.02), name
