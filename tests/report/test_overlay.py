"""Marks over a photograph: where they are, in their colours, with labels that can be read."""

from __future__ import annotations

import re

import numpy as np

from reseau.core.data import Frame
from reseau.report.overlay import Arcs, Marks, frame_overlay, preview

FRAME = Frame(np.random.default_rng(2).integers(0, 4000, (60, 80)).astype(np.uint16), 65535.0)


def test_missing_marks_are_crossed_out_and_unexpected_ones_omitted() -> None:
    xy = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 10.0], [np.nan, np.nan]])
    ok = np.array([True, False, True, False])
    drawn = frame_overlay(FRAME, Marks(("a", "b", "c", "d"), xy, ok, ("c",)))
    assert drawn.count("<circle") == 2
    assert drawn.count("<path") == 1
    assert 'cx="10.00" cy="20.00"' in drawn
    assert len(set(re.findall(r'stroke="(#\w+)"', drawn))) == 3  # fitted, not found, held out


def test_the_frame_is_stretched_in_contrast_and_reduced() -> None:
    grey = preview(FRAME, 40)
    assert grey.shape == (30, 40)
    assert np.ptp(grey) > 100


def test_an_arc_is_drawn_through_its_middle_and_ends() -> None:
    arcs = Arcs(np.array([20.0]), np.array([0.02]), np.array([0.0]))
    drawn = frame_overlay(FRAME, Marks(("a",), np.array([[40.0, 30.0]]), np.array([True]), arcs=arcs))
    match = re.search(r'd="M([\d.]+) ([\d.]+)Q([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+)M', drawn)
    assert match is not None
    x0, y0, x1, y1, x2, y2 = map(float, match.groups())
    assert (x0, x2, y0, y2) == (30.0, 50.0, 31.0, 31.0)
    assert ((x0 + 2 * x1 + x2) / 4, (y0 + 2 * y1 + y2) / 4) == (40.0, 30.0)


def test_labels_of_close_marks_do_not_overlap() -> None:
    frame = Frame(np.zeros((750, 1000), dtype=np.uint8) + np.arange(1000, dtype=np.uint8), 255.0)
    xy = np.array([[500.0, 300.0], [510.0, 305.0], [520.0, 310.0]])
    names = ("X1", "X2", "<3")
    labels = {name: name for name in names}
    drawn = frame_overlay(frame, Marks(names, xy, np.ones(3, dtype=bool), labels=labels))
    at = np.array([(float(x), float(y)) for x, y in re.findall(r'<text x="([\d.]+)" y="([\d.]+)"', drawn)])
    assert len(at) == 3
    apart = np.abs(at[:, None] - at[None])[np.triu_indices(3, 1)]
    assert ((apart[:, 0] > 15) | (apart[:, 1] > 9)).all()
    assert "&lt;3</text>" in drawn
