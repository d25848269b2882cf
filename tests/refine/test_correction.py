"""The camera corrected with a reseau: the common system, sigmas, tests, files, and failures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from reseau.adjust import adjust
from reseau.calibration import Calibration, CameraCorrection, CorrectedImage
from reseau.core.data import ImagePoints
from reseau.core.errors import FormatError
from reseau.core.failure import Failure
from reseau.designs import regular_reseau
from reseau.io import DesignPoint, Mark, ReseauDesign
from reseau.measure.fitting import mapping_problem
from reseau.optics import RationalPolynomial
from reseau.optics.composition import Similarity
from reseau.refine import correct_camera

from ..montecarlo import slowly

GRID = regular_reseau(11, 9, 10.0, Mark(shape="disk", size=1.0), name="grid")
SIGMA = 0.01
# With c1 = c2 = a2 = 0 O and S lie where the common system has them, and the world is one of the model.
VALUES = {
    "a1": 0.99,
    "b1": 1e-3,
    "b2": 0.98,
    "a0": 1e-4,
    "b0": -5e-5,
    "d1": 4e-5,
    "d2": -3e-5,
    "k": 9e-7,
    "h1": 8e-9,
    "h2": -1.5e-8,
}
WORLD = RationalPolynomial.camera().with_values(VALUES)
PROJECTIVE = RationalPolynomial.projective().with_values(
    {n: VALUES[n] for n in ("a1", "b1", "b2", "a0", "b0")}
)


def redesigned(design: ReseauDesign = GRID, *, down: bool = False, **changes) -> ReseauDesign:
    """The design with other keys, or with its y down."""
    sign = -1.0 if down else 1.0
    points = tuple(p.model_copy(update={"y": sign * p.y}) for p in design.points)
    return design.model_copy(update={"points": points, **changes})


def pixels(photo, *, angle=0.03, flip=(1.0, -1.0)):
    """A scan of photo-coordinates: 8 px to the millimetre, rotated, shifted, y down by default."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return (photo * flip) @ turn.T * 8.0 + [611.3, 480.7]


def measured(
    design=GRID, world=WORLD, *, seed=None, sigma=SIGMA, missing=(), bend=0.0, **scan
) -> ImagePoints:
    xy = pixels(world.inverse(design.xy), **scan)
    xy = xy + bend * np.exp(-((xy - [700.0, 420.0]) ** 2).sum(axis=1, keepdims=True) / (2 * 90.0**2))
    if seed is not None:
        xy = xy + np.random.default_rng(seed).normal(0, sigma, xy.shape)
    found = ImagePoints.with_sigma(design.ids, xy, sigma)
    return found.select([name for name in design.ids if name not in missing])


def corrected(points=None, design=GRID, **options) -> CameraCorrection:
    options = {"trials": 0} | options
    return correct_camera(measured(design) if points is None else points, design, **options).required()


# The common system


@pytest.mark.parametrize("down", [False, True], ids=["design y up", "design y down"])
@pytest.mark.parametrize("flip", [(1, -1), (1, 1), (-1, -1), (-1, 1)], ids=str)
def test_o_is_the_origin_and_s_lies_on_the_axis_for_either_handedness(down, flip):
    """(1, -1): as photographed; (1, 1): of a design that has its y the other way; (-1, …): from the back."""
    design = redesigned(down=down)
    points = measured(design, flip=flip, angle=0.4)
    camera = corrected(points, design)
    o, s = (camera.photo_system(points.select([name]).xy)[0] for name in (GRID.origin, GRID.axis))
    np.testing.assert_allclose(o, [0, 0], atol=1e-10)
    np.testing.assert_allclose(s, [50, 0], atol=1e-10)
    np.testing.assert_allclose(camera.apply(points).xy, design.xy, atol=1e-8)
    assert camera.photo_system.mirrored == (np.prod(flip) < 0)
    assert camera.photo_system.scale * 8.0 == pytest.approx(1.0, abs=0.03)


def test_the_axis_joins_two_marks_and_is_not_parallel_to_the_wires():
    design = redesigned(origin="A1", axis="I11")
    camera = corrected(measured(world=PROJECTIVE), design)
    plane = dict(zip(design.ids, camera.object_system(design.xy), strict=True))
    np.testing.assert_allclose(plane["A1"], [0, 0], atol=1e-12)
    np.testing.assert_allclose(plane["I11"], [np.hypot(100, 80), 0], atol=1e-12)
    assert plane["A11"][1] > 0
    np.testing.assert_allclose(camera.fit.target, np.array([plane[n] for n in camera.fit.points.names]))
    np.testing.assert_allclose(camera.apply(measured(world=PROJECTIVE)).xy, list(plane.values()), atol=1e-8)


def test_the_system_is_fixed_at_the_measured_images():
    points = measured(seed=1)
    camera = corrected(points)
    np.testing.assert_allclose(camera.photo_system(points.select([GRID.origin]).xy), [[0, 0]], atol=1e-10)
    np.testing.assert_allclose(camera.photo_system(points.select([GRID.axis]).xy), [[50, 0]], atol=1e-10)


@pytest.mark.parametrize("missing", [("E6",), ("E11",), ("E6", "E11")], ids=str)
def test_an_unmeasured_o_or_s_is_predicted_by_a_projectivity(missing):
    assert (GRID.origin, GRID.axis) == ("E6", "E11")
    points = measured(world=PROJECTIVE, missing=missing)
    camera = corrected(points)
    everything = measured(world=PROJECTIVE)
    for name, place in (("E6", [0, 0]), ("E11", [50, 0])):
        np.testing.assert_allclose(camera.photo_system(everything.select([name]).xy), [place], atol=1e-7)
    np.testing.assert_allclose(camera.apply(everything).xy, GRID.xy, atol=1e-7)


def test_by_default_o_is_the_middle_mark_and_s_is_to_its_right():
    design = redesigned(origin=None, axis=None)
    camera = corrected(measured(design), design)
    reference = corrected()
    np.testing.assert_array_equal(camera.photo_system.values, reference.photo_system.values)
    np.testing.assert_array_equal(camera.model.values, reference.model.values)


def test_a_named_mark_without_coordinates_is_a_failure():
    points = tuple(
        p.model_copy(update={"x": None, "y": None}) if p.id == GRID.origin else p for p in GRID.points
    )
    found = correct_camera(measured(), redesigned().model_copy(update={"points": points}))
    assert isinstance(found, Failure)
    assert GRID.origin in found.reason


# The model


def test_a_simulated_model_is_recovered():
    camera = corrected()
    # The scale of the photograph is that of O and S, not one: powers of it go into the coefficients.
    scale = 50 / WORLD.inverse(np.array([[50.0, 0.0]]))[0, 0]
    power = {
        "a1": -1,
        "b1": -1,
        "b2": -1,
        "a0": -1,
        "b0": -1,
        "d1": -2,
        "d2": -2,
        "k": -3,
        "h1": -4,
        "h2": -4,
    }
    found = dict(zip(camera.model.names, camera.model.values, strict=True))
    for name, value in VALUES.items():
        assert found[name] == pytest.approx(value * scale ** power[name], rel=1e-6)
    assert np.abs(camera.fit.residuals).max() < 1e-8


def test_to_pixels_is_the_inverse_of_apply():
    points = measured(seed=2)
    camera = corrected(points)
    back = camera.to_pixels(camera.apply(points).xy)
    np.testing.assert_allclose(back, points.xy, atol=1e-7)
    assert np.abs(points.xy - camera.photo_system.inverse(camera.apply(points).xy)).max() > 1.0


def test_absent_coefficients_are_dropped_but_never_the_scales():
    world = WORLD.with_values({"h1": 0.0, "d2": 0.0})
    camera = corrected(measured(world=world, seed=4), alpha=1e-3)
    dropped = camera.fit.elimination.dropped
    assert {"h1", "d2"} <= set(dropped)
    assert not {"d1", "k", "h2", "a0"} & set(dropped)
    assert set(camera.model.names) | set(dropped) == set(RationalPolynomial.camera().names)
    verdicts = {test["parameter"]: test["verdict"] for test in camera.fit.tests()}
    assert {name for name, verdict in verdicts.items() if verdict == "dropped"} == set(dropped)
    points = measured(world=world)
    nothing = corrected(ImagePoints(points.names, points.xy, points.cov * 1e10))
    assert set(nothing.model.names) - set(nothing.fit.elimination.dropped) == {"a1", "b2"}


def test_the_correction_keeps_what_is_not_significant_with_its_sigma():
    """Dropped at the level of the test, a coefficient that is not zero would bend the others."""
    camera = corrected(measured(world=WORLD.with_values({"h1": 0.0}), seed=4), alpha=1e-3)
    assert "h1" in camera.fit.elimination.dropped
    assert camera.model.names == RationalPolynomial.camera().names
    row = camera.model.names.index("h1")
    assert 0 < abs(camera.model.values[row]) < 4 * np.sqrt(camera.cofactor[row, row])


def test_another_model_is_given_by_a_table_of_terms():
    terms = RationalPolynomial.camera().terms | {"g": {"X": "x2y", "Y": "x2y"}}
    model = RationalPolynomial(terms).with_values({"a1": 1.0, "b2": 1.0})
    world = RationalPolynomial(terms).with_values(VALUES | {"g": 2e-6})
    assert np.abs(corrected(measured(world=world)).fit.residuals).max() > 0.01
    camera = corrected(measured(world=world), model=model)
    assert np.abs(camera.fit.residuals).max() < 1e-8
    assert "g" in camera.model.names


# Sigmas


def truth(camera: CameraCorrection) -> RationalPolynomial:
    """The same reduced adjustment of noise-free positions, in the same frozen system, equally weighed."""
    names = camera.fit.points.names
    exact = camera.photo_system(measured().select(names).xy)
    problem = mapping_problem(
        camera.model, ImagePoints(names, exact, camera.fit.points.cov), camera.fit.target
    )
    return camera.model.with_values(adjust(problem).required().values)


@pytest.mark.slow
def test_the_covariance_of_model_and_corrected_marks_is_that_of_repeated_measurement():
    held = GRID.ids[3::9]
    squares, degrees, marks, passed = 0.0, 0, [], []
    for seed in range(100):
        camera = corrected(measured(seed=seed), check=held)
        true = truth(camera)
        off = camera.model.values - true.values
        squares += off @ np.linalg.solve(camera.cofactor, off)
        degrees += len(off)
        exact = true(camera.photo_system(measured().select(camera.fit.check.names).xy))
        root = np.linalg.cholesky(camera.fit.check.cov)
        marks.append(np.linalg.solve(root, (camera.fit.check.xy - exact)[..., None])[..., 0])
        passed.append(camera.fit.adjustment.global_test(0.05).passed)
    low, high = chi2.ppf([0.0005, 0.9995], degrees)
    assert low < squares < high
    # 11 marks a run, which share the model's error: the rms of 2200 coordinates is sure to about 2 %.
    assert np.sqrt(np.mean(np.square(marks))) == pytest.approx(1.0, abs=0.06)
    assert np.mean(passed) == pytest.approx(0.95, abs=0.07)


@pytest.mark.slow
@pytest.mark.parametrize(
    "lost", [(), (GRID.origin,), *slowly(((GRID.axis,),))], ids=["all", "without O", "without S"]
)
def test_the_covariance_of_coefficients_contains_the_errors_of_o_and_s(lost):
    # In a world that is projective, an unmeasured O or S is predicted without a systematic error.
    keep = [name for name in GRID.ids if name not in lost]
    exact = corrected(measured(world=PROJECTIVE))
    squares, alone = 0.0, 0.0
    for seed in range(20):
        camera = corrected(measured(world=PROJECTIVE, seed=seed).select(keep))
        off = camera.model.values - exact.model.values
        squares += off @ np.linalg.solve(camera.coefficient_covariance, off)
        alone += off @ np.linalg.solve(camera.cofactor, off)
    low, high = chi2.ppf([0.0005, 0.9995], 20 * 13)
    assert low < squares < high
    assert alone > (5 if not lost else 1) * squares


def test_the_covariance_of_coefficients_contains_the_errors_of_the_design():
    stated = tuple(p.model_copy(update={"sigma": 1e-3}) for p in GRID.points)
    exact, squares = corrected(measured(world=PROJECTIVE)), 0.0
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        # O and S are where the design has them, so that the common system is the same.
        shifts = [rng.normal(0, 0.0 if p.id in (GRID.origin, GRID.axis) else 1e-3, 2) for p in stated]
        moved = [
            p.model_copy(update={"x": p.x + x, "y": p.y + y})
            for p, (x, y) in zip(stated, shifts, strict=True)
        ]
        points = measured(GRID.model_copy(update={"points": tuple(moved)}), PROJECTIVE, seed=seed)
        camera = corrected(points, GRID.model_copy(update={"points": stated}))
        off = camera.model.values - exact.model.values
        squares += off @ np.linalg.solve(camera.coefficient_covariance, off)
    low, high = chi2.ppf([0.0005, 0.9995], 12 * 13)
    assert low < squares < high


def test_corrected_covariances_are_those_of_points_and_model():
    camera = corrected(measured(seed=3))
    place = np.array([[400.0, 300.0]])
    exact = camera.apply(ImagePoints.with_sigma(["p"], place, 0.0))
    rough = camera.apply(ImagePoints.with_sigma(["p"], place, 0.5))
    _, _, by_parameter = camera.model.derivatives(camera.photo_system(place))
    np.testing.assert_allclose(exact.cov, by_parameter @ camera.cofactor @ np.swapaxes(by_parameter, 1, 2))
    step = 1e-3
    slope = np.stack(
        [
            (corrected_xy(camera, place + d) - corrected_xy(camera, place - d)) / (2 * step)
            for d in step * np.eye(2)
        ],
        axis=-1,
    )[0]
    np.testing.assert_allclose(rough.cov[0] - exact.cov[0], 0.25 * slope @ slope.T, rtol=1e-6, atol=1e-12)


def corrected_xy(camera, xy):
    return camera.apply(ImagePoints.with_sigma(["p"], xy, 0.0)).xy


def test_chi2_uses_input_sigmas_and_t_estimates_them():
    """Points half as good as they say."""
    points = measured(seed=5, sigma=2 * SIGMA)
    points = ImagePoints(points.names, points.xy, points.cov / 4)
    word, deed = (corrected(points, criterion=criterion) for criterion in ("chi2", "t"))
    shared = [name for name in word.model.names if name in deed.model.names]
    ratio = np.mean([np.sqrt(np.diag(deed.cofactor))[deed.model.names.index(n)] for n in shared]) / np.mean(
        [np.sqrt(np.diag(word.cofactor))[word.model.names.index(n)] for n in shared]
    )
    assert ratio == pytest.approx(2.0, rel=0.2)
    assert word.fit.adjustment.sigma0 == pytest.approx(2.0, rel=0.2)
    assert not word.fit.adjustment.global_test(1e-3).passed


def test_the_sigmas_of_the_design_are_used():
    rng = np.random.default_rng(6)
    points = tuple(
        DesignPoint(id=p.id, x=p.x + rng.normal(0, 0.01), y=p.y + rng.normal(0, 0.01), sigma=0.01)
        for p in GRID.points
    )
    design = redesigned().model_copy(update={"points": points})
    bare = design.model_copy(update={"points": tuple(p.model_copy(update={"sigma": None}) for p in points)})
    assert corrected(measured(seed=7), design).fit.adjustment.global_test(1e-3).passed
    assert not corrected(measured(seed=7), bare).fit.adjustment.global_test(1e-3).passed


# Check marks, and the need of a local model


def test_check_marks_are_not_used_in_the_adjustment():
    held = ("B3", "F7", "H2")
    points = measured(seed=8)
    camera = corrected(points, check=held)
    assert camera.fit.check.names == held
    assert not set(held) & set(camera.fit.points.names)
    assert len(camera.fit.points) == len(points) - 3
    moved = points.xy.copy()
    moved[[points.names.index(name) for name in held]] += 5.0
    again = corrected(ImagePoints(points.names, moved, points.cov), check=held)
    np.testing.assert_array_equal(again.model.values, camera.model.values)
    assert (np.abs(again.fit.check.xy - again.fit.check_target) > 0.5).all()
    assert np.abs(camera.fit.check.xy - camera.fit.check_target).max() < 5 * SIGMA / 8


def test_a_local_bend_requires_a_local_model():
    fit = corrected(measured(seed=9, bend=0.08), trials=199).fit
    assert fit.local is not None
    assert fit.local.need.max() <= 0.01
    assert fit.local.ratio.min() > 0


@pytest.mark.slow
def test_without_a_bend_the_test_for_a_local_model_keeps_its_level():
    """Half of white fields and more are likeliest without any signal: those have the probability 1."""
    need = np.array([corrected(measured(seed=seed), trials=59).fit.local.need for seed in range(100)]).ravel()
    # 99.9 % bands of the binomial distribution of 200 tests; the two axes share k and so very little.
    for level, low, high in ((0.05, 2, 21), (0.1, 8, 35), (0.2, 22, 59)):
        assert low <= (need <= level).sum() <= high
    assert 0.4 < (need == 1).mean() < 0.9


def test_too_few_marks_give_no_test_for_a_local_model():
    small = regular_reseau(4, 4, 20.0, Mark(shape="disk", size=1.0))
    assert corrected(measured(small), small).fit.local is None


# Calibration file


def test_a_calibration_is_read_back_to_the_same_correction_and_bytes(tmp_path):
    points = measured(seed=10, world=WORLD.with_values({"h1": 0.0}))
    camera = corrected(points)
    provenance = {"inputs": [], "software": "reseau"}
    made = camera.calibration(name="bench", provenance=provenance)
    made.write(tmp_path / "k.json")
    read = Calibration.read(tmp_path / "k.json")
    again = CameraCorrection.from_calibration(read)
    assert read.to_json() == made.to_json()
    assert again.fit is None
    ours, theirs = camera.apply(points), again.apply(points)
    np.testing.assert_array_equal(theirs.xy, ours.xy)
    np.testing.assert_array_equal(theirs.cov, ours.cov)
    np.testing.assert_array_equal(again.to_pixels(theirs.xy), camera.to_pixels(ours.xy))
    same = corrected(points).calibration(name="bench", provenance=provenance)
    assert same.to_json() == made.to_json()


def test_the_calibration_contains_accuracy_and_validity():
    camera = corrected(measured(seed=11), check=("B3",))
    made = camera.calibration(name="bench")
    assert made.kind == "oscilloscope"
    assert made.redundancy == camera.fit.adjustment.redundancy == 2 * 98 - len(camera.model.names)
    assert made.sigma0 == camera.fit.adjustment.sigma0
    assert made.validity == {"extent": [-50.0, -40.0, 50.0, 40.0], "marks": 98}
    units = {name: quantity.unit for name, quantity in made.parameters.items()}
    expected = {"a1": "1", "a0": "mm^-1", "d1": "mm^-1", "k": "mm^-2", "h1": "mm^-3"}
    assert {name: units[name] for name in expected} == expected
    for name, quantity in made.parameters.items():
        row = camera.model.names.index(name)
        assert quantity.sigma**2 == pytest.approx(camera.coefficient_covariance[row, row], rel=1e-12)


def test_the_unit_of_a_shift_is_that_of_the_design():
    points = measured(seed=12)
    shifted = ImagePoints(points.names, points.xy.copy(), points.cov)
    shifted.xy[points.names.index(GRID.origin)] += 1.0
    made = corrected(shifted).calibration(name="bench")
    assert made.parameters["c1"].unit == "mm"


@pytest.mark.parametrize(
    "spoil",
    [
        lambda c: c.model_copy(update={"model": "pinhole"}),
        lambda c: c.model_copy(update={"model": c.model | {"name": "another"}}),
        lambda c: c.model_copy(update={"model": {k: v for k, v in c.model.items() if k != "photo_system"}}),
        lambda c: c.model_copy(
            update={
                "parameters": {k: v for k, v in c.parameters.items() if k != "k"},
                "covariance": c.covariance,
            }
        ),
        lambda c: c.model_copy(update={"model": c.model | {"mapping": {"terms": {"k": {"Z": "x"}}}}}),
    ],
    ids=["no dictionary", "another model", "no system", "no value of a coefficient", "no such part"],
)
def test_a_calibration_of_another_kind_is_refused(spoil):
    calibration = corrected(measured(seed=13)).calibration(name="bench")
    with pytest.raises(FormatError):
        CameraCorrection.from_calibration(spoil(calibration))


# What cannot be had


@pytest.mark.parametrize(
    ("keep", "words"),
    [
        (GRID.ids[:0], ["0 of 0 points", "four"]),
        (GRID.ids[:3], ["3 of 3 points", "grid", "four"]),
        (("A1", "A11", "I1", "I11", "E6", "E11"), ["6 points", "12 coordinates", "13 parameters"]),
        (tuple(f"E{i}" for i in range(1, 12)), ["11 marks", "one line", "across"]),
    ],
    ids=["none", "three", "six", "one row"],
)
def test_too_few_marks_are_a_failure_that_names_what_is_missing(keep, words):
    found = correct_camera(measured().select(keep), GRID)
    assert not found
    assert isinstance(found, Failure)
    for word in words:
        assert word in found.reason


def test_points_that_are_not_in_the_design_are_ignored():
    points = measured(seed=14)
    more = ImagePoints.with_sigma(
        (*points.names, "dirt"), np.vstack([points.xy, [[10.0, 10.0]]]), [[SIGMA, SIGMA]]
    )
    np.testing.assert_array_equal(corrected(more).model.values, corrected(points).model.values)
    strangers = replace(points, names=tuple(f"p{i}" for i in range(len(points))))
    found = correct_camera(strangers, GRID)
    assert isinstance(found, Failure)
    assert "0 of 99 points" in found.reason


def test_the_system_agrees_with_a_manual_computation():
    """Step (ii) written out: shift to O, turn to S, one scale."""
    points = measured(seed=15)
    camera = corrected(points)
    o, s = (points.select([name]).xy[0] for name in (GRID.origin, GRID.axis))
    by_hand = Similarity.common_system(o, s, mirrored=True)
    scale = 50.0 / np.hypot(*(s - o))
    np.testing.assert_allclose(camera.photo_system(points.xy), scale * by_hand(points.xy), atol=1e-10)


def test_two_halves_of_a_film_are_resampled_to_parts_of_one_raster() -> None:
    film = regular_reseau(9, 17, 10.0, Mark(shape="cross", size=2.0, line_width=0.1))
    named = {tuple(xy.tolist()): name for name, xy in zip(film.ids, film.xy, strict=True)}
    # Both halves show O and S.
    film = film.model_copy(update={"origin": named[0.0, 0.0], "axis": named[10.0, 0.0]})
    halves = []
    for side, angle in ((-1, 0.004), (1, -0.006)):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        scan = (film.xy * [1.0002, 1.0]) @ (50 * turn @ np.diag([1.0, -1.0])).T + [2500 - side * 900, 2200]
        shown = side * film.xy[:, 0] > -11
        marks = ImagePoints.with_sigma(
            [n for n, s in zip(film.ids, shown, strict=True) if s], scan[shown], 0.05
        )
        camera = correct_camera(marks, film, trials=0).required()
        halves.append(CorrectedImage.plan(camera, (5000, 4400), 40.0))
        # Millimetres of the design, in either half.
        assert np.abs(camera.to_pixels(film.xy[shown]) - scan[shown]).max() < 0.02
    first = [np.array(half.origin) * 40 for half in halves]
    np.testing.assert_allclose(first, np.rint(first), rtol=0, atol=1e-6)
