"""Drawings of designs: true size, every mark in its place."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.designs import coded_testfield, regular_reseau, standard_reseau
from reseau.designs.drawing import design_pdf, design_svg
from reseau.io import Mark

SVG = "{http://www.w3.org/2000/svg}"


def test_drawings_are_in_millimetres() -> None:
    root = ET.fromstring(design_svg(standard_reseau()))
    width, height = (float(root.get(side, "").removesuffix("mm")) for side in ("width", "height"))
    assert root.get("viewBox") == f"0 0 {width:g} {height:g}"
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", design_pdf(standard_reseau()))
    assert box is not None
    points = np.array([float(box[1]), float(box[2])])
    np.testing.assert_allclose(points / 72 * 25.4, [width, height], rtol=0, atol=1e-3)


def test_disks_have_the_distances_of_the_design() -> None:
    design = regular_reseau(6, 5, 12.5, Mark(shape="disk", size=3.0))
    circles = list(ET.fromstring(design_svg(design)).iter(f"{SVG}circle"))
    at = np.array([(float(c.get("cx", "")), float(c.get("cy", ""))) for c in circles])
    assert {c.get("r") for c in circles} == {"1.5"}
    # y runs down on paper and up in the design.
    np.testing.assert_allclose((at - at[0]) * [1, -1], design.xy - design.xy[0], rtol=0, atol=2e-4)


def test_the_bar_is_a_hundred_millimetres_long() -> None:
    for design in (standard_reseau(), regular_reseau(2, 2, 10.0, Mark(shape="square", size=2.0))):
        lines = re.findall(r'd="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)"', design_svg(design))
        lengths = [float(c) - float(a) for a, b, c, d in lines if b == d]
        assert max(lengths) == pytest.approx(100.0, abs=1e-3)


def test_crosses_have_their_arms() -> None:
    design = regular_reseau(3, 3, 10.0, Mark(shape="cross", size=4.0, line_width=0.5), polarity="bright")
    svg = design_svg(design)
    paths = re.findall(r'd="M([^"]+)Z"', svg)
    assert len(paths) == 9
    corners = np.array([[float(v) for v in pair.split()] for pair in paths[0].split("L")])
    assert len(corners) == 12
    np.testing.assert_allclose(np.ptp(corners, axis=0), 4.0, rtol=0, atol=2e-4)
    x, y = corners.T
    area = abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2
    assert area == pytest.approx(2 * 4 * 0.5 - 0.25, abs=2e-3)
    assert 'fill="#000000"/>' in svg  # the ground of bright marks


def test_the_same_design_gives_the_same_bytes() -> None:
    assert design_pdf(standard_reseau()) == design_pdf(standard_reseau())
    assert design_svg(standard_reseau()) == design_svg(standard_reseau())


def test_a_design_in_other_units_cannot_be_drawn() -> None:
    inches = standard_reseau().model_copy(update={"unit": "inch"})
    with pytest.raises(UsageError, match="no millimetre coordinates"):
        design_svg(inches)


def test_every_target_and_line_of_a_testfield_is_drawn_at_its_position() -> None:
    field = coded_testfield(2, 1)
    root = ET.fromstring(design_svg(field))
    circles = np.array([(float(c.get("cx", "")), float(c.get("cy", ""))) for c in root.iter(f"{SVG}circle")])
    round_ = np.array(field.targets.shape) == "circle"
    np.testing.assert_allclose(
        (circles - circles[0]) * [1, -1], field.xy[round_] - field.xy[round_][0], rtol=0, atol=2e-4
    )
    paths = re.findall(r'd="M([^"]+)Z"', design_svg(field))
    assert len(paths) == 3 + 2 + 24  # lines upright and level, targets with corners
    corners = [np.array([[float(v) for v in pair.split()] for pair in path.split("L")]) for path in paths]
    np.testing.assert_allclose(np.ptp(corners[0], axis=0), [2.0, 127.0], rtol=0, atol=2e-4)
    triangles = [c for c in corners if len(c) == 3]
    # The apex is up: the smallest y on paper, over the middle of the other two.
    assert len(triangles) == 8
    for triangle in triangles:
        top = triangle[triangle[:, 1].argmin()]
        assert top[0] == pytest.approx(triangle[:, 0].mean(), abs=2e-4)
    assert b"/MediaBox" in design_pdf(field)


def test_wires_that_are_not_parallel_to_the_axes_are_refused() -> None:
    design = standard_reseau()
    x, y = design.xy.T
    turned = [
        point.model_copy(update={"x": float(a), "y": float(b)})
        for point, a, b in zip(design.points, x - 0.02 * y, y + 0.02 * x, strict=True)
    ]
    with pytest.raises(UsageError, match="not parallel to its axes"):
        design_svg(design.model_copy(update={"points": tuple(turned)}))
