"""Networks of wide lenses from cold and from warm: `python benchmarks/networks.py`.

Boards seen through lenses drawn by OpenCV's fisheye camera (`benchmarks/worlds/lenses.py`), calibrated with
five and with eight coefficients: images used, sigma0, focal length and processor time, from a rough focal
length without distortion (cold) and from the result of `cv2.calibrateCamera` (warm).
"""

from __future__ import annotations

import json
import time
from typing import Any

import cv2
import numpy as np
from worlds import lenses

from reseau.bundle import Network, Options, adjust_network
from reseau.io.network import Network1

FIVE = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
EIGHT = [*FIVE, "k4", "k5", "k6"]
SIGMA = 0.3


def calibrated(lens: lenses.Lens, flat: np.ndarray, seen: list[Any], eight: bool) -> dict[str, float]:
    """Parameters by `cv2.calibrateCamera`."""
    points = [flat[rows].astype(np.float32) for rows, _ in seen]
    images = [xy.astype(np.float32)[:, None] for _, xy in seen]
    flags = cv2.CALIB_RATIONAL_MODEL if eight else 0
    _, k, d, *_ = cv2.calibrateCamera(points, images, (lens.width, lens.height), None, None, flags=flags)
    values = [k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.ravel()[: 8 if eight else 5]]
    return dict(zip(EIGHT if eight else FIVE, map(float, values), strict=True))


def run(name: str, document: dict[str, Any], options: Options | None = None) -> None:
    """Adjust and print a line."""
    network = Network.from_document(Network1.from_content(json.loads(json.dumps(document)), where=name))
    begin = time.process_time()
    found = adjust_network(network, options)
    seconds = time.process_time() - begin
    if not found:
        print(f"  {name:6} {seconds:6.2f} s  no result: {found.reason[:90]}")
        return
    used, camera = int(found.fit.usable.images.sum()), found.cameras["A"]
    print(
        f"  {name:6} {seconds:6.2f} s  {used}/{len(network.images)} images  sigma0 {found.sigma0:.4f}  "
        f"fx {camera.values[0]:.3f} ± {camera.sigma[0]:.3f} px  {found.fit.iterations} iterations, "
        f"{int(found.rejected.sum())} points rejected"
    )


def compare(half_diagonal: float, eight: bool, count: int, seed: int, **more: Any) -> None:
    """One lens and board from cold and warm."""
    lens = lenses.fisheye(half_diagonal)
    flat, true = lenses.board(more.get("columns", 8), more.get("rows", 6), 1.0, more.get("bend", 0.0))
    seen = lenses.views(lens, flat, true, count, more.get("noise", SIGMA), seed)
    f = 1.07 * float(lens.matrix[0, 0])
    cold = {"fx": f, "fy": f, "cx": (lens.width - 1) / 2, "cy": (lens.height - 1) / 2}
    free = EIGHT if eight else FIVE
    bend = f", bent by {more['bend']} squares" if more.get("bend") else ""
    print(f"{half_diagonal}° in the corners, {count} views, {5 + 3 * eight} coefficients, seed {seed}{bend}")
    run("cold", lenses.document(lens, flat, seen, cold, free))
    if more.get("bend"):
        run("reject", lenses.document(lens, flat, seen, cold, free), Options(outliers="reject"))
    run("warm", lenses.document(lens, flat, seen, calibrated(lens, flat, seen, eight), free))


def main() -> None:
    """Print all comparisons."""
    for half_diagonal in (55, 62, 70, 76):
        for eight in (False, True):
            for seed in (1, 2, 3):
                compare(half_diagonal, eight, 20, seed)
    for half_diagonal, bend in ((60, 0.02), (68, 0.03), (74, 0.03)):
        compare(half_diagonal, True, 186, 5, columns=10, rows=10, noise=0.1, bend=bend)


if __name__ == "__main__":
    main()
