"""Tone curves that files state: profiles of another program, and tags."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from reseau.core.tone import ToneCurve
from reseau.io.images import read_image
from reseau.io.profiles import curve_of_profile

GREY = np.arange(256, dtype=np.uint8).reshape(16, 16)
SRGB = ToneCurve(None)


def profile(coded: bytes) -> bytes:
    """A grey profile with the given curve."""
    entry = b"kTRC" + struct.pack(">II", 144, len(coded))
    return bytes(36) + b"acsp" + bytes(88) + struct.pack(">I", 1) + entry + coded


def parametric(kind: int, *values: float) -> bytes:
    return (
        b"para"
        + bytes(4)
        + struct.pack(">HH", kind, 0)
        + struct.pack(f">{len(values)}i", *(round(65536 * value) for value in values))
    )


def assert_same(curve: ToneCurve | None, other: ToneCurve) -> None:
    assert curve is not None
    grey = np.linspace(0, 1, 200)
    np.testing.assert_allclose(curve.light(grey, 1.0), other.light(grey, 1.0), rtol=0, atol=1e-3)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif"])
def test_srgb_as_littlecms_writes_it_is_read_from_every_format(tmp_path, suffix):
    image = pytest.importorskip("PIL.Image")
    cms = pytest.importorskip("PIL.ImageCms")
    given = cms.ImageCmsProfile(cms.createProfile("sRGB")).tobytes()
    path = tmp_path / f"photo.{suffix}"
    image.fromarray(np.stack([GREY] * 3, axis=2)).save(path, icc_profile=given)
    frame = read_image(path)
    assert_same(frame.curve, SRGB)
    assert "profile 'sRGB" in frame.curve.source
    if suffix != "jpg":
        np.testing.assert_array_equal(frame.pixels, GREY)


def test_a_file_without_profile_states_no_curve(tmp_path):
    cv2 = pytest.importorskip("cv2")
    for suffix in ("png", "jpg", "tif"):
        path = tmp_path / f"photo.{suffix}"
        cv2.imwrite(str(path), GREY)
        assert read_image(path).curve is None


def test_exif_data_of_a_camera_state_srgb(tmp_path):
    image = pytest.importorskip("PIL.Image")
    exif = image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 1
    image.fromarray(GREY).save(tmp_path / "photo.jpg", exif=exif)
    curve = read_image(tmp_path / "photo.jpg").curve
    assert_same(curve, SRGB)
    assert curve.source == "Exif tag of sRGB"


@pytest.mark.parametrize(
    ("chunks", "expected"),
    [
        ({b"sRGB": b"\0"}, SRGB),
        ({b"gAMA": (45455).to_bytes(4, "big")}, ToneCurve(2.2)),
        ({b"gAMA": (45455).to_bytes(4, "big"), b"sRGB": b"\0"}, SRGB),
        ({b"cICP": bytes([1, 13, 0, 1]), b"gAMA": (100000).to_bytes(4, "big")}, SRGB),
        ({b"gAMA": (100000).to_bytes(4, "big")}, None),
        ({b"iCCP": b"name\0\0damaged"}, None),
    ],
)
def test_tags_of_png_are_read_in_the_order_of_the_standard(tmp_path, chunks, expected):
    cv2 = pytest.importorskip("cv2")
    plain = cv2.imencode(".png", GREY)[1].tobytes()
    added = b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks.items()
    )
    (tmp_path / "photo.png").write_bytes(plain[:33] + added + plain[33:])
    curve = read_image(tmp_path / "photo.png").curve
    if expected is None:
        assert curve is None
    else:
        assert_same(curve, expected)


def test_curves_of_icc_profiles_are_those_of_the_specification():
    assert_same(curve_of_profile(profile(parametric(0, 2.2))), ToneCurve(2.2))
    assert_same(
        curve_of_profile(profile(parametric(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))), SRGB
    )
    power = b"curv" + bytes(4) + struct.pack(">IH", 1, round(1.8 * 256))
    assert_same(curve_of_profile(profile(power)), ToneCurve(1.8, source="colour profile"))
    table = np.rint(65535 * np.linspace(0, 1, 1024) ** 2).astype(">u2").tobytes()
    assert_same(curve_of_profile(profile(b"curv" + bytes(4) + struct.pack(">I", 1024) + table)), ToneCurve(2))


@pytest.mark.parametrize(
    "coded", [b"curv" + bytes(8), b"mft2" + bytes(40), b"para", b"", b"curv" + b"\xff" * 8]
)
def test_straight_unknown_and_damaged_curves_are_none(coded):
    assert curve_of_profile(profile(coded)) is None
    assert curve_of_profile(profile(coded)[:140]) is None


def test_a_parametric_curve_that_begins_above_zero_has_its_values_from_the_first():
    grey = np.linspace(0, 1, 11)
    found = curve_of_profile(profile(parametric(1, 2.0, 0.9, 0.1)))
    np.testing.assert_allclose(found.light(grey, 1.0), (0.9 * grey + 0.1) ** 2, rtol=0, atol=1e-3)
