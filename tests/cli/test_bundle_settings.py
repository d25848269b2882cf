"""`reseau bundle`: what a user sets beside the network file, and networks as other programs write them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from .test_bundle import content

Run = Callable[..., tuple[int, str, str]]
DATA = Path(os.environ.get("RESEAU_DATA", "../shared/data"))
EXPORTS = DATA / "independent" / "networks"


@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "network.json"
    path.write_text(json.dumps(content()))
    return path


def test_parameters_are_freed_and_fixed(reseau: Run, network: Path) -> None:
    status, out, err = reseau("bundle", network, "--free", "K2", "--fix", "x0,y0", "--json")
    assert (status, err) == (0, "")
    names = json.loads(out)["cameras"][0]["correlation"]["names"]
    assert names == ["c", "K1", "K2"]
    status, out, _ = reseau("bundle", network, "--fix", "all", "--json")
    assert json.loads(out)["cameras"][0]["correlation"]["names"] == []
    assert "all" in json.dumps(json.loads(out)["provenance"])


def test_control_in_a_file_of_its_own_held_and_weighted(reseau: Run, tmp_path: Path) -> None:
    """The same result as with the control in the network; sigmas make observations."""
    document = content()
    network, control = tmp_path / "network.json", tmp_path / "control.txt"
    network.write_text(json.dumps(document))
    _, out, _ = reseau("bundle", network, "--json")
    inside = json.loads(out)
    points = document["points"]
    rows = [(name, *xyz) for name, xyz in zip(points["id"], points["xyz"], strict=True) if xyz is not None]
    control.write_text("# id X Y Z\n" + "\n".join(" ".join(map(str, row)) for row in rows))
    free = document | {
        "datum": "free",
        "points": points | {"xyz": [None] * 15, "sigma": [None] * 15, "role": ["tie"] * 15},
    }
    network.write_text(json.dumps(free))
    status, out, err = reseau("bundle", network, "--control", control, "--json")
    assert (status, err) == (0, "")
    beside = json.loads(out)
    np.testing.assert_allclose(beside["points"]["xyz"], inside["points"]["xyz"], atol=1e-6)
    assert "control.txt" in beside["provenance"]["inputs"]
    table = [",".join(map(str, (*row, 0.002, 0.002, 0.004))) for row in rows]
    control.write_text("id,x,y,z,sx,sy,sz\n" + "\n".join(table))
    _, out, _ = reseau("bundle", network, "--control", control, "--json")
    weighted = json.loads(out)
    assert weighted["observations"] == inside["observations"] + 3 * len(rows)
    assert weighted["redundancy"] == inside["redundancy"]


@pytest.mark.slow
def test_one_sigma_for_all_image_coordinates_and_another_datum(reseau: Run, network: Path) -> None:
    _, out, _ = reseau("bundle", network, "--datum", "free", "--json")
    free = json.loads(out)
    assert free["constraints"] == 7
    _, out, _ = reseau("bundle", network, "--datum", "free", "--sigma-px", "0.1", "--json")
    twice = json.loads(out)
    assert twice["sigma0"] == pytest.approx(free["sigma0"] / 2, rel=1e-6)


def test_a_network_beyond_the_memory_is_solved_by_conjugate_gradients(reseau: Run, network: Path) -> None:
    status, out, err = reseau("bundle", network, "--datum", "free", "--memory-gb", "0", "--json")
    assert status == 0, err
    found = json.loads(out)
    assert "conjugate gradients" in json.dumps(found["warnings"])
    assert found["provenance"]["options"]["memory_gb"] == 0.0
    _, out, _ = reseau("bundle", network, "--datum", "free", "--json")
    whole = json.loads(out)
    assert "conjugate gradients" not in json.dumps(whole["warnings"])
    assert "memory_gb" not in whole["provenance"]["options"]
    one, other = found["cameras"][0]["parameters"], whole["cameras"][0]["parameters"]
    assert list(one) == list(other)
    for name, entry in other.items():
        assert one[name]["value"] == pytest.approx(entry["value"], abs=1e-4 * (entry["sigma"] or 1.0))
        # What the points of an image have in common is not looked for in networks of this size.
        assert 0.9 * entry["sigma"] <= one[name]["sigma"] <= 1.0001 * entry["sigma"]


def test_a_network_is_converted_with_its_settings(reseau: Run, network: Path, tmp_path: Path) -> None:
    target = tmp_path / "converted.json"
    status, out, err = reseau("bundle", network, "--free", "K2", "--convert", target)
    assert (status, out, err) == (0, "", "")
    assert json.loads(target.read_text())["cameras"][0]["free"] == ["c", "x0", "y0", "K1", "K2"]
    results = [reseau("bundle", network, "--free", "K2", "--json"), reseau("bundle", target, "--json")]
    one, other = (json.loads(result[1]) for result in results)
    assert one["sigma0"] == other["sigma0"]


@pytest.mark.slow
def test_a_list_of_all_datum_points_means_all_points(reseau: Run, tmp_path: Path) -> None:
    """Without a list weak points are left out of the datum; with one the choice is that of the user."""
    document = content() | {"datum": "free"}
    points = document["points"]
    points |= {"xyz": [None] * 15, "sigma": [None] * 15, "role": ["tie"] * 15}
    path = tmp_path / "network.json"
    weak = points["id"][2]
    table = document["observations"]
    keep = [
        k for k, (i, j) in enumerate(zip(table["image"], table["point"], strict=True))
        if j != weak or i in ("i0", "i3")
    ]  # fmt: skip
    document["observations"] = {key: [column[k] for k in keep] for key, column in table.items()}
    document["datum_points"] = points["id"]
    path.write_text(json.dumps(document))
    status, out, _ = reseau("bundle", path, "--json")
    assert status == 0
    found = json.loads(out)
    assert not any("left out of the datum" in warning for warning in found["warnings"])
    sigma = np.array(found["points"]["sigma"])
    document["datum_points"] = [name for name in points["id"] if name != weak]
    path.write_text(json.dumps(document))
    other = np.array(json.loads(reseau("bundle", path, "--json")[1])["points"]["sigma"])
    # Inner constraints minimise the sum of the variances of their points.
    assert (sigma**2).sum() < (other**2).sum()


def test_a_key_twice_is_an_error_and_a_byte_order_mark_is_not(reseau: Run, network: Path) -> None:
    text = network.read_text()
    network.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert reseau("bundle", network, "--json")[0] == 0
    network.write_text(text.replace('"unit"', '"unit": "mm", "unit"', 1))
    status, out, err = reseau("bundle", network)
    assert (status != 0, out) == (True, "")
    assert "the key `unit` appears twice" in err
    assert err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.skipif(not EXPORTS.exists(), reason="needs the networks of RESEAU_DATA")
@pytest.mark.parametrize(("name", "c"), [("net1-C404Z-2d.txt", 7.4583), ("net4-canon7d-3d.txt", 20.6817)])
def test_exports_of_photomodeler_as_users_send_them(name: str, c: float, reseau: Run) -> None:
    """Marks without an object point; marks whose sigma is 0, that is, not set."""
    status, out, err = reseau("bundle", EXPORTS / name, "--json")
    assert (status, err) == (0, "")
    found = json.loads(out)["cameras"][0]["parameters"]["c"]
    assert abs(found["value"] - c) < 3 * found["sigma"] + 1e-4


def export_by_hand(sigmas: str = "0 0 0 0 0 0 0 0 0 0", name: str = "a") -> list[str]:
    """Lines of an export: a mark of no point, sigmas of marks of 0."""
    camera = "35.0 18.0 12.0 36.0 24.0 0 0 0 0 0"
    lines = ["title", "1e-6 20 3600 2400", "1", camera, sigmas]
    for i, x in enumerate((-300.0, 0.0, 300.0)):
        lines += [f"{i} {name}{i}.jpg", f"{i} {x} {40.0 * i} 1000 0 0 {5.0 * i}", f"{i} 0 0 0 0 0 0", "",
                  f"{i} {camera}", f"{i} {sigmas}"]  # fmt: skip
    lines += ["", *(f"{j} {100 * (j % 3)} {100 * (j // 3)} {20 * (j % 2)} 1 1 1" for j in range(9)), ""]
    lines += [
        f"{i} {j} {1800 + 100 * (j % 3)} {1200 - 90 * (j // 3)} 0 0" for i in range(3) for j in range(9)
    ]
    return [*lines, "0 99 15.0 20.0 0 0"]


@pytest.mark.parametrize(
    ("sigmas", "free"),
    [
        ("0 0 0 0 0 0 0 0 0 0", []),
        ("0 0.02 0.01 0.5 0.5 1e-3 1e-4 1e-4 1e-3 1e-3", ["c", "x0", "y0", "K1", "K2", "K3", "P1", "P2"]),
    ],
)
def test_the_exports_need_no_line_that_is_not_there(
    sigmas: str, free: list[str], reseau: Run, tmp_path: Path
) -> None:
    """The observations that remain are counted; a camera without sigmas is fixed in the project."""
    path, target = tmp_path / "block.txt", tmp_path / "network.json"
    path.write_text("\n".join(export_by_hand(sigmas)))
    status, out, err = reseau("bundle", path, "--convert", target)
    assert (status, out, err) == (0, "", "")
    document = json.loads(target.read_text())
    assert len(document["observations"]["x"]) == 27
    assert set(document["observations"]["sx"]) == {1.0}
    assert document["cameras"][0]["free"] == free


def test_exports_name_files_in_the_encoding_of_their_time(reseau: Run, tmp_path: Path) -> None:
    path, target = tmp_path / "block.txt", tmp_path / "network.json"
    path.write_text("\n".join(export_by_hand(name="débruité")), "latin-1")
    assert reseau("bundle", path, "--convert", target) == (0, "", "")
    assert json.loads(target.read_text())["images"]["file"][1] == "débruité1.jpg"


def test_an_export_without_the_size_of_the_images_says_what_is_missing(reseau: Run, tmp_path: Path) -> None:
    path = tmp_path / "block.txt"
    path.write_text("\n".join(["title", "1e-6 20", *export_by_hand()[2:]]))
    status, _, err = reseau("bundle", path)
    assert status != 0
    assert "line 2 lacks the size of the images" in err
    assert err.count("\n") == 1
