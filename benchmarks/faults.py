"""Write docs/faults.md from the fault tests of all drivers: ``python benchmarks/faults.py``.

With ``--exchanges 10000``, the endurance of every driver on every transport is included.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "faults.md")
    parser.add_argument(
        "--exchanges", type=int, default=0, help="number of exchanges per driver, with 1 %% faults"
    )
    asked = parser.parse_args()
    which = ["-k", "a_fault_gives"]
    if asked.exchanges:
        os.environ["RESEAU_EXCHANGES"] = str(asked.exchanges)
        which = ["-k", "a_fault_gives or endurance", "-m", "slow or not slow"]
    battery = [str(path) for path in sorted((ROOT / "tests" / "drivers").glob("test_battery_*.py"))]
    status = pytest.main(["-q", "-n", "2", *which, *battery, "--evidence", str(asked.out.resolve())])
    print(asked.out.read_text())
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
