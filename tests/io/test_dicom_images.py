"""DICOM files as photographs: grey values to the bit, one frame of several, errors of one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import ImageError, InputError
from reseau.core.provenance import sha256_of
from reseau.io.images import open_scan, read_image

pydicom = pytest.importorskip("pydicom", reason="pydicom is not installed")
from pydicom.data import get_testdata_file  # noqa: E402
from pydicom.dataset import Dataset, FileMetaDataset  # noqa: E402
from pydicom.uid import (  # noqa: E402
    ExplicitVRLittleEndian,
    JPEGLSLossless,
    RLELossless,
    SecondaryCaptureImageStorage,
    generate_uid,
)

RNG = np.random.default_rng(3)


def file(path: Path, values: Any, bits: int = 8, kind: str = "MONOCHROME2", **more: Any) -> Path:
    """A secondary capture of (rows, columns), (frames, rows, columns) or (rows, columns, 3) values."""
    colour = values.shape[-1] == 3
    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = more.pop("syntax", ExplicitVRLittleEndian)
    dataset.file_meta.MediaStorageSOPClassUID = SecondaryCaptureImageStorage
    dataset.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    dataset.SOPClassUID, dataset.SOPInstanceUID = SecondaryCaptureImageStorage, generate_uid()
    dataset.PhotometricInterpretation, dataset.SamplesPerPixel = kind, 3 if colour else 1
    if colour:
        dataset.PlanarConfiguration = 0
    elif values.ndim == 3:
        dataset.NumberOfFrames = len(values)
    dataset.Rows, dataset.Columns = values.shape[:2] if colour else values.shape[-2:]
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = 8 * values.itemsize, bits, bits - 1
    dataset.PixelRepresentation = int(values.dtype.kind == "i")
    dataset.PixelData = values.tobytes()
    for key, value in more.items():
        setattr(dataset, key, value)
    pydicom.dcmwrite(path, dataset, enforce_file_format=True)
    return path


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16), (12, np.int16)])
def test_stored_values_are_read_to_the_bit_with_their_full_scale(
    tmp_path: Path, bits: int, dtype: Any
) -> None:
    signed = np.dtype(dtype).kind == "i"
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1)) if signed else (0, 2**bits)
    values = RNG.integers(low, high, (40, 60)).astype(dtype)
    frame = read_image(file(tmp_path / "a.dcm", values, bits))
    assert (frame.pixels == values).all()
    assert frame.pixels.dtype == dtype
    assert frame.full_scale == high - 1
    assert (frame.name, frame.notes) == ("a.dcm", ())
    assert frame.sha256 == sha256_of(tmp_path / "a.dcm")


def test_in_monochrome1_the_largest_value_is_black(tmp_path: Path) -> None:
    values = RNG.integers(0, 4096, (40, 60)).astype(np.uint16)
    frame = read_image(file(tmp_path / "a.dcm", values, 12, "MONOCHROME1"))
    assert (frame.pixels == 4095 - values).all()


def test_the_modality_transformation_is_applied(tmp_path: Path) -> None:
    values = RNG.integers(0, 4096, (40, 60)).astype(np.uint16)
    path = file(tmp_path / "a.dcm", values, 12, RescaleSlope="0.5", RescaleIntercept="-1024")
    frame = read_image(path)
    assert frame.pixels == pytest.approx(0.5 * values - 1024.0, abs=1e-3)
    assert frame.full_scale == 0.5 * 4095 - 1024


def test_colour_is_read_as_that_of_other_images(tmp_path: Path) -> None:
    values = RNG.integers(0, 256, (40, 60, 3)).astype(np.uint8)
    path = file(tmp_path / "a.dcm", values, kind="RGB")
    luma = np.rint(values @ np.array([0.299, 0.587, 0.114]))
    assert np.abs(read_image(path).pixels - luma).max() <= 1
    assert (read_image(path, "green").pixels == values[:, :, 1]).all()
    assert open_scan(path).channels == ("red", "green", "blue")


def test_ybr_is_converted_to_rgb(tmp_path: Path) -> None:
    # PS3.3, C.7.6.3.1.2: Y 128, CB 128, CR 128 is a grey of 128; CR 255 is red.
    values = np.full((40, 60, 3), 128, dtype=np.uint8)
    values[:, 30:, 2] = 255
    path = file(tmp_path / "a.dcm", values, kind="YBR_FULL")
    assert (read_image(path, "red").pixels[0, [0, 59]] == [128, 255]).all()
    assert read_image(path, "green").pixels[0, 59] == pytest.approx(128 - 0.7141 * 127, abs=1)


def test_a_frame_of_several_is_named_by_its_number(tmp_path: Path) -> None:
    values = RNG.integers(0, 256, (3, 40, 60)).astype(np.uint8)
    path = file(tmp_path / "loop.dcm", values)
    first = read_image(path)
    assert (first.pixels == values[0]).all()
    assert first.name == "loop.dcm#1"
    assert first.notes == ("loop.dcm has 3 frames; the first is used, loop.dcm#2 names the second",)
    third = read_image(f"{path}#3")
    assert (third.pixels == values[2]).all()
    assert (third.name, third.notes, third.sha256) == ("loop.dcm#3", (), sha256_of(path))
    for wrong in ("0", "4"):
        with pytest.raises(ImageError, match=rf"has 3 frames; there is no frame {wrong}"):
            read_image(f"{path}#{wrong}")
    with pytest.raises(InputError, match="No such file"):
        read_image(tmp_path / "none.dcm#1")


def test_a_number_is_for_dicom_files_and_tiffs_only(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(ImageError, match="is no TIFF or DICOM file"):
        read_image(tmp_path / "a.png#2")


def test_run_lengths_are_decoded_and_other_compressions_named(tmp_path: Path) -> None:
    values = RNG.integers(0, 256, (40, 60)).astype(np.uint8)
    path = file(tmp_path / "a.dcm", values)
    dataset = pydicom.dcmread(path)
    dataset.compress(RLELossless)
    dataset.save_as(tmp_path / "rle.dcm")
    assert (read_image(tmp_path / "rle.dcm").pixels == values).all()
    decoder = pydicom.pixels.get_decoder(JPEGLSLossless)
    if decoder.is_available:
        pytest.skip("JPEG-LS can be decoded here")
    named = get_testdata_file("MR_small_jpeg_ls_lossless.dcm")
    with pytest.raises(ImageError, match=r"compressed as JPEG-LS .* cannot be decoded; decompress it"):
        read_image(named)


@pytest.mark.parametrize("name", ["examples_rgb_color.dcm", "examples_palette.dcm", "examples_jpeg2k.dcm"])
def test_examples_of_pydicom_are_read(name: str) -> None:
    frame = read_image(get_testdata_file(name))
    assert frame.pixels.max() > frame.pixels.min()


def test_files_without_a_usable_image_are_refused_in_one_line(tmp_path: Path) -> None:
    values = RNG.integers(0, 256, (40, 60)).astype(np.uint8)
    whole = file(tmp_path / "a.dcm", values).read_bytes()
    (tmp_path / "cut.dcm").write_bytes(whole[:-1000])
    (tmp_path / "head.dcm").write_bytes(whole[:200])
    for name in ("cut.dcm", "head.dcm"):
        with pytest.raises(ImageError) as caught:
            read_image(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name))
        assert "\n" not in str(caught.value)
    with pytest.raises(ImageError, match="without an image"):
        read_image(get_testdata_file("rtplan.dcm"))
