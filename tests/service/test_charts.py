"""Control charts: run lengths, false alarms without drift, delays, covariates."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.service.charts import ChartOptions, KnownSeries, design, monitor
from reseau.service.covariates import (
    CalibrationFunction,
    FunctionOptions,
    example_calibration,
    explain,
    fit_function,
)
from reseau.service.runlength import Cusum, Ewma, Shewhart

# As printed by r-cran-spc 0.6.7 to all digits shown.
PUBLISHED = [
    (lambda: Cusum(0.5, 5.0).arl(), 465.4435),
    (lambda: Cusum(0.5, 5.0).arl(1.0), 10.37597),
    (lambda: Ewma(0.1, 2.7).arl(), 368.9937),
    (lambda: Shewhart(3.0).arl(1.0), 43.89468),
]


@pytest.mark.parametrize("case", range(len(PUBLISHED)))
def test_run_lengths_are_those_of_spc(case):
    own, printed = PUBLISHED[case]
    assert own() == pytest.approx(printed, rel=1e-6)


def test_run_lengths_over_a_grid_are_those_of_the_installed_spc():
    if (
        shutil.which("Rscript") is None
        or subprocess.run(["Rscript", "-e", "library(spc)"], capture_output=True).returncode
    ):
        pytest.skip("needs r-cran-spc; apt-get install r-cran-spc")
    grid = [(k, h, mu) for k, h in ((0.25, 8.0), (0.5, 7.5), (1.0, 2.5)) for mu in (0.0, 0.25, 1.0, 3.0)]
    calls = "".join(f'cat(xcusum.arl({k},{h},{mu},sided="two"), "\\n");' for k, h, mu in grid)
    said = subprocess.run(
        ["Rscript", "-e", f"library(spc); {calls}"], capture_output=True, text=True, check=True
    )
    own = [Cusum(k, h).arl(mu) for k, h, mu in grid]
    assert np.array(said.stdout.split(), dtype=float) == pytest.approx(own, rel=0.01)


def test_a_shewhart_limit_that_is_never_reached_changes_nothing():
    for shift in (0.0, 1.0, 3.0):
        assert Cusum(0.5, 5.0, 20.0).arl(shift) == pytest.approx(Cusum(0.5, 5.0).arl(shift), rel=1e-4)


def test_the_run_length_of_a_cusum_with_a_shewhart_limit_is_that_of_simulated_runs():
    rng = np.random.default_rng(3)
    chart = Cusum(0.5, 4.0, 3.0, two_sided=False)
    sums, length, alive = np.zeros(20_000), np.zeros(20_000), np.ones(20_000, dtype=bool)
    while alive.any():
        x = rng.normal(0.5, 1.0, len(sums))
        sums = np.maximum(0.0, sums + x - 0.5)
        length += alive
        alive &= (sums <= 4.0) & (x <= 3.0)
    # Five standard errors of the mean.
    assert chart.arl(0.5) == pytest.approx(length.mean(), abs=5 * length.std() / np.sqrt(len(length)))


@pytest.mark.parametrize("kind", ["cusum", "ewma", "shewhart"])
def test_the_joint_rate_of_the_design_holds_with_known_parameters(kind):
    options = ChartOptions(kind=kind, rate=2.0)
    x = np.random.default_rng(4).normal(size=(1500, 104, 10))
    alarms = monitor(x, options, known=KnownSeries(np.zeros(10), np.ones(10))).alarms.sum()
    expected = 2.0 * 2 * 1500
    assert 0.8 * expected < alarms < expected + 3 * np.sqrt(expected)


def test_shifts_of_one_of_ten_known_series_are_found_in_time():
    limits = design(20)
    assert limits.arl(1.0) <= 16.5
    assert limits.arl(3.0) <= 3.5
    assert 20 * 52 / (2 * limits.arl()) <= 0.1 * 2


def ar1(rng, shape, phi, degrees=np.inf):
    """Series with the autocorrelation φ, of values that are normal or t distributed."""
    x = rng.normal(size=shape) if np.isinf(degrees) else rng.standard_t(degrees, size=shape)
    for k in range(1, shape[1]):
        x[:, k] = phi * x[:, k - 1] + np.sqrt(1 - phi * phi) * x[:, k]
    return x


@pytest.mark.slow
@pytest.mark.parametrize(
    ("phi", "before", "degrees"),
    [
        (0.5, 20, np.inf),
        (0.3, 52, 8),
        *(
            pytest.param(phi, n, np.inf, marks=pytest.mark.slow)
            for phi, n in ((0.0, 20), (0.3, 20), (0.3, 52))
        ),
    ],
)
def test_false_alarms_without_drift_are_at_most_one_in_ten_years(phi, before, degrees):
    count = 2000
    x = ar1(np.random.default_rng(before), (count, before + 52, 11), phi, degrees)
    alarms = monitor(x, one_sided=(10,)).alarms[:, before:].sum()
    # Three standard deviations of a Poisson count above 0.1 a year.
    assert alarms <= 0.1 * count + 3 * np.sqrt(0.1 * count)
    # The rate is not held by charts that never signal.
    assert phi == 0.0 or alarms >= 0.02 * count


def test_charts_of_correlated_series_say_so_and_one_shift_does_not_make_them_correlated():
    x = ar1(np.random.default_rng(14), (400, 52, 10), 0.5)
    assert (monitor(x).autocorrelation[:, -1] > 0.3).mean() > 0.9
    x = ar1(np.random.default_rng(15), (400, 52, 10), 0.0)
    x[:, 40:, 0] += 4.0
    assert (monitor(x).autocorrelation[:, -1] > 0.3).mean() < 0.01


def test_a_single_run_that_is_off_by_six_sigma_is_no_drift_and_a_jump_is():
    x = np.random.default_rng(16).normal(size=(200, 60, 10))
    bad, jump = x.copy(), x.copy()
    bad[:, 40, 0] += 6.0
    jump[:, 40:, 0] += 6.0
    found = [monitor(each).alarm[:, 40:46, 0].any(axis=1).mean() for each in (bad, jump)]
    assert found[0] < 0.1
    assert found[1] > 0.95


def test_scores_of_independent_series_are_standard_normal_and_independent_from_the_first():
    x = np.random.default_rng(5).normal(7.0, 1e-4, size=(20_000, 12, 1))
    score = monitor(x, ChartOptions(autocorrelation=0.0, least=4, tails=np.inf)).score[:, 4:, 0]
    cov = np.cov(score.T)
    # Five standard errors √(1/n).
    assert np.abs(cov - np.eye(8)).max() < 5 * np.sqrt(2 / 20_000)
    assert np.abs(score.mean(axis=0)).max() < 5 / np.sqrt(20_000)


def test_a_chart_learns_until_it_is_nearly_as_narrow_as_with_known_parameters():
    x = np.random.default_rng(6).normal(size=(400, 200, 1))
    found = monitor(x)
    assert found.learning[:, :8].all()
    width = np.median(found.width[:, :, 0], axis=0)
    assert width[20] > 1.2 > width[-1] > 1.0
    assert found.learning[:, -1].mean() < 0.3


def test_scores_depend_on_neither_origin_nor_unit():
    x = np.random.default_rng(7).normal(size=(60, 3))
    one, other = monitor(x), monitor(24.5 + 1e-6 * x)
    assert np.nanmax(np.abs(one.score - other.score)) < 1e-6


def test_missing_values_are_no_runs():
    x = np.random.default_rng(8).normal(size=(60, 2))
    gaps = x.copy()
    gaps = np.insert(gaps, 30, np.nan, axis=0)
    one, other = monitor(x), monitor(gaps)
    assert np.isnan(other.score[30]).all()
    np.testing.assert_array_equal(np.delete(other.score, 30, axis=0), one.score)
    np.testing.assert_array_equal(other.upper[30], other.upper[29])


def test_constant_series_give_no_signal():
    assert not monitor(np.full((60, 2), 3.25)).alarms.any()


def test_a_one_sided_chart_ignores_decreases():
    x = np.random.default_rng(9).normal(size=(80, 1))
    x[40:] -= 6.0
    assert monitor(x).alarms.any()
    assert not monitor(x, one_sided=(0,)).alarms.any()


def test_the_estimated_time_of_a_jump_is_that_of_the_jump():
    rng = np.random.default_rng(10)
    options = ChartOptions(autocorrelation=0.0)
    errors = []
    for _ in range(15):
        x = rng.normal(size=(110, 1))
        x[100:] += 4.0
        found = monitor(x, options)
        run = 100 + int(np.flatnonzero(found.alarms[100:])[0])
        errors.append(found.since(run, 0) - 100)
    assert np.abs(np.median(errors)) <= 1


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"rate": 0.0}, "rate: 0 is not above 0"),
        ({"autocorrelation": 1.0}, "autocorrelation: 1 is not from 0"),
        ({"rate": 40.0}, "every other run"),
        ({"correlated": 0.2}, "correlated: 0.2 is not from `autocorrelation`"),
        ({"tails": 2.0}, "tails: 2 is not above 2"),
        ({"kind": "pareto"}, "kind: 'pareto' is no chart"),
    ],
)
def test_unusable_options_are_refused(options, part):
    with pytest.raises(UsageError, match=part):
        ChartOptions(**options)


def warm(rng, runs=80, step=4.0):
    """Temperatures with a step after half of the runs."""
    return np.where(np.arange(runs) < runs // 2, 20.0, 20.0 + step) + rng.normal(0.0, 1.0, runs)


@pytest.mark.slow
def test_a_change_with_temperature_is_explained_and_drift_beside_it_is_not():
    explained, drift = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        t = warm(rng)
        x = np.column_stack([1.0 * t + rng.normal(size=80), rng.normal(size=80)])
        explained += [each[2] for each in explain(x, t[:, None]).verdicts]
        x[60:, 1] += 5.0
        verdicts = explain(x, t[:, None]).verdicts
        drift.append(any(series == 1 and run >= 60 and kind == "drift" for run, series, kind in verdicts))
    assert explained.count("explained") >= 4
    assert explained.count("drift") <= 1
    assert sum(drift) >= 7


def test_without_a_significant_dependence_nothing_is_explained():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(80, 1))
    x[60:] += 6.0
    found = explain(x, rng.normal(size=(80, 1)))
    assert found.verdicts
    assert {each[2] for each in found.verdicts} == {"drift"}


def runs(rng, t, slope, sigma=2e-4, bend=0.0):
    return [
        example_calibration(8.0 + slope * (v - 22) + bend * (v - 22) ** 2 + sigma * rng.normal()) for v in t
    ]


def test_the_function_of_temperature_has_its_errors_within_its_covariance():
    t, errors = np.linspace(18.0, 26.0, 20), []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        found = fit_function(runs(rng, t, 1e-3), {"temperature": t}, {"temperature": "°C"})
        if not found:  # a parabola fits better by chance
            continue
        q = found.at(temperature=25.0).parameters["c"]
        new = 8.0 + 3e-3 + 2e-4 * rng.normal()
        errors.append((new - q.value) / q.sigma)
    assert len(errors) >= 290
    # t distribution with 18 degrees of freedom: variance 1.125; five standard errors.
    assert np.var(errors) == pytest.approx(18 / 16, abs=5 * 1.125 * np.sqrt(2 / 300))


def test_a_function_is_declined_where_the_data_do_not_support_it():
    rng, t = np.random.default_rng(2), np.linspace(18.0, 26.0, 20)
    unit = {"temperature": "°C"}
    assert fit_function(runs(rng, t, 0.0), {"temperature": t}, unit).code == "not-identified"
    assert fit_function(runs(rng, t[:5], 1e-3), {"temperature": t[:5]}, unit).code == "no-redundancy"
    assert fit_function(runs(rng, t, 1e-3), {"temperature": np.full(20, 21.0)}, unit).code == "not-identified"
    assert fit_function(runs(rng, t, 1e-3, bend=4e-4), {"temperature": t}, unit).code == "unmodelled"
    bent = fit_function(runs(rng, t, 1e-3, bend=4e-4), {"temperature": t}, unit, FunctionOptions(degree=2))
    assert bent.at(temperature=26.0).parameters["c"].value == pytest.approx(8.0104, abs=5e-4)


def test_a_dependence_that_is_not_there_is_found_as_often_as_its_level_says():
    t, found = np.linspace(18.0, 26.0, 20), 0
    for seed in range(400):
        made = runs(np.random.default_rng(seed), t, 0.0)
        found += bool(
            fit_function(made, {"temperature": t}, {"temperature": "°C"}, FunctionOptions(alpha=0.05))
        )
    assert found <= 0.05 * 400 + 3 * np.sqrt(0.05 * 400)


def test_a_function_is_read_back_and_not_extrapolated():
    rng, t = np.random.default_rng(3), np.linspace(18.0, 26.0, 20)
    found = fit_function(runs(rng, t, 1e-3), {"temperature": t}, {"temperature": "°C"})
    again = CalibrationFunction.parse(found.to_json(), where="function.json")
    assert again.at(temperature=20.0) == found.at(temperature=20.0)
    with pytest.raises(UsageError, match="temperature: 30 °C is outside 18 to 26 °C"):
        found.at(temperature=30.0)
    with pytest.raises(UsageError, match="needs temperature"):
        found.at(zoom=2.0)
