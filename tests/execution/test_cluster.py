"""Jobs on a Dask cluster of this machine: the same outcomes, whoever dies meanwhile."""

from __future__ import annotations

import operator
import os
import signal
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure
from reseau.execution import Executor, executor_at

distributed = pytest.importorskip("distributed", reason="needs the extra `scale`")
# Sockets of a worker that was killed are closed by the collector.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
        ) as found:
            yield found


@pytest.fixture
def executor(cluster: Any, tmp_path: Path) -> Iterator[Executor]:
    with executor_at(cluster=cluster.scheduler_address, store=str(tmp_path)) as found:
        yield found


def test_outcomes_are_those_of_this_process_in_the_order_of_the_jobs(executor: Executor) -> None:
    found = list(executor.outcomes(operator.call, [(f"j{i}", partial(pow, i, 2)) for i in range(40)]))
    assert found == [(f"j{i}", i * i) for i in range(40)]


def test_large_jobs_and_outcomes_go_through_the_store(executor: Executor, tmp_path: Path) -> None:
    image = np.random.default_rng(1).integers(0, 255, (300, 400), dtype=np.uint8)
    ((_, found),) = executor.outcomes(np.flipud, [("photo", image)])
    assert np.array_equal(found, image[::-1])
    sizes = sorted(path.stat().st_size for path in tmp_path.glob("*/*.pickle"))
    assert [size > 100_000 for size in sizes] == [False, True, True]


def test_a_job_that_ends_its_process_leaves_the_workers_alive(executor: Executor, cluster: Any) -> None:
    before = {worker.pid for worker in cluster.workers.values()}
    jobs = [(f"j{i}", partial(pow, i, 2)) for i in range(10)]
    jobs[4] = ("poisonous", partial(os._exit, 1))  # type: ignore[arg-type]
    found = dict(executor.outcomes(operator.call, jobs))
    crashed = found.pop("poisonous")
    assert isinstance(crashed, Failure)
    assert (crashed.code, crashed.where) == (Code.CRASHED, "poisonous")
    assert found == {f"j{i}": i * i for i in range(10) if i != 4}
    assert {worker.pid for worker in cluster.workers.values()} == before


def test_what_a_killed_worker_had_is_done_by_the_others(executor: Executor, cluster: Any) -> None:
    jobs = [(f"j{i}", partial(pow, i, 2)) for i in range(120)]
    found = []
    for each in executor.outcomes(operator.call, jobs):
        found.append(each)
        if len(found) == 10:
            os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
    assert found == [(f"j{i}", i * i) for i in range(120)]


@pytest.mark.slow
def test_a_cluster_that_does_not_answer_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reseau.execution.cluster._PATIENCE_S", 0.2)
    with pytest.raises(UsageError, match=r"cluster tcp://127\.0\.0\.1:9: does not answer"):
        executor_at(cluster="tcp://127.0.0.1:9", store=str(tmp_path))


@pytest.mark.slow
def test_what_the_work_raises_is_raised_at_its_job(executor: Executor) -> None:
    jobs = [(f"j{i}", partial(pow, i, 2)) for i in range(30)]
    jobs[25] = ("bad", partial(operator.truediv, 1, 0))  # type: ignore[arg-type]
    outcomes = executor.outcomes(operator.call, jobs)
    assert [next(outcomes)[1] for _ in range(25)] == [i * i for i in range(25)]
    with pytest.raises(ZeroDivisionError):
        next(outcomes)
