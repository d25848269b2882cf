"""`reseau blurred`: a network of blurred targets, from files to files."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reseau.bundle import ResultDocument
from reseau.exchange import read_network
from reseau.io.refraction import RefractionEntry

from ..procedures import underwater

Run = Callable[..., tuple[int, str, str]]


@cache
def drawn() -> underwater.Project:
    return underwater.project()


def written(folder: Path) -> dict[str, Path]:
    """The project as the files of a user."""
    project = drawn()
    network, photographs = project.network, folder / "photographs"
    photographs.mkdir()
    for name, frame in project.frames.items():
        pixels = np.clip(np.rint(frame.pixels), 0, 255).astype(np.uint8)
        cv2.imwrite(str(photographs / f"{name}.png"), pixels)
    (folder / "targets.json").write_text(project.targets.to_json())
    assert network.refraction is not None
    entry = RefractionEntry.of(network.refraction, network.images).model_dump(mode="json", exclude_none=True)
    glass = {"medium": "N-BK7", "wavelength_nm": 546.1}
    entry["media"] |= {"glass": glass, "water": {"medium": {"water": {"temperature_c": 15.0}},
                                                 "wavelength_nm": 546.1}}  # fmt: skip
    camera = network.cameras[0]
    document: dict[str, Any] = {
        "schema": "reseau-network/1", "unit": "mm",
        "cameras": [{"id": "cam", "width": camera.width, "height": camera.height,
                     "pitch_mm": list(camera.pitch_mm), "model": "brown", "side": "object",
                     "parameters": camera.parameters, "free": list(camera.free)}],
        "images": {"id": list(network.images), "camera": ["cam"] * 3, "X0": network.x0.tolist(),
                   "rotation": network.rotation.tolist()},
        "points": {
            "id": list(network.points),
            "xyz": [row if np.isfinite(row).all() else None for row in network.xyz.tolist()],
            "sigma": [[0.0] * 3 if np.isfinite(row).all() else None for row in network.xyz.tolist()],
            "role": list(network.role)},
        "observations": {
            "image": [network.images[i] for i in network.image_of],
            "point": [network.points[j] for j in network.point_of],
            "x": network.xy[:, 0].tolist(), "y": network.xy[:, 1].tolist(),
            "sx": [0.05] * len(network.xy), "sy": [0.05] * len(network.xy)},
        "datum": "control", "refraction": entry,
    }  # fmt: skip
    (folder / "network.json").write_text(json.dumps(document))
    return {"network": folder / "network.json", "images": photographs, "targets": folder / "targets.json"}


def lens_file(folder: Path) -> Path:
    """The lens as a file of a user."""
    width, height = underwater.SIZE
    lines = [
        'schema = "lens/1"\nname = "achromat"\nwavelengths_nm = [546.1, 480.0]\nstop_radius = 5.5',
        f"[sensor]\npitch_um = [24.0, 24.0]\nsize_px = [{width}, {height}]",
    ]
    surfaces = underwater.LENS.surfaces
    for k, medium in enumerate(("N-BK7", "SF2", "air", "air")):
        curvature = underwater.ROWS[k][0]
        distance = float(surfaces[k + 1].vertex[2] - surfaces[k].vertex[2])
        lines.append(f"[[surface]]\ncurvature = {curvature!r}\ndistance = {distance!r}\nmedium = {medium!r}")
    lines[-1] += "\nstop = true"
    path = folder / "lens.toml"
    path.write_text("\n\n".join([*lines, "[[surface]]\n"]))
    return path


def test_a_user_measures_a_network_from_files(reseau: Run, tmp_path: Path) -> None:
    files = written(tmp_path)
    status, out, err = reseau(
        "blurred", files["network"], "--images", files["images"], "-t", files["targets"], "-l",
        lens_file(tmp_path), "-o", tmp_path / "out", "--rounds", 1,
    )  # fmt: skip
    assert (status, err) == (0, "")
    assert "ordinary coordinates: sigma0" in out
    assert "round 1" in out
    names = {file.name for file in (tmp_path / "out").iterdir()}
    assert names == {"round-0.json", "round-1.json", "result.json", "network.json", "report.html"}
    final, project = read_network(tmp_path / "out" / "network.json"), drawn()
    true = {
        (project.network.images[i], project.network.points[j]): xy
        for i, j, xy in zip(project.network.image_of, project.network.point_of, project.true, strict=True)
    }
    off = [
        xy - true[final.images[i], final.points[j]]
        for i, j, xy in zip(final.image_of, final.point_of, final.xy, strict=True)
        if final.rays[j] > 1
    ]
    assert np.sqrt(np.mean(np.square(off))) < 0.02
    result = ResultDocument.read(tmp_path / "out" / "result.json")
    assert result.refraction is not None
    assert (tmp_path / "out" / "report.html").read_text().count("<svg") == 3
    again = reseau(
        "blurred", files["network"], "--images", files["images"], "-t", files["targets"], "-l",
        lens_file(tmp_path), "-o", tmp_path / "out",
    )  # fmt: skip
    assert again[0] == 2
    assert "is not empty" in again[2]
