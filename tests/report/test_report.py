"""The report: alone, the same to the byte, and with the figures that were computed."""

from __future__ import annotations

import re
from functools import cache
from html.parser import HTMLParser

import numpy as np
import pytest

from reseau.calibration import CameraCorrection, InstrumentCorrection
from reseau.core.data import Frame, ImagePoints
from reseau.core.errors import UsageError
from reseau.core.provenance import Provenance
from reseau.optics import RationalPolynomial
from reseau.procedures.oscilloscope import PhotoI, PhotoII
from reseau.report import oscilloscope_report
from reseau.report.comparison import compare_with_truth
from reseau.report.figures import nice
from reseau.report.maps import body_map
from reseau.report.overview import overview_png
from reseau.report.photo_ii import equations
from reseau.report.truth import Known

from .conftest import Bench

FRAME = Frame(np.random.default_rng(2).integers(0, 255, (120, 160)).astype(np.uint8), 255.0, "photo")


@cache
def first_page(bench: Bench) -> str:
    """The page of PHOTO I alone."""
    truth = compare_with_truth(Known(bench.world.view()), bench.first, bench.world.design)
    return oscilloscope_report(
        bench.first,
        bench.world.design,
        frames=(FRAME,),
        title="A <title> & more",
        provenance=Provenance({"photo": "0" * 64}, {"seed": 6}),
        truth=truth,
    )


@cache
def whole_page(bench: Bench, with_truth: bool = True) -> str:
    """The page of all three photographs, with the truth or without."""
    return oscilloscope_report(
        bench.first,
        bench.world.design,
        bench.second,
        bench.world.test_object,
        (bench.third,),
        frames=3 * (FRAME,),
        title="A <title> & more",
        truth=bench.truth if with_truth else None,
    )


class Reader(HTMLParser):
    """Collects links and text, and checks that tags are closed."""

    VOID = frozenset({"meta", "br", "image", "link"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.rows: list[list[str]] = []
        self.equations: dict[str, list[str]] = {"symbols": [], "numbers": []}
        self._cell: list[str] | None = None
        self._equation: str | None = None
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "dd", "th"):
            self._cell = []
        kind = dict(attrs).get("class")
        self._equation = (
            kind if tag == "dd" and kind in self.equations else None if tag == "dd" else self._equation
        )

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_data(self, data: str) -> None:
        if self._cell is not None:
            self._cell.append(data)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        if tag in ("td", "th", "dd") and self._cell is not None:
            text = "".join(self._cell).replace("\u00a0", " ").strip()
            if tag == "dd" and self._equation:
                self.equations[self._equation].append(text)
            elif tag != "dd" and self.rows:
                self.rows[-1].append(text)
            self._cell = None

    def row(self, head: str, cells: int | None = None) -> list[str]:
        """The cells after the head of the first row that begins so, and has so many if that is given."""
        return next(row[1:] for row in self.rows if row and row[0] == head and cells in (None, len(row)))


def numbers(cells: list[str]) -> list[float]:
    """Cells as numbers, the true minus read as one."""
    return [float(cell.replace("\u2212", "-")) for cell in cells]


@pytest.mark.slow
@pytest.mark.parametrize("whole", [False, True])
def test_the_page_needs_no_other_files_and_is_well_formed(bench: Bench, whole: bool) -> None:
    page = whole_page(bench) if whole else first_page(bench)
    reader = Reader(page)
    assert reader.open == []
    assert reader.links  # the pictures, and references within the figures
    assert all(link.startswith(("#", "data:")) for link in reader.links)
    assert page.count("data:image/jpeg") == (3 if whole else 1)
    assert not re.search(r"url\((?!#)", page)
    assert "@import" not in page
    assert "A &lt;title&gt; &amp; more" in page


@pytest.mark.slow
def test_the_same_input_gives_the_same_bytes_without_clock_times(bench: Bench) -> None:
    assert first_page(bench) == first_page.__wrapped__(bench)
    page = whole_page(bench)
    assert page == whole_page.__wrapped__(bench)
    assert not re.search(r"20\d\d-\d\d-\d\d", page)


@pytest.mark.slow
def test_figures_and_tables_are_numbered_consecutively(bench: Bench) -> None:
    page = whole_page(bench)
    for kind in ("Figure", "Table"):
        found = [int(n) for n in re.findall(rf"<b>{kind} (\d+)\.", page)]
        assert sorted(found) == list(range(1, len(found) + 1))
        assert len(found) > 7


def test_the_page_of_photo_i_has_only_its_sections(bench: Bench) -> None:
    page = first_page(bench)
    for there in (
        "camera and film, group A",
        "Check marks",
        "compared with the simulated truth",
        "Provenance",
    ):
        assert there in page
    for absent in ("PHOTO II", "group B", "Factor by factor", "Wong", "ellipses"):
        assert absent not in page


def test_the_page_contains_the_results_of_the_camera(bench: Bench) -> None:
    reader, fit = Reader(first_page(bench)), bench.first.camera.fit
    assert fit is not None
    assert reader.row("a posteriori σ0") == [f"{fit.adjustment.sigma0:.3f}"]
    assert reader.row("redundancy") == [str(fit.adjustment.redundancy)]
    for name, left in zip(fit.check.names, (fit.check.xy - fit.check_target) * 1000, strict=True):
        assert numbers(reader.row(name))[2:4] == pytest.approx(left, abs=0.006)
    for name in fit.elimination.full.names:
        assert reader.row(name)[-1] == (
            "dropped" if name in fit.elimination.dropped else reader.row(name)[-1]
        )


def test_the_page_contains_the_results_of_the_instrument(bench: Bench) -> None:
    reader, second = Reader(whole_page(bench)), bench.second
    fit, causes = second.instrument.fit, second.causes
    assert fit is not None
    assert fit.displays is not None
    assert causes is not None
    assert numbers(reader.row("λ1")[:1] + reader.row("λ2")[:1]) == pytest.approx(
        second.instrument.plane.scale, abs=6e-6
    )
    tests = {step.name: step.test for step in fit.elimination.steps}
    assert tests  # rods good to a quarter of a millimetre do not bear out 16 coefficients
    for name, test in tests.items():
        *_, p, verdict = reader.row(name, cells=7)
        assert verdict == "dropped"
        assert float(p) == pytest.approx(test.p, abs=6e-4)
        # Where it is applied all the same, its value stands there.
        assert (reader.row(name, cells=7)[0] == "–") == (name not in second.instrument.model.names)
    for condition in causes.conditions:
        row = reader.row(condition.condition)
        assert row[-1] == ("holds" if condition.holds else "does not hold")
        assert float(row[-4]) == pytest.approx(condition.statistic, abs=0.006)
    assert numbers(reader.row("polynomials (7a, b)"))[-2:] == pytest.approx(fit.displays.rms[0], abs=6e-4)
    assert numbers(reader.row("Wong’s display model"))[-2:] == pytest.approx(fit.displays.rms[1], abs=6e-4)


def test_the_page_contains_true_coordinates_with_sigmas_and_errors(bench: Bench) -> None:
    reader, true = Reader(whole_page(bench)), bench.third.true
    expected = dict(zip(bench.known.bodies[0].names, bench.known.bodies[0].object_xy, strict=True))
    for name, xy, sigma in zip(true.names, true.xy, true.sigma, strict=True):
        # A coefficient may have the same name; this one is found again by its place.
        row = next(row[1:] for row in reader.rows if len(row) == 8 and row[0] == row[5] == name)
        assert numbers(row[:4]) == pytest.approx([*xy, *sigma], abs=6e-4)
        assert numbers(row[5:]) == pytest.approx(xy - expected[name], abs=6e-4)


def test_the_page_contains_the_numbers_of_the_comparison_for_each_factor(bench: Bench) -> None:
    reader = Reader(whole_page(bench))
    assert len(bench.truth.factors) == 5
    for factor in bench.truth.factors:
        assert factor.rods is not None
        assert factor.body is not None
        assert factor.ideal is not None
        shown = numbers(reader.row(factor.name))
        assert shown == pytest.approx([*factor.rods, *factor.body, *factor.ideal], abs=6e-4)
    both = bench.truth.factors[3]
    assert both.body is not None
    assert f"a point of PHOTO III is {np.hypot(*both.body):.3f}\u00a0mm" in whole_page(bench).replace(
        "&nbsp;", "\u00a0"
    )


@pytest.mark.slow
def test_without_the_truth_only_rods_are_listed(bench: Bench) -> None:
    page = whole_page(bench, with_truth=False)
    assert "simulated" not in page
    assert "truth" not in page
    reported = {factor.name: factor.rods for factor in bench.truth.factors}
    assert numbers(Reader(page).row("groups A and B")) == pytest.approx(reported["groups A and B"], abs=6e-4)


def test_dropped_terms_are_absent_from_the_reduced_equations(bench: Bench) -> None:
    page, fit = Reader(whole_page(bench)), bench.second.instrument.fit
    assert fit is not None
    found = [set(re.findall(r"[AB]\d", line)) for line in page.equations["symbols"]]
    assert fit.monomials is not None
    # One coefficient stands before each of its monomials that remain.
    kept = {n.partition(".")[0] for n in set(fit.monomials.full.names) - set(fit.monomials.dropped)}
    assert found == [{n for n in kept if n[0] == "A"}, {n for n in kept if n[0] == "B"}]
    constant = float(page.equations["numbers"][0].split()[1].replace("\u2212", "-"))
    assert constant == pytest.approx(fit.monomials.adjustment["A0"], abs=6e-3)


def test_the_final_equations_are_written_as_in_the_paper() -> None:
    model = RationalPolynomial.ultrasonic(reduced=True)
    value = dict.fromkeys(model.names, -2.5) | {"A0": 0.5}
    x, y = equations(model, value, dict.fromkeys(model.names, 0.1))
    assert x[1].striptags().replace("\u00a0", " ") == "A0 + A1 x + A6 xy² + A7 x⁴"
    assert y[1].striptags().replace("\u00a0", " ") == "B0 + B1 y + B2 x + B6 x²y + B7 y⁴"
    assert x[2].striptags().replace("\u00a0", " ").startswith("0.50 − 2.50 x − 2.50 xy²")
    whole = equations(RationalPolynomial.ultrasonic(), {"A6": 1.0, "A7": 1.0}, {"A6": 0.1, "A7": 0.1})[0]
    assert whole[1].striptags().replace("\u00a0", " ") in (
        "A6 (xy² + x³) + A7 (x² + y²)²",
        "A6 (x³ + xy²) + A7 (x² + y²)²",
    )


def test_a_correction_from_a_file_gives_no_report(bench: Bench) -> None:
    camera = CameraCorrection.from_calibration(bench.first.camera.calibration(name="c"))
    with pytest.raises(UsageError, match="was read from a file"):
        oscilloscope_report(PhotoI(bench.first.points, camera, None), bench.world.design)
    design, rods = bench.world.design, bench.world.test_object
    stored = bench.second.instrument.calibration(design, rods, name="c")
    instrument, *_ = InstrumentCorrection.from_calibration(stored)
    second = PhotoII(bench.second.pins, instrument, None, None, (), None)
    with pytest.raises(UsageError, match="was read from a file"):
        oscilloscope_report(bench.first, design, second, rods)


def test_a_photograph_without_its_predecessors_is_refused(bench: Bench) -> None:
    with pytest.raises(UsageError, match="needs PHOTO II"):
        oscilloscope_report(bench.first, bench.world.design, third=(bench.third,))
    with pytest.raises(UsageError, match="needs its test object"):
        oscilloscope_report(bench.first, bench.world.design, bench.second)


@pytest.mark.slow
def test_the_overview_is_small_and_reproducible_to_the_byte(bench: Bench) -> None:
    pixels = np.random.default_rng(2).integers(0, 255, (1200, 1600)).astype(np.uint8)
    frames = 3 * (Frame(pixels, 255.0),)
    one, other = (
        overview_png(bench.first, bench.second, bench.world.test_object, bench.third, frames, bench.truth)
        for _ in range(2)
    )
    assert one == other
    assert one.startswith(b"\x89PNG")
    assert len(one) < 1_000_000


def test_error_ellipses_are_enlarged_until_they_can_be_seen() -> None:
    xy = np.array([[0.0, 0.0], [50.0, 20.0], [100.0, 80.0]])
    for sigma, least, most in ((0.1, 5, 50), (0.001, 500, 5000)):
        points = ImagePoints.with_sigma(("a", "b", "c"), xy, sigma)
        svg, enlarged = body_map(points, xy, "mm")
        assert least <= enlarged <= most
        assert svg.startswith("<svg")


@pytest.mark.parametrize(
    ("value", "expected"), [(1.0, 1), (1.99, 1), (4.9, 2), (0.0071, 0.005), (250.0, 200)]
)
def test_scales_are_round_numbers(value: float, expected: float) -> None:
    assert nice(value) == pytest.approx(expected)
