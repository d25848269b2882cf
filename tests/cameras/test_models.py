"""One battery for every registered camera model, with two models that are registered here alone.

Each model goes through mapping, kernel, files, bundle, `reseau calibrate`, report and export; none of the
tests knows a model by its name.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import scipy.stats

from reseau.bundle import Camera, Network, Result, adjust_network
from reseau.core.compiled import compiled
from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.core.failure import Failure
from reseau.io.network import CameraEntry, Network1
from reseau.optics import PixelGrid, camera_model, camera_models, convert
from reseau.optics.cameras.kernels import CameraColumns
from reseau.optics.cameras.registry import CameraModel, distortion_names, register_camera, unit_of
from reseau.optics.mapping import PlaneMapping
from reseau_sims import FieldBench, Station

from ..bundle import networks
from . import division, equidistant

Run = Callable[..., tuple[int, str, str]]

GRID = PixelGrid(640, 480, (0.01, 0.0101))
F = 800.0
BEND = 3.0
"""Effect of each distortion parameter at the corner, px."""


class Case(NamedTuple):
    """A model with one choice of its options, at a realistic place."""

    model: CameraModel
    options: dict[str, str | float]

    def values(self, grid: PixelGrid = GRID, f: float = F, bend: float = BEND) -> Array:
        """Values with a shifted centre, and distortions of `bend` px at the corner, of changing sign."""
        values = self.model.start_values(f, grid)
        x, y = np.linspace(-1, 1, 9) * grid.width / (2 * f), np.linspace(-1, 1, 9) * grid.height / (2 * f)
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        seen = self.model.mapping(values, grid, self.options).derivatives(places)
        effect = np.abs(seen.d_parameters).max(axis=(0, 1))
        for k, parameter in enumerate(self.model.parameters):
            if parameter.role == "distortion" and effect[k] > 0:
                values[k] += (-1) ** k * bend / effect[k] / (1 + k)
            elif parameter.role == "centre":
                values[k] += 2.0 / effect[k]
        return values

    @property
    def size(self) -> float:
        """Size of a world that is in the image; with parallel rays one of few tenths of its unit."""
        return 0.28 if self.model.parallel else 1.0

    def mapping(self) -> PlaneMapping:
        return self.model.mapping(self.values(), GRID, self.options)


def cases(quick: tuple[str, ...] | None = None) -> list[object]:
    """Every model with every choice of its options; slow but for the models named, if any are."""
    found = []
    for model in dict.fromkeys((*camera_models(), equidistant.MODEL, division.MODEL)):
        texts = [[(o.name, choice) for choice in o.choices] for o in model.options if o.choices]
        for chosen in product(*texts):
            numbers = {o.name: 1.7 for o in model.options if not o.choices}
            case = Case(model, dict(chosen) | numbers)
            name = "-".join([model.name, *(str(v) for _, v in chosen)])
            marks = () if quick is None or {model.name, name} & {*quick} else (pytest.mark.slow,)
            found.append(pytest.param(case, id=name, marks=marks))
    return found


EVERY = pytest.mark.parametrize("case", cases())


def directions(n: int = 40) -> Array:
    return np.random.default_rng(2).uniform(-1, 1, (n, 2)) * [0.38, 0.28]


def differences(function: Callable[[Array], Array], at: Array, h: Array) -> Array:
    """Derivatives (…, u) of a function of u variables, central and of fourth order."""
    columns = []
    for step in np.diag(h):
        near, far = (
            function(at + step) - function(at - step),
            function(at + 2 * step) - function(at - 2 * step),
        )
        columns.append((8 * near - far) / (12 * step.sum()))
    return np.stack(columns, axis=-1)


@EVERY
def test_derivatives_agree_with_finite_differences(case: Case) -> None:
    mapping, uv = case.mapping(), directions()
    seen = mapping.derivatives(uv)
    np.testing.assert_allclose(mapping(uv), seen.value, rtol=1e-13)
    numeric = differences(lambda shift: mapping(uv + shift), np.zeros(2), np.full(2, 1e-3))
    np.testing.assert_allclose(seen.d_xy, numeric, rtol=0, atol=1e-8 * F)
    size = np.abs(seen.d_parameters).max(axis=(0, 1))
    size[size == 0] = 1.0
    numeric = differences(lambda values: mapping.with_values(values)(uv), mapping.values, 0.01 / size)
    np.testing.assert_allclose(seen.d_parameters / size, numeric / size, rtol=0, atol=1e-8)


@EVERY
def test_the_inverse_returns_to_the_point(case: Case) -> None:
    mapping, uv = case.mapping(), directions()
    np.testing.assert_allclose(mapping.inverse(mapping(uv)), uv, rtol=0, atol=1e-12)


def kernel_at(case: Case, compiled_: bool, uv: Array, xy: Array, values: Array) -> tuple[Array, Array, Array]:
    """Misfits (n, 2) and their derivatives by u, v and by the parameters, of the kernel."""
    assert case.model.kernel is not None
    function = compiled(case.model.kernel) if compiled_ else case.model.kernel
    options = case.model.checked_options(case.options)
    columns = CameraColumns(
        values[None],
        np.asarray(case.model.constants(options), dtype=np.float64).reshape(1, -1),
        np.array([[(GRID.width - 1) / 2, (GRID.height - 1) / 2, *GRID.pitch_mm]]),
        np.zeros((1, 0)),
        np.zeros((1, 2)),
    )
    n, u = len(uv), len(values)
    off, by_uv, d = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((n, 2, u))
    for k in range(n):
        function(k, 0, -1, uv[k, 0], uv[k, 1], xy, columns, by_uv[k], d[k], np.empty((2, 0)), off[k])
    return off, by_uv, d


WITH_KERNEL = pytest.mark.parametrize("case", [c for c in cases() if c.values[0].model.kernel is not None])


@WITH_KERNEL
def test_the_kernel_agrees_with_the_mapping(case: Case) -> None:
    """To 1e-12 of the size; for misfits of corrected image points, including the slope of the correction."""
    mapping, uv, values = case.mapping(), directions(), case.values()
    seen = mapping.derivatives(uv)
    off, by_uv, d = kernel_at(case, True, uv, seen.value, values)
    assert np.abs(off).max() < 1e-12 * GRID.width
    # Implicit function: v(u, v, p; x) = 0 on the image x(u, v, p), so that ∂v = −∂v/∂x · ∂x.
    by_xy = -by_uv @ np.linalg.inv(seen.d_xy)
    expected = -by_xy @ seen.d_parameters
    size = np.abs(expected).max(axis=(0, 1))
    size[size == 0] = 1.0
    np.testing.assert_allclose(d / size, expected / size, rtol=0, atol=1e-12)
    numeric = differences(
        lambda shift: kernel_at(case, True, uv, seen.value + shift, values)[0], np.zeros(2), np.full(2, 1.0)
    )
    np.testing.assert_allclose(by_xy, numeric, rtol=0, atol=1e-10)
    explicit = np.abs(by_xy + np.eye(2)).max() < 1e-9
    if explicit:
        off, _, _ = kernel_at(case, True, uv, np.zeros_like(uv), values)
        np.testing.assert_allclose(off, seen.value, rtol=1e-12)


@WITH_KERNEL
def test_the_compiled_kernel_agrees_with_its_source(case: Case) -> None:
    uv, values = directions(5), case.values()
    xy = np.zeros_like(uv)
    for ours, source in zip(
        kernel_at(case, True, uv, xy, values), kernel_at(case, False, uv, xy, values), strict=True
    ):
        np.testing.assert_array_equal(ours, source)


@EVERY
def test_a_model_describes_its_parameters(case: Case) -> None:
    model = case.model
    assert camera_model(model.name) is model
    assert set(model.usual) <= set(model.names)
    assert set(model.required) <= set(model.names)
    assert set(model.of_role("scale")) <= set(model.required)
    assert distortion_names(model.names, model.name) == model.of_role("distortion")
    for name in model.names:
        assert unit_of(name, model.name) == model.units[name]
    flat = model.mapping(model.undistorted(model.start_values(F, GRID)), GRID)
    slope = flat.derivatives([[0.0, 0.0]]).d_xy[0]
    assert slope[0, 0] == pytest.approx(F)
    assert np.sign(np.linalg.det(slope)) == 1
    with pytest.raises(UsageError, match="is registered already"):
        register_camera(model)
    with pytest.raises(UsageError, match="has no option `pitch_angle`"):
        model.mapping(model.start_values(F, GRID), GRID, {"pitch_angle": 1.0})


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(quick=("brown", "opencv", "fisheye", "double_sphere")))
def test_the_model_is_converted_to_itself_and_to_that_of_opencv(case: Case) -> None:
    camera = case.mapping()
    same = convert(camera, GRID, case.model.name, case.options)
    assert same.greatest_px < 1e-6
    if camera.parallel:
        with pytest.raises(UsageError, match="has parallel rays, the model `opencv` has not"):
            convert(camera, GRID, "opencv")
        return
    other = convert(camera, GRID, "opencv")
    assert other.share == 1
    assert other.greatest_px < 3 * BEND


@pytest.mark.slow
@EVERY
def test_the_model_is_converted_to_every_other_model(case: Case) -> None:
    camera = case.mapping()
    for model in camera_models():
        if model.parallel != camera.parallel:
            continue
        other = convert(camera, GRID, model.name)
        assert other.share == 1
        assert other.greatest_px < 3 * BEND
        off = other.mapping(directions()) - camera(directions())
        assert np.hypot(*off.T).max() <= 1.5 * other.greatest_px + 1e-9


def test_a_converted_camera_has_no_pole_between_the_points_that_were_compared() -> None:
    """A shear, that OpenCV's camera lacks, is not made up for by a denominator that vanishes in the image."""
    grid = PixelGrid(1600, 1200, (0.005, 0.005))
    values = {"c": 8.1, "x0": 0.05, "y0": -0.03, "K1": -2e-4, "K2": 2e-6, "P1": 3e-5, "P2": -2e-5, "B1": 1e-4}
    camera = camera_model("openptv").mapping(np.zeros(10), grid).with_values({**values, "she": 2e-4})
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
    found = convert(camera, grid, "opencv_full", free=names)
    columns, rows = np.meshgrid(np.linspace(0, 1599, 401), np.linspace(0, 1199, 301))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    uv = camera.inverse(pixels)
    assert found.mapping.one_to_one(uv).all()
    assert np.hypot(*(found.mapping(uv) - pixels).T).max() < 1.1 * found.greatest_px


def test_the_covariance_goes_along_with_a_conversion() -> None:
    """Against conversions of cameras with other values; to the same model it stays what it was."""
    camera = Case(camera_model("brown"), {"side": "object", "balance_radius_mm": 0.0}).mapping()
    names, free = ("c", "x0", "K1", "K2"), ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
    found = convert(camera, GRID, "opencv", free=free)
    assert found.greatest_px < 0.5
    assert found.rms_px <= found.greatest_px
    rows = [camera.names.index(name) for name in names]
    step = np.array([1e-4, 1e-4, 1e-7, 1e-9])
    columns = []
    for row, h in zip(rows, step, strict=True):
        shift = np.where(np.arange(len(camera.values)) == row, h, 0.0)
        ends = [
            convert(camera.with_values(camera.values + s * shift), GRID, "opencv", free=free) for s in (1, -1)
        ]
        columns.append((ends[0].mapping.values - ends[1].mapping.values) / (2 * h))
    at_names = [list(found.mapping.names).index(name) for name in found.free]
    numeric = np.stack(columns, axis=1)[at_names]
    sigma = np.array([1e-3, 2e-3, 1e-5, 1e-7])
    covariance = found.covariance(names, np.diag(sigma**2))
    slope = found.mapping.derivatives(directions()).d_parameters[:, :, at_names]
    predicted = slope @ covariance @ np.swapaxes(slope, 1, 2)
    moved = slope @ (numeric * sigma)
    expected = moved @ np.swapaxes(moved, 1, 2)
    np.testing.assert_allclose(predicted, expected, rtol=0, atol=0.01 * expected.max())
    same = convert(camera, GRID, "brown", free=camera.names)
    own = np.diag(np.arange(1.0, 1 + len(camera.names)))
    np.testing.assert_allclose(same.covariance(camera.names, own), own, atol=1e-5)
    with pytest.raises(UsageError, match="is not one of c, x0"):
        found.covariance(["fx"], [[1.0]])


def camera_of(case: Case, free: tuple[str, ...] | None = None, bend: float = BEND, f: float = F) -> Camera:
    return Camera(
        "cam", GRID.width, GRID.height, GRID.pitch_mm, case.model.name, case.values(f=f, bend=bend),
        case.model.usual if free is None else free, case.options,
        case.model.priors(case.model.usual if free is None else free),
    )  # fmt: skip


def entry_of(camera: Camera) -> dict[str, object]:
    """The entry of a network file."""
    return {
        "id": camera.id, "width": camera.width, "height": camera.height, "pitch_mm": list(camera.pitch_mm),
        "model": camera.model, **camera.options, "parameters": camera.parameters, "free": list(camera.free),
        **({"sigma": camera.sigma} if camera.sigma else {}),
    }  # fmt: skip


@EVERY
def test_the_entry_of_a_file_is_read_back(case: Case) -> None:
    camera = camera_of(case)
    entry = CameraEntry.model_validate_json(json.dumps(entry_of(camera)))
    again = CameraEntry.model_validate_json(entry.model_dump_json(exclude_none=True))
    found = Camera.from_entry(again)
    assert (found.model, found.free, found.options) == (camera.model, camera.free, camera.options)
    np.testing.assert_array_equal(found.values, camera.values)
    np.testing.assert_array_equal(found.plane_mapping()(directions()), case.mapping()(directions()))


def network_file(case: Case, path: Path) -> tuple[networks.World, Path]:
    """A world seen by the camera, and its network with approximate values of the camera in a file."""
    world = networks.world(images=6, points=30, cameras=(camera_of(case),), sigma_px=0.02, size=case.size)
    network = world.noisy(5)
    start = case.model.rescaled(np.zeros(len(case.model.names)), 1.03 * F, GRID)
    centred = case.model.start_values(F, GRID)
    start = np.where(start == 0, case.model.undistorted(centred), start)
    camera = entry_of(network.cameras[0]) | {
        "parameters": dict(zip(case.model.names, start.tolist(), strict=True))
    }
    held = {k: v for k, v in network.cameras[0].parameters.items() if k not in network.cameras[0].free}
    camera["parameters"] |= held  # type: ignore[operator]
    sigma = np.sqrt(network.cov[:, [0, 1], [0, 1]])
    document = {
        "schema": "reseau-network/1", "unit": "m", "cameras": [camera],
        "images": {"id": network.images, "camera": ["cam"] * 6, "X0": [None] * 6, "rotation": [None] * 6},
        "points": {
            "id": network.points,
            "xyz": [
                x.tolist() if s[0] == 0 else None
                for x, s in zip(network.xyz, network.sigma, strict=True)
            ],
            "sigma": [[0, 0, 0] if s[0] == 0 else None for s in network.sigma],
            "role": network.role,
        },
        "observations": {
            "image": [network.images[i] for i in network.image_of],
            "point": [network.points[j] for j in network.point_of],
            "x": network.xy[:, 0].tolist(), "y": network.xy[:, 1].tolist(),
            "sx": sigma[:, 0].tolist(), "sy": sigma[:, 1].tolist(),
            "rho": (network.cov[:, 0, 1] / sigma.prod(axis=1)).tolist(),
        },
        "datum": "control",
    }  # fmt: skip
    path.write_text(json.dumps(document))
    return world, path


@pytest.mark.parametrize("case", cases(quick=("opencv", "telecentric", "division")))
def test_the_bundle_recovers_the_truth(case: Case, tmp_path: Path) -> None:
    world, path = network_file(case, tmp_path / "network.json")
    result = adjust_network(Network.from_document(Network1.read(path)))
    assert not isinstance(result, Failure)
    assert result.sigma0 == pytest.approx(1.0, abs=0.25)
    names, _, values = result.camera_columns(0)
    assert names == case.model.usual
    true = world.network.cameras[0].parameters
    off = values - [true[name] for name in names]
    covariance = result.formal_camera_covariance(0)
    assert float(off @ np.linalg.solve(covariance, off)) < 4 * len(names)
    tested = {test.name for test in result.camera_tests(0)}
    assert tested == set(distortion_names(names, case.model.name))


def result_of(world: networks.World, seed: int) -> Result:
    """The adjustment of one draw, begun at the truth."""
    network, start = world.noisy(seed), world.problem().start
    camera, rng = network.cameras[0], np.random.default_rng(1000 + seed)
    # Parameters that are observations have errors too.
    noise = np.array([camera.sigma.get(name, 0.0) for name in camera.names]) * rng.normal(
        size=len(camera.names)
    )
    network = replace(network, cameras=(replace(camera, values=camera.values + noise),))
    fit = replace(world.problem(network), start=start).adjusted()
    assert not isinstance(fit, Failure)
    return Result(network, fit, np.zeros(len(network.xy), dtype=bool), ())


def normalised_errors(case: Case, seeds: range) -> tuple[Array, Array]:
    """Errors of the parameters over their sigmas (s, u), and their squares in the joint covariance over u.

    The image is wide for the two models with spheres: in a narrow one their shape is hardly determined, and
    first order does not suffice; for the double sphere it does so only with little noise.
    """
    sigma_px = 0.001 if len(case.model.of_role("shape")) > 1 else 0.02
    wide = bool(case.model.of_role("shape"))
    camera = camera_of(case, f=330.0) if wide else camera_of(case)
    # A regularisation in the size of the true corrections: first order suffices.
    camera = replace(camera, sigma=dict.fromkeys(camera.sigma, 1e-3))
    world = networks.world(
        images=6, points=30, cameras=(camera,), sigma_px=sigma_px, size=1.7 if wide else case.size
    )
    true = world.network.cameras[0].parameters
    single, joint = [], []
    for seed in seeds:
        result = result_of(world, seed)
        names, _, values = result.camera_columns(0)
        off = values - [true[name] for name in names]
        covariance = result.formal_camera_covariance(0)
        single.append(off / np.sqrt(np.diag(covariance)))
        joint.append(off @ np.linalg.solve(covariance, off) / len(off))
    return np.array(single), np.array(joint)


@EVERY
def test_covariances_cover_the_errors(case: Case) -> None:
    """Monte Carlo with few draws; the interval has a probability of 0.9999 for sums of this many squares."""
    _, joint = normalised_errors(case, range(12))
    u = len(case.model.usual)
    low, high = scipy.stats.chi2.ppf([5e-5, 1 - 5e-5], 12 * u) / (12 * u)
    assert low < joint.mean() < high


@pytest.mark.slow
@EVERY
def test_standard_deviations_are_right_to_five_percent(case: Case) -> None:
    """The root mean square of all normalised errors, of 200 draws, with joint covariances."""
    _, joint = normalised_errors(case, range(100, 300))
    assert 0.95 < np.sqrt(joint.mean()) < 1.05


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(quick=("brown-object",)))
def test_commands_accept_the_model_and_write_report_and_calibration(
    case: Case, reseau: Run, tmp_path: Path
) -> None:
    """`reseau bundle`, and `reseau calibrate` of a testfield, with report, calibration and its use."""
    _, path = network_file(case, tmp_path / "network.json")
    status, out, err = reseau("bundle", path, "--json", "--report", tmp_path / "B.html")
    assert (status, err) == (0, "")
    assert set(case.model.usual) <= set(json.loads(out)["cameras"][0]["parameters"])
    assert all(name in (tmp_path / "B.html").read_text() for name in case.model.usual)

    calibrated(case, tmp_path)
    options = [f"--model-option={name}={value}" for name, value in case.options.items()]
    pitch = ("--pitch-mm", 0.027) if case.model.needs_pitch else ()
    command = (
        "calibrate", *sorted(tmp_path.glob("*.csv")), "-d", tmp_path / "field.json",
        "--image-size", "240x240", "--model", case.model.name, *options, *pitch,
    )  # fmt: skip
    # With parallel rays and without distortion the principal point is not determined.
    roles = ("scale",) if case.model.parallel else ("scale", "centre")
    free = ("--free", ",".join(case.model.of_role(*roles)))
    files = ("-o", tmp_path / "K.json", "--report", tmp_path / "F.html")
    status, out, err = reseau(*command, *free, *files)
    assert (status, err) == (0, "")
    written = json.loads((tmp_path / "K.json").read_text())
    assert written["model"]["model"] == case.model.name
    assert {name: written["model"][name] for name in case.options} == case.options
    for name, unit in case.model.units.items():
        assert written["parameters"][name]["unit"] == unit
    assert "<svg" in (tmp_path / "F.html").read_text()
    f = next(iter(case.model.of_role("scale")))
    expected = case.model.start_values(bench_scale(case), PixelGrid(240, 240, (0.027, 0.027)))
    found = written["parameters"][f]
    assert abs(found["value"] - expected[case.model.names.index(f)]) < 5 * found["sigma"]
    points = tmp_path / "00.csv"
    status, out, err = reseau("apply", tmp_path / "K.json", points, "--directions", "-o", tmp_path / "D.csv")
    # What is less than measurement is said, as which poses there are and not the model decides.
    assert status == 0
    assert err == "" or err.startswith("note: calibration camera is usable for 3-D reconstruction")
    given = np.array([line.split(",")[1:3] for line in points.read_text().split()[1:]], dtype=np.float64)
    lines = (tmp_path / "D.csv").read_text().split()[1:]
    uv = np.array([line.split(",")[1:3] for line in lines], dtype=np.float64)
    values = [written["parameters"][name]["value"] for name in case.model.names]
    lens = case.model.mapping(values, PixelGrid(240, 240, (0.027, 0.027)), case.options)
    # Directions are written with seven decimals.
    np.testing.assert_allclose(lens(uv), given, rtol=0, atol=0.6e-7 * 57.5 / 0.027)
    status, out, err = reseau("compare", tmp_path / "K.json", tmp_path / "K.json")
    assert (status, err) == (0, "")
    assert "p = 1\n" in out


def bench_scale(case: Case) -> float:
    """Focal length (px) of the bench, or pixels per millimetre of its board with parallel rays."""
    return 57.5 / 0.027 / (FieldBench(seed=3).distance_mm if case.model.parallel else 1.0)


def calibrated(case: Case, folder: Path) -> None:
    """The design of a testfield, and coordinates of recordings by a camera of the model."""
    bench, rng = FieldBench(seed=3, bend_mm=0.0), np.random.default_rng(0)
    bench.design.write(folder / "field.json")
    grid = PixelGrid(240, 240, (0.027, 0.027))
    lens = case.model.mapping(case.model.start_values(bench_scale(case), grid), grid, case.options)
    for k, (phi, kappa) in enumerate(product((0.0, 30.0, 45.0), (0.0, 90.0, 180.0))):
        truth = bench.truth(Station(phi, kappa, kappa))
        rows = np.flatnonzero(bench.inside(truth, 8.0))
        # The bench has a lens without distortion: its image points give the directions.
        uv = bench.camera.inverse(truth.xy[rows])
        if lens.parallel:
            uv = truth.pose(truth.xyz[rows])[:, :2]
        xy = lens(uv) + 0.005 * rng.normal(size=(len(rows), 2))
        lines = [
            f"{truth.names[j]},{x!r},{y!r},0.005,0.005" for j, (x, y) in zip(rows, xy.tolist(), strict=True)
        ]
        (folder / f"{k:02d}.csv").write_text("id,x,y,sx,sy\n" + "\n".join(lines) + "\n")


def test_an_unknown_model_or_option_is_named_in_one_line(reseau: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("id,x,y\na,1,2\n")
    FieldBench(seed=3).design.write(tmp_path / "field.json")
    command = ("calibrate", tmp_path / "a.csv", "-d", tmp_path / "field.json", "--image-size", "240x240")
    known = ", ".join(model.name for model in camera_models())
    for arguments, words in (
        (("--model", "pinhole"), f"camera model 'pinhole': is unknown; use one of {known}"),
        (("--side", "image"), "camera model opencv: has no option `side`"),
        (("--model", "brown"), "brown: requires the pixel size"),
        (
            ("--pitch-mm", 0.01, "--model-option", "balance_radius_mm=-1"),
            "write a number that is not negative",
        ),
        (("--pitch-mm", 0.01, "--model-option", "side"), "write name=value"),
    ):
        status, out, err = reseau(*command, *arguments)
        assert (status, out) == (2, "")
        assert words in err
        assert err.count("\n") == 1
    entry = entry_of(camera_of(Case(camera_model("opencv"), {})))
    for change, words in (
        ({"model": "pinhole"}, "'pinhole' is not one of the models"),
        ({"wide": 1}, "camera 'cam': unknown key `wide`"),
    ):
        with pytest.raises(ValueError, match=words):
            CameraEntry.model_validate_json(json.dumps(entry | change))


@pytest.mark.slow
def test_calibrate_says_which_model_it_chose_and_why(reseau: Run, tmp_path: Path) -> None:
    """The lens has no distortion; the table, the document, and an option that cannot be given with it."""
    calibrated(Case(camera_model("opencv"), {}), tmp_path)
    command = (
        "calibrate", *sorted(tmp_path.glob("*.csv")), "-d", tmp_path / "field.json",
        "--image-size", "240x240", "--model", "auto",
    )  # fmt: skip
    status, out, err = reseau(*command, "--target", "auto", "-o", tmp_path / "K.json")
    assert (status, err) == (0, "")
    assert "\ncamera model opencv: no distortion (chosen" in out
    assert "target flat as designed" in out
    assert "opencv: k1 k2 p1 p2 " in out
    assert "too many parameters" in out
    written = json.loads((tmp_path / "K.json").read_text())
    assert written["model"]["model"] == "opencv"
    assert written["covariance"]["names"] == ["fx", "fy", "cx", "cy"]
    table = written["validity"]["camera_models"]
    assert table[0]["free"] == ["fx", "fy", "cx", "cy"]
    assert len(table) > 15
    assert written["validity"]["target"]["chosen"] == "flat"
    status, out, err = reseau(*command, "--free", "fx")
    assert (status, out) == (2, "")
    assert "camera model auto: has no parameters or options of its own" in err
