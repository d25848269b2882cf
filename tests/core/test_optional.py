"""Without the packages that only some features need, the rest works, and each is named in one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from reseau.core.optional import missing

HIDING = """
import gc, sys
gc.disable()

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {hidden!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hidden())
from reseau.cli import run
sys.exit(run({arguments!r}))
"""
OPTIONAL = (
    "bluesky", "fsspec", "imagecodecs", "jinja2", "matplotlib", "psutil", "psycopg", "pydicom", "pyvisa",
    "pyvisa_py", "serial", "sqlalchemy", "usb", "zeroconf",
)  # fmt: skip


def without(hidden: tuple[str, ...], *arguments: object) -> subprocess.CompletedProcess[str]:
    code = HIDING.format(hidden=hidden, arguments=[str(a) for a in arguments])
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240)


@pytest.mark.slow
def test_files_are_measured_without_any_optional_package(tmp_path: Path) -> None:
    design, image = tmp_path / "field.json", tmp_path / "flat.png"
    done = without(OPTIONAL, "design", "testfield", "--out", design)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(design.read_text())["schema"] == "testfield-design/1"
    cv2.imwrite(str(image), np.random.default_rng(0).integers(0, 255, (200, 300)).astype(np.uint8))
    done = without(OPTIONAL, "measure", "testfield", image, "--design", design, "--out", tmp_path / "a.json")
    # The measurement runs, and finds nothing in an image of noise.
    assert done.returncode == 1, done.stderr
    assert "pip install" not in done.stderr


def test_a_missing_package_is_one_line(tmp_path: Path) -> None:
    done = without(("sqlalchemy",), "archive", "list", "--archive", tmp_path)
    assert done.returncode == 2
    assert done.stderr == "reseau: needs sqlalchemy, which is not installed; pip install 'reseau[bench]'\n"
    done = without(("matplotlib",), "design", "testfield", "--pdf", tmp_path / "field.pdf")
    assert done.returncode == 2
    assert done.stderr == "reseau: needs matplotlib, which is not installed; pip install matplotlib\n"
    assert not list(tmp_path.glob("*.pdf"))


@pytest.mark.slow
def test_a_tiff_in_an_unusual_compression_names_the_package_that_decodes_it(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((40, 50), np.uint8), compression="zstd")
    tifffile.imwrite(tmp_path / "b.tif", np.zeros((40, 50), np.uint8), compression="lzw")
    design = tmp_path / "field.json"
    assert without((), "design", "testfield", "--out", design).returncode == 0
    lines = {
        name: without(("imagecodecs",), "measure", "testfield", tmp_path / name, "--design", design).stderr
        for name in ("a.tif", "b.tif")
    }
    assert "a.tif: is a TIFF in a compression that needs imagecodecs" in lines["a.tif"]
    assert "imagecodecs" not in lines["b.tif"]


@pytest.mark.slow
def test_a_dicom_photograph_names_the_package_that_reads_it(tmp_path: Path) -> None:
    (tmp_path / "a.dcm").write_bytes(bytes(128) + b"DICM" + bytes(40))
    design = tmp_path / "field.json"
    assert without((), "design", "testfield", "--out", design).returncode == 0
    done = without(("pydicom",), "measure", "testfield", tmp_path / "a.dcm", "--design", design)
    assert done.returncode == 2
    assert done.stderr == "reseau: needs pydicom, which is not installed; pip install 'reseau[dicom]'\n"


def test_errors_of_other_modules_are_not_about_optional_packages() -> None:
    assert missing(ModuleNotFoundError("No module named 'reseau.nothing'", name="reseau.nothing")) is None
    assert missing(ImportError("cannot import name 'x'", name="matplotlib")) is None


EXTRAS = tuple(name for name in OPTIONAL if name not in ("jinja2", "matplotlib"))
ON_FILES = """
calibrate none.csv --design none.json
orient none.png --format-mm 36x24
bundle none.json
refine --photo-i none.png --reseau none.json
blurred none.json --images . --targets none.json --lens none.zmx --out none
sensor none
measure fiducials none.tif --design wild-rc10
apply none.json none.png
export none.json --to opencv --out none.yml
compare none.json none.json
uncertainty none.json
"""


@pytest.mark.slow
def test_commands_on_files_need_no_optional_package() -> None:
    code = HIDING.replace(
        "sys.exit(run({arguments!r}))", "[print(words, run(words.split())) for words in {arguments!r}]"
    ).format(hidden=EXTRAS, arguments=ON_FILES.strip().splitlines())
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240)
    assert done.stdout.count(" 2\n") == len(ON_FILES.strip().splitlines()), done.stdout + done.stderr
    assert "none" in done.stderr
    assert "pip install" not in done.stderr
