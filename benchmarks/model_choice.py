"""How well the chosen camera model predicts: boards drawn by OpenCV's cameras, compared with the truth.

    python benchmarks/model_choice.py [--seeds 5] [--seed 0] [--views 15] [--case tilted …] [--model auto …]

For every case and seed, views of a board are calibrated without a model named (``auto``), and with the model
and the parameters of the drawn lens (``right``). Printed are the root mean square error of the image of rays
over the whole image, after the best rotation, in pixels: its median and its largest value over the seeds, and
the ratio of the median to that of the right model; the error by the sigma that the calibration claims (both
root mean squares over the image), in the median and at most; processor time; and the models chosen.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares
from worlds import lenses

from reseau.bundle.diagnostics.fields import camera_mapping
from reseau.calibration import projection_field
from reseau.core.data import Array, ImagePoints
from reseau.designs import board
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CameraOptions
from reseau.procedures.target_measurement import measurer_of

NOISE, VIEWS, SIZE, PITCH_MM = 0.05, 15, (1280, 960), 0.004
FRAME, BROWN = ("fx", "fy", "cx", "cy"), ("c", "x0", "y0")


@dataclass(frozen=True)
class Case:
    """A lens, the model that is right for it, and the size of a pixel where it is given."""

    lens: lenses.Lens
    right: CameraOptions


def standard(*k: float, f: float = 1200.0, aspect: float = 1.002) -> lenses.Lens:
    """A lens of OpenCV's standard camera."""
    matrix = np.array([[f, 0, 645.0], [0, aspect * f, 475.0], [0, 0, 1]])
    return lenses.Lens(*SIZE, matrix, np.pad(np.array(k, float), (0, (14 if len(k) > 8 else 8) - len(k))))


def opencv(more: str, model: str = "opencv") -> CameraOptions:
    return CameraOptions(model, (*FRAME, *more.split()))


TILTED = (-0.11, 0.1, 0.0025, -0.0018, -0.02, *np.zeros(7), np.radians(7.0), np.radians(-3.0))
PRISM = (-0.2, 0.09, 3e-4, -5e-4, 0.0, 0.0, 0.0, 0.0, 1.5e-3, 0.0, -1e-3, 0.0, 0.0, 0.0)
CASES = {
    "none": Case(standard(), opencv("")),
    "k1": Case(standard(-0.1), opencv("k1")),
    "k1-p2": Case(standard(-0.21, 0.09, -3e-4, 5e-4), opencv("k1 k2 p1 p2")),
    "k3": Case(standard(-0.21, 0.094, -3e-4, 5e-4, -0.03), opencv("k1 k2 p1 p2 k3")),
    "rational": Case(
        standard(0.75, 0.12, 2e-4, -1e-4, 0.006, 1.12, 0.31, 0.03, f=620.0),
        opencv("k1 k2 p1 p2 k3 k4 k5 k6"),
    ),
    "fisheye": Case(lenses.fisheye(70), CameraOptions("fisheye", (*FRAME, "k1", "k2", "k3", "k4"))),
    "near-180": Case(lenses.fisheye(85), CameraOptions("fisheye", (*FRAME, "k1", "k2", "k3", "k4"))),
    "tilted": Case(standard(*TILTED, f=1500.0), opencv("k1 k2 p1 p2 k3 tau_x tau_y", "opencv_full")),
    "prism": Case(standard(*PRISM), opencv("k1 k2 p1 p2 s1 s3", "opencv_full")),
    "brown": Case(
        standard(-0.15, 0.05, aspect=1.0), CameraOptions("brown", (*BROWN, "K1", "K2"), (PITCH_MM, PITCH_MM))
    ),
    "brown-b1": Case(
        standard(-0.15, 0.05), CameraOptions("brown", (*BROWN, "K1", "K2", "B1"), (PITCH_MM, PITCH_MM))
    ),
}


def calibrated(case: Case, seed: int, model: CameraOptions, count: int) -> Calibrated | str:
    """Calibrate views of a case."""
    target = board("chess", 10, 7, 25.0)
    flat = np.column_stack([target.xy * [1, -1], np.zeros(len(target.ids))])
    seen = lenses.views(case.lens, flat, flat, count, NOISE, seed, whole=False)
    frames = [
        (
            f"v{i:02}",
            ImagePoints(
                tuple(target.ids[j] for j in rows), xy, np.tile(NOISE**2 * np.eye(2), (len(rows), 1, 1))
            ),
        )
        for i, (rows, xy) in enumerate(seen)
    ]
    found = calibrate_camera(frames, target, measurer_of(target), SIZE, model)
    return found if isinstance(found, Calibrated) else found.reason


def error_px(case: Case, found: Calibrated) -> tuple[float, float]:
    """Root mean square error over the image, where the drawn lens has rays too, and what is claimed."""
    lens = camera_mapping(found.result, 0)
    field = projection_field(lens, 25, 19)
    xy = field.xy.reshape(-1, 2)
    uv = lens.mapping.inverse(xy)
    rays = np.column_stack([uv, np.ones(len(uv))])

    def off(turn: Array) -> Array:
        turned = rays @ cv2.Rodrigues(turn)[0].T
        wide = lenses.Lens(
            4 * SIZE[0], 4 * SIZE[1], case.lens.matrix + np.outer([*SIZE, 0], [0, 0, 1]),
            case.lens.coefficients, case.lens.fisheye, case.lens.widest + 0.1,
        )  # fmt: skip
        return np.asarray(wide.project(turned) - SIZE - xy)

    good = np.isfinite(off(np.zeros(3))).all(axis=1)
    if good.mean() < 0.8:
        return float("inf"), float("nan")
    best = least_squares(lambda turn: np.nan_to_num(off(turn)[good], nan=10.0).ravel(), np.zeros(3)).x
    claimed = np.trace(field.cov.reshape(-1, 2, 2)[good], axis1=1, axis2=2)
    square = (np.nan_to_num(off(best)[good], nan=10.0) ** 2).sum(axis=1)
    return float(np.sqrt(square.mean())), float(np.sqrt(np.nanmean(claimed)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0, help="the first")
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--case", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--model", nargs="*", choices=("auto", "right"), default=("auto", "right"))
    given = parser.parse_args()
    for name in given.case:
        case, typical = CASES[name], dict[str, float]()
        pitch = case.right.pitch_mm
        for kind in sorted(given.model, reverse=True):
            model = case.right if kind == "right" else CameraOptions("auto", pitch_mm=pitch)
            errors, ratios, labels, begun = list[float](), list[float](), Counter[str](), time.process_time()
            for seed in range(given.seed, given.seed + given.seeds):
                found = calibrated(case, seed, model, given.views)
                error, claimed = (np.inf, np.nan) if isinstance(found, str) else error_px(case, found)
                errors.append(error)
                ratios.append(error / claimed)
                if isinstance(found, str):
                    labels[found] += 1
                elif kind != "right":
                    camera = found.result.network.cameras[0]
                    label = f"{camera.model}: {' '.join(n for n in camera.free if n not in (*FRAME, *BROWN))}"
                    labels[label] += 1
            spent = (time.process_time() - begun) / given.seeds
            typical[kind] = float(np.median(errors))
            ratio = typical[kind] / typical.get("right", np.nan)
            line = (
                f"{name:9} {kind:7} {typical[kind]:7.4f} px, at most {max(errors):7.4f}; {ratio:5.2f} times; "
                f"{np.nanmedian(ratios):5.2f} of the sigma, at most {np.nanmax(ratios):5.2f}"
            )
            chosen = ", ".join(f"{count} {label}" for label, count in labels.most_common())
            print(f"{line}; {spent:5.2f} s  {chosen}", flush=True)


if __name__ == "__main__":
    main()
