"""Number of poses that the closed loop needs for the precision of the paper's 36 recordings.

    python benchmarks/closed_loop.py [--seeds 2] [--parameter c] [--jobs 2]

For every seed the 36 recordings of the paper are simulated first; their standard deviation of the parameter
is the goal. Then poses are chosen until the goal is reached: the next pose is the one that reduces the
predicted standard deviation most, among the tilts of the paper with eight rotations of the board, and among
tilts up to 60°. The testfield is plane, so that sigma0 is one; noise, jitter and camera are those of the
paper.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial

from parts import add_options, executor_of, main_of, outcomes

from reseau.capture import Step, paper_steps, spread
from reseau.core.data import Frame
from reseau.designs import coded_testfield
from reseau.measure.testfield.measure import TestfieldOptions
from reseau.procedures.calibration_options import CameraOptions
from reseau.procedures.target_measurement import measurer_of
from reseau.procedures.testfield import TestfieldProcedure
from reseau_sims import FieldBench, Station

AXES = ("tilt", "roll", "camera_roll")
DESIGN = coded_testfield()


def grid(tilts: Sequence[float], rolls: int) -> list[Step]:
    """All poses of a raster; an untilted board is not rotated."""
    steps = []
    for tilt in tilts:
        for roll in range(0, 360, 360 // rolls) if tilt else (0,):
            for camera in (0, 90, 180, 270):
                position = dict(zip(AXES, (tilt, float(roll), float(camera)), strict=True))
                steps.append(Step(f"{tilt:g} {roll} {camera}", position))
    return steps


class Session:
    """A testfield procedure on the simulated bench, without instruments."""

    def __init__(self, seed: int) -> None:
        self.bench = FieldBench(seed=seed, bend_mm=0.0)
        model = CameraOptions("brown", ("c", "x0", "y0", "K1"), (0.027, 0.027))
        measure = measurer_of(DESIGN, TestfieldOptions(row_jitter_px=0.0086, fill=0.8))
        self.procedure = TestfieldProcedure(DESIGN, measure, model, name="closed loop")
        self.poses = 0

    def take(self, step: Step) -> None:
        """Record and measure."""
        frame = self.bench.record(Station(*(step.position[axis] for axis in AXES)))
        self.procedure.on_frame(Frame(frame.pixels, 255.0, step.name), step)
        self.poses += 1

    def sigma(self, parameter: str) -> float:
        """Standard deviation reached so far; infinite before the first calibration."""
        return self.procedure.progress().get(f"sigma_{parameter}", float("inf"))


def closed(seed: int, candidates: Sequence[Step], parameter: str, goal: float) -> list[float]:
    """Standard deviations after each pose, from the first calibration to the goal."""
    session, left = Session(seed), list(candidates)
    reached = []
    for step in spread(candidates, 4):
        session.take(step)
        left.remove(step)
    while left:
        reached.append(session.sigma(parameter))
        if reached[-1] <= goal:
            break
        chosen = session.procedure.next_pose(left, parameter)
        assert chosen is not None
        left.remove(chosen[0])
        session.take(chosen[0])
    return reached


def lines_of(parameter: str, seed: int) -> str:
    """The lines of a seed."""
    paper = Session(seed)
    for step in paper_steps():
        paper.take(step)
    goal = paper.sigma(parameter)
    lines = [f"seed {seed}: sigma_{parameter} {goal:.3g} of the paper's {paper.poses} poses"]
    for name, tilts in (("tilts 0, 30, 45", (0.0, 30.0, 45.0)), ("… and 60", (0.0, 30.0, 45.0, 60.0))):
        reached = closed(seed, grid(tilts, 8), parameter, goal)
        course = " ".join(f"{sigma:.3g}" for sigma in reached)
        lines.append(f"  {name:<20} {len(reached) + 3:3d} poses; after 4, 5, …: {course}")
    return "\n".join(lines)


def main() -> None:
    """Print a line for every seed and set of candidates."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--parameter", default="c")
    add_options(parser)
    given = parser.parse_args()
    with executor_of(given) as executor:
        for text in outcomes(executor, partial(lines_of, given.parameter), range(given.seeds)):
            print(text, flush=True)


if __name__ == "__main__":
    main_of(__file__)
