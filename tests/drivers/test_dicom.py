"""DICOM files as a scanner: pixels to the bit, millimetres only where the file can mean them."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.capture import Bench, BenchFile
from reseau.core.errors import ConnectionLost, ProtocolError, SettingError, StateError
from reseau.instruments import UltrasonicScanner
from reseau_drivers.scanner import DicomFiles, dicom_files

pydicom = pytest.importorskip("pydicom", reason="pydicom is not installed")
from pydicom.dataset import Dataset, FileMetaDataset  # noqa: E402
from pydicom.encaps import encapsulate  # noqa: E402
from pydicom.sequence import Sequence  # noqa: E402
from pydicom.uid import (  # noqa: E402
    MPEG2MPML,
    ExplicitVRLittleEndian,
    JPEGBaseline8Bit,
    JPEGLSLossless,
    RLELossless,
    UltrasoundImageStorage,
    generate_uid,
)

SIZE = (48, 64)
PICTURE = np.random.default_rng(3).integers(0, 256, SIZE, dtype=np.uint8)


def region(**changes: Any) -> Any:
    """A section of 0.2 × 0.25 mm a pixel, in the words of PS3.3 C.8.5.5."""
    item = Dataset()
    reported = {
        "RegionSpatialFormat": 1,
        "RegionDataType": 1,
        "RegionFlags": 0,
        "RegionLocationMinX0": 4,
        "RegionLocationMinY0": 2,
        "RegionLocationMaxX1": 59,
        "RegionLocationMaxY1": 45,
        "PhysicalUnitsXDirection": 3,
        "PhysicalUnitsYDirection": 3,
        "PhysicalDeltaX": 0.02,
        "PhysicalDeltaY": 0.025,
        "TransducerFrequency": 7500,
    }
    for key, value in (reported | changes).items():
        if value is not None:
            setattr(item, key, value)
    return item


def file(path: Path, *regions: Any, pixels: Any = PICTURE, syntax: Any = None, **changes: Any) -> Path:
    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = syntax or ExplicitVRLittleEndian
    dataset.file_meta.MediaStorageSOPClassUID = UltrasoundImageStorage
    dataset.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    dataset.SOPClassUID, dataset.SOPInstanceUID = UltrasoundImageStorage, generate_uid()
    dataset.Modality, dataset.Manufacturer, dataset.ManufacturerModelName = "US", "ACME", "Echo 3"
    dataset.SoftwareVersions = "1.2"
    dataset.PhotometricInterpretation, dataset.SamplesPerPixel = "MONOCHROME2", 1
    dataset.Rows, dataset.Columns = SIZE
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit, dataset.PixelRepresentation = 8, 8, 7, 0
    if regions:
        dataset.SequenceOfUltrasoundRegions = Sequence(regions)
    dataset.PixelData = pixels if isinstance(pixels, bytes) else pixels.tobytes()
    for key, value in changes.items():
        setattr(dataset, key, value)
    pydicom.dcmwrite(path, dataset, enforce_file_format=True)
    return path


def test_a_frame_has_the_pixel_size_of_its_region(tmp_path: Path) -> None:
    with dicom_files("files", str(file(tmp_path / "a.dcm", region()))) as scanner:
        assert isinstance(scanner, UltrasonicScanner)
        assert str(scanner.connect()) == "ACME Echo 3 1.2"
        assert scanner.check()["pixels"] == "0.2 × 0.25 mm"
        scan = scanner.scan()
        assert (scan.frame().pixels == PICTURE).all()
        assert scan.mm_per_px == pytest.approx((0.2, 0.25))
        assert scan.region_px == (4, 2, 59, 45)
        assert scan.origin_px == (31.5, 2.0)
        assert (scan.frequency_khz, scan.speed_m_s) == (7500.0, 1540.0)
        assert math.isnan(scan.gain)
        with pytest.raises(StateError, match="stage it again"):
            scanner.scan()
        scanner.stage()
        scanner.trigger().wait(5.0)
        assert scanner.read()["files_mm_per_px"]["value"] == pytest.approx([0.2, 0.25])
        assert scanner.describe()["files_section"]["shape"] == [1, *SIZE]


def test_the_physical_origin_is_converted_to_pixels(tmp_path: Path) -> None:
    reported = {
        "ReferencePixelX0": 28,
        "ReferencePixelY0": 5,
        "ReferencePixelPhysicalValueX": 0.1,
        "ReferencePixelPhysicalValueY": 0.05,
    }
    with DicomFiles("files", file(tmp_path / "a.dcm", region(**reported))) as scanner:
        # Pixel 4 + 28 is at 0.1 cm, five pixels of 0.02 cm to the right of the origin.
        assert scanner.scan().origin_px == pytest.approx((27.0, 5.0))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"RegionLocationMaxX1": 600}, "outside the frame"),
        ({"RegionLocationMaxY1": 50}, "outside the frame"),
        ({"RegionLocationMinX0": 70, "RegionLocationMaxX1": 90}, "outside the frame"),
        ({"RegionLocationMinX0": 50, "RegionLocationMaxX1": 20}, "outside the frame"),
        ({"RegionLocationMaxX1": None}, "outside the frame"),
        ({"PhysicalUnitsXDirection": 4}, "not a section in centimetres"),
        ({"RegionSpatialFormat": 3}, "not a section in centimetres"),
        ({"PhysicalDeltaX": 0.0}, "implausible pixel size"),
        ({"PhysicalDeltaY": math.nan}, "implausible pixel size"),
        ({"PhysicalDeltaY": None}, "implausible pixel size"),
    ],
)
def test_an_implausible_region_gives_no_pixel_size(tmp_path: Path, changes: dict[str, Any], why: str) -> None:
    with DicomFiles("files", file(tmp_path / "a.dcm", region(**changes))) as scanner:
        assert why in scanner.check()["pixels"]
        scan = scanner.scan()
        assert (scan.mm_per_px, scan.region_px) == (None, None)
        assert (scan.pixels == PICTURE).all()


def test_only_regions_give_a_pixel_size(tmp_path: Path) -> None:
    with DicomFiles("files", file(tmp_path / "a.dcm", PixelSpacing=[0.3, 0.3])) as scanner:
        assert scanner.check()["pixels"] == "unknown: no regions"
        assert scanner.scan().mm_per_px is None


def test_a_region_may_end_one_pixel_after_the_frame(tmp_path: Path) -> None:
    whole = region(
        RegionLocationMinX0=0, RegionLocationMinY0=0, RegionLocationMaxX1=64, RegionLocationMaxY1=48
    )
    with DicomFiles("files", file(tmp_path / "a.dcm", whole)) as scanner:
        assert scanner.scan().region_px == (0, 0, 63, 47)


def test_regions_with_different_scales_need_a_choice(tmp_path: Path) -> None:
    left, right = region(RegionLocationMaxX1=30), region(RegionLocationMinX0=33)
    spectrum = region(RegionSpatialFormat=3, PhysicalUnitsXDirection=4, PhysicalUnitsYDirection=7)
    coarse, outside = region(PhysicalDeltaX=0.03), region(RegionLocationMaxX1=600)
    for name, regions, mm in (
        ("agree", (left, right), (0.2, 0.25)),
        ("beside a spectrum", (spectrum, left), (0.2, 0.25)),
        ("differ", (left, coarse), None),
        ("one outside", (left, outside), None),
    ):
        path = file(tmp_path / name, *regions)
        with DicomFiles("files", path) as scanner:
            assert scanner.scan().mm_per_px == (None if mm is None else pytest.approx(mm)), name
    path = file(tmp_path / "chosen", left, coarse)
    with dicom_files("files", str(path), settings={"region": 1}) as scanner:
        assert scanner.scan().mm_per_px == pytest.approx((0.3, 0.25))
        scanner.configure(region=2)
        assert "region 2 does not exist" in scanner.check()["pixels"]
        with pytest.raises(SettingError):
            scanner.configure(region=100)


def test_frames_of_a_folder_are_in_order(tmp_path: Path) -> None:
    loop = np.stack([np.roll(PICTURE, k, axis=1) for k in range(3)])
    file(tmp_path / "b.dcm", region(), pixels=loop, NumberOfFrames=3)
    file(tmp_path / "a.dcm", region())
    (tmp_path / "notes.txt").write_text("no image")
    with DicomFiles("files", tmp_path) as scanner:
        assert scanner.left == 4
        seen = [scanner.scan().pixels for _ in range(4)]
    assert all((got == np.roll(PICTURE, k, axis=1)).all() for got, k in zip(seen, (0, 0, 1, 2), strict=True))


def test_other_photometric_interpretations_are_converted(tmp_path: Path) -> None:
    colour = np.stack([PICTURE] * 3, axis=-1)
    rle = pydicom.dcmread(file(tmp_path / "raw", region()))
    rle.compress(RLELossless)
    pydicom.dcmwrite(tmp_path / "rle", rle)
    cases = {
        "rgb": file(
            tmp_path / "rgb",
            pixels=colour,
            SamplesPerPixel=3,
            PhotometricInterpretation="RGB",
            PlanarConfiguration=0,
        ),
        "inverted": file(tmp_path / "inv", pixels=255 - PICTURE, PhotometricInterpretation="MONOCHROME1"),
        "12 bits": file(
            tmp_path / "deep",
            pixels=np.rint(PICTURE * (4095 / 255)).astype("<u2"),
            BitsAllocated=16,
            BitsStored=12,
            HighBit=11,
        ),
        "rle": tmp_path / "rle",
    }
    for name, path in cases.items():
        with DicomFiles("files", path) as scanner:
            assert (scanner.scan().pixels == PICTURE).all(), name


def test_jpeg_is_decoded(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    smooth = cv2.GaussianBlur(PICTURE, (0, 0), 3)
    data = cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    path = file(tmp_path / "jpeg", region(), pixels=encapsulate([data]), syntax=JPEGBaseline8Bit)
    with DicomFiles("files", path) as scanner:
        assert np.abs(scanner.scan().pixels.astype(int) - smooth).max() <= 4


@pytest.mark.parametrize("syntax", [JPEGLSLossless, MPEG2MPML])
def test_unsupported_compressions_are_named(tmp_path: Path, syntax: Any) -> None:
    path = file(tmp_path / "a.dcm", region(), pixels=encapsulate([bytes(64)]), syntax=syntax)
    scanner = DicomFiles("files", path)
    with pytest.raises(ProtocolError, match=rf"{syntax.name.split('/')[0].strip()}.*cannot be decoded"):
        scanner.scan()


@pytest.mark.parametrize(
    ("name", "maker", "frames", "why"),
    [
        # Files of real scanners, as pydicom brings them; someone made them smaller, and left their regions.
        (
            "examples_ybr_color.dcm",
            "SonoSite, Inc. Turbo",
            30,
            "region (84, 31, 595, 414) outside the frame of 320×240 px",
        ),
        ("examples_palette.dcm", "", 1, "region (120, 60, 800, 518) outside the frame of 800×350 px"),
        ("examples_rgb_color.dcm", "G.E. Medical Systems LOGIQ 700 4121885", 1, "no regions"),
    ],
)
def test_real_files_give_pixels_and_no_wrong_pixel_size(name: str, maker: str, frames: int, why: str) -> None:
    path = Path(pydicom.__file__).parent / "data" / "test_files" / name
    if not path.exists():
        pytest.skip(f"pydicom came without {name}")
    with DicomFiles("files", path) as scanner:
        reported = scanner.check()
        assert maker in reported["identity"]
        assert (reported["frames"], reported["pixels"]) == (str(frames), f"unknown: {why}")
        scan = scanner.scan()
        assert (scan.mm_per_px, scan.region_px) == (None, None)
        header = pydicom.dcmread(path, stop_before_pixels=True)
        assert scan.pixels.shape == (header.Rows, header.Columns)
        # An echo is bright, and most of a frame is dark.
        assert np.median(scan.pixels) < 60 < scan.pixels.max()


def test_invalid_files_raise_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    whole = file(tmp_path / "whole", region()).read_bytes()
    (tmp_path / "cut").write_bytes(whole[:-100])
    (tmp_path / "head").write_bytes(whole[:200])
    (tmp_path / "text").write_text("hello")
    (tmp_path / "nothing").write_bytes(b"")
    # A frame of 65535 × 65535 that is not there: refused by its size, before anything is reserved.
    huge = whole.replace(
        b"\x28\x00\x10\x00US\x02\x00" + struct.pack("<H", 48), b"\x28\x00\x10\x00US\x02\x00\xff\xff"
    )
    (tmp_path / "huge").write_bytes(huge)
    file(tmp_path / "many", region(), NumberOfFrames=2_000_000_000)
    for name, message in {
        "cut": "cannot be decoded",
        "head": "is not a DICOM image",
        "text": "is not a DICOM image",
        "nothing": "is not a DICOM image",
        "huge": "states a frame of 64×65535",
        "many": "states 2000000000 frames",
        "empty": "contains no DICOM image",
    }.items():
        with pytest.raises(ProtocolError, match=message) as caught:
            DicomFiles("files", tmp_path / name).scan()
        assert caught.value.instrument == "files"
    with pytest.raises(ConnectionLost, match="give a DICOM file"):
        DicomFiles("files", tmp_path / "none").connect()


def test_files_are_an_instrument_on_a_bench(tmp_path: Path) -> None:
    path = file(tmp_path / "a.dcm", region())
    text = f'schema = "reseau-bench/1"\n[instruments.scans]\ndriver = "dicom"\naddress = "{path}"\n'
    with Bench(BenchFile.parse_toml(text, where="bench.toml")) as bench:
        (checked,) = bench.check()
        assert checked.error is None
        assert checked.found["pixels"] == "0.2 × 0.25 mm"
        scanner = bench["scans"]
        assert isinstance(scanner, UltrasonicScanner)
        assert scanner.scan().mm_per_px == pytest.approx((0.2, 0.25))
