"""The documents of scanned frames are read back unchanged, and invalid ones are refused."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import FormatError
from reseau.io import FrameCorners, FrameOrientation

CORNER = {"x": 1.5, "y": 2.5, "sx": 0.02, "sy": 0.03, "rho": 0.1}
EDGE = {"found": True, "points": 200, "rejected": 3, "rms_px": 0.2, "curvature_px": 0.0, "why": ""}


def corners(**changes: Any) -> str:
    content: dict[str, Any] = {
        "schema": "frame-corners/1",
        "unit": "mm",
        "corners": {"ul": [-18, 12], "ur": [18, 12], "lr": [18, -12], "ll": [-18, -12]},
        "sigma": [0.01, 0.02],
    }
    return json.dumps({k: v for k, v in (content | changes).items() if v != "left out"})


def orientation(**changes: Any) -> str:
    content: dict[str, Any] = {
        "schema": "reseau-orientation/1",
        "image": "a.tif",
        "status": "oriented",
        "why": "",
        "format_mm": [36.0, 24.0],
        "channel": "red",
        "corners": dict.fromkeys(("ul", "ur", "lr", "ll"), CORNER),
        "principal_point": CORNER,
        "angle_deg": 1.0,
        "angle_sigma_deg": 0.01,
        "px_per_mm": [23.6, 23.7],
        "edges": dict.fromkeys(("upper", "right", "lower", "left"), EDGE),
    }
    return json.dumps({k: v for k, v in (content | changes).items() if v != "left out"})


def test_corners_read_back_the_same_with_sigmas_or_without() -> None:
    for text in (corners(), corners(sigma="left out")):
        read = FrameCorners.parse(text, where="c.json")
        assert json.loads(read.to_json()) == json.loads(text)
        np.testing.assert_array_equal(read.xy(), [[-18, 12], [18, 12], [18, -12], [-18, -12]])


def test_corners_with_y_down_are_refused() -> None:
    turned = {"ul": [-18, -12], "ur": [18, -12], "lr": [18, 12], "ll": [-18, 12]}
    with pytest.raises(FormatError, match=r"c\.json: .*must run clockwise with y up"):
        FrameCorners.parse(corners(corners=turned), where="c.json")


def test_an_orientation_reads_back_the_same() -> None:
    read = FrameOrientation.parse(orientation(), where="o.json")
    assert json.loads(read.to_json()) == json.loads(orientation())
    points = read.image_points()
    assert points.names == ("ul", "ur", "lr", "ll")
    np.testing.assert_allclose(points.cov[0], [[4e-4, 6e-5], [6e-5, 9e-4]], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"corners": None}, "requires four corners"),
        ({"status": "declined"}, "needs a reason in `why`"),
        ({"status": "good"}, "status"),
        ({"colour": 1}, "unknown key `colour`"),
        ({"edges": "left out"}, "missing key `edges`"),
    ],
)
def test_an_invalid_orientation_is_refused(changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(FormatError, match=complaint):
        FrameOrientation.parse(orientation(**changes), where="o.json")
