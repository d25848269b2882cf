"""The report of a sensor: results and figures, reproducible to the byte."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.special import ndtr

from reseau.core.failure import Code, Failure
from reseau.core.provenance import Provenance
from reseau.report.sensor import mtf_figure, sensor_report
from reseau.sensor import EdgeSpread, Level, SensorSeries, calibrate_sensor
from reseau.sensor.sensor import SensorResult, with_edge
from reseau_sims.pixels import PixelSensor

EXPOSURES = (100.0, 1000.0, 2000.0, 4000.0, 6000.0, 8000.0, 12000.0, 17000.0)


@cache
def result() -> SensorResult:
    rng = np.random.default_rng(1)
    sensor = PixelSensor.drawn(rng)
    dark = tuple(Level.of(t, [sensor.expose(0.0, t, rng) for _ in range(6)]) for t in (100.0, 17_000.0))
    light = tuple(Level.of(t, [sensor.expose(0.25, t, rng) for _ in range(4)]) for t in EXPOSURES)
    y, x = np.mgrid[:64, :96]
    edge = 0.25 * (0.1 + 0.9 * ndtr((x - 48 - 0.1 * (y - 32)) / 0.8))
    frames = Level.of(6000.0, [sensor.expose(edge, 6000.0, rng) for _ in range(6)])
    return with_edge(calibrate_sensor(SensorSeries(dark, light, sensor.full_scale)), frames)


@pytest.mark.slow
def test_the_report_contains_all_results_and_is_reproducible_to_the_byte() -> None:
    provenance = Provenance({"edge 00 000": "ab" * 32}, {})
    page = sensor_report(result(), title="Sensor", provenance=provenance)
    assert page == sensor_report(result(), title="Sensor", provenance=provenance)
    assert page.count("<svg") == 2
    text = re.sub(r"<[^>]+>", " ", page)
    found = result().quantities()
    for name in ("psf", "mtf50_free", "mtf_nyquist_free", "gain"):
        digits = 1 - int(np.floor(np.log10(found[name].sigma)))
        assert re.search(rf"\s{found[name].value:.{digits}f}\s", text), name
    assert "Gaussian edge" in text
    assert "0.5000" in text
    assert not re.search(r"(href|src)=\"[^#]", page)


def test_the_curves_of_the_figure_are_the_estimated_ones() -> None:
    edge = result().edge
    assert isinstance(edge, EdgeSpread)
    figure = mtf_figure(edge)
    assert figure.startswith("<svg")
    # A band, a marked half, and each curve twice beside its line-spread function.
    assert figure.count("stroke-dasharray") >= 2
    assert "PolyCollection" in figure or "FillBetween" in figure


@pytest.mark.parametrize("edge", [None, Failure("the edge is slanted by 0.1°", Code.SLANT)])
def test_quantities_that_were_not_measured_are_reported(edge: Failure | None) -> None:
    page = sensor_report(replace(result(), edge=edge), title="Sensor")
    assert page.count("<svg") == 1
    assert ("slanted by 0.1°" in page) is (edge is not None)
