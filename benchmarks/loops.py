"""Write the list of loops that `reseau compile` compiles: what the main jobs are seen to compile.

    python benchmarks/loops.py [DATA] [--only demo calibrate orient …]

Each job runs once in a process of its own, with an empty folder of compiled code; what is in it afterwards is
what the job calls. The modules are listed by the time that their compilation takes, longest first, so that
processes that share them end at about the same time. With `--only`, what other jobs were seen to call stays.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path

from waiting import ROOT, commands, spent

from reseau.core.ahead import LOOPS
from reseau.core.compiled import listed


def seen(cache: Path) -> tuple[list[dict[str, object]], dict[str, int]]:
    """Loops in a folder of compiled code, and its bytes by module."""
    folder, size = cache / "reseau", dict[str, int]()
    found = listed(folder)
    for path, entry in zip(sorted(folder.glob("*.nbc")), found, strict=True):
        module = str(entry["function"]).partition(":")[0]
        size[module] = size.get(module, 0) + path.stat().st_size
    return found, size


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", nargs="?", default=os.environ.get("RESEAU_DATA", "../shared/data"), type=Path)
    parser.add_argument("--only", nargs="+", help="some of demo, auto, calibrate, board, orient")
    given = parser.parse_args()
    jobs: dict[str, set[str]] = {}
    if LOOPS.exists():
        for entry in json.loads(LOOPS.read_text()):
            own = {key: entry[key] for key in ("function", "slots", "arguments")}
            jobs.setdefault(json.dumps(own), set()).update(entry["jobs"])
    sizes: dict[str, int] = {}

    def note(job: str, cache: Path) -> None:
        found, size = seen(cache)
        for loop in found:
            jobs.setdefault(json.dumps(loop), set()).add(job)
        for module, count in size.items():
            sizes[module] = max(count, sizes.get(module, 0))

    def write() -> int:
        rows = [json.loads(key) | {"jobs": sorted(who)} for key, who in jobs.items() if who]
        rows.sort(key=lambda row: (-sizes.get(row["function"].partition(":")[0], 0), json.dumps(row)))
        LOOPS.write_text("[\n" + ",\n".join(map(json.dumps, rows)) + "\n]\n", encoding="utf-8")
        return len(rows)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for job, (code, words) in commands(given.data, folder).items():
            if job in ("version", "import") or (given.only and job not in given.only):
                continue
            cache = folder / f"compiled for {job}"
            for key in jobs:
                jobs[key].discard(job)
            write()  # a job compiles first what is listed for it, called or not
            spent(code, words, ROOT, cache)
            note(job, cache)
            print(f"{job}: {len(listed(cache / 'reseau'))} loops", flush=True)
    print(f"{write()} loops in {LOOPS.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
