"""Camera models beside OpenCV, mrcal and COLMAP: projections, calibrations of the same corners, choices.

Run from the checkout: ``python benchmarks/cameras.py [--part projections|calibrations|times|choices]
[--seeds N]``. mrcal needs Debian's ``python3-mrcal``, COLMAP needs pycolmap (extra ``peers``); without them
their rows are left out, and said to be. Corners are those of OpenCV in the photographs of
$RESEAU_DATA/chessboard_stereo, and of boards drawn by OpenCV's cameras (``benchmarks/worlds/lenses.py``).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import record
from parts import add_options, executor_of, main_of, outcomes
from worlds import lenses

from reseau.bundle import Camera, Network, Result, adjust_network, choose_model
from reseau.bundle.modelling.choice import ModelChoice
from reseau.calibration.camera import by_rotation
from reseau.core.compiled import compiled, kernel
from reseau.execution import Executor
from reseau.io.network import Network1
from reseau.optics import PixelGrid, camera_models
from reseau.optics.cameras.kernels import CameraColumns, camera
from reseau.optics.cameras.opencv import OpenCV
from reseau.optics.cameras.projections import Division, Fisheye, Stereographic
from reseau.optics.cameras.splined import SplinedStereographic, SplineGrid
from reseau.optics.poses import rotation_matrix

DATA = Path(os.environ.get("RESEAU_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
MRCAL = Path(__file__).parent / "ceres" / "mrcal_cameras.py"
FRAME = [802.0, 805.0, 641.3, 477.9]
FIVE = ["k1", "k2", "p1", "p2", "k3"]
EIGHT = [*FIVE, "k4", "k5", "k6"]
K14 = [0.2, -0.05, 4e-4, -3e-4, 0.01, 0.4, 0.03, -0.005, 2e-3, -1e-3, 3e-3, 5e-4, 0.04, -0.07]


def points(most_deg: float, n: int = 2000) -> np.ndarray:
    """Points in the camera system at all angles up to a limit."""
    rng = np.random.default_rng(3)
    angle, turn = np.radians(rng.uniform(0, most_deg, n)), rng.uniform(0, 2 * np.pi, n)
    way = np.column_stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
    return way * rng.uniform(0.5, 3, (n, 1))


def mrcal(document: dict[str, Any]) -> dict[str, Any] | None:
    """What mrcal answers; None where it is not installed."""
    try:
        run = subprocess.run(
            ["/usr/bin/python3", MRCAL],
            input=json.dumps(document),
            capture_output=True,
            text=True,
            check=True,
            env={"PATH": "/usr/bin"},
        )
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"without mrcal: {str(getattr(error, 'stderr', '') or error).strip().splitlines()[-1]}")
        return None
    return dict(json.loads(run.stdout))


def projections() -> None:
    """Largest differences of image points, px."""
    matrix, none = np.array([[FRAME[0], 0, FRAME[2]], [0, FRAME[1], FRAME[3]], [0, 0, 1]]), np.zeros(3)

    def said(who: str, name: str, ours: Any, x: np.ndarray, theirs: np.ndarray) -> None:
        off = np.abs(ours(x[:, :2] / x[:, 2:]) - theirs)
        record(f"{who}, {name}", "largest difference from reseau", off.max(), "px")
        print(f"  {who:7} {name:27} {len(x)} rays  {off.max():.1e} px{'' if off.max() < 1e-9 else '  !'}")

    x, wide = points(50.0), points(88.0)
    for count in (4, 5, 8, 12, 14):
        k = np.array(K14[:count])
        theirs, _ = cv2.projectPoints(x[:, None], none, none, matrix, k)
        said("OpenCV", f"{count} coefficients", OpenCV([*FRAME, *k, *np.zeros(14 - count)]), x, theirs[:, 0])
    k = np.array([0.05, -0.02, 0.006, -0.001])
    theirs, _ = cv2.fisheye.projectPoints(wide[:, None], none, none, matrix, k)
    said("OpenCV", "fisheye", Fisheye([*FRAME, *k]), wide, theirs[:, 0])
    asked = [
        (
            f"LENSMODEL_OPENCV{count}",
            [*FRAME, *K14[:count]],
            OpenCV([*FRAME, *K14[:count], *np.zeros(14 - count)]),
            x,
        )
        for count in (4, 5, 8, 12)
    ]
    asked.append(("LENSMODEL_STEREOGRAPHIC", FRAME, Stereographic(FRAME), wide))
    for grid in (SplineGrid(3, 30, 20, 170), SplineGrid(2, 16, 11, 120)):
        values = [*FRAME, *np.random.default_rng(4).normal(0, 0.03, 2 * grid.nx * grid.ny)]
        name = grid.name.replace("splined_stereographic", "LENSMODEL_SPLINED_STEREOGRAPHIC")
        asked.append((name, values, SplinedStereographic(values, grid), points(0.45 * grid.fov_x_deg)))
    entries = [{"lensmodel": name, "values": v, "points": p.tolist()} for name, v, _, p in asked]
    found = mrcal({"projections": entries, "calibrations": []})
    if found is not None:
        for (name, _, lens, p), seen in zip(asked, found["projections"], strict=True):
            said("mrcal", name, lens, p, np.array(seen))
    if importlib.util.find_spec("pycolmap") is None:
        print("without COLMAP: no pycolmap")
        return
    import pycolmap

    a = [0.05, -0.02, 0.006, -0.001]
    for name, values, lens, p in (
        ("OPENCV", [*FRAME, *K14[:4]], OpenCV([*FRAME, *K14[:4], 0.0]), x),
        ("FULL_OPENCV", [*FRAME, *K14[:8]], OpenCV([*FRAME, *K14[:8]]), x),
        ("OPENCV_FISHEYE", [*FRAME, *a], Fisheye([*FRAME, *a]), wide),
        ("THIN_PRISM_FISHEYE", [*FRAME, a[0], a[1], 1e-3, -8e-4, a[2], a[3], 2e-3, -1e-3],
         Fisheye([*FRAME, *a, 1e-3, -8e-4, 2e-3, -1e-3]), wide),
        ("DIVISION", [*FRAME, -0.3], Division([*FRAME, -0.3]), wide),
    ):  # fmt: skip
        theirs = pycolmap.Camera(model=name, width=1280, height=960, params=values).img_from_cam(p)
        said("COLMAP", name, lens, p, np.array(theirs))


def chessboard(side: str) -> tuple[np.ndarray, list[np.ndarray], tuple[int, int]]:
    """Board, corners of each photograph by OpenCV (without its bad view 02), and size of the images."""
    flat, _ = lenses.board(9, 6, 25.0)
    found = []
    for path in sorted((DATA / "chessboard_stereo").glob(f"{side}*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        seen, corners = cv2.findChessboardCorners(image, (9, 6))
        if seen and path.stem != "left02":
            until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-6)
            corners = cv2.cornerSubPix(image, corners, (7, 7), (-1, -1), until)
            found.append(corners.reshape(-1, 2).astype(np.float64))
    return flat, found, (640, 480)


def calibrations() -> None:
    """Greatest differences of parameters in standard deviations; the board is held as designed."""
    drawn, narrow = lenses.fisheye(76), lenses.fisheye(38)
    flat, true = lenses.board(8, 6, 1.0)
    cases: list[tuple[str, str, list[str], np.ndarray, list[np.ndarray], tuple[int, int]]] = []
    for side in ("left", "right"):
        board, seen, size = chessboard(side)
        cases += [(f"photographs, {side}", "opencv", names, board, seen, size) for names in (FIVE, EIGHT)]
    for name, lens in (("drawn, 76°", drawn), ("drawn, 38°", narrow)):
        seen = [xy for _, xy in lenses.views(lens, flat, true, 20, 0.2, 4)]
        model = ("fisheye", ["k1", "k2", "k3", "k4"]) if lens is drawn else ("opencv", FIVE)
        cases.append((name, *model, flat, seen, (lens.width, lens.height)))
    for title, model, names, board, seen, size in cases:
        compare(f"{title}, {model}, {len(names)} coefficients", model, names, board, seen, size)


def compare(
    title: str, model: str, names: list[str], board: np.ndarray, seen: list[np.ndarray], size: tuple[int, int]
) -> None:
    """One network by all programs."""
    guess = drawn_like(size, board, seen, model)
    lens = lenses.Lens(*size, np.diag([guess, guess, 1.0]), np.zeros(4))
    start = {"fx": guess, "fy": guess, "cx": (size[0] - 1) / 2, "cy": (size[1] - 1) / 2}
    free = ["fx", "fy", "cx", "cy", *names]
    rows = np.arange(len(board))
    document = lenses.document(lens, board, [(rows, xy) for xy in seen], start, free, 0.2, model)
    network = Network.from_document(Network1.from_content(json.loads(json.dumps(document)), where=title))
    result = adjust_network(network).required()
    ours = result.cameras["A"]
    matrix = np.array([[ours.values[0], 0, ours.values[2]], [0, ours.values[1], ours.values[3]], [0, 0, 1]])
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-15)
    theirs: dict[str, Any] = {}
    if model == "fisheye":
        flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW | cv2.CALIB_USE_INTRINSIC_GUESS
        _, k, d, *_ = cv2.fisheye.calibrate(
            [board[None]] * len(seen),
            [xy[None] for xy in seen],
            size,
            matrix,
            np.zeros(4),
            flags=flags,
            criteria=until,
        )
    else:
        flags = cv2.CALIB_RATIONAL_MODEL if len(names) == 8 else 0
        _, k, d, turn, shift = cv2.calibrateCamera(
            [board.astype(np.float32)] * len(seen), [xy.astype(np.float32) for xy in seen], size, None, None,
            flags=flags, criteria=until,
        )  # fmt: skip
        frames = np.concatenate([np.array(turn)[:, :, 0], np.array(shift)[:, :, 0]], axis=1)
        columns = int(board[:, 0].max() / (pitch := board[1, 0]) + 1.5)
        corners = np.array(seen).reshape(len(seen), -1, columns, 2)
        asked = {
            "lensmodel": f"LENSMODEL_OPENCV{len(names)}",
            "values": interior(k, d, len(names)).tolist(),
            "size": list(size),
            "spacing": float(pitch),
            "frames": frames.tolist(),
            "corners": corners.tolist(),
        }
        found = mrcal({"projections": [], "calibrations": [asked]})
        if found is not None:
            theirs["mrcal"] = np.array(found["calibrations"][0]["values"])
    theirs = {"OpenCV": interior(k, d, len(names))} | theirs
    # COLMAP has no model with five coefficients.
    counterpart = {("fisheye", 4): "OPENCV_FISHEYE", ("opencv", 8): "FULL_OPENCV"}.get((model, len(names)))
    if counterpart is not None:
        found = by_colmap(result, counterpart, board, seen, size, len(names))
        if found is not None:
            theirs["COLMAP"] = found
    print(
        f"{title}: {len(seen)} views, sigma0 {result.sigma0 * 0.2:.4f} px, "
        f"fx {ours.values[0]:.3f} ± {ours.sigma[0]:.3f} px"
    )
    for who, values in theirs.items():
        off = np.abs(ours.values - values) / ours.sigma
        most, mark = int(off.argmax()), "" if off.max() < 0.1 else "  !"
        record(title, f"{who}, largest difference of a parameter", off.max(), "sigma")
        print(f"  {who:7} fx {values[0]:.3f}; differs by at most {off.max():.3f} sigma ({free[most]}){mark}")


def by_colmap(
    result: Result, name: str, board: np.ndarray, seen: list[np.ndarray], size: tuple[int, int], count: int
) -> np.ndarray | None:
    """Parameters by COLMAP's bundle adjustment of the same corners, the board held; from a rough start."""
    if importlib.util.find_spec("pycolmap") is None:
        print("without COLMAP: no pycolmap")
        return None
    import pycolmap

    values = result.cameras["A"].values.copy()
    values[:2] *= 1.02
    values[4:] = 0.0
    made = pycolmap.Reconstruction()
    lens = pycolmap.Camera(model=name, width=size[0], height=size[1], params=values.tolist(), camera_id=1)
    made.add_camera_with_trivial_rig(lens)
    rotation, x0 = result.fit.values.rotation, result.fit.values.x0
    for i, xy in enumerate(seen):
        turn = rotation_matrix(np.array([0.01, -0.01, 0.01])) @ rotation[i]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ x0[i])
        image = pycolmap.Image(name=str(i), keypoints=xy, camera_id=1, image_id=i + 1)
        made.add_image_with_trivial_frame(image, pose)
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(len(seen)):
        config.add_image(i + 1)
    for j, where in enumerate(board):
        track = pycolmap.Track()
        for i in range(len(seen)):
            track.add_element(i + 1, j)
        config.add_constant_point(made.add_point3D(where, track, np.zeros(3, dtype=np.uint8)))
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_principal_point = False, True
    solver = options.ceres.solver_options
    solver.function_tolerance, solver.max_num_iterations = 1e-15, 500
    pycolmap.create_default_bundle_adjuster(options, config, made).solve()
    return np.array(made.cameras[1].params[: 4 + count])


def interior(k: np.ndarray, d: np.ndarray, count: int) -> np.ndarray:
    """fx, fy, cx, cy and the first coefficients."""
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.ravel()[:count]])


def drawn_like(size: tuple[int, int], board: np.ndarray, seen: list[np.ndarray], model: str) -> float:
    """A rough focal length (px)."""
    if model == "fisheye":
        return 1.05 * float(lenses.fisheye(76).matrix[0, 0])
    given = [board.astype(np.float32)] * len(seen), [xy.astype(np.float32) for xy in seen]
    return float(cv2.initCameraMatrix2D(*given, size, 1.0)[0, 0])


@kernel
def _run(n: int, uv: Any, xy: Any, cameras: CameraColumns, by_uv: Any, d: Any, more: Any, off: Any) -> None:
    for k in range(n):
        camera(k, 0, -1, uv[k, 0], uv[k, 1], xy, cameras, by_uv, d, more, off)


def times() -> None:
    """Processor time of one image point with all derivatives, compiled and by the mapping."""
    grid, n = PixelGrid(1280, 960, (0.01, 0.01)), 200_000
    uv = np.random.default_rng(1).uniform(-0.5, 0.5, (n, 2))
    for model in camera_models():
        values = model.start_values(1000.0, grid)
        line = f"  {model.name:14} {len(values):2} parameters"
        if model.kernel is not None:
            constants = np.asarray(model.constants(model.checked_options()), dtype=np.float64).reshape(1, -1)
            columns = CameraColumns(
                values[None],
                constants,
                np.array([[639.5, 479.5, 0.01, 0.01]]),
                np.zeros((1, 0)),
                np.zeros((1, 2)),
            )
            room = np.zeros((2, 2)), np.zeros((2, len(values))), np.zeros((2, 0)), np.zeros(2)
            seconds = least(compiled(_run, camera=model.kernel), n, uv, uv, columns, *room)
            line += f"  {1e9 * seconds / n:6.0f} ns compiled"
        part = uv[:20000]
        seconds = least(model.mapping(values, grid).derivatives, part)
        print(line + f"  {1e9 * seconds / len(part):6.0f} ns by the mapping")


def least(function: Callable[..., Any], *arguments: Any) -> float:
    """Least processor time of five calls, s, after one that compiles."""
    function(*arguments)
    found = []
    for _ in range(5):
        begin = time.process_time()
        function(*arguments)
        found.append(time.process_time() - begin)
    return min(found)


def truths() -> dict[str, lenses.Lens]:
    """Lenses drawn by OpenCV, by the simplest candidate that contains them."""
    matrix = np.array([[1200.0, 0, 645.0], [0, 1203.0, 475.0], [0, 0, 1]])

    def lens(*k: float) -> lenses.Lens:
        return lenses.Lens(1280, 960, matrix, np.array([*k, *np.zeros(12 - len(k))]))

    rational = lens(0.3, -0.1, 5e-4, -3e-4, 0.02, 0.55, -0.05, 0.03)
    return {
        "opencv: no distortion": lens(),
        "opencv: k1": lens(-0.1),
        "opencv: k1 k2": lens(-0.2, 0.1),
        "opencv: k1 k2 p1 p2": lens(-0.2, 0.1, 1e-3, -5e-4),
        "opencv: k1 k2 p1 p2 k3": lens(-0.25, 0.3, 1e-3, -5e-4, -0.5),
        "opencv: k1 k2 p1 p2 k3 k4 k5 k6": rational,
        "fisheye: k1 k2 k3 k4": lenses.fisheye(70),
    }


def choice(job: tuple[lenses.Lens, int]) -> tuple[str, float, int] | str:
    """The model that is chosen, its error (px), and by how many parameters the best fitting one has more.

    Or the reason why none is.
    """
    lens, seed = job
    flat, true = lenses.board(8, 6, 1.0)
    seen = lenses.views(lens, flat, true, 15, 0.2, seed)
    f = 1.05 * float(lens.matrix[0, 0])
    start = {"fx": f, "fy": f, "cx": (lens.width - 1) / 2, "cy": (lens.height - 1) / 2}
    free = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"]
    document = lenses.document(lens, flat, seen, start, free, 0.2, "opencv")
    content = json.loads(json.dumps(document))
    found = choose_model(Network.from_document(Network1.from_content(content, where="drawn")))
    if not isinstance(found, ModelChoice):
        return str(found.reason)
    least = min((each for each in found.compared if each.cost > 0), key=lambda each: each.cost)
    error = difference(lens, found.camera, np.concatenate([xy for _, xy in seen]))
    more = len(least.candidate.free) - len(found.chosen.candidate.free)
    return found.chosen.candidate.label, error, more


def choices(executor: Executor, seeds: int = 20) -> None:
    """Which model is chosen, its parameters, and its greatest error over the observed part of the image."""
    for truth, lens in truths().items():
        done = list(outcomes(executor, choice, ((lens, seed) for seed in range(seeds))))
        names = Counter(each if isinstance(each, str) else each[0] for each in done)
        said = ", ".join(f"{name} {count}" for name, count in names.most_common())
        print(f"  {truth}: {said}", flush=True)
        chosen = [each for each in done if not isinstance(each, str)]
        error, more = [each[1] for each in chosen], [each[2] for each in chosen]
        print(
            f"    rms error of the chosen camera where there are observations {np.median(error):.3f} px "
            f"(median), at most {np.max(error):.3f} px; "
            f"the least residuals have {np.mean(more):.1f} parameters more"
        )


def difference(lens: lenses.Lens, camera: Camera, seen: np.ndarray) -> float:
    """Root mean square difference (px) from the lens where there are observations, after a rotation."""
    # Beyond 40° the polynomials of the standard lenses turn back into the image.
    x = points(80.0 if lens.fisheye else 40.0, 20_000)
    image = lens.project(x)
    x = x[np.isfinite(image).all(axis=1)]
    image = lens.project(x)
    cells = {tuple(cell) for cell in (seen // 80).astype(int).tolist()}
    inside = np.array([tuple(cell) in cells for cell in (image // 80).astype(int).tolist()])
    x, image, mapping, turn = x[inside], image[inside], camera.plane_mapping(), np.eye(3)
    for _ in range(5):
        turned = x @ turn.T
        uv = turned[:, :2] / turned[:, 2:]
        found = mapping.derivatives(uv)
        slope = (found.d_xy @ by_rotation(uv)).reshape(-1, 3)
        turn = rotation_matrix(-np.linalg.lstsq(slope, (found.value - image).ravel(), rcond=None)[0]) @ turn
    return float(np.sqrt(((found.value - image) ** 2).sum(axis=1).mean()))


PARTS = ("projections", "calibrations", "times", "choices")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=PARTS)
    parser.add_argument("--seeds", type=int, default=20, help="networks of each lens, for the choices")
    add_options(parser)
    given = parser.parse_args()
    with executor_of(given) as executor:
        parts: dict[str, Callable[[], None]] = {
            "projections": projections,
            "calibrations": calibrations,
            "times": times,
            "choices": partial(choices, executor, given.seeds),
        }
        for name in PARTS if given.part is None else (given.part,):
            print(name)
            parts[name]()
    return 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
