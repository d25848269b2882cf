"""Compile ahead what is otherwise compiled at first calls, in several processes.

``ahead.json`` lists the loops that the main jobs call, with the types of their arguments, by job. It is what
the jobs were seen to compile: ``python benchmarks/loops.py`` writes it. What a job compiles beyond the list
costs the time of its compilation at its first call, and nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from .compiled import Compiled, folders, named, types_of
from .errors import InputError
from .executors import Executor
from .failure import Code, Failure
from .lazy import without_collecting

LOOPS = Path(__file__).with_name("ahead.json")


@dataclass(frozen=True)
class Loop:
    """A compiled function with the types of its arguments.

    Parameters
    ----------
    function : str
        Module and name, ``module:name``.
    slots : dict
        Kernels in its slots, ``module:name`` each.
    arguments : list
        Types of its arguments; see :func:`reseau.core.compiled.types_of`.
    jobs : tuple of str
        What calls it.
    """

    function: str
    slots: dict[str, str]
    arguments: list[Any]
    jobs: tuple[str, ...] = ()

    def compiled(self) -> Compiled[..., Any]:
        """Return the function."""
        return named(self.function, self.slots)


@dataclass(frozen=True)
class Ahead:
    """What was compiled ahead.

    Parameters
    ----------
    compiled, found : int
        Number of loops that were compiled, and that had been before.
    folder : Path
        Where they are kept.
    """

    compiled: int
    found: int
    folder: Path


@cache
def main_loops() -> tuple[Loop, ...]:
    """Return the loops that the main jobs call.

    Examples
    --------
    >>> "calibrate" in next(
    ...     loop.jobs for loop in main_loops() if loop.function == "reseau.optics.compiled:formed"
    ... )
    True
    """
    content = json.loads(LOOPS.read_text(encoding="utf-8"))
    return tuple(Loop(**entry | {"jobs": tuple(entry["jobs"])}) for entry in content)


def missing_loops(job: str) -> list[Loop]:
    """Return the loops of a job that have not been compiled for this processor.

    Examples
    --------
    >>> missing_loops("none")
    []
    """
    return [
        loop
        for loop in main_loops()
        if job in loop.jobs and not loop.compiled().kept(types_of(loop.arguments))
    ]


def by_module(loops: Iterable[Loop]) -> dict[str, list[Loop]]:
    """Return loops by their modules, in the order given.

    Examples
    --------
    >>> len(by_module(main_loops())["reseau.optics.compiled"])
    2
    """
    modules: dict[str, list[Loop]] = {}
    for loop in loops:
        modules.setdefault(loop.function.partition(":")[0], []).append(loop)
    return modules


def compile_ahead(
    executor: Executor,
    modules: Mapping[str, Sequence[Loop]],
    step: Callable[[str], object] = lambda description: None,
) -> Ahead:
    """Compile those of the loops that are still to be compiled.

    Those of one module are compiled by one process: kernels that several of them call are compiled once.

    Parameters
    ----------
    executor : Executor
        The processes.
    modules : mapping
        Loops by module; see :func:`by_module`.
    step : callable
        Is told each module that is done.

    Raises
    ------
    InputError
        If the list has one that is not compiled as it says.
    """
    compiled = 0
    for name, outcome in executor.outcomes(_group, modules.items()):
        if isinstance(outcome, Failure):
            raise InputError(
                f"{name} cannot be compiled as it says: {outcome}",
                where=LOOPS,
                do="write it anew with `python benchmarks/loops.py`",
            )
        compiled += outcome
        step(f"compiled {name}")
    return Ahead(compiled, sum(map(len, modules.values())) - compiled, folders()[-1])


def _group(loops: Sequence[Loop]) -> int | Failure:
    """Compile loops of a module; the number of those that had not been compiled before."""
    try:
        with without_collecting():
            return sum(loop.compiled().compile(types_of(loop.arguments)) for loop in loops)
    except Exception as error:  # Numba's are not ours to name
        return Failure(" ".join(str(error).split())[:300], Code.CRASHED)
