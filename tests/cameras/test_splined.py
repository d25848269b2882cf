"""The camera with a spline surface beside SciPy's splines and mrcal; its regularisation; its files."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline

from reseau.bundle import Camera, Network, adjust_network, regularised
from reseau.core.data import Array
from reseau.core.errors import FormatError, UsageError
from reseau.exchange.calibrations import mrcal
from reseau.exchange.calibrations.plain import given
from reseau.io.network import Network1
from reseau.optics import PixelGrid, camera_model
from reseau.optics.cameras.splined import SplinedStereographic, SplineGrid

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
lenses = importlib.import_module("worlds.lenses")

PIXELS = PixelGrid(1280, 960, (1.0, 1.0))
GRIDS = pytest.mark.parametrize("grid", [SplineGrid(3, 16, 11, 120), SplineGrid(2, 12, 9, 100)])


def values_of(grid: SplineGrid) -> Array:
    rng = np.random.default_rng(2)
    return np.array([900.0, 905.0, 640.3, 477.9, *rng.normal(0, 0.03, 2 * grid.nx * grid.ny)])


def rays(most_deg: float, n: int = 400) -> Array:
    rng = np.random.default_rng(3)
    angle, round_ = np.radians(rng.uniform(0, most_deg, n)), rng.uniform(0, 2 * np.pi, n)
    across = np.column_stack([np.cos(round_), np.sin(round_)]) * np.sin(angle)[:, None]
    return np.column_stack([across, np.cos(angle)])


@GRIDS
def test_the_surface_is_that_of_uniform_b_splines(grid: SplineGrid) -> None:
    """Basis functions of SciPy, each symmetric about its control point."""
    values, x = values_of(grid), rays(35.0)
    control = values[4:].reshape(grid.ny, grid.nx, 2)
    u = 2 * x[:, :2] / (1 + x[:, 2:])
    edge = 2 * np.tan(np.deg2rad(grid.fov_x_deg) / 4)
    scale = (grid.nx - grid.order) / (2 * edge)
    basis = []
    for axis, count in ((0, grid.nx), (1, grid.ny)):
        at, found = u[:, axis] * scale + (count - 1) / 2, []
        for k in range(count):
            own = k - (grid.order + 1) / 2 + np.arange(grid.order + 2)
            found.append(np.nan_to_num(BSpline.basis_element(own, extrapolate=False)(at)))
        basis.append(np.array(found))
    moved = u + np.einsum("in,jn,jic->nc", basis[0], basis[1], control)
    expected = moved * values[:2] + values[2:4]
    found_xy = SplinedStereographic(values, grid)(x[:, :2] / x[:, 2:])
    np.testing.assert_allclose(found_xy, expected, rtol=0, atol=1e-9)


@GRIDS
def test_projections_and_files_are_those_of_mrcal(grid: SplineGrid, tmp_path: Path) -> None:
    """mrcal reads the file that is written here, and projects the same to 1e-9 px, also beyond the knots."""
    values, x = values_of(grid), rays(65.0)
    names = camera_model(grid.name).names
    camera = Camera.of("wide", (1280, 960), grid.name, dict(zip(names, values.tolist(), strict=True)))
    path = tmp_path / "wide.cameramodel"
    path.write_text(mrcal.write(camera))
    code = (
        "import json, mrcal, numpy, sys\n"
        f"model = mrcal.cameramodel({str(path)!r})\n"
        "points = numpy.array(json.load(sys.stdin))\n"
        "json.dump(mrcal.project(points, *model.intrinsics()).tolist(), sys.stdout)\n"
    )
    try:
        run = subprocess.run(
            ["/usr/bin/python3", "-c", code], input=json.dumps(x.tolist()), capture_output=True, text=True,
            check=True, env={"PATH": "/usr/bin"},
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("Debian's python3-mrcal is not installed")
    theirs = np.array(json.loads(run.stdout))
    ours = mrcal.read(path.read_text(), path).mapping()(x[:, :2] / x[:, 2:])
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_files_are_read_back_and_damaged_ones_refused(tmp_path: Path) -> None:
    grid = SplineGrid(3, 6, 5, 90)
    values, path = values_of(grid), tmp_path / "a.cameramodel"
    names = camera_model(grid.name).names
    text = mrcal.write(Camera.of("a", (1280, 960), grid.name, dict(zip(names, values.tolist(), strict=True))))
    assert "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=6_Ny=5_fov_x_deg=90" in text
    again = mrcal.read(text, path)
    assert again.model == grid.name
    np.testing.assert_array_equal(given(again, *names), values)
    with pytest.raises(FormatError, match="has 64 intrinsics, not the 74"):
        mrcal.read(text.replace("Nx=6", "Nx=7"), path)
    with pytest.raises(FormatError, match="needs an order of 2 or 3"):
        mrcal.read(text.replace("order=3", "order=5"), path)
    plain = mrcal.read(
        mrcal.write(Camera.of("a", (1280, 960), "stereographic", {"fx": 800.0, "fy": 800.0})), path
    )
    assert plain.model == "stereographic"


def test_directions_are_found_again() -> None:
    grid = SplineGrid(3, 16, 11, 120)
    values = values_of(grid)
    values[4:] /= 10
    camera, x = SplinedStereographic(values, grid), rays(50.0)
    uv = x[:, :2] / x[:, 2:]
    np.testing.assert_allclose(camera.inverse(camera(uv)), uv, rtol=0, atol=1e-10)


def test_names_with_a_grid_are_models() -> None:
    model = camera_model("splined_stereographic_order=2_Nx=7_Ny=6_fov_x_deg=80")
    assert len(model.names) == 4 + 84
    assert model.units["ux_0_0"] == "rad"
    assert model.priors(["ux_0_0", "fx"]) == {"ux_0_0": 0.1}
    with pytest.raises(UsageError, match="needs an order of 2 or 3"):
        camera_model("splined_stereographic_order=4_Nx=7_Ny=6_fov_x_deg=80")
    with pytest.raises(UsageError, match="is unknown"):
        camera_model("splined_stereographic_order=3")


@pytest.mark.slow
def test_corners_without_image_points_are_reported_as_regularised() -> None:
    """Nothing was observed in the lower right; the other parts are determined by the image points."""
    lens = lenses.fisheye(45)
    flat, _ = lenses.board(8, 6, 1.0)
    seen = [
        (rows[own], xy[own])
        for rows, xy in lenses.views(lens, flat, flat, 24, 0.1, 3, whole=False)
        if (own := (xy < [700, 500]).any(axis=1)).sum() > 10
    ]
    f = float(lens.matrix[0, 0])
    start = {"fx": f, "fy": f, "cx": (lens.width - 1) / 2, "cy": (lens.height - 1) / 2}
    model = "splined_stereographic_order=3_Nx=10_Ny=8_fov_x_deg=90"
    free = list(camera_model(model).usual)
    document = lenses.document(lens, flat, seen, start, free, 0.1, model)
    network = Network.from_document(Network1.from_content(json.loads(json.dumps(document)), where="test"))
    result = adjust_network(network).required()
    found = regularised(result, 0)
    assert found is not None
    assert found.regions["lower right"] > 0.5
    assert not {"middle", "left", "upper", "upper left"} & set(found.regions)
    assert found.where_observed < 0.2
    assert found.largest > 20 * np.median(found.sigma[found.observed])
    (told,) = [remark for remark in result.warnings if "regularisation" in str(remark)]
    assert "lower right" in str(told)


@pytest.mark.slow
def test_a_calibration_follows_a_lens_that_no_polynomial_describes() -> None:
    """Board views drawn by OpenCV through a fisheye lens; what the regularisation contributes is stated."""
    lens = lenses.fisheye(50)
    flat, _ = lenses.board(10, 8, 1.0)
    seen = lenses.views(lens, flat, flat, 16, 0.1, 4)
    f = float(lens.matrix[0, 0])
    start = {"fx": f, "fy": f, "cx": (lens.width - 1) / 2, "cy": (lens.height - 1) / 2}
    model = "splined_stereographic_order=3_Nx=12_Ny=9_fov_x_deg=115"
    free = list(camera_model(model).usual)
    document = lenses.document(lens, flat, seen, start, free, 0.1, model)
    document["cameras"][0]["sigma"] = dict.fromkeys(free, 0.1)
    network = Network.from_document(Network1.from_content(json.loads(json.dumps(document)), where="test"))
    result = adjust_network(network).required()
    assert result.fit.usable.images.all()
    influence = result.priors(0)
    assert influence is not None
    # Not all parameters can be determined by the images: rotations, and cells without points.
    assert 0.3 * len(free) < influence.determined < len(free) - 3
    assert influence.sigma0 == pytest.approx(1.0, abs=0.08)
    assert result.sigma0 < influence.sigma0
    assert ((influence.share >= 0) & (influence.share <= 1)).all()
    assert (influence.sigma_images <= influence.sigma * (1 + 1e-9)).all()
    blind = influence.share > 0.999
    assert (influence.sigma_images[blind] < 0.05 * influence.sigma[blind]).all()
    # The camera agrees with the true one where there are observations, after a rotation.
    x = lens_rays(lens, seen)
    off = difference(result.network.cameras[0].bare_mapping(result.fit.values.cameras[0]), lens, x)
    # At the rim of the observed part the surface is uncertain.
    assert np.median(np.hypot(*off.T)) < 0.04
    assert np.quantile(np.hypot(*off.T), 0.95) < 0.2


def lens_rays(lens: object, seen: list[tuple[Array, Array]]) -> Array:
    """Rays whose images are in cells with observations."""
    x = rays(48.0, 4000)
    image = lens.project(x)  # type: ignore[attr-defined]
    x, image = x[np.isfinite(image).all(axis=1)], image[np.isfinite(image).all(axis=1)]
    every = np.concatenate([xy for _, xy in seen])
    cells = {tuple(cell) for cell in (every // 60).astype(int).tolist()}
    return x[[tuple(cell) in cells for cell in (image // 60).astype(int).tolist()]]


def difference(mapping: object, lens: object, x: Array) -> Array:
    """Differences (n, 2) of image points after the best rotation, by Gauss–Newton with differences."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    image = lens.project(x)  # type: ignore[attr-defined]

    def off(w: Array) -> Array:
        turned = Rotation.from_rotvec(w).apply(x)
        return np.asarray(mapping(turned[:, :2] / turned[:, 2:]) - image).ravel()  # type: ignore[operator]

    return np.asarray(least_squares(off, np.zeros(3)).fun).reshape(-1, 2)
