"""The photograph of the tour of blurred targets: python docs/blurred.py [FOLDER] [--check].

It writes `lens.zmx` (a double Gauss f/2 of 25 mm, stopped down to f/2.8), `plate.json` (24 disks) and
`photo.png` to the folder (`out/blurred`): the plate at 540 mm, tilted, before a camera that is focused at
500 mm. The photograph is drawn with the rays of batoid (`pip install batoid`), which share nothing with those
that measure it; `truth.json` has its principal rays. With `--check`, after the command of the tour, it
compares `targets.json` with them.
"""

from __future__ import annotations

import argparse
import json
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
RAYS = 4500
"""Rays through the pupil for each target; with a third of them errors grow by a third."""


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


def write(folder: Path) -> None:
    """Write lens, plate, photograph, and the true coordinates."""
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
        share = light(lens, target, columns, rows, 0.5, RAYS)
        image[np.ix_(rows.astype(int), columns.astype(int))] -= 150.0 * share
        truth[name] = np.asarray(point).tolist()
    write_image(folder / "photo.png", noisy(image, 150.0, 40.0, np.random.default_rng(0)))
    write_whole(folder / "truth.json", json.dumps(truth, indent=1))


def check(folder: Path) -> None:
    """Compare what was measured with the true coordinates."""
    truth = json.loads((folder / "truth.json").read_text("utf-8"))
    points = [p for p in json.loads((folder / "targets.json").read_text("utf-8"))["points"] if p["ok"]]
    errors = np.array([np.subtract((p["x"], p["y"]), truth[p["id"]]) for p in points])
    sigmas = np.array([[p["sx"], p["sy"]] for p in points])
    print(
        f"{len(errors)} of {len(truth)} targets: errors {np.sqrt((errors**2).mean()):.4f} px rms, "
        f"{np.sqrt(((errors / sigmas) ** 2).mean()):.2f} times their sigmas, at most "
        f"{np.abs(errors).max():.4f} px"
    )


def main() -> None:
    """Write the files, or check what was measured."""
    parser = argparse.ArgumentParser(description="The photograph of the tour of blurred targets.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("out/blurred"))
    parser.add_argument("--check", action="store_true", help="compare targets.json with the truth")
    given = parser.parse_args()
    (check if given.check else write)(given.folder)


if __name__ == "__main__":
    main()
