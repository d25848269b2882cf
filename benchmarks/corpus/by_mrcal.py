"""Calibrations of a set and of its halves by mrcal (Debian ``python3-mrcal``), for ``benchmarks/halves.py``.

Run by the system's Python: reads a JSON document from standard input, writes one to standard output. The
document has `size`, `spacing`, approximate `values` of LENSMODEL_OPENCV8, `corners` (m, h, w, 3) with a
weight, -1 where a corner is missing, `frames` as rotation vectors and shifts from board to camera (m, 6), and
`halves`, numbers of images. The answer has the `rms` of all images, px, and the difference of the halves by
the claimed 95 % bound, at the centre and in the corners.
"""

import json
import sys

import mrcal
import numpy as np

BOUND = 5.991464547107979


def calibrated(given, images):
    """The model of some images, as mrcal's own tool makes it: with a warped board and without outliers."""
    inputs = {
        "intrinsics": np.array([given["values"]]), "extrinsics_rt_fromref": np.zeros((0, 6)),
        "frames_rt_toref": np.array(given["frames"])[images], "points": None,
        "observations_board": np.ascontiguousarray(np.array(given["corners"])[images]),
        "indices_frame_camintrinsics_camextrinsics": np.array(
            [(i, 0, -1) for i in range(len(images))], dtype=np.int32
        ),
        "observations_point": None, "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": "LENSMODEL_OPENCV8", "imagersizes": np.array([given["size"]], dtype=np.int32),
        "calibration_object_spacing": given["spacing"], "calobject_warp": np.zeros(2),
        "do_optimize_intrinsics_core": True, "do_optimize_intrinsics_distortions": False,
        "do_optimize_calobject_warp": False, "do_optimize_extrinsics": True, "do_optimize_frames": True,
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": True, "verbose": False,
    }  # fmt: skip
    # First without distortion, then all, as mrcal's tool does.
    mrcal.optimize(**inputs)
    inputs |= {"do_optimize_intrinsics_distortions": True, "do_optimize_calobject_warp": True}
    mrcal.optimize(**inputs)
    inputs["do_apply_outlier_rejection"] = True
    found = mrcal.optimize(**inputs)
    return mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=0), found


def ratios(models, size):
    """Differences by their claimed bounds, at the centre and root mean square in the corners."""
    _, difference, at, _ = mrcal.projection_diff(
        models, gridn_width=25, gridn_height=None, use_uncertainties=True, distance=None
    )
    sigma = 0.0
    for model in models:
        rays = mrcal.unproject(at, *model.intrinsics(), normalize=True)
        each = mrcal.projection_uncertainty(rays, model, atinfinity=True, what="worstdirection-stdev")
        sigma = np.hypot(sigma, each)
    ratio = np.linalg.norm(difference, axis=-1) / sigma / np.sqrt(BOUND)
    rows, columns = ratio.shape
    corners = ratio[[0, 0, -1, -1], [0, -1, 0, -1]]
    return float(ratio[rows // 2, columns // 2]), float(np.sqrt(np.mean(corners**2)))


given = json.load(sys.stdin)
count = len(given["corners"])
_, whole = calibrated(given, list(range(count)))
out = {"rms": float(whole["rms_reproj_error__pixels"]), "halves": []}
for halves in given["halves"]:
    models = [calibrated(given, half)[0] for half in halves]
    out["halves"].append(ratios(models, given["size"]))
json.dump(out, sys.stdout)
