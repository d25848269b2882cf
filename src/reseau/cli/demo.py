"""`reseau demo`: capture, correct, adjust and report on a simulated bench over its real protocols."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..core import vocabulary as v
from .common import compile_first, progress, say

if TYPE_CHECKING:
    from ..sessions.demo import TestfieldSession


def demo(
    out: v.Out = Path("out"),
    seed: v.Seed = 1,
    as_json: v.AsJson = False,
) -> None:
    """Capture, correct and adjust on a simulated bench with real protocols; compare with the true values."""
    from ..core.provenance import canonical_json
    from ..report.summary import comparison_table
    from ..sessions.demo import STEPS, run_demo

    compile_first("demo")
    with progress("taking photographs", STEPS) as step:
        done = run_demo(out, seed, step)
    if as_json:
        say(canonical_json(done.to_dict()))
    else:
        say(comparison_table(done.comparison))
        say(_camera_table(done.testfield))
        say(f"\n{done.oscilloscope.way}; all frames are in {out / 'archive'}\nopen {out / 'report.html'}\n")


def _camera_table(field: TestfieldSession) -> str:
    """Parameters of the camera with their errors, one line each."""
    from ..core.numbers import measured
    from ..optics.cameras import unit_of

    facts = field.to_dict()
    lines = [f"\ntestfield, {facts['poses']} poses: sigma0 {facts['sigma0']:.3f}"]
    for name, row in facts["parameters"].items():
        unit, off = unit_of(name, "brown"), (row["value"] - row["true"]) / row["sigma"]
        found = measured(row["value"], row["sigma"], unit)
        lines.append(f"  {name:<4} {found:<32} true {row['true']:.6g} {unit:<6} error {off:+.1f} sigma")
    return "\n".join(lines) + "\n"
