"""Example of a blurred photograph, from a lens file to measured targets: python docs/blurred.py [FOLDER].

It writes `lens.zmx` (a double Gauss f/2 of 25 mm, stopped down to f/2.8), `plate.json` (24 disks) and
`photo.png` to the folder (`out/blurred`): the plate at 540 mm, tilted, before a camera that is focused at
500 mm. The photograph is drawn with the rays of batoid (`pip install batoid`), which share nothing with those
that measure it. Then it runs the commands of the tour, compares the coordinates with batoid's principal
rays, and keeps the figure as `docs/images/blurred.png`.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from worlds.blurred import ROWS, SCALE, WAVELENGTHS, WEIGHTS, Lens, Target, light, noisy

from reseau.core.files import write_whole
from reseau.designs import regular_reseau
from reseau.exchange import read_lens
from reseau.io import Mark
from reseau.io.images import write_image
from reseau.optics import Pose
from reseau.procedures.blurred import focused

SIZE, PITCH = (1600, 1200), 0.006
FOCUS, DISTANCE = 500.0, 540.0
F_NUMBER = 2.8


def zmx() -> str:
    """The prescription as a file of Zemax."""
    lines = ["VERS 140124", "MODE SEQ", "NAME double Gauss 25 mm", "UNIT MM", f"FNUM {F_NUMBER} 0"]
    lines += [
        f"WAVM {k} {w / 1e3:.7f} {s}" for k, (w, s) in enumerate(zip(WAVELENGTHS, WEIGHTS, strict=True), 1)
    ]
    lines += ["PWAV 2", "SURF 0", "  TYPE STANDARD", "  CURV 0.0", "  DISZ INFINITY"]
    for k, (curvature, distance, name) in enumerate(ROWS, 1):
        stop = name == "stop"
        lines += [f"SURF {k}", *(["  STOP"] if stop else []), "  TYPE STANDARD"]
        lines += [f"  CURV {curvature / SCALE:.12f}", f"  DISZ {distance * SCALE:.12f}"]
        lines += [f"  GLAS {name} 0 0 1.5 40"] if name and not stop else []
    return "\n".join([*lines, f"SURF {len(ROWS) + 1}", "  TYPE STANDARD", "  CURV 0.0", "  DISZ 0.0", ""])


def main() -> None:
    """Write the files, measure, compare, and keep the figure."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/blurred")
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "lens.zmx", zmx())
    plate = regular_reseau(6, 4, 27.0, Mark(shape="disk", size=4.0), name="plate")
    plate.write(folder / "plate.json")
    prescription = focused(read_lens(folder / "lens.zmx").prescription, FOCUS)
    assert prescription.stop_radius is not None
    principal = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    lens = Lens(prescription.stop_radius, float(prescription.surfaces[-1].vertex[2]), PITCH, principal)
    turn = Pose.from_angles(0.2, -0.15, 0.03, np.zeros(3)).matrix
    image, truth = np.full(SIZE[::-1], 200.0), {}
    for name, xy in zip(plate.ids, plate.xy - plate.xy.mean(axis=0), strict=True):
        target = Target("disk", 4.0, turn[:, :2] @ xy + [0, 0, DISTANCE], turn[:, :2])
        point = lens.principal_ray(target.centre, WAVELENGTHS[1])
        columns, rows = (np.arange(-34.0, 35.0) + round(v) for v in point)
        share = light(lens, target, columns, rows, 0.5)
        image[np.ix_(rows.astype(int), columns.astype(int))] -= 150.0 * share
        truth[name] = point
    write_image(folder / "photo.png", noisy(image, 150.0, 40.0, np.random.default_rng(0)))
    arguments = (
        f"measure blurred photo.png --design plate.json --lens lens.zmx --pitch {1e3 * PITCH:g} "
        f"--focus {FOCUS:g} --not-mirrored --max-rotation 40 --out targets.json --overlay targets.png "
        "--figure target.png"
    )
    print("reseau", arguments)
    subprocess.run([Path(sys.executable).with_name("reseau"), *arguments.split()], cwd=folder, check=True)
    points = json.loads((folder / "targets.json").read_text())["points"]
    errors = np.array([[p["x"], p["y"]] - truth[p["id"]] for p in points if p["ok"]])
    sigmas = np.array([[p["sx"], p["sy"]] for p in points if p["ok"]])
    print(
        f"{len(errors)} of {len(truth)} targets: errors {np.sqrt((errors**2).mean()):.4f} px rms, "
        f"{np.sqrt(((errors / sigmas) ** 2).mean()):.2f} times their sigmas, at most "
        f"{np.abs(errors).max():.4f} px"
    )
    shutil.copy(folder / "target.png", Path(__file__).with_name("images") / "blurred.png")


if __name__ == "__main__":
    main()
