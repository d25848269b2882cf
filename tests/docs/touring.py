"""Runs a page: its commands in the order of the page, in a folder that has only what the page says."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from reseau.cli import run
from reseau.io.images import write_image
from reseau_sims import World

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
_BLOCK = re.compile(
    r"^```(\{code-block\} \w+|console|python)\n(?::caption: (\S+)\n)?(.*?)^```$", re.DOTALL | re.M
)
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")
_UNITS = 5
"""Units of the last printed digit by which a number may differ: another processor rounds differently."""


@dataclass(frozen=True)
class Step:
    """A file that the page shows, lines of Python, or a command with the output that the page shows."""

    kind: str
    text: str
    name: str = ""
    shown: tuple[str, ...] = ()


def draw_demo() -> None:
    """Draw the photographs of the demo's world, without its bench, in the folder ``out``."""
    world, out = World.standard(seed=1), Path("out")
    out.mkdir()
    world.design.write(out / "reseau.json")
    world.test_object.write(out / "rods.json")
    for name in ("photo_i", "photo_ii", "photo_iii"):
        write_image(out / f"{name}.png", getattr(world, name)().pixels)


def steps(page: str) -> list[Step]:
    """The steps of a page, such as ``tours/camera``."""
    found: list[Step] = []
    for kind, caption, body in _BLOCK.findall((DOCS / f"{page}.md").read_text("utf-8")):
        if kind == "console":
            for part in re.split(r"^\$ ", body, flags=re.MULTILINE)[1:]:
                command, *shown = part.rstrip("\n").split("\n")
                while command.endswith("\\"):
                    command = command[:-1] + shown.pop(0).strip()
                found.append(Step("command", command, shown=tuple(shown)))
        elif caption:
            found.append(Step("file", body, caption))
        elif kind == "python" and not body.startswith(">>>"):  # doctests run elsewhere
            found.append(Step("python", body))
    assert found, page
    return found


def same(shown: str, printed: str) -> bool:
    """Whether a line was printed as the page shows it, but for numbers: in their last digit, or by a tenth.

    Processors round differently, and one mark more or less is measured. What is true is asked elsewhere.
    ``...`` stands for anything.
    """
    parts = [re.escape(_NUMBER.sub("0", part)) for part in shown.rstrip().split("...")]
    if not re.fullmatch(".*".join(parts), _NUMBER.sub("0", printed.rstrip())):
        return False
    left, right = (_NUMBER.findall(part) for part in (shown.partition("...")[0], shown.rpartition("...")[2]))
    numbers = _NUMBER.findall(printed)
    pairs = [*zip(left, numbers, strict=False), *zip(right[::-1], numbers[::-1], strict=False)]
    for a, b in pairs:
        digits = len(a.split("e")[0].partition(".")[2]) - int(a.partition("e")[2] or 0)
        last = _UNITS * 10.0**-digits * (digits > 0 or "e" in a)
        if abs(float(a) - float(b)) > max(last, 0.1 * abs(float(a))) + 1e-12:
            return False
    return True


def check_output(step: Step, printed: str) -> None:
    """The lines of the page are among those printed, in their order; ``...`` stands for any."""
    lines = iter(printed.splitlines())
    for shown in step.shown:
        if shown.strip() and shown.strip() != "...":
            assert any(same(shown, line) for line in lines), (
                f"{step.text}\nshown: {shown}\nprinted:\n{printed}"
            )


def follow(
    page: str,
    folder: Path,
    *,
    instead: Callable[[list[str]], bool] = lambda words: False,
    values: dict[str, Callable[[], str]] | None = None,
) -> None:
    """Follow a page in a folder, which is the current one; `instead` carries out some of the commands."""
    for script in (DOCS / page).parent.glob("*.py"):
        shutil.copy(script, folder)
    names: dict[str, object] = {}
    for step in steps(page):
        if step.kind == "file":
            (folder / step.name).write_text(step.text, encoding="utf-8")
        elif step.kind == "python":
            exec(compile(step.text, f"{page}.md", "exec"), names)
        else:
            command = step.text
            for word, value in (values or {}).items():
                if re.search(rf"\b{word}\b", command):
                    command = re.sub(rf"\b{word}\b", value(), command)
            command, _, if_it_fails = command.partition(" || ")
            command, _, into = command.partition(" > ")
            words = shlex.split(command)
            if instead(words):
                continue
            status, printed = _carried_out(words)
            print(f"$ {command}\n{printed}")
            assert status == 0 or if_it_fails, f"{command}: exit status {status}\n{printed}"
            if into:
                (folder / into).write_text(printed, encoding="utf-8")
            check_output(step, f"{printed}{status}\n" if if_it_fails == "echo $?" else printed)


def _carried_out(words: list[str]) -> tuple[int, str]:
    """Exit status and output of a command; `reseau` runs in this process."""
    if words[0] == "reseau":
        # One process: each further one would import and compile everything again.
        alone = ["--jobs", "1"] if words[1] in {"calibrate", "orient"} and "--cluster" not in words else []
        written = StringIO()
        with redirect_stdout(written), redirect_stderr(written):
            status = run([*words[1:], *alone])
        return status, written.getvalue()
    if words[0] == "python":
        # A page that needs a checkout begins in its folder; here it writes to the folder of the test.
        words = [sys.executable, str(ROOT / words[1]) if "/" in words[1] else words[1], *words[2:]]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr
