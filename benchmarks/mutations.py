"""Whether the quick tests and the examples notice errors in the core of each package.

    python benchmarks/mutations.py [NUMBER …] [--out build/mutations.json] [--again] [--table]

`mutations.toml` lists small changes of the source: a sign, a factor of 1.2, a swapped axis, a lost term.
Each is made in a copy of the checkout, and the tests that reach the line run there until one fails: the
examples of the file's own docstrings, then the files that the list names, without slow tests. What was found
is kept in a file and not repeated for the same change and the same tests; `--table` prints what is there.

Ends with 1 where more than three of all changes are not noticed.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "benchmarks" / "mutations.toml"
LEFT_OUT = shutil.ignore_patterns(".git", ".venv", ".pytest_cache", "build", "dist", "out", "generated")
MOST = 3
"""Changes that may go unnoticed."""


@dataclass(frozen=True)
class Mutation:
    """A change of a file of the package, and the tests that reach the line."""

    file: str
    was: str
    becomes: str
    tests: tuple[str, ...]

    @property
    def key(self) -> str:
        """What it is kept by."""
        return "\n".join((self.file, self.was, self.becomes, *self.tests))

    @property
    def change(self) -> str:
        """The words that differ, with one around them."""
        one, other = self.was.split(), self.becomes.split()
        start = next((k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), 0)
        rest = zip(reversed(one[start:]), reversed(other[start:]), strict=False)
        end = next((k for k, (a, b) in enumerate(rest) if a != b), 0)
        first, last = max(start - 1, 0), max(end - 1, 0)
        words = (" ".join(each[first : len(each) - last]) for each in (one, other))
        return " → ".join(f"`{each}`" for each in words)


def mutations() -> list[Mutation]:
    """All changes of the list."""
    rows = tomllib.loads(LIST.read_text("utf-8"))["mutation"]
    return [Mutation(row["file"], row["was"], row["becomes"], tuple(row["tests"])) for row in rows]


def noticed(mutation: Mutation, copy: Path) -> str:
    """The test that fails with a change in the copy of the checkout; nothing if all pass."""
    path = copy / "src" / "reseau" / mutation.file
    source = path.read_text("utf-8")
    if source.count(mutation.was) != 1:
        raise SystemExit(
            f"{mutation.file}: contains {mutation.was!r} {source.count(mutation.was)} times, not once"
        )
    paths = os.pathsep.join(str(copy / each) for each in ("src", "sims", "drivers", "", "benchmarks"))
    tests = [f"src/reseau/{mutation.file}", *mutation.tests]
    # A file of the package is searched for its examples alone.
    settings = {"cache_dir": ROOT / ".pytest_cache", "python_functions": "test_*", "python_classes": "none"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "--doctest-modules"]
    command += [word for key, value in settings.items() for word in ("-o", f"{key}={value}")]
    path.write_text(source.replace(mutation.was, mutation.becomes), "utf-8")
    try:
        done = subprocess.run(
            [*command, *tests],
            cwd=copy,
            env=os.environ | {"PYTHONPATH": paths},
            capture_output=True,
            text=True,
        )
    finally:
        path.write_text(source, "utf-8")
    if done.returncode == 0:
        return ""
    found = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if done.returncode != 1 or found is None:
        raise SystemExit(
            f"{mutation.file}: the tests did not run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        )
    return found[1]


def table(found: dict[str, str]) -> str:
    """Changes, and the tests that notice them, of what is known."""
    lines = ["| file | change | noticed by |", "|---|---|---|"]
    for each in mutations():
        if each.key in found:
            test = found[each.key].replace("src/reseau/", "").replace("tests/", "").partition("[")[0]
            lines.append(f"| `{each.file}` | {each.change} | {f'`{test}`' if test else '**nothing**'} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("numbers", nargs="*", type=int, help="of the list, from 0")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "mutations.json")
    parser.add_argument("--again", action="store_true", help="also what was found before")
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args()
    found: dict[str, str] = json.loads(given.out.read_text("utf-8")) if given.out.exists() else {}
    every = mutations()
    if not given.table:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "copy"
            shutil.copytree(ROOT, copy, ignore=LEFT_OUT)
            for number in given.numbers or range(len(every)):
                each = every[number]
                if given.again or each.key not in found:
                    found[each.key] = noticed(each, copy)
                    given.out.write_text(json.dumps(found, ensure_ascii=False, indent=1), "utf-8")
                print(f"{number:3} {each.file:36} {found[each.key] or 'NOT NOTICED'}", flush=True)
    print(table(found))
    known = [found[each.key] for each in every if each.key in found]
    print(f"\n{sum(map(bool, known))} of {len(known)} changes are noticed, of {len(every)} in the list")
    return int(known.count("") > MOST)


if __name__ == "__main__":
    raise SystemExit(main())
