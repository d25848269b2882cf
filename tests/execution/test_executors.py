"""Independent jobs: in order, lazily, and no job is lost with another."""

from __future__ import annotations

import operator
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from reseau.core.errors import ImageError, UsageError
from reseau.core.failure import Code, Failure
from reseau.execution import Executor, Here, Processes, executor_at

Job = Callable[[], object]


def squares(count: int) -> list[tuple[str, Job]]:
    return [(f"job {i}", partial(operator.mul, i, i)) for i in range(count)]


@pytest.fixture(params=["here", "processes"])
def executor(request: pytest.FixtureRequest) -> Iterator[Executor]:
    with Here() if request.param == "here" else Processes(2) as found:
        yield found


def test_outcomes_come_in_the_order_of_the_jobs(executor: Executor) -> None:
    found = list(executor.outcomes(operator.call, squares(30)))
    assert found == [(f"job {i}", i * i) for i in range(30)]


def test_few_jobs_are_in_memory_at_once(executor: Executor) -> None:
    asked = []

    def jobs() -> Iterator[tuple[str, Job]]:
        for each in squares(200):
            asked.append(each)
            yield each

    largest = 0
    for done, _ in enumerate(executor.outcomes(operator.call, jobs())):
        largest = max(largest, len(asked) - done)
    assert largest <= 6


def test_what_the_work_raises_is_raised_at_its_job(executor: Executor) -> None:
    jobs = [*squares(3), ("bad", partial(Path("no such file").read_bytes))]
    found = executor.outcomes(operator.call, jobs)
    assert [next(found)[1] for _ in range(3)] == [0, 1, 4]
    with pytest.raises(FileNotFoundError):
        next(found)


def test_sums_are_the_same_in_every_executor(executor: Executor) -> None:
    a = np.random.default_rng(1).normal(size=(300, 300))
    jobs = [("inverse", partial(np.linalg.inv, a))]
    ((_, found),) = executor.outcomes(operator.call, jobs)
    ((_, here),) = Here().outcomes(operator.call, jobs)
    assert np.array_equal(found, here)


def test_a_job_that_ends_its_process_becomes_a_failure_with_its_name_and_no_other_is_lost() -> None:
    jobs = squares(12)
    for place in (3, 7):
        jobs[place] = (f"poisonous {place}", partial(os._exit, 3))
    with Processes(2) as executor:
        found = dict(executor.outcomes(operator.call, jobs))
    crashed = {name: each for name, each in found.items() if isinstance(each, Failure)}
    assert list(crashed) == ["poisonous 3", "poisonous 7"]
    assert all(each.code is Code.CRASHED and each.where == name for name, each in crashed.items())
    assert [found[f"job {i}"] for i in range(12) if i not in (3, 7)] == [
        i * i for i in range(12) if i not in (3, 7)
    ]


def test_a_job_is_tried_again_when_its_process_was_ended_once(tmp_path: Path) -> None:
    # The first call makes the folder and ends the process; the second finds the folder.
    with Processes(2) as executor:
        found = dict(executor.outcomes(once, [("a", tmp_path / "a"), ("b", tmp_path / "b")]))
    assert found == {"a": "done", "b": "done"}


def once(marker: Path) -> str:
    if not marker.exists():
        marker.mkdir()
        os._exit(9)
    return "done"


def test_the_processes_serve_several_series() -> None:
    with Processes(2) as executor:
        for _ in range(3):
            assert len(list(executor.outcomes(operator.call, squares(4)))) == 4


def test_a_series_may_be_left() -> None:
    with Processes(2) as executor:
        for _, found in executor.outcomes(operator.call, squares(50)):
            if found == 4:
                break
        assert next(executor.outcomes(operator.call, squares(1)))[1] == 0


def test_one_job_needs_no_process() -> None:
    assert isinstance(executor_at(1), Here)
    assert isinstance(executor_at(3), Processes)


def test_a_cluster_requires_a_store() -> None:
    with pytest.raises(UsageError, match="requires a store that all workers share; add --store"):
        executor_at(cluster="tcp://127.0.0.1:1")


def test_an_error_of_the_project_keeps_its_place(executor: Executor) -> None:
    with pytest.raises(ImageError, match=r"a\.png: is damaged"):
        list(executor.outcomes(raised, [("a", ImageError("is damaged", where="a.png"))]))


def raised(error: Exception) -> None:
    raise error
