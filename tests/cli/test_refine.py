"""`reseau refine` with PHOTO II and III given as coordinates: the three photographs, a stored calibration."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from reseau.cli import run
from reseau.designs import standard_reseau
from reseau.io import DesignPoint, Mark, ReseauDesign
from reseau.optics import RationalPolynomial

_CAMERA = RationalPolynomial.camera().with_values({"k": 3e-7, "d1": 1e-5})
_INSTRUMENT = RationalPolynomial.ultrasonic().with_values({"A1": 1.01, "A2": 0.01, "B1": 0.99, "B2": -0.008})
_BODY = {"p1": (30.0, 30.0), "p2": (60.0, 50.0), "p3": (80.0, 70.0)}
_RODS = {f"r{i}{j}": (20.0 * i, 20.0 * j) for i in range(6) for j in range(5)}


def _pixels(common: np.ndarray) -> np.ndarray:
    photo = _CAMERA.inverse(common)
    return np.stack([800 + 9 * photo[:, 0], 600 - 9 * photo[:, 1]], axis=1)


def _shown(object_xy: np.ndarray) -> np.ndarray:
    return _pixels(_INSTRUMENT.inverse(object_xy * [1.05, -1.04] + [-50.0, 38.0]))


def _csv(path: Path, *parts: tuple[list[str] | tuple[str, ...], np.ndarray]) -> Path:
    rng = np.random.default_rng(len(path.name))
    lines = ["id,x,y,sx,sy"]
    for names, xy in parts:
        noisy = xy + rng.normal(0, 0.01, xy.shape)
        lines += [f"{n},{x:.5f},{y:.5f},0.01,0.01" for n, (x, y) in zip(names, noisy, strict=True)]
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return path


@pytest.fixture
def bench(tmp_path):
    reseau = standard_reseau()
    rods = ReseauDesign(
        name="test object",
        unit="mm",
        mark=Mark(shape="rod", size=0.75),
        polarity="bright",
        origin="r00",
        axis="r50",
        points=tuple(DesignPoint(id=n, x=x, y=y, sigma=0.02) for n, (x, y) in _RODS.items()),
    )
    reseau.write(tmp_path / "reseau.json")
    rods.write(tmp_path / "rods.json")
    marks = (reseau.ids, _pixels(reseau.xy))
    return {
        "--reseau": tmp_path / "reseau.json",
        "--test-object": tmp_path / "rods.json",
        "--photo-i": _csv(tmp_path / "one.csv", marks),
        "--photo-ii": _csv(
            tmp_path / "two.csv", marks, (list(_RODS), _shown(np.array(list(_RODS.values()))))
        ),
        "--photo-iii": _csv(
            tmp_path / "three.csv", marks, (list(_BODY), _shown(np.array(list(_BODY.values()))))
        ),
    }


def _run(files: dict[str, Path], *more: object) -> int:
    return run(["refine", *(str(part) for pair in files.items() for part in pair), *map(str, more)])


def _read_true(path: Path) -> dict[str, tuple[float, ...]]:
    rows = [line.split(",") for line in path.read_text("utf-8").splitlines()[1:]]
    return {row[0]: tuple(map(float, row[1:])) for row in rows}


def test_three_photographs_give_true_coordinates_and_a_calibration(bench, tmp_path, capsys):
    assert _run(bench, "--out", tmp_path / "k.json", "--true", tmp_path / "true.csv") == 0
    true = _read_true(tmp_path / "true.csv")
    assert list(true) == list(_BODY)
    for name, (x, y) in _BODY.items():
        # The rods' tolerance of 0.02 mm, over 30 rods, and the sigmas that say so.
        assert abs(true[name][0] - x) < 0.03
        assert abs(true[name][1] - y) < 0.03
        assert 0.001 < true[name][2] < 0.03
    message = capsys.readouterr().out
    assert "A6 = B6 is satisfied" in message
    assert "note" not in message


def test_a_stored_calibration_gives_the_same_true_coordinates(bench, tmp_path, capsys):
    assert _run(bench, "--out", tmp_path / "k.json", "--true", tmp_path / "true.csv") == 0
    third = {"--calibration": tmp_path / "k.json", "--photo-iii": bench["--photo-iii"]}
    assert _run(third, "--true", tmp_path / "again.csv") == 0
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "true.csv").read_bytes()
    capsys.readouterr()
    assert _run(third, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["points"]["id"] == list(_BODY)
    assert document["system"] == "object"
    assert document["notes"] == []


def test_stored_coefficients_are_tested_with_a_new_photo_ii(bench, tmp_path, capsys):
    assert _run(bench, "--out", tmp_path / "k.json") == 0
    reseau, rods, aside = standard_reseau(), np.array(list(_RODS.values())), np.array([0.05, 0.0])
    anew = _csv(tmp_path / "the same.csv", (reseau.ids, _pixels(reseau.xy)), (list(_RODS), _shown(rods)))
    shifted = _csv(
        tmp_path / "shifted.csv", (reseau.ids, _pixels(reseau.xy)), (list(_RODS), _shown(rods + aside))
    )
    capsys.readouterr()
    assert _run({"--calibration": tmp_path / "k.json", "--photo-ii": anew}) == 0
    assert "the same.csv: the coefficients are still valid" in capsys.readouterr().out
    assert _run({"--calibration": tmp_path / "k.json", "--photo-ii": shifted}, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert not document["holds"]
    assert document["same_object"]
    assert document["shift"][0] == pytest.approx(0.05, abs=5 * document["shift_sigma"][0])
    assert len(document["notes"]) == 1
    assert "the display has shifted against the reseau by 0.0" in document["notes"][0]
    assert len(document["rods"]["id"]) == len(_RODS)


def test_a_camera_that_moved_before_photo_iii_is_noticed_and_corrected(bench, tmp_path, capsys):
    reseau = standard_reseau()
    moved = np.array([0.8, -0.5])
    photo = _csv(
        tmp_path / "moved.csv",
        (reseau.ids, _pixels(reseau.xy) + moved),
        (list(_BODY), _shown(np.array(list(_BODY.values()))) + moved),
    )
    assert _run(bench | {"--photo-iii": photo}, "--true", tmp_path / "true.csv") == 0
    assert "the camera has moved since PHOTO I, by up to 0.94 px" in capsys.readouterr().out
    for name, (x, _) in _BODY.items():
        assert abs(_read_true(tmp_path / "true.csv")[name][0] - x) < 0.03


@pytest.mark.slow
def test_a_missing_row_of_pins_a_rotated_object_and_swapped_marks_are_reported(bench, tmp_path, capsys):
    rods = ReseauDesign.read(bench["--test-object"])
    reseau = ReseauDesign.read(bench["--reseau"])
    turn = np.deg2rad(5)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    kept = [name for name, (_, y) in _RODS.items() if y != 40.0]
    xy = np.array([_RODS[name] for name in kept])
    turned = _pixels(_INSTRUMENT.inverse((xy * [1.05, -1.04] + [-50.0, 38.0]) @ rotation.T))
    photo = _csv(tmp_path / "odd.csv", (reseau.ids, _pixels(reseau.xy)), (kept, turned))
    swapped = reseau.model_copy(update={"origin": reseau.axis, "axis": reseau.origin})
    swapped.write(tmp_path / "swapped.json")
    assert rods.axis == "r50"
    files = {key: value for key, value in bench.items() if key != "--photo-iii"}
    assert _run(files | {"--photo-ii": photo}) == 0
    message = capsys.readouterr().out
    assert "the whole row of rods at y = 40 mm is missing" in message
    assert "the test object is turned by 5.6° against the reseau" in message  # 5° and the display's own 0.6°
    assert _run(files | {"--reseau": tmp_path / "swapped.json"}) == 0
    assert "are O and S swapped?" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("left_out", "message"),
    [
        (("--test-object",), "PHOTO II and its test object must be given together"),
        (("--photo-ii", "--test-object"), "needs PHOTO II"),
        (("--reseau",), "needs PHOTO I and its reseau, or a calibration"),
    ],
)
def test_contradictory_options_are_refused_in_one_line(bench, capsys, left_out, message):
    assert _run({key: value for key, value in bench.items() if key not in left_out}) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_stored_calibration_writes_its_result_and_a_report(bench, tmp_path, capsys):
    assert _run(bench, "--out", tmp_path / "k.json") == 0
    files = {"--calibration": tmp_path / "k.json"}
    files |= {key: bench[key] for key in ("--photo-ii", "--photo-iii")}
    capsys.readouterr()
    assert _run(files, "--out", tmp_path / "r.json", "--report", tmp_path / "r.html", "--json") == 0
    assert (tmp_path / "r.json").read_text("utf-8") == capsys.readouterr().out
    test, points = json.loads((tmp_path / "r.json").read_text("utf-8"))
    assert test["holds"] is True
    assert points["points"]["id"] == list(_BODY)
    page = (tmp_path / "r.html").read_text("utf-8")
    assert "the coefficients still hold" in page
    assert all(f"<td>{name}</td>" in page or name in page for name in _BODY)
    assert page.count("SHA-256") == 3


def test_a_calibration_without_group_b_is_refused_with_a_remedy(bench, tmp_path, capsys):
    first = {key: bench[key] for key in ("--photo-i", "--reseau")}
    assert _run(first, "--out", tmp_path / "camera.json") == 0
    assert _run({"--calibration": tmp_path / "camera.json", "--photo-iii": bench["--photo-iii"]}) == 2
    assert "make it with a PHOTO II and its test object" in capsys.readouterr().err


def test_points_measured_elsewhere_are_corrected_in_a_photograph_given_as_marks(bench, tmp_path):
    assert _run(bench, "--out", tmp_path / "k.json", "--true", tmp_path / "true.csv") == 0
    body = _csv(tmp_path / "body.csv", (list(_BODY), _shown(np.array(list(_BODY.values())))))
    third = {"--calibration": tmp_path / "k.json", "--photo-iii": body}
    assert _run(third, "--true", tmp_path / "again.csv") == 0
    first, again = _read_true(tmp_path / "true.csv"), _read_true(tmp_path / "again.csv")
    assert max(abs(first[name][0] - again[name][0]) for name in _BODY) < 0.01
