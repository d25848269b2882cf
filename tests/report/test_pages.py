"""Pages for everybody: alternative texts, headings in order, a dark scheme, nothing from outside."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from reseau.bundle import adjust_network, example_network
from reseau.calibration import CameraMapping
from reseau.core.data import Frame
from reseau.core.figures import contour_levels
from reseau.core.numbers import power
from reseau.core.provenance import Provenance
from reseau.core.version import __version__
from reseau.io.photographs import Exif
from reseau.optics import PixelGrid
from reseau.optics.cameras.registry import camera_model
from reseau.procedures.assessment import assess
from reseau.report import oscilloscope_report
from reseau.report.bundle import bundle_report
from reseau.report.bundle_figures import _radial, distortion_figure
from reseau.report.page import applied_report
from reseau.report.template import TEMPLATES, environment

from .conftest import Bench

FRAME = Frame(np.random.default_rng(2).integers(0, 255, (120, 160)).astype(np.uint8), 255.0, "photo")


class Outline(HTMLParser):
    """Levels of the headings, the names of pictures, texts by their ids, and links to other files."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.levels: list[int] = []
        self.named_by: list[str | None] = []
        self.unnamed = 0
        self.texts: dict[str, str] = {}
        self.links: list[str] = []
        self._inside: str | None = None
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if re.fullmatch("h[1-6]", tag):
            self.levels.append(int(tag[1]))
        if tag == "svg":
            self.named_by.append(given.get("aria-labelledby") if given.get("role") == "img" else None)
        if tag == "img":
            self.unnamed += not given.get("alt")
        if tag == "figcaption":
            self._inside = given.get("id") or ""
            self.texts[self._inside] = ""
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)

    def handle_data(self, data: str) -> None:
        if self._inside is not None:
            self.texts[self._inside] += data

    def handle_endtag(self, tag: str) -> None:
        if tag == "figcaption":
            self._inside = None


def bundle_page() -> str:
    result = adjust_network(example_network()).required()
    return bundle_report(
        result, title="Block", assessments={"camera": assess(result)}, photograph=lambda name: FRAME
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bundle", "oscilloscope", "applied"])
def test_a_page_has_named_pictures_headings_in_order_and_nothing_from_outside(
    bench: Bench, kind: str
) -> None:
    if kind == "bundle":
        page = bundle_page()
    elif kind == "oscilloscope":
        page = oscilloscope_report(
            bench.first, bench.world.design, bench.second, bench.world.test_object, (bench.third,),
            frames=(FRAME, FRAME, FRAME), truth=bench.truth,
        )  # fmt: skip
    else:
        page = applied_report(bench.world.test_object, (bench.third,), frames=(FRAME,))
    found = Outline(page)
    assert len(found.named_by) >= (2 if kind == "applied" else 6)
    for name in found.named_by:
        assert name is not None
        assert len(found.texts[name].split()) > 5
    assert found.unnamed == 0
    assert found.levels[0] == 1
    assert found.levels.count(1) == 1
    steps = np.diff(found.levels)
    assert steps.max(initial=0) <= 1
    assert all(link.startswith(("#", "data:")) for link in found.links)
    assert "@media screen and (prefers-color-scheme: dark)" in page
    assert not re.search(r"url\((?!#)|@import|<script", page)


def test_all_pages_have_one_frame_and_one_way_to_show_figures_and_tables() -> None:
    loader = environment().loader
    assert loader is not None
    names = [name for name in loader.list_templates() if not name.startswith("_")]
    assert len(names) > 10
    for name in names:
        text = loader.get_source(environment(), name)[0]
        assert "<figure" not in text
        assert "<html" not in text
        assert text.count("<table") == text.count('<div class="wide" tabindex="0"><table')
        if name in TEMPLATES:
            assert text.startswith('{% extends "_page.html.j2" %}')


def wide_lens() -> CameraMapping:
    """A fisheye of 170° along the diagonal, with the uncertainty of its coefficients."""
    lens = camera_model("fisheye").mapping(
        [500.0, 500.0, 639.5, 479.5, 0.03, -0.008, 0.002, -3e-4], PixelGrid(1280, 960, (1.0, 1.0))
    )
    rows = np.array([lens.names.index(name) for name in ("k1", "k2", "k3", "k4")], dtype=np.intp)
    return CameraMapping(lens, 1280, 960, rows, np.diag([1e-4, 1e-4, 1e-5, 1e-6]) ** 2)


def test_the_distortion_of_a_wide_lens_is_drawn_by_the_angle() -> None:
    found = distortion_figure(wide_lens())
    assert found is not None
    assert found[1].startswith("Radius in the image by the angle of the ray")
    at, radius, sigma, ideal = _radial(wide_lens())  # type: ignore[misc]
    angle = np.deg2rad(at)
    k = (0.03, -0.008, 0.002, -3e-4)
    own = 500.0 * angle * (1 + sum(c * angle ** (2 * i) for i, c in enumerate(k, start=1)))
    assert np.abs(radius - own).max() < 1e-6
    assert np.abs(ideal - 500.0 * angle).max() < 1e-6
    effect = [500.0 * s * angle ** (2 * i + 1) for i, s in enumerate((1e-4, 1e-4, 1e-5, 1e-6), start=1)]
    assert np.abs(sigma - np.sqrt(sum(e**2 for e in effect))).max() < 1e-6
    assert 80 < at[-1] < 90


@pytest.mark.slow
def test_powers_of_ten_stand_with_each_number_and_options_that_were_not_given_are_not_listed() -> None:
    macros = environment().get_template("_macros.html.j2").module
    cells = re.findall(r"<td>(.*?)</td>", str(macros.quantity(power(5.882e-4, 1.0e-5))))  # type: ignore[attr-defined]
    assert len(cells) == 2
    assert all("10<sup>−4</sup>" in cell for cell in cells)
    result = adjust_network(example_network()).required()
    given = Provenance({}, {"sigma": None, "reject": False, "free": (), "leave_out": "", "row_jitter": 0.0})
    page = bundle_report(result, title="Block", provenance=given)
    listed = page.split("<h2>Provenance</h2>")[1]
    assert "None" not in listed
    assert "False" not in listed
    assert "<dt>free</dt>" not in listed
    assert "<dt>row jitter</dt><dd>0.0</dd>" in listed


@pytest.mark.slow
def test_the_first_screen_has_camera_days_version_verdict_map_and_every_photograph() -> None:
    result = adjust_network(example_network()).required()
    assessed = assess(result)
    page = bundle_report(
        result, title="Block", assessments={"camera": assessed}, photograph=lambda name: FRAME,
        exif=[Exif(day="2026-03-05", camera="Zeiss RMK"), Exif(day="2026-03-07", camera="Zeiss RMK"), Exif()],
    )  # fmt: skip
    first = page.split("<header>")[1].split("</header>")[0]
    camera = result.network.cameras[0]
    described = f"{camera.model}, {camera.width} × {camera.height} px"
    assert f"Zeiss RMK · {described} · {len(result.network.images)} photographs" in first
    assert f"2026-03-05 to 2026-03-07 · reseau {__version__}" in first
    assert first.index(assessed.lines[0][1:]) < first.index("the total error of the projection")
    captions = re.findall(r'<figcaption id="thumbnail-\d+">(.*?): \d+ points, [\d.e-]+ px rms<', first)
    assert captions == list(result.network.images)


def test_a_map_has_contours_at_1_2_5_and_a_colour_bar() -> None:
    errors = assess(adjust_network(example_network()).required()).errors
    assert errors is not None
    levels = contour_levels(np.stack([errors.total, errors.formal]))
    assert len(levels) > 2
    assert {f"{level:.0e}"[0] for level in levels} <= {"1", "2", "5"}
    axes = errors.plot()
    bar = axes.figure.axes[-1]
    assert bar is not axes
    assert [label.get_text() for label in bar.get_yticklabels()] == [f"{level:g}" for level in levels]
