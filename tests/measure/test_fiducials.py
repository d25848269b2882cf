"""Fiducial marks: forms, orientation of the film, missing marks, foreign pictures."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.calibration import read_calibration
from reseau.core.data import ImagePoints
from reseau.core.failure import Code, Failure
from reseau.io import FiducialDesign, FiducialMark, FiducialOrientation, MarkPart
from reseau.io.scans import scan_of
from reseau.measure.fiducials import learn_marks, measure_fiducials
from reseau.measure.fiducials.forms import contours_of
from reseau.measure.fiducials.learning import LearntDesign
from reseau.measure.fiducials.measure import FiducialOptions
from reseau.measure.fiducials.result import FiducialResult
from reseau.optics.formation import Outline, draw, mark_outline

from .photographs import PLACES, UNEVEN, camera, photograph


def measured(image, design: FiducialDesign, **options) -> FiducialResult:
    found = measure_fiducials(scan_of(image, "photo.tif", dpi=255.0), design, FiducialOptions(**options))
    assert not isinstance(found, Failure), found
    return found


def area(contours) -> float:
    return sum(
        0.5 * float(np.sum(c[:, 0] * np.roll(c[:, 1], -1) - c[:, 1] * np.roll(c[:, 0], -1))) for c in contours
    )


def learnt(image, design: FiducialDesign, place, mark_px: float, name: str) -> LearntDesign:
    found = learn_marks(scan_of(image), design, {name: tuple(np.rint(place))}, mark_px)
    assert not isinstance(found, Failure), found
    return found


_SQUARE = MarkPart(shape="square", size=1.0)


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ((MarkPart(shape="disk", size=2.0),), np.pi),
        ((MarkPart(shape="ring", size=2.0, line_width=0.5),), np.pi * 0.75),
        ((MarkPart(shape="cross", size=2.0, line_width=0.2),), 0.76),
        ((MarkPart(shape="cross", size=2.0, line_width=0.2, gap=1.0),), 0.4),
        ((MarkPart(shape="arc", size=2.0, line_width=0.5, from_deg=0, to_deg=90),), np.pi * 0.75 / 4),
        ((MarkPart(shape="wedge", size=2.0, width=1.0),), 1.0),
        ((MarkPart(shape="square", size=1.0), MarkPart(shape="square", size=1.0, at=(0.5, 0.5))), 1.75),
        (
            (MarkPart(shape="cross", size=2.0, line_width=0.2), MarkPart(shape="disk", size=1.0)),
            0.4 + np.pi / 4,
        ),
        ((MarkPart(shape="polygon", corners=((0, 0), (0, 1), (2, 1), (2, 0))),), 2.0),
        ((MarkPart(shape="arc", size=2.0, from_deg=0, to_deg=180),), np.pi / 2),
        ((MarkPart(shape="cross", size=2.0, line_width=0.2, arms_deg=(0, 90)),), 0.4),
        ((MarkPart(shape="cross", size=2.0, line_width=0.2, arms_deg=(0, 90, 180)),), 0.58),
        # Parts that touch along a side, lie on each other, or are taken away.
        (
            (MarkPart(shape="square", size=1.0), MarkPart(shape="bar", size=1.0, line_width=1.0, at=(1, 0))),
            2.0,
        ),
        ((_SQUARE, _SQUARE), 1.0),
        ((MarkPart(shape="disk", size=2.0), MarkPart(shape="square", size=1.0, use="cut")), np.pi - 1),
        ((MarkPart(shape="disk", size=2.0), MarkPart(shape="square", size=1.0, use="ignore")), np.pi),
    ],
)
def test_a_mark_covers_the_area_of_the_union_of_its_parts(parts, expected) -> None:
    # The arms end inside the disk on a chord of its circle: 0.004 mm² are less than the eye sees.
    assert area(contours_of(FiducialMark(polarity="dark", parts=parts), 5.0)) == pytest.approx(
        expected, abs=5e-3
    )


def test_marks_are_measured_within_their_sigmas() -> None:
    image, places = photograph(UNEVEN)
    found = measured(image, camera(UNEVEN))
    error = found.xy - places
    sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    assert np.abs(error).max() < 0.05  # px
    assert np.abs(error / sigma).max() < 4.0


def test_negatives_are_found() -> None:
    image, places = photograph(UNEVEN)
    found = measured(255 - image, camera(UNEVEN))
    assert found.negative
    assert np.abs(found.xy - places).max() < 0.05  # px


def test_marks_are_learnt_from_one_scan_and_measured_in_another_within_their_sigmas() -> None:
    example, places = photograph(UNEVEN, rotation=90, seed=1)
    taken = learnt(example, camera(UNEVEN), places[1], 46.0, "2")
    assert taken.folds == {"x": 4}
    assert (taken.pattern.attitude.rotation, taken.pattern.attitude.mirrored) == (90, False)
    image, places = photograph(UNEVEN, mirrored=True)
    found = measured(image, FiducialDesign.parse(taken.design.to_json(), where=""))
    assert found.attitude.mirrored
    error, sigma = found.xy - places, np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    assert np.abs(error).max() < 0.05  # px
    assert np.abs(error / sigma).max() < 4.0
    shared = found.covariance.diagonal() / found.fit.covariance.diagonal()
    assert (shared > 2.0).tolist() == 2 * [False, False, True]  # what all marks have in common is a shift


def test_the_place_that_was_given_is_the_point_of_an_asymmetric_mark() -> None:
    example, places = photograph(UNEVEN, without=tuple(PLACES))
    for x, y in np.rint(places).astype(int):
        example[y - 8 : y + 9, x - 1 : x + 2] = example[y + 6 : y + 9, x - 1 : x + 8] = 180
    found = learnt(example, camera(UNEVEN), places[0], 36.0, "1")
    assert found.folds == {"x": 1}
    mark = found.design.marks["x"].learnt
    assert mark is not None
    assert mark.covariance[0] == pytest.approx(1 / 12)  # of a pixel


def test_one_place_in_a_square_of_marks_leaves_a_mirrored_film_possible() -> None:
    square = {"1": (20.0, -20.0), "2": (-20.0, -20.0), "3": (-20.0, 20.0), "4": (20.0, 20.0)}
    image, places = photograph(square)
    assert len(learnt(image, camera(square), places[0], 46.0, "1").others) == 1
    every = {name: tuple(place) for name, place in zip("123", np.rint(places), strict=False)}
    found = learn_marks(scan_of(image), camera(square), every, 46.0)
    assert not isinstance(found, Failure)
    assert found.others == ()


def test_what_does_not_recur_is_not_learnt() -> None:
    image, places = photograph(UNEVEN, without=("1", "3"))
    found = learn_marks(scan_of(image), camera(UNEVEN), {"2": tuple(np.rint(places[1]))}, 46.0)
    assert isinstance(found, Failure)
    assert found.code is Code.NOT_FOUND


@pytest.mark.slow
@pytest.mark.parametrize(("rotation", "mirrored"), [(90, False), (180, True), (270, False), (0, True)])
def test_uneven_marks_tell_how_the_film_lies(rotation: int, mirrored: bool) -> None:
    image, places = photograph(UNEVEN, rotation, mirrored)
    found = measured(image, camera(UNEVEN))
    assert (found.attitude.rotation, found.attitude.mirrored) == (rotation, mirrored)
    assert Code.AMBIGUOUS not in [note.code for note in found.notes]
    assert np.abs(found.xy - places).max() < 0.05  # px


def test_symmetric_marks_are_said_to_fit_in_several_orientations() -> None:
    image, places = photograph(rotation=180)
    found = measured(image, camera())
    assert found.attitude.rotation == 0
    assert [note.code for note in found.notes] == [Code.AMBIGUOUS]
    told = measured(image, camera(), rotation=180, mirrored=False)
    assert told.notes == ()
    assert np.abs(told.xy - places).max() < 0.05  # px


@pytest.mark.slow
def test_a_missing_mark_is_said_and_predicted() -> None:
    image, places = photograph(UNEVEN, without=("2",))
    found = measured(image, camera(UNEVEN), transform="similarity")
    assert found.ok.tolist() == [True, False, True, True]
    assert Code.NOT_FOUND in [note.code for note in found.notes]
    assert np.abs(found.predicted[1] - places[1]).max() < 1.5  # px, by a similarity of uneven film


def test_a_foreign_picture_is_declined() -> None:
    image, _ = photograph(without=tuple(PLACES))
    found = measure_fiducials(scan_of(image, dpi=255.0), camera())
    assert isinstance(found, Failure)
    assert found.code in (Code.NOT_FOUND, Code.UNLIKE, Code.INCONSISTENT)


def test_the_orientation_maps_marks_to_their_calibrated_coordinates(tmp_path) -> None:
    image, places = photograph(UNEVEN, rotation=90)
    design = camera(UNEVEN)
    found = measured(image, design)
    path = tmp_path / "photo.json"
    found.document().write(path)
    assert FiducialOrientation.read(path) == found.document()
    mapping = read_calibration(path).mapping()
    mm = mapping.apply(ImagePoints.with_sigma(design.ids, places, 0.0))
    assert np.abs(mm.xy - design.xy).max() < 0.01  # mm
    assert np.abs(mapping.to_pixels(mm.xy) - places).max() < 1e-6
    assert 0 < mm.sigma.max() < 0.02


def test_a_wrong_resolution_of_the_file_is_said() -> None:
    image, places = photograph(UNEVEN)
    found = measure_fiducials(scan_of(image, dpi=400.0), camera(UNEVEN))
    assert not isinstance(found, Failure)
    assert Code.INCONSISTENT in [note.code for note in found.notes]
    assert np.abs(found.xy - places).max() < 0.05  # px


@pytest.mark.slow
def test_the_overview_shows_the_thin_lines_of_large_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    cross = FiducialMark(
        polarity="bright", parts=(MarkPart(shape="cross", size=3.9, line_width=0.1),), margin=0.6
    )
    thin, k, size = camera().model_copy(update={"marks": {"x": cross}}), 30.0, (1350, 1650)
    places = thin.xy * [k, -k] + [size[1] / 2, size[0] / 2]
    lines = mark_outline("cross", 3.9 * k, 0.1 * k, 0.5)
    light = draw(Outline(lines.xy + places[:, None], np.tile(lines.dxy, (4, 1, 1))), size, 1.0)
    grey = 40 + 25 * light + np.random.default_rng(0).normal(0, 4, light.shape)
    scan, sizes = scan_of(grey.astype(np.uint8), dpi=25.4 * k), []
    whole = type(scan).overview
    monkeypatch.setattr(type(scan), "overview", lambda self, n: (sizes.append(n), whole(self, n))[1])
    found = measure_fiducials(scan, thin)
    assert not isinstance(found, Failure), found
    assert np.abs(found.xy - places).max() < 0.2  # px
    assert 0.1 * k * sizes[0] / size[1] >= 1.0  # px in a line
