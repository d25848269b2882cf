"""The independent parts of a benchmark, done by the executor that the user asks for.

A benchmark that uses it takes ``--jobs``, ``--cluster`` and ``--store``, and prints the same with each. On a
cluster, the workers need this folder in their PYTHONPATH.
"""

from __future__ import annotations

import argparse
import importlib
import os
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import TypeVar

from reseau.core.failure import Failure
from reseau.execution import Executor, executor_at

__all__ = ["add_options", "executor_of", "main_of", "outcomes", "timed"]

J = TypeVar("J")
R = TypeVar("R")

_loaded: set[str] = set()
"""Kinds of work that this process has done, and whose compiled code it has loaded."""


def add_options(parser: argparse.ArgumentParser, jobs: int = 2) -> None:
    """Add the options that choose an executor."""
    parser.add_argument("--jobs", type=int, default=jobs, help="processes")
    parser.add_argument("--cluster", default=os.environ.get("RESEAU_CLUSTER", ""), help="tcp://HOST:PORT")
    parser.add_argument("--store", default=os.environ.get("RESEAU_STORE", ""), help="folder of the cluster")


def executor_of(given: argparse.Namespace) -> Executor:
    """The executor that the options ask for."""
    return executor_at(given.jobs, given.cluster, given.store)


def outcomes(executor: Executor, work: Callable[[J], R], jobs: Iterable[J], together: int = 1) -> Iterator[R]:
    """What `work` returns for each job, in their order; jobs of milliseconds are done some together.

    Raises
    ------
    RuntimeError
        If a job ends its process: a benchmark without one of its parts would be another one.
    """
    left = iter(jobs)
    parts = ((f"part {k}", each) for k, each in enumerate(iter(lambda: tuple(islice(left, together)), ())))
    found = executor.outcomes(partial(_several, work), parts)
    return chain.from_iterable(_whole(name, each) for name, each in found)


def timed(work: Callable[[], R], kind: str) -> tuple[R, float]:
    """What `work` returns, and its processor time (s) in this process, without loading compiled code.

    The first work of a kind in a process is therefore done twice.
    """
    if kind not in _loaded:
        work()
        _loaded.add(kind)
    begun = time.process_time()
    found = work()
    return found, time.process_time() - begun


def main_of(file: str) -> object:
    """Call `main` of a benchmark under the name by which other processes find its functions."""
    return importlib.import_module(Path(file).stem).main()


def _several(work: Callable[[J], R], jobs: tuple[J, ...]) -> list[R]:
    return [work(job) for job in jobs]


def _whole(name: str, found: list[R] | Failure) -> list[R]:
    if isinstance(found, Failure):
        raise RuntimeError(f"{name}: {found.reason}")
    return found
