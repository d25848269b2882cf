"""`reseau bundle` with windows and media in the network."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.bundle import ResultDocument
from reseau.io.network import Network1
from reseau.optics import Brown, PixelGrid
from reseau.optics.poses import rotation_matrix
from reseau.optics.refraction import RefractedRays

from .test_bundle import content, looking_at

Run = Callable[..., tuple[int, str, str]]

REFRACTION: dict[str, Any] = {
    "media": {"air": 1.0, "glass": 1.52, "water": {"index": 1.33, "free": True, "sigma": 0.01}},
    "windows": [
        {"id": "surface", "shape": "plane", "on": "object", "direction": [0, 0, -1],
         "parameters": {"distance": -1.5}, "free": ["tilt_X", "distance"], "media": ["air", "water"]},
    ],
}  # fmt: skip


def behind_water(distance: float = -1.45, index: float = 1.334) -> dict[str, Any]:
    """The network of :func:`content` under water, with another level and index than given."""
    rng, document = np.random.default_rng(3), content(0.0)
    document["refraction"] = json.loads(json.dumps(REFRACTION))
    true = json.loads(json.dumps(document))
    true["refraction"]["windows"][0]["parameters"]["distance"] = distance
    true["refraction"]["media"]["water"] = index
    entry = Network1.parse(json.dumps(true), where="network")
    assert entry.refraction is not None
    refraction = entry.refraction.refraction(entry.images.id, entry.images.camera)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-0.7, 0.7, 3)))
    xyz = np.column_stack([x, y, 0.3 * ((np.arange(15) * 7) % 4)])
    x0 = np.array([(-2.2, -1.8, 4.0), (2.3, -1.6, 4.3), (2.0, 2.1, 3.8), (-1.9, 2.0, 4.4)])
    turn = rotation_matrix(np.array([looking_at(at, 1.5 * i) for i, at in enumerate(x0)]))
    camera = Brown(grid=PixelGrid(640, 480, (0.01, 0.01))).with_values({"c": 8.0, "x0": 0.02, "K1": 1e-3})
    table = document["observations"]
    image = np.array([int(name[1:]) for name in table["image"]])
    point = np.array([int(name[1:]) for name in table["point"]])
    rays = RefractedRays.of(
        refraction.columns(refraction.values), refraction.path_of, turn, x0, xyz, image, point
    )
    assert rays.reached.all()
    xy = camera(rays.uv) + 0.05 * rng.normal(size=(len(image), 2))
    table["x"], table["y"] = xy[:, 0].tolist(), xy[:, 1].tolist()
    return document


@pytest.fixture
def network(tmp_path: Path) -> Callable[[dict[str, Any]], Path]:
    def write(document: dict[str, Any]) -> Path:
        path = tmp_path / "network.json"
        path.write_text(json.dumps(document))
        return path

    return write


def test_windows_and_media_are_estimated_from_the_command_line(
    reseau: Run, network: Callable[..., Path], tmp_path: Path
) -> None:
    path = network(behind_water())
    status, out, err = reseau("bundle", path, "-o", tmp_path / "r.json", "--report", tmp_path / "r.html")
    assert (status, err) == (0, "")
    assert "windows and media\n" in out
    assert "differs from -1.5" in out
    found = ResultDocument.read(tmp_path / "r.json")
    assert found.refraction is not None
    level = found.refraction.parameters["distance of surface"]
    assert abs(level.value + 1.45) < 4 * level.sigma < 0.1
    assert found.refraction.given["distance of surface"] == -1.5
    assert found.refraction.tests["distance of surface"].significant
    assert not found.refraction.tests["tilt_X of surface"].significant
    assert found.refraction.parameters["tilt_Y of surface"].sigma == 0.0
    assert set(found.refraction.partners) == {
        "tilt_X of surface",
        "distance of surface",
        "index of water",
    }
    assert "Windows and media" in (tmp_path / "r.html").read_text()


@pytest.mark.slow
def test_without_the_water_the_global_test_fails(reseau: Run, network: Callable[..., Path]) -> None:
    document = behind_water()
    del document["refraction"]
    status, out, _ = reseau("bundle", network(document), "--json")
    assert status == 3
    assert any("which chance does not explain" in warning for warning in json.loads(out)["warnings"])


def test_images_in_air_and_paths_of_single_images_can_be_named(
    reseau: Run, network: Callable[..., Path]
) -> None:
    document = content()
    document["refraction"] = REFRACTION | {"through": {"cameras": {}, "images": {}}}
    status, out, _ = reseau("bundle", network(document), "--json")
    assert status == 0
    assert 0.6 < json.loads(out)["sigma0"] < 1.4


def change(*keys: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    def apply(document: dict[str, Any]) -> None:
        part = document
        for key in keys[:-1]:
            part = part[key]
        part[keys[-1]] = to

    return apply


REFUSED = {
    "an unknown medium": (change("windows", 0, "media", to=["air", "oil"]), "'oil'"),
    "an unknown shape": (change("windows", 0, "shape", to="cone"), "shape"),
    "an unknown parameter": (change("windows", 0, "free", to=["height"]), "'height'"),
    "an unknown window": (change("through", to={"cameras": {"cam": ["x"]}}), "'x'"),
    "an unknown camera": (change("through", to={"cameras": {"y": ["surface"]}}), "'y'"),
    "an unknown image": (change("through", to={"images": {"z": []}}), "'z'"),
    "an index of zero": (change("media", "water", to=0.0), "refractive index"),
    "a medium without an index": (change("media", "water", to={"free": True}), "`index`"),
    "a medium without a wavelength": (change("media", "water", to={"medium": "N-BK7"}), "belong together"),
    "a window twice": (change("windows", to=2 * REFRACTION["windows"]), "twice"),
    "a pane of no thickness": (change("windows", 0, "media", to=["air", "glass", "water"]), "thickness"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_window_is_refused_in_one_line(
    case: str, reseau: Run, network: Callable[..., Path]
) -> None:
    document = behind_water()
    apply, words = REFUSED[case]
    apply(document["refraction"])
    status, out, err = reseau("bundle", network(document), "--json")
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert words in err


def test_the_refraction_is_read_back_as_it_was_written() -> None:
    document = Network1.parse(json.dumps(behind_water()), where="network")
    assert Network1.parse(document.to_json(), where="network") == document
