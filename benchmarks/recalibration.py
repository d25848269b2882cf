"""Recalibrations: run lengths of charts, joint false alarms, delays, and acceptance against a reference.

    python benchmarks/recalibration.py --part lengths     # run lengths compared with r-cran-spc (Debian)
    python benchmarks/recalibration.py --part false       # years without drift
    python benchmarks/recalibration.py --part delays      # shifts with known and with estimated parameters
    python benchmarks/recalibration.py --part acceptance  # years of 52 runs beside a reference calibration

A bench has ten parameters and the norm of the field over the image, which is that of their differences from
the first run. Series are AR(1); parameters are independent, or correlated by 0.5 and −0.9 as K1, K2, K3 are.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import time
from collections.abc import Iterator
from functools import partial

import numpy as np
from parts import add_options, executor_of, main_of, outcomes

from reseau.core.data import Array
from reseau.execution import Executor
from reseau.service.charts import ChartOptions, KnownSeries, monitor
from reseau.service.explaining import RunHistory, explain_runs
from reseau.service.runlength import Cusum, Ewma, Shewhart

PARAMETERS, YEAR, AT_ONCE = 10, 52, 2500
SHIFTS = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0)


def correlated() -> Array:
    """Correlations of ten parameters."""
    found = np.full((PARAMETERS, PARAMETERS), 0.2)
    found[5:8, 5:8] = [[1.0, -0.9, 0.75], [-0.9, 1.0, -0.95], [0.75, -0.95, 1.0]]
    found[0, 1:3] = found[1:3, 0] = 0.5
    np.fill_diagonal(found, 1.0)
    values, vectors = np.linalg.eigh(found)
    whole = vectors * np.maximum(values, 1e-3) @ vectors.T
    scale = np.sqrt(np.diag(whole))
    fixed: Array = whole / np.outer(scale, scale)
    return fixed


def years(
    rng: np.random.Generator,
    count: int,
    runs: int,
    phi: float | Array,
    matrix: Array,
    degrees: float = np.inf,
) -> Array:
    """Ten parameters and the norm of the field (count, runs, 11), without drift; normal or t distributed."""
    root = np.linalg.cholesky(matrix)
    shape = (count, runs, PARAMETERS)
    drawn = rng.normal(size=shape) if np.isinf(degrees) else rng.standard_t(degrees, size=shape)
    x = drawn @ root.T
    for k in range(1, runs):
        x[:, k] = phi * x[:, k - 1] + np.sqrt(1.0 - phi * phi) * x[:, k]
    return with_norm(x)


def with_norm(x: Array) -> Array:
    """The parameters and the transformed norm of their field, with effects of 0.2 to 1 of one sigma."""
    effect = np.linspace(1.0, 0.2, PARAMETERS)
    norm = np.sqrt(np.square((x - x[:, :1]) * effect).sum(axis=2, keepdims=True))
    norm[:, 0] = np.nan
    return np.concatenate([x, np.cbrt(norm**2)], axis=2)


def lengths() -> None:
    """Compare run lengths with the package spc of R."""
    if shutil.which("Rscript") is None:
        print("Rscript is not installed: apt-get install r-cran-spc")
        return
    rows = list(_cases())
    script = "library(spc)\n" + "".join(f"cat(format({code}, digits=12), '\\n')\n" for _, code, _ in rows)
    said = subprocess.run(["Rscript", "-"], input=script, capture_output=True, text=True, check=True).stdout
    worst: dict[str, float] = {}
    for (label, _, own), line in zip(rows, said.splitlines(), strict=True):
        worst[label] = max(worst.get(label, 0.0), abs(own / float(line) - 1.0))
    for label, off in worst.items():
        print(f"{label:<44} largest relative difference {off:.1e}{'' if off < 0.01 else ' !'}")
    print(f"{len(rows)} run lengths")


def _cases() -> Iterator[tuple[str, str, float]]:
    """Label, call of R, and own value."""
    for mu in SHIFTS:
        for k, h in ((0.25, 8.0), (0.5, 4.0), (0.5, 5.0), (0.5, 7.5), (1.0, 2.5)):
            yield "CUSUM, two-sided, zero state", f'xcusum.arl({k},{h},{mu},sided="two")', Cusum(k, h).arl(mu)
            one = Cusum(k, h, two_sided=False)
            yield "CUSUM, one-sided, zero state", f'xcusum.arl({k},{h},{mu},sided="one")', one.arl(mu)
        for weight, c in ((0.05, 2.5), (0.1, 2.7), (0.2, 2.86), (0.5, 3.0)):
            chart, call = Ewma(weight, c), f'({weight},{c},{mu},sided="two"'
            yield "EWMA, zero state", f"xewma.arl{call},r=80)", chart.arl(mu)
        yield "Shewhart", f'xshewhartrunsrules.arl({mu},c=1,type="1")', Shewhart(3.0).arl(mu)


Case = tuple[tuple[str, str, float | Array, float], int]
"""Name, text of φ, φ and degrees of freedom of a series, and the runs before its year."""


def false_alarms(executor: Executor, count: int, seed: int) -> None:
    """Alarms a year without drift."""
    print(f"{count} years of {YEAR} runs without drift, ten parameters and the norm; limit 0.1 a year")
    print(
        "  parameters     φ         runs before  alarms a year  upper 95 % limit  width  learning  correlated"
    )
    normal, both, one = np.inf, (20, 52), np.where(np.arange(PARAMETERS) == 0, 0.5, 0.0)
    cases: list[tuple[str, str, float | Array, float]] = [
        *(("independent", f"{phi:.2f}", phi, normal) for phi in (0.0, 0.15, 0.3, 0.5)),
        *(("correlated", f"{phi:.2f}", phi, normal) for phi in (0.0, 0.15, 0.3, 0.5)),
        ("independent", "one 0.50", one, normal),
        *(("t, 8 degrees", f"{phi:.2f}", phi, 8.0) for phi in (0.0, 0.3, 0.5)),
        *(("t, 4 degrees", f"{phi:.2f}", phi, 4.0) for phi in (0.0, 0.3)),
    ]
    every = [(case, m) for case in cases for m in both]
    drawn = outcomes(executor, partial(_alarms, count, seed), every)
    for ((name, written, _, _), m), (alarms, told) in zip(every, drawn, strict=True):
        rate, most = alarms / count, upper_limit(alarms) / count
        width, learning, beyond = told * [1, 100, 100] / (count / AT_ONCE)
        note = "" if most <= 0.105 else " !"
        counted = f"{m:12d}{rate:15.4f}{most:18.4f}{note:2}"
        print(f"  {name:<15}{written:<8}{counted}{width:7.2f}{learning:8.0f} %{beyond:9.0f} %", flush=True)


def _alarms(count: int, seed: int, case: Case) -> tuple[int, Array]:
    """Number of alarms in the simulated years of a case; sums of width, of learning and correlated series."""
    (name, _, phi, tails), m = case
    rng = np.random.default_rng(seed)
    matrix = correlated() if name == "correlated" else np.eye(PARAMETERS)
    alarms, told = 0, np.zeros(3)
    for _ in range(0, count, AT_ONCE):
        found = monitor(years(rng, AT_ONCE, m + YEAR, phi, matrix, tails), one_sided=(PARAMETERS,))
        alarms += int(found.alarms[:, m:].sum())
        beyond = found.autocorrelation[:, -1] > ChartOptions().autocorrelation
        told += [each.mean() for each in (found.width[:, -1], found.learning[:, -1], beyond)]
    return alarms, told


def upper_limit(events: int) -> float:
    """One-sided upper 95 % limit of the mean of a Poisson count."""
    from scipy.stats import chi2

    return float(chi2.ppf(0.95, 2 * events + 2) / 2)


def delays(executor: Executor, count: int, seed: int) -> None:
    """Runs until a shift of one of ten parameters is found."""
    print("shift of one of ten parameters at a run: mean number of runs to the first alarm of the bench")
    cases = (
        ("known, from the start", 0, 0.0), ("known, after 20 runs", 20, 0.0), ("known, φ 0.3", 20, 0.3),
        ("estimated from 20 runs", 20, 0.0), ("estimated from 52", 52, 0.0), ("estimated from 150", 150, 0.0),
        ("estimated from 150, φ held 0", 150, 0.0),
    )  # fmt: skip
    for line in outcomes(executor, partial(_delays, count, seed), cases):
        print(line, flush=True)


def _delays(count: int, seed: int, case: tuple[str, int, float]) -> str:
    """The line of a case."""
    name, before, phi = case
    rng = np.random.default_rng(seed)
    known = name.startswith("known")
    options = ChartOptions(autocorrelation=0.0) if name.endswith("held 0") else ChartOptions()
    line = ""
    for shift in (1.0, 2.0, 3.0):
        runs = 200 if known else 104
        x = years(rng, count, before + runs, phi, np.eye(PARAMETERS))
        x[:, before:, 0] += shift
        if known:
            series = KnownSeries(np.zeros(PARAMETERS), np.ones(PARAMETERS), np.full(PARAMETERS, phi))
            alarms = monitor(x[:, :, :PARAMETERS], options, known=series).alarms
        else:
            x = with_norm(x[:, :, :PARAMETERS])
            alarms = monitor(x, options, one_sided=(PARAMETERS,)).alarms
        # Benches that signalled before the shift do not count.
        after = alarms[~alarms[:, :before].any(axis=1), before:]
        found = after.any(axis=1)
        delay = np.argmax(after, axis=1)[found] + 1.0
        error = delay.std() / np.sqrt(len(delay))
        within = "" if found.all() else f" of the {100 * found.mean():.0f} % found in {runs} runs"
        line += f"   {shift:g} σ: {delay.mean():.2f} ± {error:.2f}{within}"
    return f"  {name:<30}{line}"


SIGMA, WEEKS = 0.3, 53
"""Largest standard deviation of a run over the image, in limits; runs with the reference."""
HAPPENINGS = (
    ("stable", 0.0), ("creeping", 0.05), ("creeping", 0.1), ("creeping", 0.2), ("creeping", 0.5),
    ("jump", 2.0), ("jump", 3.0), ("temperature", 0.4), ("temperature", 0.3), ("lens exchanged", 10.0),
    ("other target", 3.0),
)  # fmt: skip
"""What happens, and how large it is in limits: a week, at once, at most in the year."""


def error_fields() -> Array:
    """Fields (49, 2, 4) of the errors of a run: scale, both offsets, distortion; orthogonal, in limits."""
    x, y = (each.ravel() for each in np.meshgrid(*[np.linspace(-1.0, 1.0, 7)] * 2))
    one, r2 = np.ones_like(x), x**2 + y**2
    pairs = ((x, y), (0.7 * one, 0 * x), (0 * x, 0.7 * one), (0.5 * x * r2, 0.5 * y * r2))
    root = np.stack([np.stack(pair, axis=1) for pair in pairs], axis=2)
    largest = np.linalg.eigvalsh(root @ np.swapaxes(root, 1, 2))[:, -1].max()
    u, s, _ = np.linalg.svd((SIGMA / np.sqrt(largest) * root).reshape(-1, 4), full_matrices=False)
    return np.asarray((u * s).reshape(-1, 2, 4))


def acceptance(executor: Executor, count: int, seed: int) -> None:
    """Simulate years of weekly runs in which something happens, each accepted or not as by `judge`."""
    print(
        f"acceptance against a reference: years of 52 runs, errors of a run {SIGMA} limits, four directions"
    )
    for kind, size in HAPPENINGS:
        jobs = [(kind, size, 1000 * seed + k) for k in range(count)]
        found = np.array(list(outcomes(executor, a_year, jobs, together=20)))
        missed, held, accepted, first, announced, late, within = found.T
        line = (
            f"  {kind:<15}{size:5.2f}   missed {100 * missed.mean():5.1f} %   false {held.mean():5.3f} a year"
        )
        line += f"   accepted {100 * np.nanmean(accepted):5.1f} %"
        for name, values in (("held at", first), ("announced at", announced)):
            there = values[np.isfinite(values)]
            if len(there):
                low, middle, high = np.quantile(there, [0.01, 0.5, 0.99])
                line += f"   {name} {middle:.2f} ({low:.2f} to {high:.2f})"
        if kind == "creeping" and np.isfinite(late).any():
            line += f"   date late by {np.nanmedian(late):+.1f} weeks, within its interval "
            line += f"{100 * np.nanmean(within):.0f} %"
        print(line, flush=True)


def a_year(job: tuple[str, float, int]) -> tuple[float, ...]:
    """A year: whether a run beyond limit and two sigma was accepted; runs held back that are nearer to the
    reference than limit less two sigma; part of the runs accepted without a warning; drift at which one was
    held back, and announced, first; how late the announced date is (weeks), and whether its interval of 90 %
    has the true one."""
    kind, size, seed = job
    rng, basis, weeks = np.random.default_rng(seed), error_fields(), np.arange(WEEKS)
    direction = rng.normal(size=4)
    direction /= np.hypot(*(basis @ direction).T).max()
    drift = {
        "stable": 0.0 * weeks, "creeping": size * weeks, "jump": size * (weeks >= 20),
        "temperature": size * np.sin(2 * np.pi * weeks / 52), "lens exchanged": size * (weeks >= 20),
        "other target": size * (weeks % 10 == 9),
    }[kind]  # fmt: skip
    values = rng.normal(size=(WEEKS, 4)) + drift[:, None] * direction
    values -= values[0]
    in_force, rejects, missed, false, sound = 0, np.zeros(WEEKS, dtype=bool), False, 0, list[bool]()
    first = announced = late = within = np.nan
    for week in range(1, WEEKS):
        rows, true = np.arange(week + 1), abs(drift[week])
        covs = np.repeat(np.eye(4)[None], len(rows), axis=0)
        said = explain_runs(
            RunHistory(7.0 * rows, values[rows], covs, basis, rejected=rejects[rows]), 1.0, in_force
        )
        changed = said.held(1.0, step=True)
        rejected = changed and said.p < 0.01
        held = changed or said.held(1.0)
        told = len(rows) > 4 and said.creeps(1.0, 0.5)
        sound.append(not (held or told) and said.p >= 0.01 and said.beyond(0.5) <= 0.5)
        rejects[week] = rejected
        if held:
            first = true if np.isnan(first) else first
            false += true < 1 - 2 * SIGMA
        else:
            in_force = week
            missed |= true > 1 + 2 * SIGMA
        if told and np.isnan(announced):
            announced = true
            if kind == "creeping" and true < 1:
                low, about, high = said.reaches(1.0, 0.05, 0.5, 0.95) / 7
                left = 1 / size - week
                late, within = about - left, float(low <= left <= high)
        if held and kind == "creeping" and true > 1 + 2 * SIGMA:
            break
    return float(missed), float(false), float(np.mean(sound)), first, announced, late, within


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=("lengths", "false", "delays", "acceptance"))
    parser.add_argument("--years", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser)
    given = parser.parse_args()
    start = time.monotonic()
    if given.part in (None, "lengths"):
        lengths()
    with executor_of(given) as executor:
        if given.part in (None, "false"):
            false_alarms(executor, given.years, given.seed)
        if given.part in (None, "delays"):
            delays(executor, 5000, given.seed)
        if given.part in (None, "acceptance"):
            acceptance(executor, min(given.years, 1000), given.seed)
    print(f"{time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main_of(__file__)
