"""Image files: values are kept, headers are checked first, damage is reported."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from reseau.core.errors import ImageError, InputError
from reseau.core.provenance import sha256_of
from reseau.io.images import MAX_PIXELS, open_scan, read_image, write_image

GREY8 = np.random.default_rng(1).integers(0, 256, (40, 60)).astype(np.uint8)
GREY16 = np.random.default_rng(2).integers(0, 65536, (40, 60)).astype(np.uint16)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("pixels", [GREY8, GREY16], ids=["8-bit", "16-bit"])
def test_grey_values_are_written_and_read_unchanged(tmp_path: Path, suffix: str, pixels: np.ndarray) -> None:
    path = tmp_path / f"a{suffix}"
    write_image(path, pixels)
    frame = read_image(path)
    np.testing.assert_array_equal(frame.pixels, pixels)
    assert frame.pixels.dtype == pixels.dtype
    assert frame.full_scale == np.iinfo(pixels.dtype).max
    assert (frame.name, frame.sha256) == (path.name, sha256_of(path))


def test_a_jpeg_is_read_as_its_grey_values(tmp_path: Path) -> None:
    smooth = np.tile(np.arange(60, dtype=np.uint8) * 4, (40, 1))
    write_image(tmp_path / "a.jpg", smooth)
    assert np.abs(read_image(tmp_path / "a.jpg").pixels.astype(int) - smooth).max() <= 3


def test_colour_becomes_its_luma(tmp_path: Path) -> None:
    rgb = np.zeros((4, 6, 3), dtype=np.uint8)
    rgb[..., 0], rgb[..., 1], rgb[..., 2] = 200, 100, 50
    luma = round(0.299 * 200 + 0.587 * 100 + 0.114 * 50)
    write_image(tmp_path / "a.png", rgb)
    tifffile.imwrite(tmp_path / "a.tif", rgb, photometric="rgb")
    for name in ("a.png", "a.tif"):
        assert (read_image(tmp_path / name).pixels == luma).all()


def test_tiff_of_other_kinds(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "white.tif", GREY8, photometric="miniswhite")
    np.testing.assert_array_equal(read_image(tmp_path / "white.tif").pixels, 255 - GREY8)
    tifffile.imwrite(tmp_path / "signed.tif", np.full((4, 4), -5, dtype=np.int16))
    assert read_image(tmp_path / "signed.tif").pixels[0, 0] == -5
    tifffile.imwrite(tmp_path / "long.tif", np.zeros((4, 4), dtype=np.uint32))
    with pytest.raises(ImageError, match="uint32"):
        read_image(tmp_path / "long.tif")


def test_a_huge_image_is_refused_by_its_header(tmp_path: Path) -> None:
    # 100 000 × 100 000 pixels promised by 57 bytes.
    side = (100_000).to_bytes(4, "big")
    path = tmp_path / "bomb.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4, "big") + b"IHDR" + side + side + bytes(29))
    with pytest.raises(ImageError, match=f"100000×100000 pixels, more than {MAX_PIXELS:,}"):
        read_image(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
@pytest.mark.parametrize("part", [0.2, 0.7])
def test_truncated_images_are_refused(tmp_path: Path, suffix: str, part: float) -> None:
    write_image(tmp_path / f"a{suffix}", GREY8)
    whole = (tmp_path / f"a{suffix}").read_bytes()
    (tmp_path / f"b{suffix}").write_bytes(whole[: int(len(whole) * part)])
    with pytest.raises(ImageError, match=rf"b\{suffix}: is a (truncated|damaged)"):
        read_image(tmp_path / f"b{suffix}")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "is empty"),
        *((content, "is not a PNG, JPEG, TIFF or BMP") for content in (b"hello", b"%PDF-1.4", bytes(1000))),
    ],
)
def test_a_file_that_is_not_an_image_is_refused_by_name(tmp_path: Path, content: bytes, why: str) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(ImageError, match=rf"a\.png: {why}"):
        read_image(path)


def test_a_missing_file_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_image(tmp_path / "none.png")
    with pytest.raises(InputError, match="cannot be read"):
        read_image(tmp_path)


def test_only_images_are_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no suffix of an image"):
        write_image(tmp_path / "a.txt", GREY8)
    rgb = np.dstack([GREY8, GREY8, 0 * GREY8])
    write_image(tmp_path / "c.png", rgb)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "c.png"))[..., ::-1], rgb)


@pytest.mark.parametrize("compression", ["jpeg", "lzw"])
def test_windows_of_compressed_strips_are_those_of_the_whole_image(tmp_path: Path, compression: str) -> None:
    pixels = np.add.outer(np.arange(96), np.arange(160)).astype(np.uint8)
    rows = 16 if compression == "jpeg" else 1
    tifffile.imwrite(tmp_path / "a.tif", pixels, compression=compression, rowsperstrip=rows)
    scan = open_scan(tmp_path / "a.tif")
    assert np.abs(scan.window(10, 60, 20, 90)[:, :, 0].astype(int) - pixels[10:60, 20:90]).max() <= 3


def test_further_pages_of_a_tiff_are_reported(tmp_path: Path) -> None:
    two_pages(tmp_path / "a.tif")
    assert open_scan(tmp_path / "a.tif").notes == (
        "has 2 pages, of which the first is used; a.tif#2 is the second",
    )


@pytest.mark.parametrize(
    ("compression", "kind", "colour"),
    [("lzw", np.uint8, "miniswhite"), ("lzw", np.uint16, "rgb"), ("zlib", np.uint16, "miniswhite"),
     ("zlib", np.float32, "minisblack"), ("jpeg", np.uint8, "rgb")],
)  # fmt: skip
def test_opencv_decodes_where_imagecodecs_is_not_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compression: str, kind: type, colour: str
) -> None:
    shape = (40, 50, 3) if colour == "rgb" else (40, 50)
    pixels = np.random.default_rng(0).integers(0, 255, shape).astype(kind)
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for page in (pixels, pixels[::-1]):
            file.write(page, photometric=colour, compression=compression, predictor=compression != "jpeg")
    usual = [open_scan(tmp_path / name).window(0, 40, 0, 50) for name in ("a.tif", "a.tif#2")]
    monkeypatch.setattr("reseau.io.images._has_imagecodecs", lambda: False)
    for name, expected in zip(("a.tif", "a.tif#2"), usual, strict=True):
        np.testing.assert_array_equal(open_scan(tmp_path / name).window(0, 40, 0, 50), expected)


@pytest.mark.parametrize("compression", [None, "lzw"])
def test_a_page_of_a_tiff_is_chosen_by_its_number(tmp_path: Path, compression: str | None) -> None:
    two_pages(tmp_path / "a.tif", compression)
    assert [int(read_image(tmp_path / name).pixels[0, 0]) for name in ("a.tif", "a.tif#1", "a.tif#2")] == [
        0,
        0,
        100,
    ]
    second = open_scan(tmp_path / "a.tif#2")
    assert second.name == "a.tif#2"
    assert not second.notes


def test_a_page_that_a_file_does_not_have_is_reported(tmp_path: Path) -> None:
    two_pages(tmp_path / "a.tif")
    with pytest.raises(ImageError, match="has 2 pages; there is no page 3"):
        open_scan(tmp_path / "a.tif#3")


def two_pages(path: Path, compression: str | None = None) -> None:
    """Write a TIFF of a black and a grey page."""
    with tifffile.TiffWriter(path) as file:
        for tone in (0, 100):
            page = np.full((16, 16), tone, np.uint8)
            file.write(page, photometric="minisblack", compression=compression)
