"""Example of a network of blurred targets under water: python docs/underwater.py [FOLDER].

It writes the underwater project of Meid (1992, section 4) as files to the folder (`out/underwater`): the
lens, a network with rough image coordinates and a port, the targets, and three photographs drawn with the
rays of batoid (`pip install batoid`). Then it runs `reseau blurred`, compares the object points with the
truth, and draws the residuals before and after to `docs/images/underwater.png`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from underwater import camera_of, network_of, targets_of
from worlds.underwater import GLASS, PITCH, PSF, SIZE, WATER, Project, project

from reseau.core.figures import drawing, to_bytes
from reseau.core.files import write_whole
from reseau.exchange import read_network
from reseau.io import LensDocument, LensSensor
from reseau.io.images import write_image

STRENGTH = "medium"


def main() -> None:
    """Write the files, measure, compare, and draw the figure."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/underwater")
    (folder / "photographs").mkdir(parents=True, exist_ok=True)
    drawn = project(STRENGTH, 0)
    for name, pixels in drawn.images.items():
        write_image(folder / "photographs" / f"{name}.png", pixels)
    camera = camera_of(STRENGTH)
    sensor = LensSensor(pitch_um=(1e3 * PITCH, 1e3 * PITCH), size_px=SIZE)
    LensDocument.of(camera.lens, sensor).write(folder / "lens.toml")
    targets_of(drawn).write(folder / "frame.json")
    write_whole(folder / "network.json", json.dumps(network(drawn), indent=1))
    arguments = (
        "blurred network.json --images photographs --targets frame.json --lens lens.toml --initial centroid "
        f"--psf {PSF:g} --search 8 --out measured"
    )
    print("reseau", arguments)
    subprocess.run([Path(sys.executable).with_name("reseau"), *arguments.split()], cwd=folder, check=True)
    for number in (0, 1):
        points = json.loads((folder / "measured" / f"round-{number}.json").read_text())["points"]
        free = [k for k, role in enumerate(points["role"]) if role == "tie"]
        off = np.array([points["xyz"][k] for k in free]) - drawn.xyz[free]
        print(f"round {number}: object points wrong by {np.sqrt((off**2).mean()):.4f} mm rms")
    write_whole(Path(__file__).with_name("images") / "underwater.png", figure(folder))


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


def figure(folder: Path) -> bytes:
    """Residuals of the middle photograph before and after, to one scale."""
    from matplotlib.figure import Figure

    final = read_network(folder / "measured" / "network.json")
    with drawing():
        picture = Figure(figsize=(8.6, 3.6), layout="constrained")
        for axes, (name, title) in zip(
            picture.subplots(1, 2),
            (("round-0", "centres of gravity"), ("result", "measured by rays")),
            strict=True,
        ):
            table = json.loads((folder / "measured" / f"{name}.json").read_text())["image_points"]
            rows = [k for k, image in enumerate(table["image"]) if image == "middle"]
            v = np.array([(table["vx"][k], table["vy"][k]) for k in rows], dtype=np.float64)
            names = [table["point"][k] for k in rows]
            at = {
                final.points[j]: xy
                for i, j, xy in zip(final.image_of, final.point_of, final.xy, strict=True)
                if final.images[i] == "middle"
            }
            xy = np.array([at.get(point, (np.nan, np.nan)) for point in names])
            axes.plot(*xy.T, ".", color="#9aa3a8", markersize=2)
            axes.quiver(
                *xy.T, *(2000 * v).T, angles="xy", scale_units="xy", scale=1, width=0.004, color="#b3402a"
            )
            axes.set(xlim=(0, SIZE[0]), ylim=(SIZE[1], 0), aspect="equal")
            axes.set_title(f"{title}: {np.sqrt((v**2).mean()):.4f} px rms (× 2000)")
        return to_bytes(picture, "png", dpi=110)


if __name__ == "__main__":
    main()
