"""What `import reseau` gives: its names, what they accept, and what their results show of themselves."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

import reseau
import reseau_drivers
import reseau_sims
from reseau.bundle import example_network
from reseau.core.data import ImagePoints
from reseau.core.errors import UsageError
from reseau.core.failure import Code
from reseau.designs import regular_reseau
from reseau.io import Mark
from reseau.io.images import write_image
from reseau_sims import FieldBench, paper_stations
from reseau_sims.filmframe import FilmFrame

mpl.use("agg")

NAMES = {
    "Archive", "Bench", "Calibration", "Code", "Failure", "Frame", "ImagePoints", "Network", "ReseauError",
    "__version__", "adjust_network", "calibrate", "measure", "orient", "read_calibration", "read_design",
    "read_image", "read_lens", "refine",
}  # fmt: skip


@pytest.fixture(autouse=True)
def _close_figures() -> Iterator[None]:
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


def test_the_public_names_are_these_and_no_others() -> None:
    assert set(reseau.__all__) == NAMES
    assert set(dir(reseau)) == NAMES
    for name in NAMES:
        assert getattr(reseau, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = reseau.nothing  # type: ignore[attr-defined]


def test_import_reseau_loads_nothing_that_takes_time() -> None:
    code = (
        "import sys, time; before = set(sys.modules); t = time.process_time(); import reseau; "
        "t = time.process_time() - t; new = {m.split('.')[0] for m in set(sys.modules) - before}; "
        "print(t, *sorted(new - set(sys.stdlib_module_names)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    seconds, *loaded = out.split()
    assert loaded == ["reseau"]
    assert float(seconds) < 0.1


def test_packages_that_share_a_name_with_a_function_are_callable_and_stay_packages() -> None:
    import reseau.measure.fitting
    import reseau.refine.camera

    assert callable(reseau.measure)
    assert callable(reseau.refine)
    assert reseau.measure.fitting.fit_mapping is not None
    assert reseau.refine.camera.correct_camera is not None


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: reseau.read_image(3), "source: is of type int"),  # type: ignore[arg-type]
        (lambda: reseau.read_image(np.zeros((4, 4), complex)), "source: has grey values of type complex128"),
        (lambda: reseau.read_design(None), "source: is None"),  # type: ignore[arg-type]
        (lambda: reseau.read_calibration(3.0), "source: is of type float"),  # type: ignore[arg-type]
        (lambda: reseau.read_lens(5), "source: is of type int"),  # type: ignore[arg-type]
        (lambda: reseau.measure([], GRID), "source: is of type list"),  # type: ignore[arg-type]
        (lambda: reseau.measure(GREY, GRID, options=3), "options: is of type int"),  # type: ignore[arg-type]
        (lambda: reseau.calibrate(5, GRID), "images: is of type int"),  # type: ignore[arg-type]
        (lambda: reseau.read_image(COLOUR), "colours: is None, and the array has three channels"),
        (lambda: reseau.calibrate([3, 4, 5], GRID), "photograph: is of type int"),  # type: ignore[list-item]
        (lambda: reseau.calibrate({"a": [GREY, GREY], "b": [GREY]}, GRID), "images: are 2 of a, 1 of b"),
        (lambda: reseau.orient(3), "scan: is of type int"),  # type: ignore[arg-type]
        (lambda: reseau.refine(), "refine: needs PHOTO I and its reseau"),
        (lambda: reseau.refine(GREY, GRID, photo_ii=GREY), "must be given together"),
        (lambda: reseau.refine(GREY, GRID, photo_iii=[GREY]), "PHOTO III: needs PHOTO II"),
        (lambda: reseau.adjust_network(7), "network: is of type int"),  # type: ignore[arg-type]
    ],
)
def test_an_argument_of_a_wrong_kind_is_named(call: object, named: str) -> None:
    assert callable(call)
    with pytest.raises(UsageError) as found:
        call()
    assert named in str(found.value)


GREY = np.full((60, 80), 128, np.uint8)
COLOUR = np.stack([GREY, GREY // 2, GREY // 4], axis=2)
GRID = regular_reseau(5, 4, 10.0, Mark(shape="disk", size=2.0), name="disks")


def test_a_target_that_is_not_in_the_image_is_a_failure_with_a_code_and_the_image() -> None:
    noise = np.random.default_rng(1).normal(128, 3, GREY.shape).astype(np.uint8)
    found = reseau.measure(reseau.Frame(noise, 255.0, "grey.png"), GRID)
    assert not found
    assert isinstance(found, reseau.Failure)
    assert isinstance(found.code, Code)
    assert str(found).startswith("grey.png: ")
    with pytest.raises(reseau.ReseauError):
        found.required()


@pytest.fixture(scope="module")
def photographs() -> list[reseau.Frame]:
    bench = FieldBench(seed=5)
    return [bench.record(station) for station in paper_stations()[::5]]


@pytest.mark.slow
def test_a_folder_is_enough_and_the_target_is_found(photographs: list[reseau.Frame], tmp_path: Path) -> None:
    for frame in photographs:
        write_image(tmp_path / f"{frame.name}.png", frame.pixels)
    FieldBench().design.write(tmp_path / "field.json")
    found = reseau.calibrate(tmp_path).required()
    assert len(found.measured) == len(photographs)
    assert found.notes[0] == f"the target is {tmp_path / 'field.json'}"


def test_channels_of_arrays_are_told_by_their_order() -> None:
    one = reseau.read_image(COLOUR, colours="rgb").pixels
    other = reseau.read_image(COLOUR[:, :, ::-1], colours="bgr").pixels
    np.testing.assert_array_equal(one, other)
    assert (reseau.read_image(COLOUR, "blue", colours="bgr").pixels == 128).all()
    assert (reseau.read_image(COLOUR, colours="bgr").pixels < one).all()


@pytest.mark.slow
def test_the_lines_of_the_readme_make_of_photographs_a_calibration_its_file_and_its_plot(
    photographs: list[reseau.Frame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    readme = (Path(__file__).parents[1] / "README.md").read_text("utf-8")
    (lines,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    assert sum(bool(line) for line in lines.splitlines()) == 5
    (tmp_path / "photos").mkdir()
    for frame in photographs:
        write_image(tmp_path / "photos" / f"{frame.name}.jpg", frame.pixels)
    FieldBench().design.write(tmp_path / "board.json")
    monkeypatch.chdir(tmp_path)
    exec(compile(lines, "README.md", "exec"), names := dict[str, Any]())
    calibrated = names["calibrated"]
    assert len(repr(calibrated)) < 500
    assert "sigma0" in repr(calibrated)
    assert calibrated.assessment.short in repr(calibrated)
    assert len(calibrated.plot(photographs[0])) == 4
    calibration = reseau.read_calibration("camera.json")
    assert calibration.kind == "camera"
    estimate = calibrated.cameras["camera"]
    (name, *_), (value, *_) = estimate.parameters, estimate.values
    assert calibration.values()[name] == value
    assert calibration.assessment == calibrated.assessment
    assert len(repr(calibration)) < 300
    assert calibration.plot().get_title(loc="left") == "error of the projection / px"


@pytest.mark.slow
def test_measured_marks_are_shown_written_and_read_back(
    photographs: list[reseau.Frame], tmp_path: Path
) -> None:
    measured = reseau.measure(photographs[0], FieldBench().design).required()
    assert repr(measured).startswith("<TestfieldResult: image")
    assert len(repr(measured)) < 200
    assert len(repr(measured.points)) < 200
    assert measured.plot(frame=photographs[0]).get_xlabel() == "x / px"
    assert len(measured.points.plot().collections) == 1
    measured.write(tmp_path / "marks.json")
    measured.write(tmp_path / "marks.csv")
    again = reseau.calibrate([tmp_path / "marks.json"], FieldBench().design, image_size=(240, 240))
    assert again.code == Code.TOO_FEW_IMAGES
    with pytest.raises(UsageError, match=r"use \.json or \.csv"):
        measured.write(tmp_path / "marks.txt")


@pytest.mark.slow
def test_a_scan_in_memory_is_oriented(tmp_path: Path) -> None:
    frame = FilmFrame(3)
    (found,) = reseau.orient(frame.scan(), format_mm=(36.0, 24.0), dpi=frame.dpi)
    assert found
    assert "36 × 24 mm" in repr(found)
    assert found.plot().get_title(loc="left").endswith("oriented")
    found.write(tmp_path / "frame.json")
    assert reseau.read_calibration(tmp_path / "frame.json").kind == "film_frame"


def test_a_network_gives_cameras_images_and_points_with_their_sigmas(tmp_path: Path) -> None:
    result = reseau.adjust_network(example_network()).required()
    assert len(repr(result)) < 300
    assert result.points.sigma.shape == (20, 3)
    assert np.isfinite(result.cameras["camera"].sigma).all()
    assert "residuals" in result.plot().get_title(loc="left")
    result.write(tmp_path / "result.json")
    assert (tmp_path / "result.json").read_text("utf-8").startswith('{\n "schema": "reseau-bundle/1"')


def test_columns_become_a_data_frame_where_pandas_is_installed() -> None:
    points = ImagePoints.with_sigma(["a", "b"], [[1.0, 2.0], [3.0, 4.0]], 0.1)
    try:
        import pandas  # noqa: F401
    except ImportError:
        with pytest.raises(UsageError, match="needs pandas"):
            points.to_dataframe()
    else:
        assert list(points.to_dataframe().columns) == ["id", "x", "y", "sx", "sy", "rho"]


def test_every_public_class_and_function_has_an_example() -> None:
    missing = []
    for root in (reseau, reseau_drivers, reseau_sims):
        packages = [
            each.name for each in pkgutil.walk_packages(root.__path__, f"{root.__name__}.") if each.ispkg
        ]
        for name in (root.__name__, *packages):
            if name.startswith("reseau.cli"):
                continue  # commands show their use with --help
            module = importlib.import_module(name)
            for public in getattr(module, "__all__", ()):
                each = getattr(module, public)
                if (inspect.isclass(each) or inspect.isfunction(each)) and not _has_example(each):
                    missing.append(f"{name}.{public}")
    assert missing == []


def _has_example(each: type | object) -> bool:
    parts = [each, *(vars(each).values() if inspect.isclass(each) else ())]
    return any(">>>" in (inspect.getdoc(part) or "") for part in parts)
