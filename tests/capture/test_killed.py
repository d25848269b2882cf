"""`kill -9` at random moments, resumed each time: no frame lost, none doubled, the same calibration.

The kills are shared between a session that measures and one that only stores, where most of the time is spent
between the file and the index. `RESEAU_KILLS` says how many.
"""

import multiprocessing
import os
import random
import signal
import time
from pathlib import Path

import pytest

from reseau.archive import Archive, verify
from reseau.capture import carry_out, paper_steps, plans

from .fieldrig import FieldRig

KILLS = int(os.environ.get("RESEAU_KILLS", "200"))
POSES = paper_steps()[:12]
FRAMES = 40


def work(place: Path, kind: str) -> None:
    """What `reseau capture` does, on a bench that is there anew: begin or resume, and carry on to the end."""
    rig = FieldRig()
    with Archive.open(place, create=True) as archive:
        names = [each.name for each in archive.sessions()]
        kept = archive.session("s") if "s" in names else archive.begin("s", kind, {})
        kept.recover()
        run = rig.acquisition(kept, rig.procedure() if kind == "testfield" else None)
        plan = plans.poses(run, POSES) if kind == "testfield" else plans.frames(run, FRAMES)
        carry_out(run, plan)


def ended(place: Path, kind: str, after_s: float | None) -> bool:
    """Whether a process came to its end before it was killed."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([work.__module__])
    process = context.Process(target=work, args=(place, kind))
    process.start()
    process.join(after_s)
    if process.is_alive():
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
    process.join(60)
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode == 0


def held(place: Path) -> tuple[list[tuple[str, int, str]], list[bytes], list[bool]]:
    """Frames in their order, results, and verdicts of the session."""
    with Archive.open(place) as archive:
        assert verify(archive)
        kept = archive.session("s")
        frames = [(f.step, f.take, f.sha256) for f in kept.frames(kind="frame")]
        verdicts = [f.verdict is not None and f.verdict.ok for f in kept.frames(kind="frame")]
        assert kept.status == "done"
        return frames, [kept.content(result) for result in kept.results()], verdicts


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["testfield", "frames"])
@pytest.mark.timeout(3600)
def test_killed_at_any_moment_a_session_ends_as_if_undisturbed(kind: str, tmp_path: Path) -> None:
    rng = random.Random(kind)
    began = time.monotonic()
    assert ended(tmp_path / "undisturbed", kind, None)
    seconds = time.monotonic() - began
    undisturbed = held(tmp_path / "undisturbed")
    assert len(undisturbed[0]) == (len(POSES) if kind == "testfield" else FRAMES)
    kills, sessions = 0, 0
    while kills < KILLS // 2:
        place = tmp_path / f"killed {sessions}"
        # Half of an undisturbed run on average: each session is killed a few times.
        while not ended(place, kind, rng.uniform(0, seconds)):
            kills += 1
        assert held(place) == undisturbed
        sessions += 1
