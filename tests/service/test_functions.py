"""Calibrations as a function of temperature: from an archive, with the uncertainty of the temperature."""

from __future__ import annotations

import json
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from reseau.archive import Archive
from reseau.calibration import read_calibration
from reseau.cli import run
from reseau.core.data import ImagePoints
from reseau.core.errors import UsageError
from reseau.service import Configurations
from reseau.service.certificates import measurement_budget
from reseau.service.certificates.budget import simulate_measurement, uncertainty_of
from reseau.service.covariates import CalibrationFunction

from .test_inforce import RULES, START, camera

SLOPE = {"c": 1e-3, "x0": -5e-4}  # mm per kelvin


@pytest.fixture(scope="module")
def warm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an archive of 30 calibrations whose c and x0 follow the temperature, and their table."""
    folder = tmp_path_factory.mktemp("warm")
    rng, lines = np.random.default_rng(4), ["calibration,temperature [°C]"]
    with Archive.open(folder / "archive", create=True) as archive:
        known = Configurations(archive)
        known.define("left", {"camera": "DMK 33"})
        for k, t in enumerate(rng.uniform(18.0, 26.0, 30)):
            values = {"c": 8.0 + SLOPE["c"] * (t - 22), "x0": 0.02 + SLOPE["x0"] * (t - 22)}
            drawn = camera(**{name: value + 2e-4 * rng.normal() for name, value in values.items()})
            stored = {"mean": round(t, 3), "low": t, "high": t, "unit": "°C", "sigma": 0.2, "frames": 9}
            drawn = drawn.model_copy(update={"provenance": {"environment": {"air.temperature": stored}}})
            made = known.decide("left", drawn, RULES, since=START + timedelta(weeks=k))
            if made.outcome == "needs review":
                known.review("left", made.key, "accepted", comment="first")
            if made.outcome != "rejected":
                lines.append(f"{made.key},{t:.3f}")
    (folder / "runs.csv").write_text("\n".join(lines))
    return folder


@pytest.mark.slow
def test_a_function_is_fitted_evaluated_and_budgeted_from_the_command_line(
    warm: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(warm)
    assert run(["calibrations", "function", "left", "--covariates", "runs.csv", "--out", "left.json"]) == 0
    assert run(["calibrations", "at", "left.json", "-c", "temperature=24±0.5", "--out", "camera.json"]) == 0
    made = read_calibration(Path("camera.json"))
    assert made.parameters["c"].value == pytest.approx(8.002, abs=2e-4)
    capsys.readouterr()
    assert run(["uncertainty", "camera.json", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    sigma = {each["name"]: each["sigma"] for each in told["contributions"]}
    c = told["results"]["name"].index("c")
    # Half a kelvin, and the error of the slope.
    assert sigma["temperature"][c] == pytest.approx(0.5 * SLOPE["c"], rel=0.1)
    x0 = told["results"]["name"].index("x0")
    assert told["covariance"][c][x0] == pytest.approx(0.25 * SLOPE["c"] * SLOPE["x0"], rel=0.2)
    assert run(["calibrations", "drift", "left", "--covariates", "runs.csv"]) == 0


@pytest.mark.slow
def test_what_sensors_recorded_serves_as_a_table_of_covariates(
    warm: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(warm)
    assert run(["calibrations", "function", "left", "--covariates", "runs.csv", "--out", "table.json"]) == 0
    assert run(["calibrations", "function", "left", "--recorded", "temperature", "--out", "known.json"]) == 0
    assert Path("known.json").read_text() == Path("table.json").read_text()
    capsys.readouterr()
    assert run(["calibrations", "drift", "left", "--recorded", "temperature", "--json"]) == 0
    assert all(each["verdict"] == "explained" for each in json.loads(capsys.readouterr().out)["verdicts"])
    for wrong in (["--recorded", "dew"], ["--recorded", "temperature", "--covariates", "runs.csv"]):
        assert run(["calibrations", "drift", "left", *wrong]) != 0
    assert "recorded nothing as dew" in capsys.readouterr().err


@pytest.mark.slow
def test_points_measured_at_an_uncertain_temperature_share_its_error(warm: Path) -> None:
    """Their covariance is that of drawn temperatures."""
    with Archive.open(warm / "archive") as archive:
        from reseau.service import CovariateTable

        function = Configurations(archive).function("left", CovariateTable.read(warm / "runs.csv"))
    assert isinstance(function, CalibrationFunction)
    points = ImagePoints.with_sigma(["a", "b"], [[40.0, 30.0], [600.0, 440.0]], 1e-4)
    known, uncertain = (function.at({"temperature": s}, temperature=24.0) for s in (0.0, 0.5))
    before, after = (measurement_budget(uncertainty_of(each), points) for each in (known, uncertain))
    added = after.covariance - before.covariance

    def mapped(t: float) -> np.ndarray:
        return function.at(temperature=t).mapping().derivatives(points.xy)[0].ravel()

    # The linear effect of half a kelvin, by the difference of whole calibrations.
    effect = (mapped(24.5) - mapped(23.5)) * 0.5
    np.testing.assert_allclose(added, np.outer(effect, effect), rtol=1e-3, atol=1e-3 * (effect**2).max())
    drawn = simulate_measurement(uncertainty_of(uncertain), points, draws=4000)
    np.testing.assert_allclose(drawn.sigma, after.sigma, rtol=0.06)  # 5 standard errors


@pytest.mark.slow
def test_a_function_cannot_be_used_where_it_is_not_known(warm: Path) -> None:
    with Archive.open(warm / "archive") as archive:
        from reseau.service import CovariateTable

        table = CovariateTable.read(warm / "runs.csv")
        function = Configurations(archive).function("left", table)
        assert isinstance(function, CalibrationFunction)
        with pytest.raises(UsageError, match="30 °C is outside"):
            function.at(temperature=30.0)
        with pytest.raises(UsageError, match="-1 of temperature is no standard uncertainty"):
            function.at({"temperature": -1.0}, temperature=22.0)
        short = CovariateTable(table.keys[1:], {"temperature": table.values["temperature"][1:]}, table.units)
        with pytest.raises(UsageError, match="has no lines with it"):
            Configurations(archive).function("left", short)
