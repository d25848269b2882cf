"""Scans: windows do not depend on how a file stores its pixels; unsupported kinds are named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from reseau.core.errors import ImageError, InputError
from reseau.io.images import open_scan, write_image

RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (300, 210, 3)).astype(np.uint8)
DEEP = RNG.integers(0, 65536, (300, 210)).astype(np.uint16)


@pytest.mark.parametrize(
    ("pixels", "how"),
    [
        (RGB, {}),
        (RGB, {"byteorder": ">"}),
        (RGB, {"compression": "zlib", "rowsperstrip": 37}),
        (RGB, {"compression": "zlib", "tile": (64, 80)}),
        (RGB, {"planarconfig": "separate", "compression": "zlib", "rowsperstrip": 50}),
        (RGB, {"planarconfig": "separate"}),
        (DEEP, {}),
        (DEEP, {"byteorder": ">"}),
        (DEEP, {"compression": "lzw", "rowsperstrip": 1}),
        (DEEP, {"photometric": "miniswhite"}),
    ],
)
def test_windows_of_a_tiff_do_not_depend_on_its_storage(
    pixels: Any, how: dict[str, Any], tmp_path: Path
) -> None:
    stored = np.moveaxis(pixels, -1, 0) if how.get("planarconfig") and pixels.ndim == 3 else pixels
    how = {"photometric": "rgb" if pixels.ndim == 3 else "minisblack"} | how
    if how["photometric"] == "miniswhite":
        stored = 65535 - stored
    tifffile.imwrite(tmp_path / "a.tif", stored, resolution=(600, 600), resolutionunit=2, **how)
    scan = open_scan(tmp_path / "a.tif")
    want = pixels if pixels.ndim == 3 else pixels[:, :, None]
    assert (scan.height, scan.width, len(scan.channels)) == want.shape
    assert scan.dpi == 600
    for top, bottom, left, right in ((0, 300, 0, 210), (30, 121, 77, 170), (299, 300, 0, 1)):
        seen = scan.window(top, bottom, left, right)
        np.testing.assert_array_equal(seen, want[top:bottom, left:right])
        assert seen.dtype == pixels.dtype


def test_an_overview_averages_and_keeps_the_pixel_centres(tmp_path: Path) -> None:
    ramp = np.arange(210, dtype=np.uint16)[None] + 1000 * np.ones((300, 1), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", ramp.astype(np.uint16))
    small, r = open_scan(tmp_path / "a.tif").overview(100)
    assert r == 3
    at = (np.arange(small.shape[1]) + 0.5) * r - 0.5
    np.testing.assert_allclose(small[5, :, 0], 1000 + at, rtol=0, atol=0.51)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.bmp"])
def test_other_images_have_their_channels_in_the_order_of_their_names(name: str, tmp_path: Path) -> None:
    import cv2

    flat = np.full((40, 50, 3), (10, 100, 200), dtype=np.uint8)  # red 10
    cv2.imwrite(str(tmp_path / name), flat[:, :, ::-1])
    scan = open_scan(tmp_path / name)
    assert scan.channels == ("red", "green", "blue")
    np.testing.assert_allclose(scan.window(0, 40, 0, 50).mean(axis=(0, 1)), [10, 100, 200], atol=2)


def test_unsupported_kinds_are_named_with_a_remedy(tmp_path: Path) -> None:
    def tiff(name: str, pixels: Any, **how: Any) -> Path:
        tifffile.imwrite(tmp_path / name, pixels, **how)
        return tmp_path / name

    cmyk = tiff("cmyk.tif", np.zeros((20, 20, 4), np.uint8), photometric="separated")
    colours = np.zeros((3, 256), np.uint16)
    palette = tiff("palette.tif", np.zeros((20, 20), np.uint8), photometric="palette", colormap=colours)
    long = tiff("long.tif", np.zeros((20, 20), np.uint32))
    wave = tiff("wave.tif", np.zeros((20, 20), np.complex64))
    for path, what in ((cmyk, "CMYK"), (palette, "palette"), (long, "type uint32"), (wave, "type complex64")):
        with pytest.raises(ImageError, match=f"{path.name}: .*{what}.*; convert it"):
            open_scan(path)
    whole = tiff("whole.tif", DEEP)
    cut = tmp_path / "cut.tif"
    cut.write_bytes(whole.read_bytes()[:50_000])
    with pytest.raises(ImageError, match=r"cut\.tif: is a truncated TIFF; copy"):
        open_scan(cut)
    with pytest.raises(InputError, match="cannot be read"):
        open_scan(tmp_path / "none.tif")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(ImageError, match="is not a PNG, JPEG, TIFF or BMP"):
        open_scan(tmp_path / "text.png")


def test_an_unknown_resolution_is_none(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", DEEP)
    assert open_scan(tmp_path / "a.png").dpi is None
    tifffile.imwrite(tmp_path / "a.tif", DEEP)
    assert open_scan(tmp_path / "a.tif").dpi is None
