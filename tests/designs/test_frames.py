"""The targets of a space frame: their layout and their drawing."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.designs import space_frame
from reseau.designs.drawing import design_svg


def test_targets_lie_on_the_edges_of_the_box_and_face_the_cameras() -> None:
    frame = space_frame((1200.0, 900.0, 400.0), 28)
    xyz = np.array(frame.targets.xyz)
    on_border = np.isclose(np.abs(xyz), [600.0, 450.0, 200.0])
    assert (on_border.sum(axis=1) >= 2).all()
    assert len(np.unique(xyz.round(6), axis=0)) == 28
    assert set(frame.targets.normal) == {(0.0, 0.0, 1.0)}


@pytest.mark.parametrize(("shape", "element"), [("disk", "<circle"), ("square", '<path d="M')])
def test_every_target_is_drawn_in_true_size_with_its_name(shape: Any, element: str) -> None:
    frame = space_frame(count=12, size=20.0, shape=shape)
    drawing = design_svg(frame)
    if shape == "disk":
        radii = [float(r) for r in re.findall(r'<circle [^>]* r="([\d.]+)"', drawing)]
        assert radii == [10.0] * 12
    assert drawing.count(element) >= 12
    for name in frame.targets.id:
        assert f">{name}</text>" in drawing


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: space_frame(count=7), "eight corners"),
        (lambda: space_frame(size=0.0), "above 0"),
        (lambda: space_frame((100.0, 100.0, 100.0), 60, 20.0), "would touch"),
    ],
)
def test_what_is_no_frame_is_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make()
