"""A published adjustment: angles, signs of the distortion and pixels as another program has them."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.optics import Brown, PixelGrid, Pose, project

NETWORKS = Path(os.environ.get("RESEAU_DATA", Path(__file__).parents[3] / "shared" / "data")) / "networks"


def camera_of(report: str, given: dict[str, Any]) -> Brown:
    section = report[report.index("Camera Constant") : report.index("Photograph Standard Deviations")]
    entry = r"(K\d|P\d|px|py|Camera Constant)[^\n]*\n\s+Value:\s+(\S+)"
    values = {name: float(value) for name, value in re.findall(entry, section)}
    grid = PixelGrid(given["width"], given["height"], tuple(given["pitch_mm"]))
    # The report reckons the principal point from the upper left corner of the upper left pixel.
    from_corner = np.array([values.pop("px"), values.pop("py")])
    x0, y0 = grid.to_photo([from_corner / grid.pitch_mm - 0.5])[0]
    return Brown(side="image", grid=grid).with_values(
        {"c": values.pop("Camera Constant"), "x0": x0, "y0": y0} | values
    )


def poses_of(report: str) -> dict[str, Pose]:
    names = ("Omega:", "Phi:", "Kappa:", "Xc:", "Yc:", "Zc:")
    entry = r"Photo (\d+): .*?" + "".join(name + r"\s+Value:\s+(\S+).*?" for name in names)
    return {
        image: Pose.from_angles(*np.radians([float(v) for v in six[:3]]), [float(v) for v in six[3:]])
        for image, *six in re.findall(entry, report, re.DOTALL)
    }


@pytest.mark.skipif(not NETWORKS.is_dir(), reason="needs the reference data in $RESEAU_DATA")
def test_control_points_of_a_published_adjustment_are_projected_to_their_measured_positions() -> None:
    network = json.loads((NETWORKS / "camcal.network.json").read_text())
    report = (NETWORKS / "camcal-dbatreport-model1.txt").read_text()
    camera, poses = camera_of(report, network["cameras"][0]), poses_of(report)
    table, points = network["observations"], network["points"]
    control = {name: xyz for name, xyz in zip(points["id"], points["xyz"], strict=True) if xyz}
    rows = [k for k, name in enumerate(table["point"]) if name in control]
    seen_by = [poses[table["image"][k]] for k in rows]
    pose = Pose(np.array([p.rotation for p in seen_by]), np.array([p.x0 for p in seen_by]))
    xyz = np.array([control[table["point"][k]] for k in rows])
    measured = np.array([[table["x"][k], table["y"][k]] for k in rows])
    v = project(camera, pose, xyz).xy - measured
    assert len(v) > 60
    # The printed digits allow for 0.1 px, the adjustment's own residuals for the rest; one wrong sign among
    # angles and distortion shows as tens of pixels.
    assert np.sqrt((v**2).mean()) < 0.6
    assert np.abs(v.mean(axis=0)).max() < 0.1
