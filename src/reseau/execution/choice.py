"""The executor that a user asks for."""

from __future__ import annotations

from collections.abc import Sequence

from ..core.executors import Executor, Here, Processes
from ..core.processes import cores


def executor_at(
    jobs: int | None = None,
    cluster: str = "",
    store: str = "",
    modules: Sequence[str] = (),
    parts: int | None = None,
) -> Executor:
    """Return the executor that a user asks for.

    Parameters
    ----------
    jobs : int, optional
        Number of processes; by default one for each core.
    cluster : str, optional
        Address of the scheduler of a Dask cluster, such as ``tcp://192.168.1.5:8786``; replaces `jobs`.
    store : str, optional
        Folder or URL that the workers of the cluster share; required with a cluster.
    modules : sequence of str
        Modules to import once for all processes.
    parts : int, optional
        Number of parts that the work has; there are no more processes.

    Raises
    ------
    UsageError
        If the cluster has no store, its packages are not installed, or it does not answer.

    Examples
    --------
    >>> executor_at(1).local
    True
    """
    if cluster:
        from .cluster import Cluster

        return Cluster(cluster, store)
    count = jobs or cores()
    if parts is not None:
        count = max(1, min(count, parts))
    return Here() if count == 1 else Processes(count, modules)
