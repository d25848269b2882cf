"""Projections and calibrations by mrcal (Debian ``python3-mrcal``), for ``benchmarks/cameras.py``.

Run by the system's Python: reads a JSON document from standard input, writes one to standard output. A
document has a list of `projections` (`lensmodel`, `values`, `points`) and one of `calibrations` (`lensmodel`,
`values`, `size`, `spacing`, `frames` as rotation vectors and shifts from board to camera, `corners`
(m, h, w, 2)).
"""

import json
import sys

import mrcal
import numpy as np

document = json.load(sys.stdin)
out = {"projections": [], "calibrations": []}
for each in document["projections"]:
    seen = mrcal.project(np.array(each["points"]), each["lensmodel"], np.array(each["values"]))
    out["projections"].append(seen.tolist())
for each in document["calibrations"]:
    corners = np.array(each["corners"])
    m = len(corners)
    intrinsics, frames = np.array([each["values"]]), np.array(each["frames"])
    observations = np.ascontiguousarray(np.concatenate([corners, np.ones((*corners.shape[:3], 1))], axis=3))
    indices = np.array([(i, 0, -1) for i in range(m)], dtype=np.int32)
    problem = {
        "intrinsics": intrinsics, "extrinsics_rt_fromref": np.zeros((0, 6)), "frames_rt_toref": frames,
        "points": None, "observations_board": observations,
        "indices_frame_camintrinsics_camextrinsics": indices, "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None, "lensmodel": each["lensmodel"],
        "imagersizes": np.array([each["size"]], dtype=np.int32),
        "calibration_object_spacing": each["spacing"],
        "do_optimize_intrinsics_core": True, "do_optimize_intrinsics_distortions": True,
        "do_optimize_calobject_warp": False, "do_apply_outlier_rejection": False,
        "do_apply_regularization": False, "verbose": False,
    }  # fmt: skip
    # Its solver stops early: it is repeated from where it stopped.
    for _ in range(5):
        found = mrcal.optimize(**problem)
    out["calibrations"].append(
        {"values": intrinsics[0].tolist(), "rms": float(found["rms_reproj_error__pixels"])}
    )
json.dump(out, sys.stdout)
