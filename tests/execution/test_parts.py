"""Benchmarks whose parts are independent: the same to the byte in this process, in several, on a cluster."""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.execution import Executor, Here, Processes, executor_at

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
# Sockets of a cluster that ends are closed by the collector.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


@pytest.fixture(scope="module", autouse=True)
def importable() -> Iterator[None]:
    # As for a script of this folder: other processes get this path, too.
    sys.path.insert(0, str(BENCHMARKS))
    yield
    sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module", params=["here", "processes", "cluster"])
def executor(
    request: pytest.FixtureRequest, importable: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Executor]:
    with ExitStack() as stack:
        if request.param == "cluster":
            distributed = pytest.importorskip("distributed", reason="needs the extra `scale`")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                cluster = distributed.LocalCluster(
                    n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
                )
            address = stack.enter_context(cluster).scheduler_address
            found = executor_at(cluster=address, store=str(tmp_path_factory.mktemp("store")))
        else:
            found = Here() if request.param == "here" else Processes(2)
        yield stack.enter_context(found)


def benchmark(name: str) -> Any:
    return importlib.import_module(name)


@pytest.mark.slow
def test_simulated_tests_of_significance(executor: Executor) -> None:
    work = partial(benchmark("group_a").tested, size=2.0)
    found = list(benchmark("parts").outcomes(executor, work, range(5), together=2))
    assert np.array_equal(found, [work(seed) for seed in range(5)])
    assert len({each.tobytes() for each in found}) > 1


def test_simulated_years(executor: Executor) -> None:
    cases = [("known, after 20 runs", 20, 0.0), ("estimated from 20 runs", 20, 0.3)]
    work = partial(benchmark("recalibration")._delays, 40, 3)
    assert list(benchmark("parts").outcomes(executor, work, cases)) == [work(case) for case in cases]


@pytest.mark.slow
def test_a_part_that_ends_its_process_ends_the_benchmark(executor: Executor) -> None:
    if isinstance(executor, Here):
        pytest.skip("would end this process")
    with pytest.raises(RuntimeError, match="part 1: ended its process twice"):
        list(benchmark("parts").outcomes(executor, ended_by_two, [1, 2, 3]))


def ended_by_two(number: int) -> int:
    if number == 2:
        os._exit(3)
    return number
