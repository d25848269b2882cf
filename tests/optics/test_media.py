"""Media: indices against data sheets and published tables, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.optics.lenses import AIR, Medium, glass, glass_names
from reseau.optics.lenses.media import Air, Cauchy, Constant, Powers, Sellmeier, Water, model_glass

F, D, C = 486.1327, 587.5618, 656.2725


@pytest.mark.parametrize(
    ("name", "n_d", "abbe"),
    [
        # As printed in the data sheets of the makers.
        ("N-BK7", 1.51680, 64.17),
        ("N-SF6", 1.80518, 25.36),
        ("F5", 1.60342, 38.03),
        ("N-SK16", 1.62041, 60.32),
        ("N-SSK2", 1.62229, 53.27),
        ("SF11", 1.78472, 25.76),
        ("N-LASF9", 1.85025, 32.17),
        ("S-LAL8", 1.71300, 53.87),
        ("S-TIH53", 1.84666, 23.78),
        ("L-TIM28", 1.68948, 31.02),
        ("H-K9L", 1.51680, 64.20),
        ("D-ZK3", 1.58913, 61.15),
        ("TAF3", 1.80420, 46.50),
        ("FCD1", 1.49700, 81.61),
        ("SILICA", 1.45846, 67.82),
        ("CAF2", 1.43385, 95.10),
    ],
)
def test_catalogued_glasses_have_the_index_and_dispersion_of_their_data_sheets(
    name: str, n_d: float, abbe: float
) -> None:
    n_f, found, n_c = (glass(name).index(w) for w in (F, D, C))
    assert found == pytest.approx(n_d, abs=1.1e-5)
    assert (found - 1) / (n_f - n_c) == pytest.approx(abbe, abs=0.15)


def test_every_glass_of_the_catalogue_has_a_plausible_index_that_falls_with_the_wavelength() -> None:
    assert len(glass_names()) > 80
    for name in glass_names():
        assert glass(name).name == name
        blue, green, red = (glass(name).index(w) for w in (450.0, 550.0, 650.0))
        assert 1.4 < red < green < blue < 2.2, name


def test_spellings_of_a_glass_are_the_same_and_those_of_another_maker_are_not() -> None:
    assert glass("NBK7_SCHOTT") == glass("n-bk7") == glass("BK7")
    with pytest.raises(UsageError, match="NBK7_OHARA is not in the catalogue"):
        glass("NBK7_OHARA")


@pytest.mark.parametrize(
    ("temperature", "pressure_hpa", "refractivity"),
    # Ciddor 1996, Applied Optics 35, 1566, table 1: dry air at 633 nm, in 1e-8.
    [(20, 800, 21458.0), (20, 1000, 26824.4), (20, 1200, 32191.6), (10, 1000, 27774.7), (30, 1000, 25937.2)],
)
def test_air_has_the_refractivity_of_an_independent_formula(
    temperature: float, pressure_hpa: float, refractivity: float
) -> None:
    vacuum = Air(20.0, 0.0).index(633.0)
    found = 1e8 * (Air(temperature, pressure_hpa).index(633.0) / vacuum - 1)
    assert found == pytest.approx(refractivity, abs=5.0)


def test_reference_air_has_the_index_one() -> None:
    assert AIR.index(550.0) == 1.0
    assert Air(20.0, 1013.25).index(550.0) == 1.0


@pytest.mark.parametrize(
    ("water", "n"),
    [
        # Relative to air at the D line: IAPWS 1997 for fresh water, Austin and Halikas 1976 for sea water.
        (Water(20.0), 1.33299),
        (Water(25.0), 1.33251),
        (Water(20.0, 35.0), 1.33940),
    ],
)
def test_water_has_the_index_of_independent_tables(water: Water, n: float) -> None:
    assert water.index(589.3) == pytest.approx(n, abs=6e-5)


def test_a_model_glass_follows_a_real_one_between_the_lines_it_is_made_of() -> None:
    bk7 = glass("N-BK7")
    n_f, n_d, n_c = (bk7.index(w) for w in (F, D, C))
    model = model_glass(n_d, (n_d - 1) / (n_f - n_c))
    assert max(abs(model.index(w) - bk7.index(w)) for w in np.linspace(F, C, 30)) < 3e-4


@pytest.mark.parametrize(
    ("medium", "wavelength"),
    [
        (glass("N-BK7"), 250.0),
        (Water(), 1000.0),
        (Air(), 200.0),
        (Cauchy((1.5,), "plastic", (400.0, 700.0)), 800.0),
        (Constant(1.5), 0.0),
        (Constant(1.5), float("nan")),
        (Sellmeier((-3.0,), (0.01,), "nothing"), 550.0),
        (Powers(-1.0, (), "nothing"), 550.0),
    ],
)
def test_no_index_is_given_outside_of_a_formula(medium: Medium, wavelength: float) -> None:
    with pytest.raises(UsageError):
        medium.index(wavelength)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Water(40.0),
        lambda: Water(20.0, 60.0),
        lambda: Air(200.0),
        lambda: Constant(0.0),
        lambda: Constant(float("inf")),
        lambda: model_glass(0.9, 60.0),
        lambda: model_glass(1.5, 0.0),
    ],
)
def test_media_that_cannot_be_are_refused(make: object) -> None:
    with pytest.raises(UsageError):
        make()  # type: ignore[operator]
