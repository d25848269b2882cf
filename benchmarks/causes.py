"""What `reseau.calibrate` names as the cause of misfit: networks with one known cause, and sound ones.

Run from the checkout: ``python benchmarks/causes.py [--seed 1] [--per 1] [--sound 400] [--causes …]
[--sizes …] [--setups …] [--only CAUSE:SIZE:SETUP:SEED …] [--reject] [--jobs 1]``. Networks are drawn by
``drawn_networks``: ten causes, four sizes, ten set-ups. The size is what the cause leaves in the residuals of
an adjustment without noise, over the noise; for ``noise`` it is a factor, for ``blunders`` and ``names`` a
count, and the columns are those of the four sizes. A case is right where the first code is that of the cause,
not right and not wrong where there is none or ``unknown``, and otherwise wrong. Where an adjustment fails,
nothing is found; with ``--reject`` it is then done once more without gross errors. ``--only`` repeats single
cases of the list of failures and prints what was found.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from drawn_networks import CAUSES, SETUPS, SIZES, calibrated, draw_case, draw_sound
from figures import record
from parts import add_options, executor_of, main_of, outcomes

from reseau.core.failure import Failure

NONE, UNKNOWN, FAILED, ERROR = "none", "unknown", "failed", "error"
"""Nothing found, nothing that explains it, no adjustment, an exception."""
SOUND = "sound"
ASKED_RIGHT, ASKED_EACH, ASKED_WRONG, ASKED_SOUND = 0.95, 0.85, 0.02, 0.98


@dataclass(frozen=True)
class Job:
    """A case to draw: cause, number of the size, set-up, seed, and whether gross errors may be rejected."""

    cause: str
    level: int
    setup: str
    seed: int
    reject: bool = False

    @property
    def label(self) -> str:
        """As `--only` has it."""
        size = "0" if self.cause == SOUND else f"{SIZES[self.level]:g}"
        return f"{self.cause}:{size}:{self.setup}:{self.seed}"


@dataclass(frozen=True)
class Done:
    """What was found in a case.

    Parameters
    ----------
    job : Job
        The case.
    variant, flat : str, bool
        In which way, and whether the target was held.
    asked, size, reached : float, float, bool
        Asked size and that reached, and whether they agree to a tenth.
    amplitude : float
        Of the cause, in the unit of the variant.
    sigma0 : float
        Standard deviation of unit weight of the adjustment.
    codes : tuple of str
        Codes found, most probable first; or :data:`FAILED`, :data:`ERROR`.
    text : str
        What was found, or the reason of the failure.
    adjusted_s, explained_s : float
        Processor times.
    drawn_s : float
        Processor time to draw the case.
    """

    job: Job
    variant: str
    flat: bool
    asked: float
    size: float
    reached: bool
    amplitude: float
    sigma0: float
    codes: tuple[str, ...]
    text: str
    adjusted_s: float
    explained_s: float
    drawn_s: float

    @property
    def first(self) -> str:
        """First code, or that nothing was found."""
        return self.codes[0] if self.codes else NONE

    @property
    def right(self) -> bool:
        """Whether it is the right one."""
        return self.first == (NONE if self.job.cause == SOUND else self.job.cause)

    @property
    def wrong(self) -> bool:
        """Whether another cause than the right one is named."""
        return not self.right and self.first not in (NONE, UNKNOWN, FAILED, ERROR)


def done(job: Job) -> Done:
    """Draw, adjust and explain a case."""
    begun = time.process_time()
    case = (
        draw_sound(job.setup, job.seed)
        if job.cause == SOUND
        else draw_case(job.cause, job.level, job.setup, job.seed)
    )
    drawn = time.process_time()
    raised = ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            result = calibrated(case)
            if not result and job.reject:
                result = calibrated(case, reject=True)
        except Exception as error:
            raised = f"{type(error).__name__} in the adjustment: {error}"
    adjusted = time.process_time()
    known = Done(
        job, case.variant, case.flat, case.asked, case.size, case.reached, case.amplitude, float("nan"),
        (FAILED,), "", adjusted - drawn, 0.0, drawn - begun,
    )  # fmt: skip
    if raised:
        return replace(known, codes=(ERROR,), text=raised)
    if isinstance(result, Failure):
        return replace(known, text=result.reason)
    known = replace(known, sigma0=result.sigma0)
    try:
        found = result.explanation
        codes = tuple(str(getattr(c.code, "value", c.code)) for c in found.causes)
        said = "; ".join(
            f"{c.code} {c.amount_px:.3g} px, {100 * c.share:.0f} %, {c.where}" for c in found.causes
        )
    except Exception as error:
        return replace(known, codes=(ERROR,), text=f"{type(error).__name__}: {error}")
    return replace(known, codes=codes, text=said, explained_s=time.process_time() - adjusted)


def jobs_of(options: argparse.Namespace) -> Iterator[Job]:
    """The cases that are asked for."""
    if options.only:
        for text in options.only:
            cause, size, setup, seed = text.split(":")
            level = 0 if cause == SOUND else SIZES.index(float(size))
            yield Job(cause, level, setup, int(seed), options.reject)
        return
    for seed in range(options.seed, options.seed + options.per):
        for cause in options.causes:
            for size in options.sizes:
                for setup in options.setups:
                    yield Job(cause, SIZES.index(size), setup, seed, options.reject)
    for k in range(options.sound):
        setup = options.setups[k % len(options.setups)]
        yield Job(SOUND, 0, setup, 1000 * options.seed + k // len(options.setups), options.reject)


def shares(found: list[Done]) -> None:
    """Print the table of causes and sizes."""
    print("right / none / unknown / wrong, by the size left in the residuals (noise: factor 0.5 1.5 3 10;")
    print("blunders: 1 3 10 30; names: 1 2 3 and a third of the images); rms of sizes reached; not reached")
    print(f"{'':16}" + "".join(f"{size:>26g}" for size in SIZES))
    for cause in CAUSES:
        line, wrong = f"{cause:16}", Counter[str]()
        for level in range(len(SIZES)):
            own = [each for each in found if each.job.cause == cause and each.job.level == level]
            if not own:
                line += f"{'':>26}"
                continue
            n = Counter(
                "right" if e.right else "wrong" if e.wrong else "unknown" if e.first == UNKNOWN else "none"
                for e in own
            )
            wrong.update(e.first for e in own if e.wrong or e.first in (FAILED, ERROR))
            sizes = np.array([e.size for e in own if e.reached])
            off = sum(not e.reached for e in own)
            reached = f"{np.sqrt((sizes**2).mean()):.3g}" if len(sizes) else "-"
            line += f"{n['right']:>8}/{n['none']}/{n['unknown']}/{n['wrong']} {f'({reached}; {off})':>11}"
        print(line + "   " + " ".join(f"{code}×{count}" for code, count in wrong.most_common()))


def confusion(found: list[Done]) -> None:
    """Print which codes are first for which causes, of sizes from 1 on."""
    columns = [*CAUSES, UNKNOWN, NONE, FAILED, ERROR]
    print("\nfirst codes (across) of causes (down), sizes from 1 on")
    print(f"{'':16}" + "".join(f"{name[:9]:>10}" for name in columns))
    for cause in (*CAUSES, SOUND):
        own = [e for e in found if e.job.cause == cause and (cause == SOUND or e.job.level >= 1)]
        if own:
            n = Counter(e.first for e in own)
            other = {code: count for code, count in n.items() if code not in columns}
            more = f"   {other}" if other else ""
            print(f"{cause:16}" + "".join(f"{n[name] or '':>10}" for name in columns) + more)


def totals(found: list[Done]) -> None:
    """Print what is asked."""
    cases = [e for e in found if e.job.cause != SOUND]
    large, sound = [e for e in cases if e.job.level >= 1], [e for e in found if e.job.cause == SOUND]

    def said(what: str, count: int, of: int, asked: float, *, most: bool = False) -> None:
        share = count / of
        good = share <= asked if most else share >= asked
        record("causes", what, 100 * share, "%")
        sign, fails = "≤" if most else "≥", "" if good else "  !"
        print(f"  {what:44} {count:4} of {of:4}  {100 * share:5.1f} %  asked {sign} {100 * asked:g} %{fails}")

    print()
    if large:
        said("right code first, from 1 on", sum(e.right for e in large), len(large), ASKED_RIGHT)
        for cause in CAUSES:
            own = [e for e in large if e.job.cause == cause]
            if own:
                said(f"  {cause}", sum(e.right for e in own), len(own), ASKED_EACH)
        second = sum(not e.right and e.job.cause in e.codes[1:] for e in cases)
        print(f"  right code named, but not first, all sizes: {second}")
    for level, size in enumerate(SIZES):
        own = [e for e in cases if e.job.level == level]
        if own:
            said(
                f"wrong code first, size {size:g}",
                sum(e.wrong for e in own),
                len(own),
                ASKED_WRONG,
                most=True,
            )
    if cases:
        said("wrong code first, all sizes", sum(e.wrong for e in cases), len(cases), ASKED_WRONG, most=True)
    if sound:
        said("sound called sound", sum(e.right for e in sound), len(sound), ASKED_SOUND)


def times(found: list[Done]) -> None:
    """Print processor times."""
    drawn, adjusted, explained = np.array([(e.drawn_s, e.adjusted_s, e.explained_s) for e in found]).T
    print(
        f"\nprocessor time per network: drawn {drawn.mean():.2f} s, adjusted {adjusted.mean():.3f} s", end=""
    )
    if explained.any():
        part = explained[explained > 0] / adjusted[explained > 0]
        print(
            f", explained {explained.mean():.3f} s; explained over adjusted: median {np.median(part):.2f}",
            end="",
        )
        print(f", 90 % {np.quantile(part, 0.9):.2f}, largest {part.max():.1f}", end="")
    print(f"; {drawn.sum() + adjusted.sum() + explained.sum():.0f} s in all")


def failures(found: list[Done]) -> None:
    """Print the cases that are not right, and those whose size was not reached."""
    bad = [e for e in found if not e.right]
    if bad:
        print(f"\n{len(bad)} not right: case, variant, amplitude, target, sigma0, first code, what was found")
        for e in bad:
            held = "flat" if e.flat else "free"
            what = f"{e.variant:26} {e.amplitude:8.2g} {held}  {e.sigma0:8.3f}"
            print(f"  {e.job.label:34} {what}  {e.first:16} {e.text}")
    off = [e for e in found if not e.reached]
    if off:
        print(f"\n{len(off)} sizes not reached: case, variant, asked, reached")
        for e in off:
            print(f"  {e.job.label:40} {e.variant:26} {e.asked:g} {e.size:.3g}")
    lost = [e for e in found if e.first in (FAILED, ERROR)]
    if lost:
        print(f"\n{len(lost)} not adjusted, or with an exception")
        for e in lost:
            print(f"  {e.job.label:40} {e.variant:26} {e.text}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--per", type=int, default=1, help="seeds of each cause, size and set-up")
    parser.add_argument("--sound", type=int, default=400, help="sound networks")
    parser.add_argument("--causes", nargs="*", default=list(CAUSES), choices=CAUSES)
    parser.add_argument("--sizes", nargs="*", type=float, default=list(SIZES), choices=SIZES)
    parser.add_argument("--setups", nargs="*", default=list(SETUPS), choices=list(SETUPS))
    parser.add_argument("--only", nargs="*", metavar="CAUSE:SIZE:SETUP:SEED", help="repeat single cases")
    parser.add_argument(
        "--reject", action="store_true", help="reject gross errors where the adjustment fails"
    )
    add_options(parser, jobs=1)
    options = parser.parse_args()
    with executor_of(options) as executor:
        found = []
        for each in outcomes(executor, done, jobs_of(options), together=8):
            found.append(each)
            if not each.right and not options.only:
                print(f"{len(found):4} {each.job.label:36} {each.first}", file=sys.stderr, flush=True)
    if options.only:
        for e in found:
            print(f"{e.job.label}: {e.variant}, target {'flat' if e.flat else 'free'}, size {e.size:.3g}, "
                  f"sigma0 {e.sigma0:.3f}: {e.first}: {e.text}")  # fmt: skip
        return 0
    shares(found)
    confusion(found)
    totals(found)
    times(found)
    failures(found)
    return 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
