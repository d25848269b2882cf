"""Photographs of sheets of independent formation: what is found, errors and sigmas.

Run from the checkout: ``python benchmarks/sheets.py [--count 3] [--condition C …]``; see
:mod:`worlds.sheets` for the conditions. A disk counts as inside if its centre is more than 8 px from the
border and nothing in front of the sheet comes nearer than 12 px.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np
from worlds.sheets import CONDITIONS, View, views

from reseau.core.data import Frame
from reseau.core.failure import Failure
from reseau.io import ReseauDesign
from reseau.measure import measure_reseau

_BORDER_PX, _CLEAR_PX = 8.0, 12.0
_WRONG_PX, _WRONG_SIGMA = 0.15, 5.0


def measured(view: View) -> tuple[np.ndarray, np.ndarray, int, int, float] | Failure:
    """Errors (n, 2) and the same in units of sigmas, numbers found and inside, and processor time."""
    design = ReseauDesign.parse(json.dumps(view.sheet.design()), where="sheet")
    pixels = view.picture()
    start = time.process_time()
    found = measure_reseau(Frame(pixels, 255.0), design)
    seconds = time.process_time() - start
    if isinstance(found, Failure):
        return found
    size = np.array(pixels.shape[::-1])
    inside = ((view.truth > _BORDER_PX) & (view.truth < size - 1 - _BORDER_PX)).all(axis=1)
    inside &= view.hidden > _CLEAR_PX
    error = (found.xy - view.truth)[found.ok]
    root = np.linalg.cholesky(found.cov[found.ok])
    scaled = np.linalg.solve(root, error[..., None])[..., 0]
    return error, scaled, int((found.ok & inside).sum()), int(inside.sum()), seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--condition", nargs="*", default=list(CONDITIONS))
    arguments = parser.parse_args()
    print(f"{'condition':12} {'measured':>14}  rms     worst px, sigma  wrong  error/sigma  processor time")
    for condition in arguments.condition:
        parts = []
        for view in views(condition, arguments.count):
            found = measured(view)
            if isinstance(found, Failure):
                print(f"{condition:12} declined: {found.reason}")
            else:
                parts.append(found)
        if not parts:
            continue
        error, scaled = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        off, sigmas = np.hypot(*error.T), np.hypot(*scaled.T)
        wrong = int(((off > _WRONG_PX) & (sigmas > _WRONG_SIGMA)).sum())
        count, inside = (sum(part[k] for part in parts) for k in (2, 3))
        print(
            f"{condition:12} {count:5} of {inside:5}  {np.sqrt((error**2).mean()):.4f}  {off.max():.3f}  "
            f"{sigmas.max():5.1f}      {wrong:5}  {np.sqrt((scaled**2).mean()):11.2f}  "
            f"{np.mean([part[4] for part in parts]):.2f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
