"""Slanted wires: echoes on segments, the share at which they are cut, and its uncertainty."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.io import DesignPoint, Mark, ReseauDesign
from reseau.io.images import read_image
from reseau.measure import measure_pins
from reseau.measure.pins.measure import cut_segments

SOURCE = np.array([[0.0, 0], [40, 0], [0, 15], [40, 15], [0, 30], [32, 30]])
SEGMENTS = np.array([[[0.0, 0], [40, 0]], [[40.0, 15], [0, 15]]])
IMAGE = np.array([[6.0, 0.4], [0.3, -5.5]])


def seen(sigma: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Echoes of the points, and those of the two wires, cut at 0.3 and 0.7 of their segments."""
    noise = np.random.default_rng(seed)
    cuts = SEGMENTS[:, 0] + np.array([[0.3], [0.7]]) * (SEGMENTS[:, 1] - SEGMENTS[:, 0])
    target = SOURCE @ IMAGE.T + sigma * noise.standard_normal(SOURCE.shape)
    return target, cuts @ IMAGE.T + sigma * noise.standard_normal(cuts.shape), cuts


def test_the_errors_of_shares_have_their_standard_deviations() -> None:
    errors = []
    for seed in range(400):
        target, echoes, _ = seen(0.5, seed)
        cuts = cut_segments(SEGMENTS, echoes, np.tile(0.25 * np.eye(2), (2, 1, 1)), SOURCE, target, 10.0)
        errors.append((cuts.share - [0.3, 0.7]) / cuts.sigma)
    # The scatter of six points about an affinity has six degrees of freedom: sigmas err by a quarter.
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.1


def test_two_echoes_on_one_segment_are_declined() -> None:
    target, echoes, cuts = seen(0.0, 0)
    other = (cuts[0] + [10.0, 0.0]) @ IMAGE.T
    found = cut_segments(
        SEGMENTS, np.vstack([echoes, other]), np.tile(1e-4 * np.eye(2), (3, 1, 1)), SOURCE, target, 10.0
    )
    assert found.row.tolist() == [-1, 1]
    assert found.why[0].code == "ambiguous"
    assert np.isnan(found.share[0])


def test_an_echo_beyond_its_segment_or_beside_it_is_not_taken() -> None:
    target, _, _ = seen(0.0, 0)
    beyond = np.array([[-6.0, 0.0], [20.0, 9.0]]) @ IMAGE.T
    found = cut_segments(SEGMENTS, beyond, np.tile(1e-4 * np.eye(2), (2, 1, 1)), SOURCE, target, 10.0)
    assert found.row.tolist() == [-1, -1]
    assert [why.code for why in found.why] == ["not-found", "not-found"]


def test_three_points_do_not_test_a_mapping() -> None:
    found = cut_segments(SEGMENTS, np.empty((0, 2)), np.empty((0, 2, 2)), SOURCE[:3], SOURCE[:3], 10.0)
    assert found.why[0].code == "too-few-points"


@pytest.mark.slow
def test_slanted_wires_of_a_real_phantom_are_those_found_by_plus(
    reference_data: Callable[[str], Path],
) -> None:
    folder = reference_data("ultrasound_nwire")
    reference = json.loads((folder / "fCal20_3NWires_cal.reference.json").read_text("utf-8"))
    points = []
    for name, ends in reference["phantom_wires"].items():
        (x, _, y), (far_x, _, far_y) = ends
        end = None if (x, y) == (far_x, far_y) else (float(far_x), float(far_y))
        points.append(DesignPoint(id=name, x=float(x), y=float(y), end=end))
    mark = Mark(shape="rod", size=0.3)
    design = ReseauDesign(name="fCal", unit="mm", mark=mark, polarity="bright", points=tuple(points))
    for record in reference["frames"][::8]:
        found = measure_pins(read_image(folder / record["image"]), design)
        assert found
        assert found.found == len(design.ids)
        xy = np.array([record["points"][name] for name in design.ids])
        assert np.hypot(*(found.xy - xy).T).max() < 10
        # The share on the straight line through the three wires of a layer, from PLUS's own coordinates.
        for right, slanted, left in ((0, 1, 2), (3, 4, 5), (6, 7, 8)):
            along = xy[left] - xy[right]
            part = (xy[slanted] - xy[right]) @ along / (along @ along)
            x = design.xy[right, 0] + part * (design.xy[left, 0] - design.xy[right, 0])
            start, end = design.segments[slanted, :, 0]
            assert found.share[slanted] == pytest.approx((x - start) / (end - start), abs=0.03)


def test_rods_on_one_line_are_refused(reference_data: Callable[[str], Path]) -> None:
    points = tuple(DesignPoint(id=str(k), x=10.0 * k, y=3.0 * k) for k in range(5))
    mark = Mark(shape="rod", size=0.3)
    design = ReseauDesign(name="line", unit="mm", mark=mark, polarity="bright", points=points)
    frame = read_image(reference_data("ultrasound_nwire") / "VLCUS_6pt_000.png")
    with pytest.raises(Exception, match="has its points on one line"):
        measure_pins(frame, design)
