"""Raw frames of colour sensors are measured without interpolation: filters are gains of pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from reseau.archive.picture import frame_of, tiff_of
from reseau.core.data import Array, Frame
from reseau.core.errors import ImageError, InputError
from reseau.core.failure import Failure
from reseau.io import BoardDesign
from reseau.io.images import read_image, write_image
from reseau.io.photographs import mosaic_of_raw
from reseau.measure import measure_board
from reseau.measure.mosaic import balanced, gains_of

from .board_pictures import picture

FILTERS = {"RGGB": (0.5, 1.0, 1.0, 0.6), "BGGR": (0.6, 1.0, 1.0, 0.5), "GRBG": (1.0, 0.5, 0.6, 1.0)}
CHESS = BoardDesign(name="b", unit="mm", kind="chess", columns=9, rows=6, pitch=26.0)
DESIGNS = {
    "chess": CHESS,
    "circles": BoardDesign(name="b", unit="mm", kind="circles", columns=9, rows=6, pitch=24.0, size=14.0),
}


def behind(frame: Frame, gains: tuple[float, ...], seed: int = 0) -> Frame:
    """A frame behind filters, with the noise and the grey values of a camera."""
    height, width = frame.pixels.shape
    whole = np.tile(np.reshape(gains, (2, 2)), (height // 2, width // 2))
    noise = np.random.default_rng(seed).normal(0, 0.7, whole.shape)
    return replace(frame, pixels=np.clip(np.rint(frame.pixels * whole + noise), 0, 255).astype(np.uint8))


def errors(frame: Frame, design: BoardDesign, truth: Array) -> tuple[Array, Array]:
    found = measure_board(frame, design)
    assert not isinstance(found, Failure), found.reason
    assert found.ok.all()
    sigma = np.sqrt(np.stack([found.cov[:, 0, 0], found.cov[:, 1, 1]], axis=1))
    return found.xy - truth, sigma


@pytest.mark.slow
@pytest.mark.parametrize("pattern", FILTERS)
@pytest.mark.parametrize("kind", DESIGNS)
def test_boards_behind_filters_are_measured_as_precisely_as_they_say(kind: str, pattern: str) -> None:
    frame, truth = picture(DESIGNS[kind], seed=2, moved=(0.3, 0.6))
    error, sigma = errors(behind(frame, FILTERS[pattern]), DESIGNS[kind], truth)
    # Half of the pixels have half of the light: 0.005 px without filters, noise of both against one level.
    assert np.sqrt(np.mean(error**2)) < 0.012
    assert 0.7 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.4


def dng(path: Path, mosaic: NDArray[np.uint16], black: int = 512, white: int = 16383, side: int = 2) -> None:
    """A raw file by the specification of DNG 1.4, with filters in cells of so many pixels."""
    cell = np.resize((0, 1, 1, 2), side * side).tolist()
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50708, "s", 0, "test camera", True),
        (33421, "H", 2, (side, side), True),
        (33422, "B", len(cell), cell, True),
        (50714, "H", 1, black, True),
        (50717, "H", 1, white, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
        (50778, "H", 1, 21, True),
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags)


def test_a_raw_file_is_measured_behind_its_filters_as_a_frame_of_a_camera(tmp_path: Path) -> None:
    pytest.importorskip("rawpy", reason="no rawpy: pip install reseau[photographs]")
    picture_, truth = picture(CHESS, seed=2, moved=(0.3, 0.6))
    seen = behind(picture_, FILTERS["RGGB"])
    dng(tmp_path / "a.dng", seen.pixels.astype(np.uint16) * 62 + 512)
    found = read_image(tmp_path / "a.dng")
    assert found.filters == "RGGB"
    assert found.full_scale == 16383 - 512
    assert (found.pixels == seen.pixels.astype(np.uint16) * 62).all()
    assert gains_of(found) == pytest.approx(gains_of(seen), abs=1e-6)
    error, _ = errors(found, CHESS, truth)
    assert np.sqrt(np.mean(error**2)) < 0.012


@pytest.mark.slow
def test_raw_files_are_measured_more_precisely_than_interpolated_and_lose_no_corners(tmp_path: Path) -> None:
    pytest.importorskip("rawpy", reason="no rawpy: pip install reseau[photographs]")
    kept, rms = {}, {}
    for channel in ("luma", "interpolated"):
        errors_ = []
        for seed in range(3):
            picture_, truth = picture(CHESS, seed=seed, noise=0.0, moved=(0.3, 0.6))
            cell = np.tile(np.reshape(FILTERS["RGGB"], (2, 2)), (200, 240))
            noise = np.random.default_rng(seed).normal(0, 10, cell.shape)
            dng(tmp_path / "a.dng", np.rint(picture_.pixels * cell * 16 + noise + 512).astype(np.uint16))
            found = measure_board(read_image(tmp_path / "a.dng", channel), CHESS)  # type: ignore[arg-type]
            assert not isinstance(found, Failure)
            errors_.append((found.xy - truth)[found.ok])
        kept[channel], rms[channel] = sum(map(len, errors_)), np.sqrt(np.mean(np.concatenate(errors_) ** 2))
    assert kept["luma"] == 3 * 40 >= kept["interpolated"]
    assert rms["luma"] < 0.8 * rms["interpolated"]


def test_filters_that_are_known_are_found_in_noise_that_hides_them() -> None:
    """Coloured paper: black is the same behind all filters, white is not."""
    frame, truth = picture(CHESS, seed=1, noise=0.0, moved=(0.3, 0.6))
    light = (frame.pixels.astype(float) - 20) / 195
    cell = np.tile([[0.9, 0.65], [0.65, 0.35]], (200, 240))
    noise = np.random.default_rng(1).normal(0, 6, light.shape)
    seen = Frame(200 * (0.05 + (cell - 0.05) * light) + noise + 30, 255.0, filters="RGGB")
    error, _ = errors(seen, CHESS, truth)
    assert np.sqrt(np.mean(error**2)) < 0.04
    assert balanced(replace(seen, filters="")).pixels is seen.pixels


def test_files_that_are_no_mosaic_are_read_as_before(tmp_path: Path) -> None:
    pytest.importorskip("rawpy", reason="no rawpy: pip install reseau[photographs]")
    dng(tmp_path / "x.dng", np.full((96, 96), 900, np.uint16), side=6)
    dng(tmp_path / "a.dng", np.full((96, 96), 900, np.uint16))
    write_image(tmp_path / "c.png", np.zeros((20, 20, 3), np.uint8))
    write_image(tmp_path / "g.png", np.full((20, 20), 7, np.uint8))
    assert mosaic_of_raw(tmp_path / "x.dng") is None
    for name in ("c.png", "g.png"):
        for channel in ("luma", "interpolated"):
            assert not read_image(tmp_path / name, channel).filters  # type: ignore[arg-type]
    assert not read_image(tmp_path / "a.dng", "interpolated").filters
    (tmp_path / "b.cr2").write_bytes(b"no raw file")
    for name, message in (("b.cr2", "no raw file"), ("none.dng", "cannot be read")):
        with pytest.raises((ImageError, InputError), match=message):
            read_image(tmp_path / name)


def test_a_coloured_target_is_measured_in_its_luminance() -> None:
    """Red on white: there is little contrast behind red filters; no gain of the whole frame explains it."""
    design = DESIGNS["circles"]
    frame, truth = picture(design, seed=0, noise=0.0, moved=(0.3, 0.6))
    light = (frame.pixels.astype(float) - 20) / 195
    ink, filters = (
        np.tile(np.reshape(v, (2, 2)), (200, 240)) for v in ((0.7, 0.1, 0.1, 0.1), (0.5, 1, 1, 0.6))
    )
    noise = np.random.default_rng(0).normal(0, 8, light.shape)
    seen = Frame(3200 * filters * (ink + (1 - ink) * light) + noise, 16383.0, filters="RGGB")
    error, _ = errors(seen, design, truth)
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert gains_of(replace(seen, pixels=3200 * filters * light)) == pytest.approx(
        np.array([[0.5, 1], [1, 0.6]]), abs=0.01
    )
    assert isinstance(measure_board(replace(seen, filters=""), design), Failure)


def test_an_archive_keeps_that_a_frame_is_a_mosaic() -> None:
    frame = Frame(np.zeros((20, 20), np.uint8), 255.0, filters="RGGB")
    assert frame_of(tiff_of(frame, {}), "a.tif")[0].filters == "RGGB"
    assert not frame_of(tiff_of(replace(frame, filters=""), {}), "a.tif")[0].filters


def test_gains_are_those_of_the_filters_and_grey_frames_are_left_alone() -> None:
    frame, _ = picture(CHESS, seed=4)
    assert gains_of(behind(frame, FILTERS["RGGB"])) == pytest.approx(
        np.array([[0.5, 1], [1, 0.6]]), abs=0.005
    )
    for seed in range(3):
        grey, _ = picture(CHESS, seed=seed, noise=0.5 + seed)
        assert balanced(grey) is grey
    small = Frame(np.random.default_rng(0).normal(100, 3, (9, 9)), 255.0)
    assert balanced(small) is small


def test_a_picture_of_lines_two_pixels_wide_is_no_mosaic() -> None:
    lines = 100 + 60 * np.sin(np.arange(200) * 2 * np.pi / 4.4)
    frame = Frame(np.tile(lines, (120, 1)) + np.random.default_rng(1).normal(0, 1, (120, 200)), 255.0)
    assert balanced(frame) is frame
