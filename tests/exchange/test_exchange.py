"""Files of other programs: what they hold, their diagnosis, and their mistakes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reseau.bundle import Network, Result, adjust_network
from reseau.core.errors import FormatError, InputError
from reseau.core.failure import Code
from reseau.exchange.colmap import read_colmap
from reseau.exchange.networks import read_foreign
from reseau.io.network import Network1
from reseau.optics import OpenCV
from reseau.optics.poses import Pose, project

Find = Callable[[str], Path]


def held(network: Network) -> Network:
    """camcal with its four control points held, as its control file says."""
    control = np.isin(network.points, ["1001", "1002", "1003", "1004"])
    sigma = np.where(control[:, None], 0.0, np.nan) * np.ones(3)
    return replace(network, sigma=sigma, datum="control")


def test_the_export_of_photomodeler_is_the_published_network(reference_data: Find) -> None:
    export = read_foreign(reference_data("networks/camcal-pmexport-1ray.txt"))
    ours = Network.from_document(Network1.read(reference_data("networks/camcal.network.json")))
    assert export.images == ours.images
    theirs = {
        (export.images[i], export.points[j]): k
        for k, (i, j) in enumerate(zip(export.image_of, export.point_of, strict=True))
    }
    rows = [
        theirs.get((ours.images[i], ours.points[j]), -1)
        for i, j in zip(ours.image_of, ours.point_of, strict=True)
    ]
    found = np.array(rows) >= 0
    # Point 88 was taken out of all images but one.
    assert found.sum() == len(export.xy) == 2058
    np.testing.assert_allclose(export.xy[np.array(rows)[found]], ours.xy[found], rtol=0, atol=1e-9)
    assert len(export.cameras) == 1


def test_a_point_with_a_single_ray_is_named(reference_data: Find) -> None:
    """Published diagnosis: deficiency 1, the depth of point 88."""
    result = adjust_network(held(read_foreign(reference_data("networks/camcal-pmexport-1ray.txt"))))
    assert isinstance(result, Result)
    said = [w.text for w in result.warnings if w.code is Code.RANK_DEFECT]
    assert len(said) == 1
    assert "rank defect 1" in said[0]
    assert "point 88 " in said[0]
    assert result.redundancy == 4116 - 2 - (8 + 126 + 285)


def test_points_in_no_image_are_named(reference_data: Find) -> None:
    """Published diagnosis: deficiency 6, points 13 and 60."""
    result = adjust_network(held(read_foreign(reference_data("networks/camcal-pmexport-missing-obs.txt"))))
    assert isinstance(result, Result)
    said = [w.text for w in result.warnings if w.code is Code.RANK_DEFECT]
    assert len(said) == 1
    assert "rank defect 6: points 13, 60 are in no image" in said[0]
    assert result.redundancy == 4064 - (8 + 126 + 282)


def test_bal_starts_at_its_published_cost(reference_data: Find) -> None:
    network = read_foreign(reference_data("networks/bal-ladybug-49.txt"))
    assert (len(network.images), len(network.points), len(network.xy)) == (49, 7776, 31843)
    from reseau.bundle import problem_of

    problem, _ = problem_of(network, None)
    fit = replace(problem, max_iterations=1).adjusted()
    assert 0.5 * fit.costs[0] == pytest.approx(8.509124607e5, rel=1e-9)


@pytest.mark.slow
def test_bal_is_adjusted_to_the_cost_the_best_solver_reaches(reference_data: Find) -> None:
    from reseau.bundle import problem_of

    problem, _ = problem_of(read_foreign(reference_data("networks/bal-ladybug-49.txt")), None)
    costs: list[float] = []
    replace(problem, max_iterations=60, watch=lambda _, cost: costs.append(cost)).adjusted()
    assert 0.5 * min(costs) <= 1.334433e4


def colmap(folder: Path) -> tuple[Path, np.ndarray]:
    """Two images of six points by an OpenCV camera; the second is moved and turned about x."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-1, -1, 4], [1, 1, 6], (6, 3))
    camera = OpenCV(np.array([500.0, 510.0, 319.5, 239.5, 0.05, 0.0, 0.0, 0.0, 0.0]))
    x0 = np.array([[0.0, 0.0, 0.0], [1.0, 0.2, 0.0]])
    rotation = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
    lines = []
    for i in range(2):
        pose = Pose(rotation[i], x0[i])
        q = [np.cos(rotation[i, 0] / 2), np.sin(rotation[i, 0] / 2), 0, 0]
        t = -pose.matrix @ x0[i]
        lines.append(
            " ".join(map(repr, map(float, [i + 1, *q, *t]))).replace(f"{i + 1}.0 ", f"{i + 1} ", 1)
            + f" 1 image {i}.jpg"
        )
        xy = project(camera, pose, xyz).xy + 0.5
        lines.append(
            " ".join(f"{x!r} {y!r} {10 + j}" for j, (x, y) in enumerate(xy.tolist())) + " 7.0 7.0 -1"
        )
    (folder / "images.txt").write_text("# images\n" + "\n".join(lines) + "\n")
    (folder / "cameras.txt").write_text("# cameras\n1 OPENCV 640 480 500 510 320 240 0.05 0 0 0\n")
    points = [f"{10 + j} {x!r} {y!r} {z!r} 0 0 0 0.1 1 0" for j, (x, y, z) in enumerate(xyz.tolist())]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")
    return folder, xyz


def test_a_colmap_model_projects_to_its_own_features(tmp_path: Path) -> None:
    folder, xyz = colmap(tmp_path)
    network = read_foreign(folder)
    assert network.images == ("image 0.jpg", "image 1.jpg")
    assert network.points == tuple(str(10 + j) for j in range(6))
    np.testing.assert_allclose(network.xyz, xyz)
    poses = Pose(network.rotation[network.image_of], network.x0[network.image_of])
    seen = project(OpenCV(network.cameras[0].values), poses, network.xyz[network.point_of])
    np.testing.assert_allclose(seen.xy, network.xy, rtol=0, atol=1e-9)


def test_errors_are_reported_with_their_line(tmp_path: Path) -> None:
    folder, _ = colmap(tmp_path)
    (folder / "cameras.txt").write_text("1 FISHEYE 640 480 500\n")
    with pytest.raises(FormatError, match=r"cameras.txt: line 1"):
        read_colmap(folder)
    (folder / "points3D.txt").unlink()
    with pytest.raises(InputError):
        read_foreign(tmp_path / "nothing.txt")
    bad = tmp_path / "bad.txt"
    bad.write_text("2 3 4\n0 0 1 1\n")
    with pytest.raises(FormatError, match="numbers"):
        read_foreign(bad)
    bad.write_text("anything\n")
    with pytest.raises(FormatError, match="known"):
        read_foreign(bad)


def test_a_truncated_export_is_refused(reference_data: Find, tmp_path: Path) -> None:
    lines = reference_data("networks/camcal-pmexport-1ray.txt").read_text().splitlines()
    short = tmp_path / "short.txt"
    short.write_text("\n".join(lines[:9]))
    with pytest.raises(FormatError):
        read_foreign(short)
    short.write_text("\n".join([*lines[:300], "  99  1  1.0 2.0 0.1 0.1"]))
    with pytest.raises(FormatError, match="line 301"):
        read_foreign(short)
