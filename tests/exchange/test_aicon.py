"""Projects of AICON 3D Studio, written by these tests from the equations of collinearity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.core.errors import FormatError, InputError
from reseau.exchange import read_network

from .scene import residuals, scene

C, XH, YH, A1, A2, A3, R0 = 28.8, 0.02, -0.05, -1.1e-4, 1.5e-7, 2e-11, 13.0
B1, B2, C1, C2 = 6e-6, -9e-6, -7e-5, 3e-5
CAMERA = f"""# camera
1 -999 {-C} {XH} {YH} {A1} {A2} {R0}
  {A3}
  {B1} {B2}
  {C1} {C2}
  36.0 24.0 3600 2400
"""
SCENE = scene()


def projected(xyz: Array) -> Array:
    """Photo-coordinates (m, p, 2) in mm, y up."""
    local = np.einsum("mij,mpj->mpi", SCENE.turns, xyz[None] - SCENE.x0[:, None])
    x, y = C * local[..., 0] / local[..., 2], -C * local[..., 1] / local[..., 2]
    r2 = x**2 + y**2
    radial = A1 * (r2 - R0**2) + A2 * (r2**2 - R0**4) + A3 * (r2**3 - R0**6)
    dx = x * radial + B1 * (r2 + 2 * x**2) + 2 * B2 * x * y + C1 * x + C2 * y
    dy = y * radial + B2 * (r2 + 2 * y**2) + 2 * B1 * x * y
    return np.stack([XH + x + dx, YH + y + dy], axis=-1)


def project(folder: Path, sigma: Array, v: Array) -> Path:
    """The scene as a project, with standard deviations and residuals (m, p, 2) of the image points."""
    seen, own = projected(SCENE.xyz), SCENE.turns * np.array([1.0, -1.0, -1.0])[:, None]
    omega = np.arctan2(-own[:, 2, 1], own[:, 2, 2])
    kappa = np.arctan2(-own[:, 1, 0], own[:, 0, 0])
    angles = np.column_stack([omega, np.arcsin(own[:, 2, 0]), kappa])
    m, p = seen.shape[:2]
    lines = {
        "phc": [
            [i + 1, 10 + j, *(seen[i, j] + v[i, j]), *sigma[i, j], *v[i, j], 1, int(i + j > 0), 1]
            for i in range(m)
            for j in range(p)
        ],
        "obc": [[10 + j, *SCENE.xyz[j], 0.1, 0.2, 0.3, m, int(j != 1), int(j != 2), 0] for j in range(p)],
        "eor": [[i + 1, 1, *SCENE.x0[i], *angles[i], 0, 1, 3] for i in range(m)],
        "scale": [[0, '"the bar"', 12, 13, 1.5, 0.01, 1], [1, '"off"', 12, 14, 1.5, 0.01, 0]],
    }
    for end, rows in lines.items():
        text = "".join(" ".join(str(word) for word in row) + "\n" for row in rows)
        (folder / f"block.{end}").write_text(text)
    (folder / "block.ior").write_text(CAMERA)
    return folder / "block.phc"


def test_points_are_where_the_project_has_them(tmp_path: Path) -> None:
    even = np.full((4, 15, 2), 1e-3)
    network = read_network(project(tmp_path, even, 0 * even))
    np.testing.assert_allclose(residuals(network), 0, atol=1e-9)
    np.testing.assert_allclose(network.cov, np.broadcast_to(0.01 * np.eye(2), network.cov.shape))
    # Point 11 and one image point are not active, point 12 is not new, one scale bar is not active.
    assert len(network.xy) == 4 * 14 - 1
    assert "11" not in network.points
    assert network.role.count("control") == 1
    np.testing.assert_allclose(network.sigma[network.points.index("12")], [0.1, 0.2, 0.3])
    assert [network.points[j] for j in network.distance_of[0]] == ["12", "13"]
    assert network.distance.tolist() == [[1.5, 0.01]]


@pytest.mark.parametrize("equal", [True, False])
def test_weights_are_those_at_whose_minimum_the_residuals_are(equal: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    sigma = 1e-3 * rng.uniform(0.3, 3.0, (4, 15, 2))
    v = 1e-3 * rng.normal(size=(4, 15, 2))
    step = 1e-4 * np.eye(3)
    slope = np.stack([(projected(SCENE.xyz + h) - projected(SCENE.xyz - h)) / 2e-4 for h in step], axis=-1)
    weight = np.ones_like(sigma) if equal else sigma**-2
    for j in range(15):
        a, p = slope[:, j].reshape(-1, 3), weight[:, j].ravel()
        off = np.linalg.solve((a.T * p) @ a, (a.T * p) @ v[:, j].ravel())
        v[:, j] -= (a @ off).reshape(-1, 2)
    network = read_network(project(tmp_path, sigma, v))
    spread = np.sqrt(network.cov[:, 0, 0])
    assert bool(np.ptp(spread) < 1e-12) is equal
    assert bool(network.notes) is equal


@pytest.mark.parametrize(
    ("end", "old", "new", "message"),
    [
        ("eor", " 0 1 3", " 1 1 3", "line 1: has the order of rotations 1"),
        ("obc", " 4 1 1 0", "", "line 1: has 7 of 11 columns"),
        ("ior", "  36.0 24.0 3600 2400\n", "", "five lines for each camera"),
        ("phc", "0.001 0.001", "0 0", "image points without standard deviations"),
    ],
)
def test_what_is_not_as_described_is_refused(
    end: str, old: str, new: str, message: str, tmp_path: Path
) -> None:
    even = np.full((4, 15, 2), 1e-3)
    path = project(tmp_path, even, 0 * even).with_suffix(f".{end}")
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(FormatError, match=message):
        read_network(path)
    path.unlink()
    with pytest.raises(InputError, match="is missing beside"):
        read_network(path.with_suffix(".ior" if end == "obc" else ".obc"))
