"""Photographs of telephones and raw files: the pixels of the sensor, and what the camera says."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageFile

from reseau.core.errors import ImageError
from reseau.io.images import read_image
from reseau.io.photographs import read_exif


def gradient() -> np.ndarray:  # type: ignore[type-arg]
    y, x = np.mgrid[:48, :64]
    return np.stack([3 * x, 4 * y, 100 + 0 * x], axis=-1).astype(np.uint8)


def exif(orientation: int, focal: float = 4.2, equivalent: int = 26) -> Image.Exif:
    found = Image.Exif()
    found[0x0112] = orientation
    inner = found.get_ifd(0x8769)
    inner[0x920A], inner[0xA405] = focal, equivalent
    return found


def test_the_focal_length_and_the_orientation_of_a_jpeg_are_read(tmp_path: Path) -> None:
    Image.fromarray(gradient()).save(tmp_path / "a.jpg", exif=exif(6), quality=95)
    found = read_exif(tmp_path / "a.jpg")
    assert (found.orientation, found.focal_mm, found.focal_35_mm) == (6, 4.2, 26.0)
    assert found.focal_px(4000, 3000) == pytest.approx(26 * 5000 / 43.267, rel=1e-4)
    # The pixels are those of the sensor, however a viewer turns them.
    assert read_image(tmp_path / "a.jpg").pixels.shape == (48, 64)


def test_a_jpeg_with_a_film_behind_it_is_complete_and_a_truncated_one_is_not(tmp_path: Path) -> None:
    _, coded = cv2.imencode(".jpg", gradient())
    whole = coded.tobytes()
    (tmp_path / "motion.jpg").write_bytes(whole + b"ftypmp42" + b"\x00" * 9000)
    assert read_image(tmp_path / "motion.jpg").width == 64
    (tmp_path / "half.jpg").write_bytes(whole[: len(whole) // 2] + b"\x00" * 9000)
    with pytest.raises(ImageError, match="truncated"):
        read_image(tmp_path / "half.jpg")


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_heic_is_read_as_the_sensor_has_it(tmp_path: Path, orientation: int) -> None:
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    Image.fromarray(gradient()).save(tmp_path / "a.heic", exif=exif(orientation), quality=95)
    found = read_image(tmp_path / "a.heic", "red")
    assert (found.width, found.height) == (64, 48)
    assert np.abs(found.pixels.astype(float) - gradient()[:, :, 0]).mean() < 4
    assert read_exif(tmp_path / "a.heic").focal_35_mm == 26
    (tmp_path / "broken.heic").write_bytes((tmp_path / "a.heic").read_bytes()[:300])
    with pytest.raises(ImageError, match="damaged HEIC"):
        read_image(tmp_path / "broken.heic")


def made(path: Path, *pictures: np.ndarray) -> None:  # type: ignore[type-arg]
    """Write an image with Pillow, without loss where the format can; several pictures as an animation."""
    first, *more = (Image.fromarray(each) for each in pictures)
    how: dict[str, object] = {"save_all": True, "append_images": more} if more else {}
    if path.suffix == ".webp":
        how["lossless"] = True
    elif path.suffix == ".avif":
        how |= {"quality": 100, "subsampling": "4:4:4", "exif": exif(6)}
    first.save(path, **how)


@pytest.mark.parametrize(
    ("suffix", "loss"), [(".webp", 0), (".gif", 0), (".avif", 3), (".jp2", 0), (".pgm", 0), (".ppm", 0)]
)
def test_formats_of_web_pages_and_archives_are_read(
    tmp_path: Path, suffix: str, loss: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As WeasyPrint does for the whole process.
    monkeypatch.setattr(ImageFile, "LOAD_TRUNCATED_IMAGES", True)
    path = tmp_path / f"a{suffix}"
    pixels = gradient()
    made(path, pixels[:, :, 0] if suffix in (".gif", ".pgm") else pixels)
    found = read_image(path, "red")
    assert (found.width, found.height, found.full_scale) == (64, 48, 255.0)  # AVIF: a viewer would turn it
    assert np.abs(found.pixels.astype(int) - pixels[:, :, 0]).max() <= loss
    if suffix not in (".pgm", ".ppm"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ImageError, match="is a damaged"):
        read_image(path)


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_the_first_picture_of_an_animation_is_read_with_a_note(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    made(path, np.full((20, 30), 10, np.uint8), np.full((20, 30), 200, np.uint8))
    found = read_image(path)
    assert abs(int(found.pixels.max()) - 10) <= 2
    assert found.notes == ("has several pictures, of which the first is used",)


def test_values_of_ten_bit_fill_the_scale_of_sixteen(tmp_path: Path) -> None:
    values = (np.arange(48 * 64).reshape(48, 64) % 1024).astype(np.uint16)
    (tmp_path / "a.pgm").write_bytes(b"P5 # a camera\n64 48\n1023\n" + values.astype(">u2").tobytes())
    found = read_image(tmp_path / "a.pgm")
    assert found.full_scale == 65535.0
    assert np.abs(found.pixels - values * (65535 / 1023)).max() <= 1


def test_an_empty_file_is_declined_as_empty(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").touch()
    with pytest.raises(ImageError, match=r"a\.jpg: is empty"):
        read_image(tmp_path / "a.jpg")


def test_an_image_that_is_too_large_is_declined_by_its_header(tmp_path: Path) -> None:
    for suffix in (".gif", ".pgm"):
        made(tmp_path / f"a{suffix}", gradient()[:, :, 0])
    gif = bytearray((tmp_path / "a.gif").read_bytes())
    gif[6:10] = b"\xff\xff\xff\xff"
    (tmp_path / "a.gif").write_bytes(gif)
    (tmp_path / "a.pgm").write_bytes(b"P5 40000 40000 255\n")
    for suffix in (".gif", ".pgm"):
        with pytest.raises(ImageError, match=r"more (pixels )?than"):
            read_image(tmp_path / f"a{suffix}")


def dng(path: Path, mosaic: np.ndarray) -> None:  # type: ignore[type-arg]
    """A raw file by the specification of DNG 1.4, of one green-dominated Bayer pattern."""
    unit = (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1)
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50708, "s", 0, "test camera", True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, (0, 1, 1, 2), True),
        (50714, "H", 1, 0, True),
        (50717, "H", 1, 65535, True),
        (50721, "2i", 9, unit, True),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
        (50778, "H", 1, 21, True),
        (274, "H", 1, 6, True),
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags)


def test_a_raw_file_is_linear_and_as_the_sensor_has_it(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    y, x = np.mgrid[:120, :160]
    light = (8000 + 200 * x + 50 * y).astype(np.uint16)
    dng(tmp_path / "a.dng", light)
    found = read_image(tmp_path / "a.dng", "green")
    assert found.full_scale == 65535
    h, w = found.pixels.shape
    assert w > h  # the viewer would turn it
    top, left = (120 - h) // 2, (160 - w) // 2
    assert (
        np.abs(
            found.pixels[8:-8, 8:-8] - light[top + 8 : top + h - 8, left + 8 : left + w - 8].astype(float)
        ).mean()
        < 300
    )
    (tmp_path / "b.cr2").write_bytes(b"no raw file")
    with pytest.raises(ImageError, match="no raw file"):
        read_image(tmp_path / "b.cr2")
