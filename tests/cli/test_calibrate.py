"""`reseau calibrate`: from simulated recordings to the calibration, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape

from reseau.calibration import Calibration
from reseau.designs import board
from reseau.io import ReseauMeasurement
from reseau.io.images import write_image
from reseau_sims import FieldBench, Station

from ..measure.board_pictures import picture

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
    return ("calibrate", *measured[1:], "-d", measured[0], "--image-size", "240x240", "--pitch-mm", 0.027)


def test_the_calibration_is_within_its_sigmas_of_the_truth(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    files = ("-o", tmp_path / "K.json", "--report", tmp_path / "F.html")
    status, out, err = reseau(*common(measured), "--free", "c,x0,y0,K1", *files)
    assert (status, err) == (0, "")
    assert out.startswith("usable for ")
    assert "\n12 images, " in out
    assert "error of the projection: median" in out
    found = Calibration.read(tmp_path / "K.json")
    assert found.sigma0 == pytest.approx(1.0, abs=0.05)
    true = dict(zip(BENCH.camera.names, BENCH.camera.values, strict=True))
    for name in ("c", "x0", "y0", "K1"):
        quantity = found.parameters[name]
        assert abs(quantity.value - true[name]) < 4 * quantity.sigma
    assert found.parameters["c"].sigma < 0.02  # mm of 57.5
    assert "<svg" in (tmp_path / "F.html").read_text()


@pytest.mark.slow
def test_a_calibration_is_compared_with_another_of_the_same_recordings(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    reseau(*common(measured), "--free", "c,x0,y0,K1", "-o", tmp_path / "K.json")
    status, out, _ = reseau(*common(measured), "--free", "c,x0,y0,K1", "--against", tmp_path / "K.json")
    assert status == 0
    assert "p = 1\n" in out


@pytest.mark.slow
def test_two_calibrations_are_compared_as_a_field(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    """Of six recordings each: they differ by their sigmas; of another lens: significantly."""
    design, images = measured[0], measured[1:]
    options = ("-d", design, "--image-size", "240x240", "--pitch-mm", 0.027, "--free", "c,x0,y0,K1")
    for name, part in (("A", images[::2]), ("B", images[1::2])):
        assert reseau("calibrate", *part, *options, "-o", tmp_path / f"{name}.json")[0] == 0
    files = ("-o", tmp_path / "D.json", "--figure", tmp_path / "D.svg")
    status, out, err = reseau("compare", tmp_path / "A.json", tmp_path / "B.json", *files)
    assert (status, err) == (0, "")
    assert out.startswith("difference to B.json: ")
    found = json.loads((tmp_path / "D.json").read_text())
    assert found["schema"] == "reseau-difference/1"
    assert found["p"] > 1e-3
    assert np.array(found["dx"]).shape == np.array(found["p_at"]).shape == (25, 25)
    size = np.hypot(found["dx"], found["dy"]) / np.hypot(found["sx"], found["sy"])
    assert np.median(size) < 2.5
    assert "<svg" in (tmp_path / "D.svg").read_text()
    content = json.loads((tmp_path / "B.json").read_text())
    content["parameters"]["K1"]["value"] += 30 * content["parameters"]["K1"]["sigma"]
    (tmp_path / "C.json").write_text(json.dumps(content))
    status, out, _ = reseau("compare", tmp_path / "A.json", tmp_path / "C.json", "--json")
    assert status == 0
    assert json.loads(out)["p"] < 1e-6


def test_files_that_are_not_calibrations_are_not_compared(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    status, out, err = reseau("compare", measured[0], measured[0])
    assert (status, out) == (2, "")
    assert err.count("\n") == 1


@pytest.mark.slow
def test_control_points_define_the_datum(reseau: Run, measured: tuple[Path, ...], tmp_path: Path) -> None:
    """Three corners of the board, one of them in its height alone: no freedom left, nothing redundant."""
    names, xy = BENCH.design.targets.id, BENCH.design.xy
    seen = np.abs(xy).max(axis=1) < 250
    corners = [
        int(np.argmin(np.where(seen, xy @ np.array(way), np.inf))) for way in ((1, 1), (-1, 1), (1, -1))
    ]
    sigmas = ("0,0,0", "0,0,0", ",,0.001")
    rows = [
        f"{names[k]},{float(xy[k, 0])},{float(xy[k, 1])},0,{s}" for k, s in zip(corners, sigmas, strict=True)
    ]
    path = tmp_path / "control.csv"
    path.write_text("id,x,y,z,sx,sy,sz\n" + "\n".join(rows) + "\n")
    free = reseau(*common(measured), "--free", "c,x0,y0,K1", "--json")
    status, out, err = reseau(*common(measured), "--free", "c,x0,y0,K1", "--control", path, "--json")
    assert (status, err) == (0, "")
    found, without = json.loads(out), json.loads(free[1])
    # Six coordinates held, one observed: as much as the seven constraints of the free network.
    assert found["redundancy"] == without["redundancy"]
    assert found["parameters"]["c"]["value"] == pytest.approx(without["parameters"]["c"]["value"], abs=1e-6)
    assert "control.csv" in found["provenance"]["inputs"]


@pytest.mark.slow
def test_a_point_can_be_left_out_by_name(reseau: Run, measured: tuple[Path, ...]) -> None:
    name = measured[3].read_text().splitlines()[5].partition(",")[0]
    point = f"{measured[3].name}:{name}"
    whole = json.loads(reseau(*common(measured), "--json")[1])
    status, out, _ = reseau(*common(measured), "--leave-out", point, "--json")
    assert status == 0
    assert json.loads(out)["redundancy"] == whole["redundancy"] - 2
    for wrong, words in (("02.csv:none", "was not measured"), ("none", "write image:point")):
        status, _, err = reseau(*common(measured), "--leave-out", wrong)
        assert status == 2
        assert words in err


@pytest.mark.slow
def test_components_and_elimination_search_the_model(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    """K2, P1 and P2, which the lens does not have, are dropped; the sigmas of x and y are confirmed."""
    files = (
        "-o", tmp_path / "K.json", "--report", tmp_path / "F.html", "--distance", 1500, "--distance", 9000
    )  # fmt: skip
    free = ("--free", "c,x0,y0,K1,K2,P1,P2", "--eliminate", 0.001, "--components", "axes")
    status, out, err = reseau(*common(measured), *free, *files)
    assert (status, err) == (0, "")
    assert "sigmas of x times " in out
    assert "cross-validation" in out
    assert "at 1500 mm: median " in out
    content = json.loads((tmp_path / "K.json").read_text())["validity"]
    assert {step["name"] for step in content["eliminated"]} == {"K2", "P1", "P2"}
    assert content["cross_validation"]["kept"] < content["cross_validation"]["all"]
    for factor, sigma in zip(*(content["variance_components"][k] for k in ("factors", "sigma")), strict=True):
        assert abs(factor - 1.0) < 4 * sigma
    page = (tmp_path / "F.html").read_text()
    for words in ("Variance components", "Dropped parameters", "points at 1500 mm", "points at 9000 mm"):
        assert words in page


@pytest.mark.slow
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
        "-o", tmp_path / "K.json", "--report", tmp_path / "F.html", "--jobs", 1,
    )  # fmt: skip
    assert (status, err) == (0, "")
    why = out.partition("left out: blank.png: ")[2].partition("\n")[0]
    assert why
    page = (tmp_path / "F.html").read_text()
    assert f"<li><b>blank.png</b>: {escape(why)}</li>" in page.partition("Photographs left out")[2]
    found = Calibration.read(tmp_path / "K.json").parameters["fx"]
    assert abs(found.value - 57.5 / 0.027) < 4 * found.sigma
    # Two processes find the same to the byte, whichever is first.
    again = reseau(
        "calibrate", *images, "-d", tmp_path / "field.json", "--free", "fx,fy,cx,cy", "--fill", 0.8, "--json",
        "--jobs", 2, "--overlay", tmp_path / "seen",
    )  # fmt: skip
    assert again[1] == (tmp_path / "K.json").read_text()
    drawn = {file.name for file in (tmp_path / "seen").iterdir()}
    assert drawn == {f"{image.stem}-overlay.png" for image in images}


def test_photographs_of_which_none_can_be_read_are_reported_in_one_line(reseau: Run, tmp_path: Path) -> None:
    FieldBench(seed=4).design.write(tmp_path / "field.json")
    for name in "abcde":
        (tmp_path / f"{name}.png").write_text("no image")
    images = sorted(tmp_path.glob("*.png"))
    status, out, err = reseau("calibrate", *images, "-d", tmp_path / "field.json", "--jobs", 2)
    assert (status, out) == (1, "")
    assert err.count("\n") == 1
    assert "a.png and 4 others: is not a PNG" in err


@pytest.mark.slow
def test_sigma_naught_refers_to_the_given_sigma(reseau: Run, measured: tuple[Path, ...]) -> None:
    """Twice the sigma of the coordinates gives half the sigma naught."""
    status, out, _ = reseau(*common(measured), "--free", "c,x0,y0,K1", "--sigma-px", 2 * SIGMA)
    assert status == 0
    sigma0 = float(out.partition("sigma0 ")[2].partition(",")[0])
    assert sigma0 == pytest.approx(0.5, abs=0.025)


@pytest.mark.slow
def test_the_size_of_a_target_that_was_found_is_not_known(
    reseau: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    design = board("charuco", 7, 10, 23.0)
    (tmp_path / "photos").mkdir()
    write_image(tmp_path / "photos" / "a.png", picture(design, distance=460.0)[0].pixels)
    _, _, err = reseau("calibrate", tmp_path / "photos", "--design", "auto", "--jobs", 1)
    assert "on Letter or charuco on Tabloid; photographs do not tell its size" in err
    design.write(tmp_path / "mine.json")
    _, _, err = reseau("calibrate", tmp_path / "photos", "--design", "auto", "--jobs", 1)
    assert "mine.json\n" in err


@pytest.mark.slow
def test_documents_of_measurements_are_accepted_as_images(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    files: list[Path] = []
    for path in measured[1:]:
        files.append(tmp_path / f"{path.stem}.json")
        ReseauMeasurement.read_csv(path).write(files[-1])
    arguments = ("-d", measured[0], "--image-size", "240x240", "--pitch-mm", 0.027, "--free", "c", "--json")
    first = reseau("calibrate", *files, *arguments)
    assert first[0] == 0
    assert reseau("calibrate", *files, *arguments) == first


def port(folder: Path, water: float) -> Path:
    content = {
        "schema": "reseau-refraction/1",
        "media": {"air": 1.0, "glass": 1.0, "water": water},
        "windows": [{"id": "port", "shape": "plane", "on": "camera", "media": ["air", "glass", "water"],
                     "parameters": {"distance": 30.0, "thickness": 10.0}}],
    }  # fmt: skip
    path = folder / f"port-{water:g}.json"
    path.write_text(json.dumps(content))
    return path


def checked(answer: tuple[int, str, str]) -> str:
    status, out, err = answer
    assert (status, err) == (0, "")
    return out


@pytest.mark.slow
def test_windows_before_the_target_are_taken_from_a_file(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    """The recordings were made in air: media of the index 1 change nothing, through water c is less."""
    command = (*common(measured), "--free", "c,x0,y0,K1", "--json")
    plain, dry, wet = (
        json.loads(checked(reseau(*command, *more)))
        for more in ((), ("--refraction", port(tmp_path, 1.0)), ("--refraction", port(tmp_path, 1.333)))
    )
    assert dry["sigma0"] == pytest.approx(plain["sigma0"], abs=1e-3)
    c = [each["parameters"]["c"]["value"] for each in (plain, dry, wet)]
    assert c[1] == pytest.approx(c[0], abs=1e-3)
    assert c[2] == pytest.approx(c[0] / 1.333, abs=0.05)
    path = port(tmp_path, 1.333)
    path.write_text(path.read_text().replace("glass", "mud", 1))
    status, out, err = reseau(*command, "--refraction", path)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert "glass" in err


def photographs(folder: Path) -> list[Path]:
    """Photographs of the field, small ones; the last is none."""
    stations = [Station(45.0, kappa, kappa) for kappa in (0.0, 90.0, 180.0)] + [Station(30.0, 270.0)]
    files = []
    for k, station in enumerate(stations):
        files.append(folder / f"{k}.png")
        write_image(files[-1], BENCH.record(station).pixels)
    return files


@pytest.mark.slow
def test_measurements_are_kept_in_a_store_and_not_repeated(
    reseau: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "photos").mkdir()
    BENCH.design.write(tmp_path / "field.json")
    files = photographs(tmp_path / "photos")
    command = (
        "calibrate", *files, "-d", tmp_path / "field.json", "--pitch-mm", 0.027, "--free", "c,K1", "--jobs",
        1
    )  # fmt: skip
    kept = (*command, "--store", tmp_path / "store", "-o", tmp_path / "kept.json")
    assert reseau(*kept)[0] == 0
    measured = (tmp_path / "kept.json").read_bytes()
    assert len(list((tmp_path / "store").glob("records/*/*.json"))) == len(files)

    def fails(*_: object) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr("reseau.procedures.target_measurement._points", fails)
    assert reseau(*kept)[0] == 0
    assert (tmp_path / "kept.json").read_bytes() == measured
    (next((tmp_path / "store").glob("records/*/*.json"))).unlink()
    with pytest.raises(AssertionError, match="measured again"):
        reseau(*kept)


@pytest.mark.slow
def test_a_calibration_beyond_the_memory_is_that_of_the_direct_solution(
    reseau: Run, measured: tuple[Path, ...], tmp_path: Path
) -> None:
    """Within a part of its sigmas; what conjugate gradients do not compute is said."""
    found = []
    for memory in (("--memory-gb", "0"), ("--memory-gb", "1")):
        out = tmp_path / "K.json"
        status, _, err = reseau(*common(measured), "--free", "c,x0,y0,K1", *memory, "-o", out)
        assert status == 0, err
        found.append((Calibration.read(out), out.read_text()))
    (iterative, said), (direct, plain) = found
    assert "conjugate gradients" in said
    assert "conjugate gradients" not in plain
    for name in ("c", "x0", "y0", "K1"):
        one, other = iterative.parameters[name], direct.parameters[name]
        assert one.value == pytest.approx(other.value, abs=1e-3 * other.sigma)
        assert one.sigma == pytest.approx(other.sigma, rel=1e-4)
