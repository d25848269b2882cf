"""`reseau bundle` with cameras that are fixed to each other."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.bundle.network.settings import network_document

from ..bundle.rigs import PLACES, drawn

Run = Callable[..., tuple[int, str, str]]


@pytest.mark.slow
def test_the_command_prints_relative_orientations(tmp_path: Path, reseau: Run) -> None:
    file = tmp_path / "stereo.json"
    file.write_text(network_document(drawn()).to_json())
    code, out, err = reseau(
        "bundle", str(file), "--out", str(tmp_path / "out.json"), "--report", str(tmp_path / "out.html")
    )
    assert code == 0
    assert "camera camera 1 from camera 0: base" in out + err
    found = json.loads((tmp_path / "out.json").read_text())["rig"]
    assert found["camera"] == ["camera 1"]
    assert abs(found["length"][0] - np.linalg.norm(PLACES[1][1])) < 5 * found["length_sigma"][0]
    assert "Cameras fixed to each other" in (tmp_path / "out.html").read_text()
