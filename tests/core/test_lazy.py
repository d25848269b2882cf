"""Imports without looking for garbage leave that of others to be found."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import gc, weakref
from reseau.core.lazy import without_collecting

class Circle: pass

one = Circle()
one.itself, seen = one, weakref.ref(one)
for _ in range(2):
    with without_collecting():
        pass
assert gc.get_freeze_count() > 0
del one
gc.collect()
assert seen() is None
assert gc.get_freeze_count() == 0
assert not gc.callbacks
"""


def test_what_others_had_made_before_an_import_is_collected_afterwards() -> None:
    subprocess.run([sys.executable, "-c", PROGRAM], check=True)
