"""`reseau calibrate`: from simulated recordings to the calibration, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.calibration import Calibration
from reseau.formats import ReseauMeasurement
from reseau.images import write_image
from reseau_sims import FieldBench, Station

Run = Callable[..., tuple[int, str, str]]

BENCH = FieldBench(seed=3, bend_mm=0.0).distorted(1.0)
SIGMA = 0.005
"""Of the coordinates, px: what measured targets have on average."""


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """The design, and coordinates of twelve recordings: the true ones with noise."""
    folder, rng = tmp_path_factory.mktemp("recordings"), np.random.default_rng(0)
    BENCH.design.write(folder / "field.json")
    stations = [
        Station(phi, kappa, kappa) for phi in (0.0, 30.0, 45.0) for kappa in (0.0, 90.0, 180.0, 270.0)
    ]
    for k, station in enumerate(stations):
        truth = BENCH.truth(station)
        rows = np.flatnonzero(BENCH.inside(truth, 8.0))
        xy = truth.xy[rows] + SIGMA * rng.normal(size=(len(rows), 2))
        lines = [
            f"{truth.names[j]},{x!r},{y!r},{SIGMA},{SIGMA}"
            for j, (x, y) in zip(rows, xy.tolist(), strict=True)
        ]
        (folder / f"{k:02d}.csv").write_text("id,x,y,sx,sy\n" + "\n".join(lines) + "\n")
    return (folder / "field.json", *sorted(folder.glob("*.csv")))


def common(measured: tuple[Path, ...]) -> tuple[object, ...]:
    return ("calibrate", *measured[1:], "-d", measured[0], "--size", "240x240", "--pitch", 0.027)


def test_the_calibration_is_within_its_sigmas_of_the_truth(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    files = ("-o", tmp_path / "K.json", "--report", tmp_path / "F.html")
    status, out, err = reseau(*common(measured), "--free", "c,x0,y0,K1", *files)
    assert (status, err) == (0, "")
    assert out.startswith("12 images, ")
    assert "projection known to" in out
    found = Calibration.read(tmp_path / "K.json")
    assert found.sigma0 == pytest.approx(1.0, abs=0.05)
    true = dict(zip(BENCH.camera.names, BENCH.camera.values, strict=True))
    for name in ("c", "x0", "y0", "K1"):
        quantity = found.parameters[name]
        assert abs(quantity.value - true[name]) < 4 * quantity.sigma
    assert found.parameters["c"].sigma < 0.02  # mm of 57.5
    assert "<svg" in (tmp_path / "F.html").read_text()


def test_a_calibration_is_compared_with_another_of_the_same_recordings(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    reseau(*common(measured), "--free", "c,x0,y0,K1", "-o", tmp_path / "K.json")
    status, out, _ = reseau(*common(measured), "--free", "c,x0,y0,K1", "--against", tmp_path / "K.json")
    assert status == 0
    assert "p = 1\n" in out


def test_photographs_are_measured_and_blank_ones_are_named(reseau: Run, tmp_path: Path) -> None:
    """Four photographs with OpenCV's model and nothing known of the camera; one that shows no testfield."""
    bench = FieldBench(seed=4, bend_mm=0.0)
    bench.design.write(tmp_path / "field.json")
    for k, station in enumerate(
        (Station(45), Station(45, 90, 90), Station(45, 180, 180), Station(30, 270, 0))
    ):
        write_image(tmp_path / f"{k}.png", bench.record(station).pixels)
    noise = np.random.default_rng(0).normal(100, 5, (240, 240))
    write_image(tmp_path / "blank.png", noise.astype(np.uint8))
    images = sorted(tmp_path.glob("*.png"))
    status, out, err = reseau(
        "calibrate", *images, "-d", tmp_path / "field.json", "--free", "fx,fy,cx,cy", "--fill", 0.8,
        "-o", tmp_path / "K.json",
    )  # fmt: skip
    assert (status, err) == (0, "")
    assert "left out: blank.png: " in out
    found = Calibration.read(tmp_path / "K.json").parameters["fx"]
    assert abs(found.value - 57.5 / 0.027) < 4 * found.sigma


def test_sigma_naught_is_that_of_the_sigma_given(reseau: Run, measured: tuple[Path, ...]) -> None:
    """Twice the sigma that the coordinates have, and half the sigma naught."""
    status, out, _ = reseau(*common(measured), "--free", "c,x0,y0,K1", "--sigma", 2 * SIGMA)
    assert status == 0
    sigma0 = float(out.partition("sigma0 ")[2].partition(",")[0])
    assert sigma0 == pytest.approx(0.5, abs=0.025)


def test_too_few_images_are_refused_with_their_reasons(reseau: Run, measured: tuple[Path, ...]) -> None:
    status, _, err = reseau("calibrate", *measured[1:3], "-d", measured[0], "--size", "240x240")
    assert status == 1
    assert "2 images show the target, 3 are needed" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--pitch", 0.027, "--free", "c,fx"), "fx: is none of c, x0"),
        (("--side", "inner", "--pitch", 0.027), "write `object` or `image`"),
        (("--size", "large"), "write 640x480"),
    ],
)
def test_wrong_options_are_named(
    reseau: Run, measured: tuple[Path, ...], arguments: tuple[object, ...], message: str
) -> None:
    status, _, err = reseau("calibrate", *measured[1:], "-d", measured[0], *arguments)
    assert status == 2
    assert message in err


def test_coordinates_without_a_size_are_refused(reseau: Run, measured: tuple[Path, ...]) -> None:
    status, _, err = reseau("calibrate", *measured[1:], "-d", measured[0])
    assert status == 2
    assert "size of the images" in err


def test_documents_of_measurements_serve_as_images(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    files: list[Path] = []
    for path in measured[1:]:
        files.append(tmp_path / f"{path.stem}.json")
        ReseauMeasurement.read_csv(path).write(files[-1])
    arguments = ("-d", measured[0], "--size", "240x240", "--pitch", 0.027, "--free", "c", "--json")
    first = reseau("calibrate", *files, *arguments)
    assert first[0] == 0
    assert reseau("calibrate", *files, *arguments) == first
