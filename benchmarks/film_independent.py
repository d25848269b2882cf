"""Frames of film in scans that other programs drew, and two real scans: corners compared with their truth.

Run from the checkout: ``RESEAU_DATA=… python benchmarks/film_independent.py [--without] [--hard] [--real]
[--only NAME …] [--each] [--jobs N]``. The frames are those of ``independent/film``. For each class: the
number of frames to be oriented, those answered and those answered right, rms of the errors of the corners,
rms of errors over sigmas, and the frames that are wrong by more than 0.5 px and 5 sigma; then the reason of
each that is missing.
By default with the format of each frame (``truth.json``), without it, the hard frames and the real ones.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from figures import ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes

from reseau.core.data import Array
from reseau.execution import Executor
from reseau.io.images import open_scan
from reseau.procedures.film_frame import FrameOptions, FrameResult, orient_scan

MOST_PX, MOST_SIGMAS = 0.5, 5.0
"""A corner is wrong if it is off by more than both."""
_ORDER = ("ul", "ur", "lr", "ll")
_STATUS = {"oriented": "orient", "three-edges": "three", "declined": "decline"}
_REAL = ("lex1.jpg", "kino_1267.jpg")
"""Real scans without a truth: every answer is printed to be looked at."""


def far_off(error: Array, sigma: Array) -> bool:
    """Whether a corner (n, 2) is off by more than 0.5 px and 5 sigma; NaN is not."""
    return bool(((np.abs(error) > MOST_PX) & (np.abs(error) > MOST_SIGMAS * sigma)).any())


@dataclass(frozen=True)
class Answer:
    """What was said of one frame: status, reason, errors and sigmas of its corners (n, 2)."""

    name: str
    kind: str
    expected: tuple[str, ...]
    status: str
    why: str
    error: Array
    sigma: Array

    @property
    def wrong(self) -> bool:
        """Whether a corner is off by more than 0.5 px and 5 sigma."""
        return far_off(self.error, self.sigma)

    @property
    def answered(self) -> bool:
        """Whether it is answered; with three edges instead of four only if its corners are right."""
        if self.status == "decline":
            return False
        close = (np.abs(self.error) <= MOST_PX) | (np.abs(self.error) <= MOST_SIGMAS * self.sigma)
        return self.status in self.expected or bool(close.all())

    @property
    def right(self) -> bool:
        """Whether it is answered, or declined where it must be, and not wrong."""
        if self.status == "decline":
            return "decline" in self.expected
        return not self.wrong and self.answered and self.expected != ("decline",)


def _errors(result: FrameResult, truth: Array) -> tuple[Array, Array]:
    """Errors and sigmas (n, 2) of corners; each is compared with the nearest true one (NaN: not known)."""
    if result.lines is None or not result:
        return np.zeros((0, 2)), np.zeros((0, 2))
    corners, sigma = result.lines.corners, np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)
    apart = np.hypot(*(corners[:, None] - truth[None]).transpose(2, 0, 1))
    nearest = np.argmin(np.where(np.isfinite(apart), apart, np.inf), axis=0)
    error = corners[nearest] - truth
    known = np.isfinite(error).all(axis=1)
    return error[known], sigma[nearest][known]


def _nearest(results: list[FrameResult], truth: Array) -> FrameResult:
    """The result whose corners are closest to the truth."""

    def away(result: FrameResult) -> float:
        error = _errors(result, truth)[0]
        return float(np.abs(error).max()) if len(error) else np.inf

    return min(results, key=away)


def of_truth(executor: Executor, folder: Path, known: bool, only: list[str]) -> Iterator[Answer]:
    """Answers to the frames of ``truth.json``, with or without their format."""
    items = json.loads((folder / "truth.json").read_text())
    asked = [item for item in items if not only or any(part in item["image"] for part in only)]
    return outcomes(executor, partial(to_frame, folder, known), asked)


def to_frame(folder: Path, known: bool, item: dict[str, Any]) -> Answer:
    """The answer to a frame of ``truth.json``."""
    options = FrameOptions(formats=(tuple(item["format_mm"]),)) if known else FrameOptions()
    results = orient_scan(open_scan(folder / item["image"]), options)
    nothing = [np.nan, np.nan]
    seen, hidden = item["corners"] or {}, item.get("corners_hidden") or {}
    truth = np.array([seen.get(c) or hidden.get(c) or nothing for c in _ORDER], dtype=float)
    # The most a wrong answer can be: among several frames of a scan each is compared.
    result = max(results, key=lambda r: bool(r)) if np.isnan(truth).all() else _nearest(results, truth)
    expected = {"orient": ("orient",), "orient-three-edges": ("three",), "decline": ("decline",)}
    also = tuple({"orient-three-edges": "three"}.get(a, a) for a in item.get("also_ok") or [])
    return Answer(
        item["image"],
        item["class"],
        expected[item["expect"]] + also,
        _STATUS[result.status],
        result.why,
        *_errors(result, truth),
    )


def of_hard(executor: Executor, folder: Path, only: list[str]) -> Iterator[Answer]:
    """Answers to the frames of ``hard.json``."""
    items = json.loads((folder / "hard.json").read_text()).items()
    asked = [item for item in items if not only or any(part in item[0] for part in only)]
    for several in outcomes(executor, partial(to_hard, folder), asked):
        yield from several


def to_hard(folder: Path, named: tuple[str, dict[str, Any]]) -> list[Answer]:
    """The answers to a scan of ``hard.json``, one for each frame in it."""
    name, item = named
    expected = {"trap": ("decline",), "mount": ("orient", "three", "decline")}
    width, height = (float(side) for side in item["fmt"].split("x"))
    options, found = FrameOptions(formats=((width, height),)), list[Answer]()
    results = orient_scan(open_scan(folder / item["image"]), options)
    for i, q in enumerate(item["q"] or [[[np.nan] * 2] * 4]):
        truth = np.array(q, dtype=float)
        result = _nearest(results, truth)
        found.append(
            Answer(
                name if not i else f"{name} ({i + 1})",
                item["exp"],
                expected.get(item["exp"], tuple(item["exp"].split("|"))),
                _STATUS[result.status],
                result.why,
                *_errors(result, truth),
            )
        )
    return found


def table(title: str, answers: list[Answer], each: bool) -> tuple[int, int]:
    """Print a row for each class and those that failed; the numbers of answered and of wrong ones."""
    print(f"\n{title}")
    print(f"{'':22} {'asked':>5} {'answered':>8} {'right':>5} {'wrong':>5}   rms px  err/σ  largest px  of σ")
    kinds = dict.fromkeys(a.kind for a in answers)
    groups = [(kind, [a for a in answers if a.kind == kind]) for kind in kinds]
    groups.append(("all but blurred", [a for a in answers if a.kind != "blurred"]))
    groups.append(("all", answers))
    for name, group in groups:
        asked = [a for a in group if a.expected[0] in ("orient", "three")]
        measured = [a for a in group if len(a.error) and a.status == "orient" and not a.wrong]
        figures = ""
        if measured:
            error = np.concatenate([a.error for a in measured])
            ratio = error / np.concatenate([a.sigma for a in measured])
            figures = f"{np.sqrt(np.mean(error**2)):8.3f} {np.sqrt(np.mean(ratio**2)):6.2f}"
            figures += f" {np.abs(error).max():10.2f} {np.abs(ratio).max():6.1f}"
            record(name, "rms", np.sqrt(np.mean(error**2)), "px", table=title)
            record(name, "errors ÷ sigmas", np.sqrt(np.mean(ratio**2)), table=title)
            record(name, "largest error", np.abs(error).max(), "px", table=title)
        counts = len(asked), sum(a.answered for a in asked), sum(a.right for a in group)
        if asked:
            record(name, "answered", counts[1], of=counts[0], table=title)
        record(name, "wrong", sum(_false(a) for a in group), table=title)
        print(
            f"{name:22} {counts[0]:5} {counts[1]:8} {counts[2]:5} {sum(_false(a) for a in group):5} {figures}"
        )
    for a in answers:
        if each or not a.right:
            error = ""
            if len(a.error):
                ratio = np.abs(a.error / a.sigma)
                rms = np.sqrt(np.mean(a.error**2))
                error = f" rms {rms:.3f}, at most {np.abs(a.error).max():.2f} px, "
                error += f"err/σ {np.sqrt(np.mean(ratio**2)):.2f}, at most {ratio.max():.1f}"
            mark = "WRONG" if _false(a) else ("" if a.right else "missing")
            print(f"  {mark:8}{a.name:18} {'|'.join(a.expected):16} {a.status:8}{error} {a.why[:150]}")
    asked = [a for a in answers if a.expected[0] in ("orient", "three")]
    return sum(a.answered for a in asked), sum(_false(a) for a in answers)


def _false(a: Answer) -> bool:
    """Whether an answer is wrong: its corners, or any answer where only declining is right."""
    return a.status != "decline" and (a.wrong or a.expected == ("decline",))


ROWS = {
    "all": "film frames",
    "clean": "film, sharp and clean",
    "tilted": "film, tilted",
    "perforated": "film, perforated",
    "blurred": "film, out of focus",
}
"""Classes that are compared with the simulator's frames, by their rows."""


def keep(answers: list[Answer]) -> None:
    """Record the classes that the simulator draws, too."""
    for kind, row in ROWS.items():
        group = [a for a in answers if kind in ("all", a.kind)]
        asked = [a for a in group if a.expected[0] in ("orient", "three")]
        if not asked:
            continue
        answered = sum(a.answered for a in asked)
        record(row, "independent, found", answered, of=len(asked), table=ORIGIN)
        good = [a for a in group if len(a.error) and a.status == "orient" and not a.wrong]
        ratios = [
            np.sqrt(np.mean(np.concatenate([a.error / a.sigma for a in good if a.kind == k]) ** 2))
            for k in dict.fromkeys(a.kind for a in good)
        ]
        record(row, "independent, errors ÷ sigmas", ratios, table=ORIGIN)


def real(executor: Executor, folder: Path, only: list[str]) -> None:
    """Answers to real scans, with their formats and without."""
    print("\nreal scans without a frame to be answered by guessing")
    names = [name for name in _REAL if not only or any(part in name for part in only)]
    jobs = [(name, side) for name in names for side in ((), (36.0, 24.0), (22.0, 16.0))]
    for lines in outcomes(executor, partial(to_real, folder), jobs):
        print("\n".join(lines))


def to_real(folder: Path, job: tuple[str, tuple[float, ...]]) -> list[str]:
    """Lines about the frames of a real scan, whose format is given unless it is empty."""
    name, form = job
    options = FrameOptions(formats=((form[0], form[1]),)) if form else FrameOptions()
    lines = []
    for result in orient_scan(open_scan(folder / name), options):
        at = "" if result.lines is None else np.rint(result.lines.corners).astype(int).tolist()
        given = f"{form[0]:g}x{form[1]:g}" if form else "without"
        lines.append(f"  {name:14} {given:8} {result.status:12} {result.format_mm} {at} {result.why[:160]}")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--with", dest="known", action="store_true", help="frames with their format only")
    parser.add_argument("--without", action="store_true", help="frames without their format only")
    parser.add_argument("--hard", action="store_true", help="hard frames only")
    parser.add_argument("--real", action="store_true", help="real scans only")
    parser.add_argument("--only", nargs="*", default=[], help="parts of names of images")
    parser.add_argument("--each", action="store_true", help="print every frame")
    add_options(parser)
    given = parser.parse_args()
    root = os.environ.get("RESEAU_DATA")
    if root is None:
        print("RESEAU_DATA is not set: the frames of other programs are not measured")
        return 0
    with executor_of(given) as executor:
        return 1 if wrong_ones(executor, given, (Path(root) / "independent" / "film").resolve()) else 0


def wrong_ones(executor: Executor, given: argparse.Namespace, folder: Path) -> int:
    """Print the parts that are asked for; the number of wrong answers."""
    wrong = 0
    every = not (given.known or given.without or given.hard or given.real)
    parts: list[tuple[bool, str, Any]] = [
        (given.known, "truth.json, format given", partial(of_truth, executor, folder, True, given.only)),
        (
            given.without,
            "truth.json, format not given",
            partial(of_truth, executor, folder, False, given.only),
        ),
        (given.hard, "hard.json, format given", partial(of_hard, executor, folder, given.only)),
    ]
    for chosen, title, answers in parts:
        if every or chosen:
            found = list(answers())
            wrong += table(title, found, given.each)[1]
            if title == parts[0][1]:
                keep(found)
    if every or given.real:
        real(executor, folder, given.only)
    return wrong


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
