"""Newly compiled code and cached code give the same bytes: results can be reproduced."""

import hashlib
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

MEASURED = """
    import hashlib
    from reseau.measure import measure_testfield
    from reseau_sims import FieldBench, Station
    bench = FieldBench(seed=3)
    found = measure_testfield(bench.record(Station(30, 90, 90)), bench.design)
    print(hashlib.sha256(found.points.xy.tobytes() + found.points.cov.tobytes()).hexdigest())
    """


@pytest.mark.slow
def test_compiled_code_and_cached_code_give_the_same_bytes(tmp_path: Path) -> None:
    message = [
        subprocess.run(
            [sys.executable, "-c", textwrap.dedent(MEASURED)],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for _ in range(2)
    ]
    assert len(message[0]) == len(hashlib.sha256().hexdigest())
    assert message[0] == message[1]
