"""The photographs of the tour of blurred targets under water: python docs/underwater.py [FOLDER] [--check].

It writes the underwater project of Meid (1992, section 4) as files to the folder (`out/underwater`): the
lens, a network with rough image coordinates and a port, the targets, and three photographs drawn with the
rays of batoid (`pip install batoid`); `truth.json` has the object points. With `--check`, after the command
of the tour, it compares those of every round with them.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from underwater import camera_of, network_of, targets_of
from worlds.underwater import GLASS, PITCH, SIZE, WATER, Project, project

from reseau.core.files import write_whole
from reseau.io import LensDocument, LensSensor
from reseau.io.images import write_image

STRENGTH = "medium"
RAYS = 1500
"""Rays for each target and wavelength."""


def write(folder: Path) -> None:
    """Write lens, network, targets, photographs, and the true object points."""
    (folder / "photographs").mkdir(parents=True, exist_ok=True)
    drawn = project(STRENGTH, 0, count=RAYS)
    for name, pixels in drawn.images.items():
        write_image(folder / "photographs" / f"{name}.png", pixels)
    camera = camera_of(STRENGTH)
    sensor = LensSensor(pitch_um=(1e3 * PITCH, 1e3 * PITCH), size_px=SIZE)
    LensDocument.of(camera.lens, sensor).write(folder / "lens.toml")
    targets_of(drawn).write(folder / "frame.json")
    write_whole(folder / "network.json", json.dumps(network(drawn), indent=1))
    truth = dict(zip(drawn.points, drawn.xyz.tolist(), strict=True))
    write_whole(folder / "truth.json", json.dumps(truth, indent=1))


def check(folder: Path) -> None:
    """Compare the object points of every round, but for control points, with the truth."""
    truth = json.loads((folder / "truth.json").read_text("utf-8"))
    for number, path in enumerate(sorted((folder / "measured").glob("round-?.json"))):
        points = json.loads(path.read_text("utf-8"))["points"]
        rows = zip(points["id"], points["role"], points["xyz"], strict=True)
        off = np.array([np.subtract(xyz, truth[name]) for name, role, xyz in rows if role == "tie"])
        print(f"round {number}: object points wrong by {np.sqrt((off**2).mean()):.4f} mm rms")


def main() -> None:
    """Write the files, or check what was measured."""
    parser = argparse.ArgumentParser(description="The photographs of the tour of targets under water.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("out/underwater"))
    parser.add_argument("--check", action="store_true", help="compare the object points with the truth")
    given = parser.parse_args()
    (check if given.check else write)(given.folder)


def network(drawn: Project) -> dict[str, object]:
    """The network as a user would write it: rough coordinates, and a port of which the media are known."""
    made = network_of(drawn, camera_of(STRENGTH))
    assert made.refraction is not None
    camera, window = made.cameras[0], made.refraction.windows[0]
    b, c = GLASS[:3], GLASS[3:]
    wavelength = {"wavelength_nm": 546.1}
    held = np.isfinite(made.xyz).all(axis=1)
    return {
        "schema": "reseau-network/1", "unit": "mm",
        "cameras": [{"id": "cam", "width": SIZE[0], "height": SIZE[1], "model": camera.model,
                     "parameters": camera.parameters, "free": list(camera.free),
                     "sigma": dict(camera.sigma)}],
        "images": {"id": list(made.images), "camera": ["cam"] * len(made.images), "X0": made.x0.tolist(),
                   "rotation": made.rotation.tolist()},
        "points": {"id": list(made.points),
                   "xyz": [xyz if known else None
                           for xyz, known in zip(made.xyz.tolist(), held, strict=True)],
                   "sigma": [[0.0] * 3 if known else None for known in held],
                   "role": list(made.role)},
        "observations": {"image": [made.images[i] for i in made.image_of],
                         "point": [made.points[j] for j in made.point_of],
                         "x": made.xy[:, 0].tolist(), "y": made.xy[:, 1].tolist(),
                         "sx": [0.05] * len(made.xy), "sy": [0.05] * len(made.xy)},
        "datum": "control",
        "refraction": {
            "media": {"air": 1.0, "window": {"medium": {"sellmeier": {"b": b, "c": c}}, **wavelength},
                      "water": {"medium": {"sellmeier": {"b": WATER[0], "c": WATER[1]}}, **wavelength}},
            "windows": [{"id": "port", "shape": "plane", "on": "camera", "media": list(window.media),
                         "parameters": dict(window.values)}]},
    }  # fmt: skip


if __name__ == "__main__":
    main()
