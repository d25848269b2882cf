"""`reseau orient` on files: output, resumption, and messages for frames that cannot be oriented."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

from reseau.io import FrameCorners, FrameOrientation
from reseau.io.frame import RollSummary
from reseau_sims.filmframe import Beside, FilmFrame

Run = Callable[..., tuple[int, str, str]]


def scan(path: Path, frame: FilmFrame) -> FilmFrame:
    pixels = frame.scan()
    tifffile.imwrite(path, pixels, photometric="minisblack", resolution=(frame.dpi, frame.dpi))
    return frame


@pytest.fixture(scope="module")
def roll(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("roll")
    for seed in range(4):
        scan(folder / f"{seed}.tif", FilmFrame(seed, dpi=300))
    scan(folder / "4.tif", FilmFrame(4, dpi=300, crop="left"))
    return folder


@pytest.mark.slow
def test_a_roll_gives_documents_marked_copies_corners_and_an_overview(
    roll: Path, tmp_path: Path, reseau: Run
) -> None:
    images = sorted(roll.glob("*.tif"))
    how = ("--format-mm", "36x24", "--out", tmp_path, "--jobs", 1, "--cut")
    status, out, err = reseau("orient", *images, *how)
    assert (status, err) == (0, "")
    assert out.count(".tif: oriented") == 4
    assert "5 frames: 4 oriented, 1 with three edges" in out
    assert "4.tif: three-edges" in out
    assert "4 frames of its roll" in out
    frame = FilmFrame(0, dpi=300)
    found = FrameOrientation.read(tmp_path / "0.json")
    np.testing.assert_allclose(found.image_points().xy, frame.truth.corners, rtol=0, atol=0.3)
    assert (tmp_path / "0.csv").read_text().startswith("id,x,y,sx,sy,rho\nul,")
    height, width = tifffile.imread(tmp_path / "0-frame.tif").shape
    assert abs(width - 36 / 25.4 * 300) < 3
    assert abs(height - 24 / 25.4 * 300) < 3
    marked, plain = tifffile.imread(tmp_path / "0-marked.tif"), tifffile.imread(roll / "0.tif")
    x, y = np.rint(found.image_points().xy[0]).astype(int)
    assert marked[y, x] == 255
    assert (marked != plain).sum() < 4 * 30
    assert (tmp_path / "overview.png").stat().st_size > 10_000
    summary = RollSummary.read(tmp_path / "summary.json")
    assert [frame.by_roll for frame in summary.frames] == [False] * 4 + [True]
    assert (tmp_path / "summary.html").read_text("utf-8").count("<img") == 5
    # A second run, of the folder, finds the results of the first one, and its roll is still the same.
    (tmp_path / "corners.json").rename(tmp_path / "before.json")
    assert reseau("orient", roll, *how)[1] == out
    assert (tmp_path / "corners.json").read_text() == (tmp_path / "before.json").read_text()
    corners = FrameCorners.read(tmp_path / "corners.json")
    np.testing.assert_allclose(corners.xy(), frame.gate, rtol=0, atol=0.15)
    # The frame that lacks an edge is surer by its roll than by the format alone.
    alone = json.loads(reseau("orient", roll / "4.tif", "--format-mm", "36x24", "--json")[1])
    helped = FrameOrientation.read(tmp_path / "4.json")
    assert helped.corners is not None
    assert helped.corners["ul"].sx < 0.5 * alone["corners"]["ul"]["sx"]


@pytest.mark.slow
def test_a_second_run_continues_where_the_first_ended(roll: Path, tmp_path: Path, reseau: Run) -> None:
    images = [roll / "0.tif", roll / "1.tif"]
    arguments = ("--format-mm", "36x24", "--out", tmp_path, "--jobs", 1, "--no-marked")
    reseau("orient", images[0], *arguments)
    written = (tmp_path / "0.json").stat().st_mtime_ns
    assert reseau("orient", *images, *arguments)[0] == 0
    assert (tmp_path / "0.json").stat().st_mtime_ns == written
    assert (tmp_path / "1.json").exists()
    # Other options are another result.
    reseau("orient", images[0], "--out", tmp_path, "--jobs", 1, "--no-marked", "--format-mm", "36.1x24")
    assert (tmp_path / "0.json").stat().st_mtime_ns > written


@pytest.mark.slow
def test_a_second_run_decides_by_what_the_first_one_found_without_the_roll(
    roll: Path, tmp_path: Path, reseau: Run
) -> None:
    scan(tmp_path / "doubtful.tif", FilmFrame(320023, dpi=300, beside=Beside(lines=2)))
    arguments = (roll, tmp_path / "doubtful.tif", "--format-mm", "36x24", "--out", tmp_path, "--jobs", 1)
    first, document = reseau("orient", *arguments), (tmp_path / "doubtful.json").read_bytes()
    assert "4 oriented, 1 oriented with the help of the roll, 1 with three edges" in first[1]
    assert reseau("orient", *arguments) == first
    assert (tmp_path / "doubtful.json").read_bytes() == document


@pytest.mark.slow
def test_calibrated_corners_give_a_transformation_and_its_residuals_if_there_are_any(
    roll: Path, tmp_path: Path, reseau: Run
) -> None:
    frame = FilmFrame(0, dpi=300)
    FrameCorners.from_xy(frame.gate).write(tmp_path / "gate.json")
    for kind in ("similarity", "affine", "projective", "bilinear"):
        status, out, _ = reseau(
            "orient", roll / "0.tif", "--corners", tmp_path / "gate.json", "--transform", kind, "--json"
        )
        assert status == 0
        transform = json.loads(out)["transform"]
        assert transform["kind"] == kind
        left = np.array(list(transform["residuals_mm"].values()))
        if kind in ("projective", "bilinear"):
            assert transform["sigma_mm"] is None
            assert np.abs(left).max() < 1e-6
        else:
            assert 0 < max(transform["sigma_mm"]) < 0.05
            assert np.abs(left).max() < 0.05


@pytest.mark.slow
def test_a_scan_in_floating_point_is_oriented_as_the_same_one_in_8_bits(tmp_path: Path, reseau: Run) -> None:
    pixels = FilmFrame(0, dpi=300).scan()
    found = []
    for name, kind in (("bytes.tif", np.uint8), ("floats.tif", np.float32)):
        tifffile.imwrite(tmp_path / name, pixels.astype(kind))
        status, out, _ = reseau("orient", tmp_path / name, "--format-mm", "36x24", "--json")
        assert status == 0
        found.append(json.loads(out)["corners"])
    for corner in ("ul", "ur", "lr", "ll"):
        for axis in "xy":
            assert abs(found[0][corner][axis] - found[1][corner][axis]) < 0.02


def one_bad(name: str, path: Path) -> None:
    """Write a scan of a kind that cannot be oriented."""
    frame = FilmFrame(0, dpi=300)
    if name == "without borders":
        tifffile.imwrite(path, FilmFrame(1, dpi=300, margin_mm=-1.0).scan())
    elif name == "overlapping":
        first, second = frame.scan(), FilmFrame(1, dpi=300).scan()
        h, w = min(len(first), len(second)), first.shape[1]
        both = np.zeros((h, 2 * w - 100), np.uint8)
        both[:, :w] = first[:h]
        both[:, w - 100 :] = np.maximum(both[:, w - 100 :], second[:h, :w])
        tifffile.imwrite(path, both)
    elif name == "blank":
        tifffile.imwrite(path, np.full((300, 400), 9, np.uint8))
    elif name == "truncated":
        tifffile.imwrite(path, frame.scan())
        path.write_bytes(path.read_bytes()[:9000])
    elif name == "CMYK":
        tifffile.imwrite(path, np.zeros((30, 30, 4), np.uint8), photometric="separated")
    elif name == "palette":
        tifffile.imwrite(path, frame.scan(), photometric="palette", colormap=np.zeros((3, 256), np.uint16))
    elif name == "32 bit integer":
        tifffile.imwrite(path, frame.scan().astype(np.uint32))
    else:
        tifffile.imwrite(path, frame.scan().astype(np.complex64))


@pytest.mark.parametrize(
    ("name", "status", "wrong", "helps"),
    [
        ("without borders", 1, "no frame of the format", "scan it with a margin of film around"),
        ("overlapping", 1, "no frame of the format", "overlapping frames cannot be separated"),
        ("blank", 1, "of one tone", "scan it with more exposure"),
        ("truncated", 2, "is a truncated TIFF", "copy or scan it again"),
        ("CMYK", 2, "colour CMYK", "convert it to grey or RGB of 8 or 16 bit"),
        ("palette", 2, "a palette", "convert it to grey or RGB of 8 or 16 bit"),
        ("32 bit integer", 2, "type uint32", "convert it to grey or RGB of 8 or 16 bit"),
        ("complex", 2, "type complex64", "convert it to grey or RGB of 8 or 16 bit"),
    ],
)
def test_bad_input_is_reported_with_a_remedy(
    name: str, status: int, wrong: str, helps: str, tmp_path: Path, reseau: Run
) -> None:
    one_bad(name, tmp_path / "bad.tif")
    out_folder = tmp_path / "out"
    got, out, err = reseau("orient", tmp_path / "bad.tif", "--format-mm", "36x24", "--out", out_folder)
    reported = out + err
    assert got == status
    assert wrong in reported
    assert helps in reported
    assert reported.count("\n") == 1
    assert not list(out_folder.glob("*-marked.tif"))


@pytest.mark.slow
def test_without_a_resolution_tag_the_scale_is_that_of_the_format(tmp_path: Path, reseau: Run) -> None:
    tifffile.imwrite(tmp_path / "untagged.tif", FilmFrame(0, dpi=300).scan())
    status, out, _ = reseau("orient", tmp_path / "untagged.tif", "--format-mm", "36x24", "--json")
    assert status == 0
    # The gate differs from its format by some hundredths of a millimetre.
    assert json.loads(out)["px_per_mm"] == pytest.approx([300 / 25.4] * 2, rel=0.005)


@pytest.mark.slow
def test_the_frames_of_a_roll_are_resampled_by_one_command(roll: Path, tmp_path: Path, reseau: Run) -> None:
    reseau("orient", roll, "--format-mm", "36x24", "--out", tmp_path / "oriented", "--jobs", 1, "--no-marked")
    (tmp_path / "oriented" / "3.json").unlink()
    alone = reseau(
        "apply", tmp_path / "oriented" / "1.json", roll / "1.tif", "--scale", 5, "-o", tmp_path / "one.tif"
    )
    status, out, err = reseau(
        "apply", tmp_path / "oriented", roll, "--scale", 5, "--out", tmp_path / "frames"
    )
    assert status == alone[0] == 0
    assert err == f"left out: 3.tif: is not oriented in {tmp_path / 'oriented'}\n"
    assert [path.name for path in sorted((tmp_path / "frames").iterdir())] == [
        f"{k}.tif" for k in (0, 1, 2, 4)
    ]
    assert len(out.splitlines()) == 4
    one, same = tifffile.imread(tmp_path / "one.tif"), tifffile.imread(tmp_path / "frames" / "1.tif")
    assert (one == same).all()
    wrong = reseau("apply", tmp_path / "oriented", roll / "1.tif")
    assert (wrong[0], wrong[2].count("\n")) == (2, 1)
    assert "is a folder of orientations; give the folder of the scans" in wrong[2]


@pytest.mark.slow
def test_every_frame_of_a_strip_is_oriented(tmp_path: Path, reseau: Run) -> None:
    frames = [FilmFrame(seed, dpi=300) for seed in range(3)]
    height = min(frame.shape[0] for frame in frames)
    tifffile.imwrite(tmp_path / "strip.tif", np.hstack([frame.scan()[:height] for frame in frames]))
    status, out, _ = reseau("orient", tmp_path / "strip.tif", "--format-mm", "36x24", "--json")
    assert status == 0
    found = json.loads(out)
    assert [one["status"] for one in found] == ["oriented"] * 3
    left = np.cumsum([0, *(frame.shape[1] for frame in frames)])
    for one, frame, start in zip(found, frames, left, strict=False):
        xy = np.array([[one["corners"][k]["x"], one["corners"][k]["y"]] for k in ("ul", "ur", "lr", "ll")])
        np.testing.assert_allclose(xy - [start, 0], frame.truth.corners, rtol=0, atol=0.3)


def test_frames_that_cannot_be_oriented_are_reported_in_one_line(
    tmp_path: Path, reseau: Run, roll: Path
) -> None:
    tifffile.imwrite(tmp_path / "blank.tif", np.full((300, 400), 9, np.uint8))
    status, out, err = reseau("orient", tmp_path / "blank.tif")
    assert (status, err) == (1, "")
    assert out.startswith("blank.tif: declined: is of one tone")
    (tmp_path / "cut.tif").write_bytes((roll / "0.tif").read_bytes()[:9000])
    tifffile.imwrite(tmp_path / "cmyk.tif", np.zeros((30, 30, 4), np.uint8), photometric="separated")
    for name, words in (("cut.tif", "truncated"), ("cmyk.tif", "CMYK"), ("none.tif", "cannot be read")):
        status, _, err = reseau("orient", tmp_path / name)
        assert status == 2
        assert words in err
        assert err.count("\n") == 1
    for arguments in (("--format-mm", "36"), ("--near", "1,2,3"), ("--format-mm", "ax b")):
        status, _, err = reseau("orient", roll / "0.tif", *arguments)
        assert status == 2
        assert "write " in err
    # One bad file does not keep the others of a roll from being oriented, but the command has not succeeded.
    status, out, err = reseau("orient", roll / "0.tif", tmp_path / "cut.tif", "--jobs", 1)
    assert status == 1
    assert "2 frames: 1 oriented, 1 not read" in out
    assert "0.tif: oriented" in out
    assert "cut.tif: is a truncated TIFF" in err
