"""Do the independent parts of a computation on a Dask cluster.

Whatever is large goes through a store that client and workers share, by its SHA-256: the function with its
parameters once; jobs and outcomes if they are larger than a message should be. The scheduler sees names and
hashes only.

A worker gives each job to a process of its own, so that a job which ends its process does not end the worker
and all that is under way in it. What is lost with a worker is done again by another.
"""

from __future__ import annotations

import json
import multiprocessing
import pickle
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple, Self, TypeVar

from ..archive.objects import Objects, objects_at
from ..core.errors import ArchiveError, EstimationError, UsageError
from ..core.executors import Executor, Here, Processes, crashed
from ..core.failure import Failure
from ..core.optional import optional
from ..core.processes import cores
from ..core.provenance import canonical_json, sha256_of
from ..core.version import __version__

J = TypeVar("J")
R = TypeVar("R")
_AHEAD = 3
"""Messages that are queued for each thread of a worker, so that none is idle."""
_SMALL = 2048
"""Bytes that may be sent through the scheduler; what is larger is stored."""
_TOGETHER_S = 1.0
"""Jobs that take less are sent together: a message costs client, scheduler and worker some milliseconds."""
_SUFFIX = ".pickle"
_PATIENCE_S = 10.0
_ASK_S = 2.0


class Cluster:
    """The workers of a Dask cluster do the work.

    Client, scheduler and workers trust each other: whoever reaches the scheduler, or writes to the store, can
    execute code on the workers.

    Parameters
    ----------
    address : str
        Address of the scheduler.
    store : str
        Folder or URL that client and workers share.

    Raises
    ------
    UsageError
        If there is no store, Dask is not installed, or the scheduler does not answer.

    Examples
    --------
    >>> Cluster("tcp://127.0.0.1:8786", "")
    Traceback (most recent call last):
    ...
    reseau.core.errors.UsageError: --cluster: requires a store that all workers share; add --store
    """

    local = False

    def __init__(self, address: str, store: str) -> None:
        if not store:
            raise UsageError("requires a store that all workers share", where="--cluster", do="add --store")
        with optional():
            import distributed
        self._place, self._store = store, _messages(store)
        self._known, self._asked = 1, -_ASK_S
        connect: Any = distributed.Client
        try:
            self._client = connect(address, timeout=_PATIENCE_S, set_as_default=False)
        except (OSError, ValueError) as error:
            what = "does not answer" if isinstance(error, OSError) else f"is no address ({error})"
            raise UsageError(
                what,
                where=f"cluster {address}",
                do="start it with `dask scheduler`, or write tcp://host:8786",
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def outcomes(
        self, work: Callable[[J], R], jobs: Iterable[tuple[str, J]]
    ) -> Iterator[tuple[str, R | Failure]]:
        """Yield the outcome of each job; see :meth:`Executor.outcomes`.

        Raises
        ------
        EstimationError
            If the cluster is lost; what its workers have stored remains.
        """
        run: _Run = partial(_on_worker, self._place, _sent(self._store, work, always=True))
        waiting, pending, size = deque[tuple[_Batch, Any]](), _Batch(), 1
        try:
            for name, job in jobs:
                pending.append((name, _sent(self._store, job)))
                if len(pending) >= size:
                    waiting.append((pending, self._submit(run, pending)))
                    pending = _Batch()
                    if len(waiting) > _AHEAD * self._threads():
                        seconds, found = self._next(run, *waiting.popleft())
                        size = _next_size(size, seconds / len(found))
                        yield from self._given(found)
            if pending:
                waiting.append((pending, self._submit(run, pending)))
            while waiting:
                yield from self._given(self._next(run, *waiting.popleft())[1])
        finally:
            self._client.cancel([future for _, future in waiting])

    def _threads(self) -> int:
        """Number of threads of all workers, which come and go; the scheduler is asked now and then."""
        now = time.monotonic()
        if now - self._asked > _ASK_S:
            self._known, self._asked = max(1, sum(self._client.nthreads().values())), now
        return self._known

    def _submit(self, run: _Run, batch: _Batch) -> Any:
        # Keys of one group: Dask keeps a record of every group that it has ever seen.
        return self._client.submit(run, batch, key=("reseau", uuid.uuid4().hex), pure=False)

    def _next(self, run: _Run, batch: _Batch, future: Any) -> tuple[float, list[tuple[str, _Sent]]]:
        from distributed import CancelledError, KilledWorker
        from distributed.comm.core import CommClosedError

        names = [name for name, _ in batch]
        try:
            seconds, found = future.result()
            return seconds, list(zip(names, found, strict=True))
        except KilledWorker:
            # Workers died with it, perhaps of something else: the system's memory, or another's hand.
            if len(batch) == 1:
                return 0.0, [(names[0], _sent(self._store, crashed(names[0])))]
            each = [_Batch([one]) for one in batch]
            again = [(one, self._submit(run, one)) for one in each]
            return 0.0, [found for one, future in again for found in self._next(run, one, future)[1]]
        except (CancelledError, CommClosedError, TimeoutError):
            raise EstimationError(
                "the cluster is lost", where=names[0], do="start it again, and repeat the command"
            ) from None

    def _given(self, found: Iterable[tuple[str, _Sent]]) -> Iterator[tuple[str, Any]]:
        for name, sent in found:
            outcome = _received(self._store, sent)
            if isinstance(outcome, _Raised):
                raise outcome.error
            yield name, outcome


def _next_size(size: int, seconds: float) -> int:
    """Number of jobs that are sent together: as many as take a second, at most twice as many as before."""
    return min(max(1, int(_TOGETHER_S / max(seconds, 1e-3))), 2 * size)


class _Sent(NamedTuple):
    """An object as bytes, or as the hash of bytes in the store."""

    data: bytes
    sha256: str


class _Raised(NamedTuple):
    """What a job raised; it is raised again where the outcome of the job is asked for."""

    error: Exception


_Batch = list[tuple[str, _Sent]]
_Run = Callable[[_Batch], tuple[float, list[_Sent]]]


@lru_cache(maxsize=4)
def _messages(place: str) -> Objects:
    # A message that is lost in a power failure is lost with the run.
    return objects_at(place, durable=False)


def _sent(store: Objects, thing: object, *, always: bool = False) -> _Sent:
    data = pickle.dumps(thing, protocol=5)
    if always or len(data) > _SMALL:
        return _Sent(b"", store.put(data, _SUFFIX))
    return _Sent(data, "")


def _received(store: Objects, sent: _Sent) -> Any:
    return pickle.loads(store.get(sent.sha256, _SUFFIX) if sent.sha256 else sent.data)


_of_thread = threading.local()


def _on_worker(place: str, work: _Sent, batch: _Batch) -> tuple[float, list[_Sent]]:
    """Have jobs done by the process that belongs to this thread of a worker; return how long it took."""
    if not hasattr(_of_thread, "processes"):
        # Dask marks its workers as processes without children. These end by themselves with their parent.
        multiprocessing.current_process().daemon = False
        _of_thread.processes = Processes(1, (__name__,))
    began, store = time.monotonic(), _messages(place)
    outcomes = _of_thread.processes.outcomes(partial(_done, place, work), batch)
    found = [_sent(store, each) if isinstance(each, Failure) else each for _, each in outcomes]
    return time.monotonic() - began, found


def _done(place: str, work: _Sent, job: _Sent) -> _Sent:
    store = _messages(place)
    try:
        return _sent(store, _work(place, work)(_received(store, job)))
    except Exception as error:
        return _sent(store, _Raised(error))


@lru_cache(maxsize=4)
def _work(place: str, sent: _Sent) -> Callable[[Any], Any]:
    found: Callable[[Any], Any] = _received(_messages(place), sent)
    return found


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


_SCHEMA = "reseau-output/1"


@dataclass(frozen=True)
class Outputs:
    """Where the outputs of a computation are kept, and what they depend on besides their inputs.

    Parameters
    ----------
    place : str
        Folder or URL of the store.
    about : mapping
        Name of the computation and its parameters, JSON values.
    suffix : str
        Suffix of the files.

    Examples
    --------
    >>> outputs = Outputs("memory://outputs", {"compute": "length"})
    >>> outputs.read(outputs.made({"text": "3f"}, lambda: b"3"))
    b'3'
    >>> outputs.read(outputs.made({"text": "3f"}, lambda: b"not computed again"))
    b'3'
    """

    place: str
    about: Mapping[str, Any]
    suffix: str = ".json"

    @cached_property
    def _store(self) -> Objects:
        # What is lost in a power failure is computed again.
        return objects_at(self.place, durable=False)

    def made(self, inputs: Mapping[str, str], compute: Callable[[], bytes]) -> str:
        """Return the SHA-256 of an output; compute and keep it unless it exists and is whole.

        Parameters
        ----------
        inputs : mapping of str to str
            SHA-256 of each input, by its role.
        compute : callable
            Returns the output; deterministic.

        Raises
        ------
        ArchiveError
            If the store cannot be used.
        Exception
            What `compute` raises.
        """
        depends = {"about": dict(self.about), "inputs": dict(inputs), "software": __version__}
        key = sha256_of(json.dumps(depends, sort_keys=True).encode())
        sha256 = self._whole(key)
        if not sha256:
            sha256 = self._store.put(compute(), self.suffix)
            record = {"schema": _SCHEMA, "sha256": sha256, **depends}
            self._store.write_record(key, canonical_json(record).encode())
        return sha256

    def read(self, sha256: str) -> bytes:
        """Return an output.

        Raises
        ------
        ArchiveError
            If it is missing or damaged.
        """
        return self._store.get(sha256, self.suffix)

    def _whole(self, key: str) -> str:
        try:
            sha256 = str(json.loads(self._store.record(key) or b"{}")["sha256"])
            self.read(sha256)
        except (ValueError, KeyError, TypeError, ArchiveError):
            return ""
        return sha256
