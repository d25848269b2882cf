"""Sets of PHOTO I, II, III that other programs drew, through ``reseau refine``, compared with their truth.

A set is what lies in ``$RESEAU_DATA/independent/oscilloscope`` or what `worlds.oscilloscope` writes: three
photographs, designs of the reseau and of the test object, and a truth. The command runs as a user would run
it, and its files are read.

Coefficients are compared in the parametrisation of the calibration file. Group A refers to the common system
of the measured marks O and S, and the truth to that of the true ones: the covariance of the file has to cover
the difference. Group B leads to the scaled system of the rods M and N; the file says how it is related to
object coordinates, so that the true coefficients there follow from the truth. Of e, the errors of n
coefficients, and C, their covariance, √(eᵀC⁻¹e/n) is reported.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from figures import ORIGIN, record
from tables import judged
from worlds.oscilloscope import World, designs_of, truth_of

from reseau.calibration import Calibration, InstrumentCorrection
from reseau.core.data import Array, ImagePoints
from reseau.core.provenance import canonical_json
from reseau.io import ReseauDesign
from reseau.procedures.oscilloscope import photo_i, photo_ii, photo_iii

__all__ = ["Refined", "of_points", "print_refined", "refined", "true_group_b"]

FAR_MM = 1.2
"""Distance in the object beyond which a point is none of the true ones, mm."""
WRONG_SIGMA, WRONG_MM = 5.0, 0.05
HIDDEN = 0.5
MARKS_PX, ECHOES_PX = 0.006, (0.06, 0.03)
"""Standard deviations of coordinates without images: marks, and echoes in x and y."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A set through the command.

    Parameters
    ----------
    name : str
        Of the set.
    exit : int
        Of the command.
    message : str
        What it wrote to standard error.
    known, found : int
        Points of PHOTO III of which less than half is hidden, and how many of them were found.
    false, wrong : int
        Points that are none; points off by more than 5 sigma and 0.05 mm.
    errors : ndarray (m, 2)
        Errors of the points over their sigmas.
    mm : ndarray (m, 2)
        The same in mm.
    a, b : ndarray (2,)
        eᵀC⁻¹e of the coefficients of a group, and their number.
    worst : str
        The point with the largest error over its sigma.
    notes : str
        Notes of the command.
    """

    name: str
    exit: int
    message: str
    known: int
    found: int = 0
    false: int = 0
    wrong: int = 0
    errors: Array = field(default_factory=lambda: np.zeros((0, 2)))
    mm: Array = field(default_factory=lambda: np.zeros((0, 2)))
    a: Array = field(default_factory=lambda: np.zeros(2))
    b: Array = field(default_factory=lambda: np.zeros(2))
    worst: str = ""
    notes: str = ""


def refined(folder: Path, name: str, keep: Path) -> Refined:
    """Run the command on a set and compare with its truth; its files are written to `keep`."""
    truth = json.loads((folder / f"{name}.truth.json").read_text())
    check = truth["photos"]["III"]["check"]
    known = sum(h < HIDDEN and v for h, v in zip(check["hidden"], check["visible"], strict=True))
    keep.mkdir(parents=True, exist_ok=True)
    out, true = keep / f"{name}.calibration.json", keep / f"{name}.true.json"
    for file in (out, true):
        file.unlink(missing_ok=True)
    command = [
        sys.executable,
        "-c",
        "from reseau.cli import main; main()",
        "refine",
        "--out",
        str(out),
        "--true",
        str(true),
    ]
    for option, file in (
        ("--photo-i", "photo1.png"),
        ("--photo-ii", "photo2.png"),
        ("--photo-iii", "photo3.png"),
        ("--reseau", "reseau.design.json"),
        ("--test-object", "object.design.json"),
    ):
        command += [option, str(folder / f"{name}.{file}")]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"})
    if done.returncode or not out.exists():
        return Refined(name, done.returncode, " ".join(done.stderr.split())[-160:], known)
    calibration = Calibration.read(out)
    points = json.loads(true.read_text())["points"]
    return Refined(
        name,
        0,
        "",
        known,
        **_points(points, check),
        a=_weighted(calibration, truth["A"]),
        b=_weighted(calibration, true_group_b(calibration, truth)),
        notes="; ".join(
            line.strip() for line in done.stdout.splitlines() if "note:" in line and "has moved" not in line
        ),
    )


def _points(points: dict[str, Any], check: dict[str, Any]) -> dict[str, Any]:
    """Points of PHOTO III against the truth."""
    known = np.stack([check["object_X_mm"], check["object_Y_mm"]], axis=-1)
    hidden = np.array(check["hidden"])
    xy = np.stack([points["x"], points["y"]], axis=-1).reshape(-1, 2)
    sigma = np.stack([points["sx"], points["sy"]], axis=-1).reshape(-1, 2)
    off = xy[:, None] - known[None]
    distance = np.hypot(off[..., 0], off[..., 1])
    row = distance.argmin(axis=1)
    mine = (distance.min(axis=1) < FAR_MM) & (distance.argmin(axis=0)[row] == np.arange(len(xy)))
    error = off[np.arange(len(xy)), row][mine]
    row = row[mine]
    normalised = error / sigma[mine]
    wrong = ((np.abs(normalised) > WRONG_SIGMA) & (np.abs(error) > WRONG_MM)).any(axis=1)
    worst = ""
    if len(error):
        k = int(np.abs(normalised).max(axis=1).argmax())
        pair = ", ".join(f"{e:+.3f} mm = {n:+.1f}σ" for e, n in zip(error[k], normalised[k], strict=True))
        worst = f"{check['id'][row[k]]} (hidden {hidden[row[k]]:.2f}): {pair}"
    return {
        "found": int((hidden[row] < HIDDEN).sum()),
        "false": int((~mine).sum()),
        "wrong": int(wrong.sum()),
        "errors": normalised,
        "mm": error,
        "worst": worst,
    }


def true_group_b(calibration: Calibration, truth: dict[str, Any]) -> dict[str, float]:
    """The true coefficients of group B in the scaled system of the rods that a calibration uses.

    The truth maps the screen to the object by (7a, b). Turned into the system of M and N by κ, a cubic term
    of y enters the equation of x with sin κ, which (7a, b) do not have; fitted to the places of the rods,
    that leaves less than 0.002 mm.
    """
    instrument, _, _ = InstrumentCorrection.from_calibration(calibration)
    pins = truth["photos"]["II"]["pins"]
    screen = np.stack([pins["screen_x_mm"], pins["screen_y_mm"]], axis=-1)
    made = np.stack([pins["object_X_mm"], pins["object_Y_mm"]], axis=-1)
    goal = instrument.plane.to_common(made)
    model = instrument.model
    columns = model.with_values(np.zeros(len(model.names))).derivatives(screen).d_parameters
    matrix = columns.reshape(-1, len(model.names))
    size = np.linalg.norm(matrix, axis=0)
    found = np.linalg.lstsq(matrix / size, goal.ravel(), rcond=None)[0] / size
    return dict(zip(model.names, found.tolist(), strict=True))


def _weighted(calibration: Calibration, true: dict[str, float]) -> Array:
    """eᵀC⁻¹e of the coefficients that have a covariance, and their number."""
    names = [name for name in calibration.covariance.names if name in true]
    rows = [calibration.covariance.names.index(name) for name in names]
    cov = np.array(calibration.covariance.matrix)[np.ix_(rows, rows)]
    e = np.array([calibration.parameters[name].value - true[name] for name in names])
    scale = np.sqrt(np.diagonal(cov))
    e = e / scale
    return np.array([e @ np.linalg.solve(cov / np.outer(scale, scale), e), len(names)])


def of_points(seed: int) -> Refined:
    """A world without images: true positions with noise of the covariance that the procedure is given."""
    world, rng = World.drawn_from(seed), np.random.default_rng((seed, 30))
    truth = truth_of(world, f"world{seed:03d}")
    reseau, rods = (ReseauDesign.parse(canonical_json(d), where="world") for d in designs_of(world, "world"))

    def noisy(ids: Sequence[str], xy: Array, sigma: float | Sequence[float]) -> ImagePoints:
        spread = np.broadcast_to(np.asarray(sigma), xy.shape)
        return ImagePoints.with_sigma(ids, xy + rng.normal(0, 1, xy.shape) * spread, spread)

    visible = np.flatnonzero(world.visible)
    marks = [
        noisy([world.ids[i] for i in visible], world.to_pixels(photo, world.marks[visible]), MARKS_PX)
        for photo in world.photos
    ]
    there = np.flatnonzero(world.rods_there)
    pins = noisy(
        [rods.ids[i] for i in there], world.to_pixels(world.photos[1], world.pins.at[there]), ECHOES_PX
    )
    check = truth["photos"]["III"]["check"]
    body = noisy(check["id"], world.to_pixels(world.photos[2], world.body.at), ECHOES_PX)
    first = photo_i(marks[0], reseau).required()
    second = photo_ii(pins, reseau, rods, first.camera, marks=marks[1]).required()
    third = photo_iii(body, second.instrument, reseau, marks=marks[2]).required()
    calibration = second.instrument.calibration(reseau, rods, name="world")
    true = third.true
    points = {"x": true.xy[:, 0], "y": true.xy[:, 1], "sx": true.sigma[:, 0], "sy": true.sigma[:, 1]}
    return Refined(
        truth["set"],
        0,
        "",
        len(body),
        **(_points(points, check | {"hidden": [0.0] * len(body)})),
        a=_weighted(calibration, truth["A"]),
        b=_weighted(calibration, true_group_b(calibration, truth)),
    )


def _root(pairs: Iterable[Array]) -> float:
    """√(Σ eᵀC⁻¹e / Σ n)."""
    square, count = np.sum(list(pairs), axis=0)
    return float(np.sqrt(square / count)) if count else np.nan


def keep(sets: Sequence[Refined], done: Sequence[Refined]) -> None:
    """Record the figures of each set, and of all of them beside the simulator's."""
    for s in sets:
        record(s.name, "found", s.found, of=s.known)
        record(s.name, "wrong", s.wrong)
        if len(s.errors):
            record(s.name, "rms", np.sqrt((s.mm**2).mean()), "mm")
            record(s.name, "errors ÷ sigmas", np.sqrt((s.errors**2).mean()))
            record(s.name, "of group A", _root([s.a]))
            record(s.name, "of group B", _root([s.b]))
    what = "oscilloscope, points of PHOTO III"
    found, known = sum(s.found for s in sets), sum(s.known for s in sets)
    record(what, "independent, found", found, of=known, table=ORIGIN)
    column = "independent, errors ÷ sigmas"
    record(what, column, [np.sqrt((s.errors**2).mean()) for s in done], table=ORIGIN)
    for group, values in (("A", [_root([s.a]) for s in done]), ("B", [_root([s.b]) for s in done])):
        record(f"oscilloscope, coefficients of group {group}", column, values, table=ORIGIN)


def print_refined(
    title: str, sets: Sequence[Refined], low: float, high: float, low_c: float, high_c: float
) -> None:
    """The table of several sets; bands of the errors of points and of the coefficients."""
    print(f"\n{title}: {len(sets)} sets")
    print(f"  {'set':<10} {'exit':>4}  {'found of hidden < 0.5':<22} {'none':>4} {'wrong':>5}  ", end="")
    print(f"{'error/σ x':>9} {'y':>6}  {'rms mm x':>8} {'y':>7}  {'A':>6} {'B':>6}")
    for s in sets:
        if s.exit or not len(s.errors):
            print(f"  {s.name:<10} {s.exit:>4}  {s.message}")
            continue
        rms, mm = (np.sqrt((v**2).mean(axis=0)) for v in (s.errors, s.mm))
        share = s.found / s.known
        print(f"  {s.name:<10} {s.exit:>4}  {f'{s.found} of {s.known}':<9} {share:6.0%}", end="")
        print(
            f" {'!' if share < 0.85 else ' ':<4} {s.false:>4} {s.wrong:>5}  {rms[0]:9.3f} {rms[1]:6.3f}  ",
            end="",
        )
        print(f"{mm[0]:8.4f} {mm[1]:7.4f}  {_root([s.a]):6.3f} {_root([s.b]):6.3f}  {s.worst}")
    done = [s for s in sets if len(s.errors)]
    if not done:
        return
    keep(sets, done)
    errors = np.concatenate([s.errors for s in done])
    x, y = np.sqrt((errors**2).mean(axis=0)).tolist()
    shares = np.array([s.found / s.known for s in sets])
    print(f"  exit 0: {sum(not s.exit for s in sets)} of {len(sets)}; ", end="")
    print(f"85 % of the points found in {(shares >= 0.85).sum()}, median {np.median(shares):.0%}; ", end="")
    print(
        f"{sum(s.false for s in done)} points are none, {sum(s.wrong for s in done)} of {len(errors)} wrong"
    )
    robust = 1.4826 * np.median(np.abs(errors), axis=0)
    print(f"  pooled: error/σ {judged(x, low, high)} in x, {judged(y, low, high)} in y ", end="")
    print(f"(1.4826 × median of absolute values {robust[0]:.3f}, {robust[1]:.3f}); ", end="")
    a, b = (_root(pairs) for pairs in ([s.a for s in done], [s.b for s in done]))
    print(f"A {judged(a, low_c, high_c)}, B {judged(b, low_c, high_c)}")
