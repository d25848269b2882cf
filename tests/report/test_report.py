"""The report: alone, the same to the byte, and with the figures that were computed."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from reseau.data import Frame, ImagePoints
from reseau.errors import UsageError
from reseau.procedures.oscilloscope import PhotoI, photo_i
from reseau.provenance import Provenance
from reseau.refine import CameraCorrection
from reseau.report import photo_i_report
from reseau.report.comparison import compare_with_truth, comparison_table
from reseau.report.figures import nice
from reseau.report.overlay import frame_overlay, preview
from reseau.report.overview import overview_png
from reseau_sims import World

NOISE_PX = 0.01


@pytest.fixture(scope="module")
def world() -> World:
    return World.standard(6)


@pytest.fixture(scope="module")
def found(world: World) -> PhotoI:
    """Corrected from true positions with noise of known size: nothing depends on the measurement."""
    truth = world.truth()
    noisy = truth.xy + np.random.default_rng(1).normal(0, NOISE_PX, truth.xy.shape)
    points = ImagePoints.with_sigma(truth.names, noisy, NOISE_PX)
    result = photo_i(points, world.design, check=world.check_marks())
    assert isinstance(result, PhotoI)
    return result


def page_of(world: World, found: PhotoI, frame: Frame | None = None) -> str:
    truth = compare_with_truth(found, world.design, world.view())
    provenance = Provenance({"photo": "0" * 64}, {"seed": 6})
    return photo_i_report(
        found, world.design, frame=frame, title="A <title> & more", provenance=provenance, truth=truth
    )


class Reader(HTMLParser):
    """Collects links and checks that tags are closed."""

    VOID = frozenset({"meta", "br", "image", "link"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_stands_alone_and_is_well_formed(world: World, found: PhotoI) -> None:
    pixels = np.random.default_rng(2).integers(0, 255, (120, 160)).astype(np.uint8)
    page = page_of(world, found, Frame(pixels, 255.0))
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    assert reader.links  # the picture, and references within the figures
    assert all(link.startswith(("#", "data:")) for link in reader.links)
    assert not re.search(r"url\((?!#)", page)
    assert "@import" not in page
    assert "A &lt;title&gt; &amp; more" in page


def test_same_input_same_bytes(world: World, found: PhotoI) -> None:
    first, second = page_of(world, found), page_of(world, found)
    assert first == second
    assert not re.search(r"20\d\d-\d\d-\d\d", first)


def test_the_page_tells_what_was_computed(world: World, found: PhotoI) -> None:
    page, fit = page_of(world, found), found.camera.fit
    assert fit is not None
    assert f"{fit.adjustment.sigma0:.3f}" in page
    assert f"{fit.adjustment.redundancy}</td>" in page
    assert f"{len(fit.check)} check marks" in page
    for name in fit.check.names:
        assert f"<td>{name}</td>" in page
    for name in fit.elimination.full.names:
        assert f"{name[0]}<sub>{name[1:]}</sub>" in page or f"<i>{name}</i>" in page
    for name in fit.elimination.dropped:
        assert f"<tr><td>{name}</td>" in page


def test_truth_and_correction_agree_to_the_noise(world: World, found: PhotoI) -> None:
    truth = compare_with_truth(found, world.design, world.view())
    assert truth.position_px == pytest.approx((NOISE_PX, NOISE_PX), rel=0.2)
    assert truth.position_normalised == pytest.approx((1.0, 1.0), rel=0.2)
    stages = [max(stage.check) for stage in truth.stages]
    assert stages == sorted(stages, reverse=True)
    assert stages[-1] < 0.005 < 0.05 < stages[0]  # millimetres
    assert max(truth.approximation) < 0.002
    lines = comparison_table(truth).splitlines()
    assert max(map(len, lines)) <= 80
    assert f"{truth.stages[-1].check[0]:.4f}" in lines[4]


def test_a_correction_from_a_file_has_nothing_to_show(world: World, found: PhotoI) -> None:
    read = CameraCorrection.from_calibration(found.camera.calibration(name="c"))
    with pytest.raises(UsageError, match="was read from a file"):
        photo_i_report(PhotoI(found.points, read, None), world.design)


def test_marks_not_found_are_crossed_out_and_those_nobody_expects_are_left_out() -> None:
    frame = Frame(np.random.default_rng(2).integers(0, 4000, (60, 80)).astype(np.uint16), 65535.0)
    xy = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 10.0], [np.nan, np.nan]])
    ok = np.array([True, False, True, False])
    drawn = frame_overlay(frame, ("a", "b", "c", "d"), xy, ok, ("c",))
    assert drawn.count("<circle") == 2
    assert drawn.count("<path") == 1
    assert 'cx="10.00" cy="20.00"' in drawn
    assert len(set(re.findall(r'stroke="(#\w+)"', drawn))) == 3  # fitted, not found, held out
    grey = preview(frame, 40)
    assert grey.shape == (30, 40)
    assert np.ptp(grey) > 100  # stretched


def test_the_overview_is_a_small_picture_and_the_same_to_the_byte(world: World, found: PhotoI) -> None:
    pixels = np.random.default_rng(2).integers(0, 255, (1200, 1600)).astype(np.uint8)
    first, second = (overview_png(found, Frame(pixels, 255.0), "mm") for _ in range(2))
    assert first == second
    assert first.startswith(b"\x89PNG")
    assert len(first) < 300_000


@pytest.mark.parametrize(
    ("value", "expected"), [(1.0, 1), (1.99, 1), (4.9, 2), (0.0071, 0.005), (250.0, 200)]
)
def test_scales_are_round_numbers(value: float, expected: float) -> None:
    assert nice(value) == pytest.approx(expected)
