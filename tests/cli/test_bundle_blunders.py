"""`reseau bundle` with what is wrong in a network: found and named, or refused; what it says of quality."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.optics import Brown, PixelGrid
from reseau.optics.poses import Pose, project

from ..bundle.networks import points_of
from ..montecarlo import slowly
from .test_bundle import looking_at

Run = Callable[..., tuple[int, str, str]]
SIGMA = 0.05
CONTROL = (0, 1, 2, 3, 4, 5)
PARTS = pytest.mark.parametrize("part", [0.2, *slowly(0.01, 0.05, 0.1)])
"""Of the observations that are wrong."""


def block(factors: tuple[float, float] = (1.0, 1.0), rho: float = 0.0, seed: int = 3) -> dict[str, Any]:
    """Eight images of sixty points, six of them control; noise of `factors` times the sigma given."""
    rng = np.random.default_rng(seed)
    camera = Brown(grid=PixelGrid(640, 480, (0.01, 0.01))).with_values({"c": 8.0, "x0": 0.02, "K1": 1e-3})
    xyz = rng.uniform(-1, 1, (60, 3)) * [1.0, 0.8, 0.4] + [0.0, 0.0, 0.4]
    table: dict[str, list[Any]] = {key: [] for key in ("image", "point", "x", "y", "sx", "sy", "rho")}
    root = np.linalg.cholesky(np.array([[1.0, rho], [rho, 1.0]])) * SIGMA
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, 8, endpoint=False)):
        x0 = np.array([3.2 * np.cos(angle), 3.2 * np.sin(angle), 3.4 + 0.4 * (i % 3)])
        pose = Pose(looking_at(x0, 1.3 * i), x0)
        for j, xy in enumerate(project(camera, pose, xyz).xy):
            if (np.abs(xy - [319.5, 239.5]) < [319, 239]).all():
                u, v = (xy + np.array(factors) * (root @ rng.normal(size=2))).tolist()
                row = (f"i{i}", f"p{j}", u, v, SIGMA, SIGMA, rho)
                for key, value in zip(table, row, strict=True):
                    table[key].append(value)
    return {
        "schema": "reseau-network/1", "unit": "m",
        "cameras": [{"id": "cam", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01], "model": "brown",
                     "side": "object", "parameters": {"c": 7.8}, "free": ["c", "x0", "y0", "K1"]}],
        "images": {"id": [f"i{i}" for i in range(8)], "camera": ["cam"] * 8, "X0": [None] * 8,
                   "rotation": [None] * 8},
        "points": {"id": [f"p{j}" for j in range(60)],
                   "xyz": [xyz[j].tolist() if j in CONTROL else None for j in range(60)],
                   "sigma": [[0, 0, 0] if j in CONTROL else None for j in range(60)],
                   "role": ["control" if j in CONTROL else "tie" for j in range(60)]},
        "observations": table, "datum": "control",
    }  # fmt: skip


def written(tmp_path: Path, document: dict[str, Any]) -> Path:
    path = tmp_path / "block.json"
    path.write_text(json.dumps(document))
    return path


def said(status: int, out: str, err: str) -> str:
    """The warnings of a result, or the one line of a refusal."""
    assert "Traceback" not in err
    if status not in (0, 3):
        assert err.count("\n") == 1
        return err
    return " | ".join(json.loads(out)["warnings"])


@pytest.mark.slow
@PARTS
def test_gross_errors_are_rejected_and_listed_with_their_test_values(
    part: float, reseau: Run, tmp_path: Path
) -> None:
    document, rng = block(), np.random.default_rng(int(100 * part))
    table = document["observations"]
    n = len(table["x"])
    bad = rng.choice(n, int(part * n), replace=False)
    for k in bad:
        table["x"][k] += float(rng.uniform(5, 60) * rng.choice([-1, 1]))
        table["y"][k] += float(rng.uniform(5, 60) * rng.choice([-1, 1]))
    status, out, _ = reseau("bundle", written(tmp_path, document), "--reject", "--json")
    assert status == 0
    found = json.loads(out)
    rejected = {k for k, r in enumerate(found["image_points"]["rejected"]) if r}
    r = np.array([[np.nan if v is None else v for v in found["image_points"][key]] for key in ("rx", "ry")])
    uncontrolled = set(np.flatnonzero(~(np.nansum(r, axis=0) > 0.1)).tolist())
    assert set(bad.tolist()) <= rejected | uncontrolled
    assert len(rejected - set(bad.tolist())) <= 0.02 * n
    assert 0.85 < found["sigma0"] < 1.1
    left = found["left_out"]
    assert len(left["w"]) == len(rejected)
    assert all(value > critical > 3 for value, critical in zip(left["w"], left["critical"], strict=True))
    status, out, _ = reseau("bundle", tmp_path / "block.json", "--reject")
    k = int(bad[0])
    line = f"left out: point {table['point'][k]} in image {table['image'][k]}, test value "
    assert line in out or k in uncontrolled


@pytest.mark.slow
@PARTS
def test_gross_errors_that_are_kept_are_named(part: float, reseau: Run, tmp_path: Path) -> None:
    document, rng = block(), np.random.default_rng(7)
    table = document["observations"]
    bad = rng.choice(len(table["x"]), int(part * len(table["x"])), replace=False)
    for k in bad:
        table["y"][k] += float(rng.uniform(20, 60) * rng.choice([-1, 1]))
    words = said(*reseau("bundle", written(tmp_path, document), "--json"))
    listed = words.partition("gross errors are likely ")[2].partition(" | ")[0].partition("; and ")[0]
    names = {(table["image"][k], table["point"][k]) for k in bad}
    named = points_of(listed)
    assert named
    # Nothing among the worst that is not wrong; where all can be listed, all are.
    assert set(named) <= names
    assert len(named) == min(8, len(bad))


@pytest.mark.slow
def test_swapped_point_names_are_named_and_rejected(reseau: Run, tmp_path: Path) -> None:
    document = block()
    table = document["observations"]
    rows = [k for k, image in enumerate(table["image"]) if image == "i5"][20:22]
    a, b = rows
    table["point"][a], table["point"][b] = table["point"][b], table["point"][a]
    names = {("i5", table["point"][k]) for k in rows}
    words = said(*reseau("bundle", written(tmp_path, document), "--json"))
    assert names <= points_of(words.partition("gross errors are likely ")[2].partition(" | ")[0])
    status, out, _ = reseau("bundle", tmp_path / "block.json", "--reject", "--json")
    assert status == 0
    found = json.loads(out)
    assert set(rows) <= {k for k, r in enumerate(found["image_points"]["rejected"]) if r}
    assert found["sigma0"] < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("axis", [1, *slowly(0, 2)])
def test_mirrored_control_is_reported(axis: int, reseau: Run, tmp_path: Path) -> None:
    document = block()
    for j in CONTROL:
        document["points"]["xyz"][j][axis] *= -1
    assert "mirrored" in said(*reseau("bundle", written(tmp_path, document), "--json"))


@pytest.mark.slow
@pytest.mark.parametrize("pair", [(0, 1), *slowly(((2, 5),))])
def test_a_swapped_pair_of_control_points_is_named(
    pair: tuple[int, int], reseau: Run, tmp_path: Path
) -> None:
    document = block()
    xyz = document["points"]["xyz"]
    xyz[pair[0]], xyz[pair[1]] = xyz[pair[1]], xyz[pair[0]]
    words = said(*reseau("bundle", written(tmp_path, document), "--json"))
    assert f"control points p{pair[0]} and p{pair[1]} look exchanged" in words


@pytest.mark.slow
def test_a_mirrored_control_point_is_named(reseau: Run, tmp_path: Path) -> None:
    document = block()
    document["points"]["xyz"][3][0] *= -1
    words = said(*reseau("bundle", written(tmp_path, document), "--json"))
    assert "control point p3 (by 1.55 m, w " in words


def test_an_image_with_two_points_and_a_camera_without_image_are_named(reseau: Run, tmp_path: Path) -> None:
    document = block()
    table = document["observations"]
    seen = [k for k, image in enumerate(table["image"]) if image == "i6"]
    drop = set(seen[2:])
    for key in table:
        table[key] = [value for k, value in enumerate(table[key]) if k not in drop]
    document["cameras"].append(document["cameras"][0] | {"id": "idle"})
    words = said(*reseau("bundle", written(tmp_path, document), "--json"))
    assert "image i6 has fewer than three points; left out" in words
    assert "camera idle has no image" in words


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_variance_components_distinguish_rows_from_columns(rho: float, reseau: Run, tmp_path: Path) -> None:
    """True sigmas of 1.0 and 1.8 times those given, whatever the correlation."""
    path = written(tmp_path, block((1.0, 1.8), rho))
    status, out, _ = reseau("bundle", path, "--components", "axes", "--json")
    assert status == 0
    found = json.loads(out)
    parts = found["variance_components"]
    assert parts["names"] == ["x", "y"]
    for factor, sigma, true in zip(parts["factors"], parts["sigma"], (1.0, 1.8), strict=True):
        assert abs(factor - true) < 3 * sigma
        assert sigma < 0.08
    assert found["sigma0"] == pytest.approx(1.0, abs=1e-3)
    status, out, _ = reseau("bundle", path, "--json")
    assert "y scatters 1." in " ".join(json.loads(out)["warnings"])


@pytest.mark.slow
def test_an_image_with_larger_scatter_is_named_with_its_factor(reseau: Run, tmp_path: Path) -> None:
    document, rng = block(), np.random.default_rng(1)
    table = document["observations"]
    for k, image in enumerate(table["image"]):
        if image == "i2":
            table["x"][k] += 2.8 * SIGMA * rng.normal()
            table["y"][k] += 2.8 * SIGMA * rng.normal()
    path = written(tmp_path, document)
    status, out, _ = reseau("bundle", path, "--json")
    found = json.loads(out)
    assert "in image i2 (" in " ".join(found["warnings"])
    factors = np.array(found["images"]["factors"])
    assert (factors[2] > 1.8).all()
    assert (np.delete(factors, 2, axis=0) < 1.6).all()
    status, out, _ = reseau("bundle", path, "--components", "images")
    assert status == 0
    assert "sigmas of image i2 times " in out


def test_reliability_is_in_columns(reseau: Run, tmp_path: Path) -> None:
    """The error that is found: 4.13 σ / √r, what it does at most: 4.13 √((1 − r)/r), without correlations."""
    _, out, _ = reseau("bundle", written(tmp_path, block()), "--json")
    table = json.loads(out)["image_points"]
    r, least, effect = (np.array(table[key]) for key in ("rx", "mx", "ex"))
    np.testing.assert_allclose(least, 4.1321 * SIGMA / np.sqrt(r), rtol=1e-3)
    np.testing.assert_allclose(effect, 4.1321 * np.sqrt((1 - r) / r), rtol=1e-3)


@pytest.mark.slow
def test_unnecessary_parameters_are_dropped_and_cross_validated(reseau: Run, tmp_path: Path) -> None:
    document = block()
    document["cameras"][0]["free"] += ["K2", "K3", "P1", "P2", "B1", "B2"]
    path, report = written(tmp_path, document), tmp_path / "report.html"
    status, out, _ = reseau("bundle", path, "--eliminate", 0.001, "--json", "--report", report)
    assert status == 0
    found = json.loads(out)
    assert {step["name"] for step in found["eliminated"]} == {"K2", "K3", "P1", "P2", "B1", "B2"}
    assert found["cross_validation"]["kept"] < found["cross_validation"]["all"]
    assert "Dropped parameters" in report.read_text()
    status, out, _ = reseau("bundle", path, "--eliminate", 0.001)
    assert "dropped: B1 of camera cam" in out
    assert "cross-validation" in out
