"""The path of a user: print a target, photograph it, calibrate, undistort, use the result in OpenCV.

The photographs are rendered from the printed PDF by code that shares nothing with the project (`printed.py`).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from .printed import Lens, photograph, poses, print_out, printer

Run = Callable[..., tuple[int, str, str]]

LENS = Lens(
    width=480,
    height=360,
    fx=445.3,
    fy=444.6,
    cx=242.8,
    cy=177.1,
    k1=-0.21,
    k2=0.06,
    p1=9e-4,
    p2=-6e-4,
    fine=3,
)
Pixels = Any
TRUTH = {name: getattr(LENS, name) for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")}
PAPER = (210.0, 297.0)

pytestmark = pytest.mark.skipif(printer() is None, reason="pdftoppm (poppler-utils) is not installed")


@pytest.fixture(scope="module")
def rays() -> Pixels:
    return np.asarray(LENS.rays())


BOARDS = {
    "charuco": (7, 10),
    "chess": (7, 10),
    "circles": (7, 10),
    "asymmetric": (4, 11),
    "aprilgrid": (5, 7),
}
"""Columns and rows."""


def evening(
    reseau: Run, folder: Path, rays: Pixels, seed: int, count: int, kind: str = "charuco"
) -> tuple[dict[str, dict[str, float]], float]:
    """Print, photograph and calibrate; the parameters found, and sigma0."""
    columns, rows = BOARDS.get(kind, (7, 9))
    turned = kind == "asymmetric"
    option = ("circles", "--asymmetric") if turned else (kind,)
    target = ("board", "--kind", *option) if kind in BOARDS else ("sheet",)
    files = ("--pdf", folder / "target.pdf", "--out", folder / "target.json")
    assert reseau("design", *target, "--columns", columns, "--rows", rows, *files)[0] == 0
    sheet, rng = print_out(folder / "target.pdf"), np.random.default_rng(seed)
    photos = folder / "photos"
    photos.mkdir()
    for k, pose in enumerate(poses(count, PAPER, rng)):
        cv2.imwrite(str(photos / f"{k:02d}.png"), photograph(sheet, LENS, rays, pose, rng))
    options = ("--out", folder / "camera.json", "--jobs", 1)
    status, out, err = reseau("calibrate", photos, "--design", folder / "target.json", *options)
    # A grid of circles equals itself turned: a note says so.
    assert status == 0
    assert err == "" or kind == "circles"
    assert out.startswith("usable for ")
    found: dict[str, dict[str, float]] = json.loads((folder / "camera.json").read_text())["parameters"]
    return found, float(out.split("sigma0 ")[1].split(",")[0])


def test_a_printed_board_calibrates_a_camera_whose_result_opencv_uses(
    reseau: Run,
    tmp_path: Path,
    rays: Pixels,
) -> None:
    found, sigma0 = evening(reseau, tmp_path, rays, seed=1, count=7)
    assert 0.7 < sigma0 < 1.3
    for name, true in TRUTH.items():
        assert abs(found[name]["value"] - true) < 4 * found[name]["sigma"]
        assert found[name]["sigma"] > 0
    # A photograph without distortion is what a lens without distortion sees.
    sheet, pose = print_out(tmp_path / "target.pdf"), poses(7, PAPER, np.random.default_rng(1))[0]
    bent = photograph(sheet, LENS, rays, pose, np.random.default_rng(5), noise=0.0)
    cv2.imwrite(str(tmp_path / "bent.png"), bent)
    assert (
        reseau("apply", tmp_path / "camera.json", tmp_path / "bent.png", "-o", tmp_path / "flat.png")[0] == 0
    )
    flat = cv2.imread(str(tmp_path / "flat.png"), cv2.IMREAD_GRAYSCALE).astype(float)
    straight = replace(LENS, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    seen = photograph(sheet, straight, straight.rays(), pose, np.random.default_rng(5), noise=0.0)
    assert np.abs(flat - seen)[40:-40, 40:-40].mean() < 0.6  # of 175 grey values
    # OpenCV reads the calibration, and projects as the true lens does.
    assert reseau("export", tmp_path / "camera.json", "--to", "opencv", "-o", tmp_path / "camera.yml")[0] == 0
    storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_READ)
    matrix, distortion = (storage.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients"))
    u, v = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7))
    points, zero = np.column_stack([u.ravel(), v.ravel(), np.ones(63)]), np.zeros(3)
    own, _ = cv2.projectPoints(points, zero, zero, matrix, distortion)
    true = np.array([[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, zero, zero, true, np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2]))
    assert np.abs(own - expected).max() < 0.15


def keep(picture: Pixels, path: Path, suffix: str) -> None:
    """Write a photograph as telephones and cameras do: turned for the viewer by its file, 16 bits, HEIC."""
    path = path.with_suffix(suffix)
    if suffix == ".jpg":
        from PIL import Image

        turned = Image.Exif()
        turned[0x0112] = 6
        Image.fromarray(picture).convert("RGB").save(path, quality=97, exif=turned)
    elif suffix == ".heic":
        heif = pytest.importorskip("pillow_heif")
        heif.from_bytes("L", picture.shape[::-1], picture.tobytes()).save(str(path), quality=97)
    else:
        scale = 257 if suffix == ".TIF" else 1
        cv2.imwrite(str(path), picture.astype(np.uint16) * scale if scale > 1 else picture)


@pytest.mark.slow
def test_the_target_is_found_among_the_designs_beside_the_photographs(
    reseau: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lens = replace(LENS, width=320, height=240, fx=300.0, fy=300.0, cx=160.2, cy=119.1)
    for kind, size in (("charuco", (5, 7)), ("chess", (6, 9))):
        files = ("--pdf", tmp_path / f"{kind}.pdf", "--out", tmp_path / f"{kind}.json")
        board = ("--kind", kind, "--columns", size[0], "--rows", size[1])
        assert reseau("design", "board", *board, *files)[0] == 0
    sheet, rng = print_out(tmp_path / "charuco.pdf"), np.random.default_rng(2)
    photos = tmp_path / "photos"
    photos.mkdir()
    pictures = [photograph(sheet, lens, lens.rays(), pose, rng, noise=1.0) for pose in poses(4, PAPER, rng)]
    for k, picture in enumerate(pictures):
        keep(picture, photos / str(k), (".png", ".jpg", ".heic", ".TIF")[k])
    (photos / "cut.jpg").write_bytes((photos / "1.jpg").read_bytes()[:3000])
    (photos / "notes.txt").write_text("f/8")
    status, out, err = reseau("calibrate", photos, "--design", "auto", "--jobs", 1)
    assert status == 0
    assert "4 images" in out
    assert [line for line in out.splitlines() if line.startswith("left out")] == [
        "left out: cut.jpg: is a truncated image"
    ]
    assert "note: the target is" in err
    assert "charuco" in err
    assert abs(float(out.split("fx")[1].split()[0]) - 300.0) < 3.0
    status, _, err = reseau("calibrate", photos / "0.png", "--design", tmp_path / "none.json")
    assert status == 2
    assert "none.json" in err


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["charuco", "chess", "circles", "asymmetric", "aprilgrid", "sheet"])
def test_true_parameters_are_within_their_sigmas_over_twenty_evenings(
    reseau: Run, tmp_path: Path, rays: Pixels, kind: str
) -> None:
    z, factors = [], []
    for seed in range(20):
        folder = tmp_path / str(seed)
        folder.mkdir()
        found, sigma0 = evening(reseau, folder, rays, seed, 10, kind)
        z.append([(found[name]["value"] - true) / found[name]["sigma"] for name, true in TRUTH.items()])
        factors.append(sigma0)
    error = np.array(z)
    print(
        f"{kind}: rms {np.sqrt((error**2).mean()):.3f}, largest {np.abs(error).max():.2f}, "
        f"sigma0 {min(factors):.2f} to {max(factors):.2f}, mean",
        error.mean(axis=0).round(2),
    )
    # 160 errors, correlated within a seed: as 20 × 3 independent ones.
    assert 0.75 < np.sqrt((error**2).mean()) < 1.3
    assert np.abs(error).max() < 4.5
    assert np.abs(error.mean(axis=0)).max() < 4 / np.sqrt(20)
    assert 0.8 < np.mean(factors) < 1.2
