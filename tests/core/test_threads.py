"""The limit of BLAS to one thread: also where contexts are nested."""

from __future__ import annotations

import scipy.linalg  # noqa: F401  # loads the libraries
import threadpoolctl  # type: ignore[import-untyped]

from reseau.core.threads import one_thread


def threads() -> set[int]:
    return {
        library["num_threads"] for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"
    }


def test_the_limit_ends_with_the_outermost_context() -> None:
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads()
        with one_thread():
            with one_thread():
                assert threads() == {1}
            assert threads() == {1}
        assert threads() == before


def test_the_limit_decorates_a_function() -> None:
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads()
        assert one_thread()(threads)() == {1}
        assert threads() == before
