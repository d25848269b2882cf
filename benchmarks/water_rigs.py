"""Cameras above water beside AquaCal, on its own scenarios: ``python benchmarks/water_rigs.py [--seeds N]``.

AquaCal (McGrath Lab, MIT licence) calibrates cameras that are fixed to each other and look down through one
surface of water, from photographs of a board under water. Its scenarios carry their truth
(``aquacal.datasets.create_scenario``), its detections are computed by its own refraction
(``generate_synthetic_detections``), and so nothing here is drawn by this project. Each scenario is solved by
both from the same detections and the same approximate values: by AquaCal's own
``calibrate_synthetic`` (its second pass, with focal lengths and principal points), and as a network in which
the board is the object, each moment an exposure of a rig, and the surface a window on the rig.

For each scenario over the seeds (of trajectory and noise): mean absolute errors of both, pooled over cameras
and seeds, and their ratios: centres of the cameras and distance of the surface (mm), rotations (mrad), focal
lengths and principal points (px); and the root mean square of errors ÷ sigmas of this project. The scenario
without noise is only solved by this project, from approximate values that are off: its largest residual is
told. AquaCal must be installed (``pip install aquacal``; it takes ten seconds for a seed of "minimal" and two
minutes for one of "realistic", nearly all of it in AquaCal); with `--keep` the figures of each seed are kept
in a folder, and those there are not computed again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import time
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from figures import record
from numpy.typing import NDArray
from parts import add_options, executor_of, main_of, outcomes, timed

from reseau.bundle import Camera, Network, Result, adjust_network
from reseau.bundle.network.rig import Rig
from reseau.optics.poses import matrix_to_vector, rotation_matrix
from reseau.optics.refraction import Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex

Array = NDArray[np.float64]

SCENARIOS = {"minimal": 50, "realistic": 50, "ideal": 1}
"""Scenarios, and their seeds."""
FREE = ("fx", "fy", "cx", "cy")
QUANTITIES = ("centre, mm", "rotation, mrad", "surface, mm", "focal length, px", "principal point, px")
EXACT_PX = 0.01
"""Standard deviation of the coordinates of a scenario without noise."""


def network_of(scenario: Any, detections: Any, board: Any) -> Network:
    """The detections as a network in mm: the board is the object."""
    names = list(scenario.intrinsics)
    corners = 1e3 * np.array([board.corner_positions[k] for k in range(board.num_corners)])
    poses = {pose.frame_idx: pose for pose in scenario.board_poses}
    images, camera_of, exposure, turns, centres = [], [], [], [], []
    image_of, point_of, xy = [], [], []
    for index, frame in detections.frames.items():
        of_board, at = rotation_matrix(poses[index].rvec), 1e3 * np.asarray(poses[index].tvec)
        for name, found in frame.detections.items():
            extrinsics = scenario.extrinsics[name]
            turn = extrinsics.R @ of_board
            # x = R (R_b X + t_b) + t
            turns.append(turn)
            centres.append(-turn.T @ (extrinsics.R @ at + 1e3 * extrinsics.t))
            image_of += [len(images)] * len(found.corner_ids)
            images.append(f"{name}-{index}")
            camera_of.append(names.index(name))
            exposure.append(index)
            point_of += found.corner_ids.tolist()
            xy.append(found.corners_2d)
    sigma = scenario.noise_std or EXACT_PX
    m, p = len(images), len(corners)
    cameras = []
    for name in names:
        entry = scenario.intrinsics[name]
        k, d = entry.K, entry.dist_coeffs
        values = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d[:4], d[4], 0.0, 0.0, 0.0])
        cameras.append(Camera(name, *entry.image_size, (1.0, 1.0), "opencv", values, FREE))
    surface = Window(
        "surface", "plane", "rig", {"distance": 1e3 * scenario.water_zs[names[0]]}, ("air", "water"),
        free=("distance",),
    )  # fmt: skip
    media = (RefractiveIndex("air", scenario.n_air), RefractiveIndex("water", scenario.n_water))
    return Network(
        cameras=tuple(cameras), images=tuple(images), camera_of=np.array(camera_of), x0=np.array(centres),
        rotation=matrix_to_vector(np.array(turns)), points=tuple(str(k) for k in range(p)), xyz=corners,
        sigma=np.zeros((p, 3)), role=("control",) * p, image_of=np.array(image_of, dtype=np.intp),
        point_of=np.array(point_of, dtype=np.intp), xy=np.concatenate(xy),
        cov=np.tile(np.eye(2) * sigma**2, (len(image_of), 1, 1)), distance_of=np.zeros((0, 2), np.intp),
        distance=np.zeros((0, 2)), datum="control", datum_points=np.ones(p, dtype=bool), groups=(None,) * m,
        files=(None,) * m, unit="mm", rig=Rig(np.array(camera_of), np.array(exposure)),
        refraction=Refraction(media, (surface,), ((0,),), np.zeros(m, np.intp)),
    )  # fmt: skip


def displaced(network: Network) -> Network:
    """The network with approximate values that are off: focal length, centres, rotations, surface."""
    rng, refraction = np.random.default_rng(0), network.refraction
    assert refraction is not None
    scale = np.array([1.01, 1.01, *10 * [1.0]])
    surface = refraction.windows[0]
    wrong = replace(surface, values={"distance": 1.03 * surface.values["distance"]})
    return replace(
        network, cameras=tuple(replace(camera, values=camera.values * scale) for camera in network.cameras),
        x0=network.x0 + rng.normal(0, 20.0, network.x0.shape),
        rotation=network.rotation + rng.normal(0, 0.01, network.rotation.shape),
        refraction=replace(refraction, windows=(wrong,)),
    )  # fmt: skip


def errors_of_network(scenario: Any, result: Result) -> tuple[list[list[float]], list[list[float]]]:
    """Errors of each quantity, and errors over sigmas."""
    names, rig, windows = list(scenario.intrinsics), result.rig, result.refraction
    assert rig is not None
    assert windows is not None
    centre, turn, normal = [], [], [list[float]() for _ in QUANTITIES]
    for k, name in enumerate(rig.cameras):
        true = scenario.extrinsics[name]
        off = rig.base[k] - 1e3 * np.asarray(true.C)
        about = matrix_to_vector(rig.rotation[k] @ true.R.T)
        sigma = np.sqrt(np.diag(rig.cov[k]))
        centre += off.tolist()
        turn += (1e3 * about).tolist()
        normal[0] += (off / sigma[3:]).tolist()
        normal[1] += (about / sigma[:3]).tolist()
    surface = float(windows.values[0] - 1e3 * scenario.water_zs[names[0]])
    normal[2].append(surface / float(windows.sigma[0]))
    focal, point = list[float](), list[float]()
    for name in names:
        k, found = scenario.intrinsics[name].K, result.cameras[name]
        off = found.values - [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
        focal += off[:2].tolist()
        point += off[2:].tolist()
        normal[3] += (off / found.sigma)[:2].tolist()
        normal[4] += (off / found.sigma)[2:].tolist()
    return [centre, turn, [surface], focal, point], normal


def errors_of_peer(scenario: Any, found: Any) -> list[list[float]]:
    """Errors of each quantity."""
    names = list(scenario.intrinsics)
    reference = min(names, key=lambda name: float(np.linalg.norm(scenario.extrinsics[name].C)))
    centre, turn, focal, point = list[float](), list[float](), list[float](), list[float]()
    for name in names:
        own, k = found.cameras[name], scenario.intrinsics[name].K
        if name != reference:
            true = scenario.extrinsics[name]
            centre += (1e3 * (np.asarray(own.extrinsics.C) - true.C)).tolist()
            turn += (1e3 * matrix_to_vector(own.extrinsics.R @ true.R.T)).tolist()
        off = own.intrinsics.K - k
        focal += [float(off[0, 0]), float(off[1, 1])]
        point += [float(off[0, 2]), float(off[1, 2])]
    surface = 1e3 * (found.cameras[reference].water_z - scenario.water_zs[reference])
    return [centre, turn, [float(surface)], focal, point]


def solved(name: str, seed: int) -> dict[str, Any]:
    """Errors of both for one seed, and the processor times."""
    from aquacal.core.board import BoardGeometry
    from aquacal.datasets import calibrate_synthetic, create_scenario, generate_synthetic_detections

    scenario = create_scenario(name, seed=seed)
    board, peer = BoardGeometry(scenario.board_config), None
    begin = time.process_time()
    if scenario.noise_std > 0:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            peer, _ = calibrate_synthetic(scenario, scenario.n_water, refine_intrinsics=True, seed=seed)
    middle = time.process_time()
    detections = generate_synthetic_detections(
        scenario.intrinsics, scenario.extrinsics, scenario.water_zs, board, scenario.board_poses,
        scenario.noise_std, seed=seed, n_air=scenario.n_air, n_water=scenario.n_water,
    )  # fmt: skip
    network = network_of(scenario, detections, board)
    if peer is None:
        network = displaced(network)
    result, seconds = timed(partial(adjust_network, network), name)
    assert isinstance(result, Result), f"{name} {seed}: {result}"
    own, normal = errors_of_network(scenario, result)
    return {
        "own": own,
        "normal": normal,
        "peer": [[np.nan]] * len(QUANTITIES) if peer is None else errors_of_peer(scenario, peer),
        "largest_px": float(np.abs(result.residuals).max()),
        "sigma0": result.sigma0,
        "seconds": [seconds, middle - begin],
    }


def kept(folder: Path | None, name: str, seed: int) -> dict[str, Any]:
    """The same, read from the folder if it is there, or written to it."""
    if folder is None:
        return solved(name, seed)
    path = folder / f"{name}-{seed:03d}.json"
    if not path.exists():
        part = path.with_suffix(".part")
        part.write_text(json.dumps(solved(name, seed)))
        part.replace(path)
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenario", choices=tuple(SCENARIOS))
    parser.add_argument("--seeds", type=int, help="by default 50; 1 of the scenario without noise")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the figures of each seed here")
    # Both programs are timed: one process by default.
    add_options(parser, jobs=1)
    chosen = parser.parse_args()
    try:
        import aquacal  # noqa: F401
    except ImportError as error:
        raise SystemExit(f"AquaCal is not installed ({error}): pip install aquacal") from None
    if chosen.keep is not None:
        chosen.keep.mkdir(parents=True, exist_ok=True)
    for name in [chosen.scenario] if chosen.scenario else SCENARIOS:
        seeds = chosen.seeds or SCENARIOS[name]
        with executor_of(chosen) as executor:
            rows = list(outcomes(executor, partial(kept, chosen.keep, name), range(seeds)))
        times = np.median([row["seconds"] for row in rows], axis=0)
        for k, who in enumerate(("reseau", "AquaCal")):
            record(f"{name}, processor time", who, [row["seconds"][k] for row in rows], "s")
        largest = max(row["largest_px"] for row in rows)
        print(
            f"{name}: {seeds} seed{'s' * (seeds > 1)}, {times[0]:.1f} s each, AquaCal {times[1]:.1f} s "
            f"(processor); sigma0 {np.mean([row['sigma0'] for row in rows]):.4f}, "
            f"largest residual {largest:.2g} px"
        )
        print(f"  {'mean absolute error':<22}{'reseau':>12}{'AquaCal':>12}{'ratio':>8}{'e/σ':>14}")
        for q, quantity in enumerate(QUANTITIES):
            own, peer, normal = (
                np.array([value for row in rows for value in row[part][q]])
                for part in ("own", "peer", "normal")
            )
            one, other = np.abs(own).mean(), np.abs(peer).mean()
            what, unit = quantity.split(", ")
            for who, part in (("reseau", "own"), ("AquaCal", "peer")):
                each = [np.abs(row[part][q]).mean() for row in rows]
                record(f"{name}, error of the {what}", who, each, unit)
            # Errors of one seed are correlated: the interval is that of the mean squares of seeds.
            squares = np.array([np.mean(np.square(row["normal"][q])) for row in rows])
            rms = float(np.sqrt(np.mean(normal**2)))
            wide = 1.96 * squares.std(ddof=1) / np.sqrt(seeds) / (2 * rms) if seeds > 1 else np.nan
            print(f"  {quantity:<22}{one:>12.3g}{other:>12.3g}{one / other:>8.3f}{rms:>7.2f} ± {wide:.2f}")


if __name__ == "__main__":
    main_of(__file__)
