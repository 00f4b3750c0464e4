"""Work on an existing dask.distributed cluster (the only user of distributed).

The workers compute and send results back; only this process writes. Tasks of a lost worker are
done again by others. A worker has as many tasks at a time as it has threads, each on one core. Its
results are the same as here, because it must have the same versions of the packages that compute.
"""

from __future__ import annotations

import asyncio
import logging
import pickle
import platform
import re
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import cv2
from threadpoolctl import threadpool_limits

from colmap_affrect.errors import ClusterError
from colmap_affrect.parallel.executor import Result, Task

if TYPE_CHECKING:
    from distributed import Client, Future, Security

logger = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 10.0
POLL_S = 2.0  # how often to look whether there are workers at all
TASKS_PER_THREAD = 2  # one that is being worked on and one that waits, so that no worker has to

PACKAGES = (
    "colmap-affrect", "distributed", "numpy", "opencv-python-headless", "torch", "kornia",
)  # fmt: skip
"""Packages whose versions must be the same everywhere."""


@dataclass(frozen=True)
class WorkerEnvironment:
    """What results depend on besides the task: versions of ``PACKAGES``, and sizes of files."""

    host: str
    versions: tuple[tuple[str, str], ...]
    files: tuple[tuple[str, int], ...]

    @classmethod
    def of(cls, paths: Sequence[str]) -> Self:
        """Describe the machine this is called on."""
        return cls(
            platform.node(),
            tuple((name, _version(name)) for name in PACKAGES),
            tuple((path, _size(Path(path))) for path in paths),
        )

    def require_same(self, worker: WorkerEnvironment) -> None:
        """Refuse a worker that would give other results: ClusterError with the first reason."""
        for (name, here), (_, there) in zip(self.versions, worker.versions, strict=True):
            if here != there:
                raise ClusterError(
                    f"worker on {worker.host}: has {name} {there}, and the machine that leads the "
                    f"work {here}; results could differ, install the same versions on both"
                )
        if other := set(self.files) - set(worker.files):
            raise ClusterError(
                f"worker on {worker.host}: does not see {min(other)[0]} as this machine does; put "
                "it on storage that all machines share, under the same path"
            )


def _version(package: str) -> str:
    """Return a version without its build, which differs on a worker with a GPU."""
    try:
        return metadata.version(package).partition("+")[0]
    except metadata.PackageNotFoundError:
        return "missing"


def _size(path: Path) -> int:
    """Return the size of a file in bytes, 0 for a folder, -1 for what is not there."""
    try:
        return 0 if path.is_dir() else path.stat().st_size
    except OSError:
        return -1


@dataclass(frozen=True)
class _Job:
    """What comes with every task of a map: a pickled function and the environment it expects."""

    function: bytes
    environment: WorkerEnvironment


_loading = threading.Lock()


@lru_cache(maxsize=1)
def _function(job: _Job) -> Callable[[Any], Any]:
    """Unpickle a function once per process; the next one replaces it and frees its memory."""
    paths = [path for path, _ in job.environment.files]
    job.environment.require_same(WorkerEnvironment.of(paths))
    threadpool_limits(1, user_api="blas")
    cv2.setNumThreads(1)
    function: Callable[[Any], Any] = pickle.loads(job.function)  # noqa: S301 - from the driver
    return function


def _work(job: _Job, task: bytes) -> Any:
    """Do one task on a worker."""
    with _loading:
        function = _function(job)
    return function(pickle.loads(task))  # noqa: S301 - from the driver


def _forget() -> None:
    """Free the memory of the last function."""
    _function.cache_clear()


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """Use the cluster of a scheduler, such as ``tcp://10.0.0.1:8786``, and leave it running.

    Raises ClusterError when distributed is not installed, the scheduler does not answer, there are
    no workers, or they differ from this machine.
    """
    try:
        from dask import config
        from distributed import Client, Security
    except ModuleNotFoundError as error:
        raise ClusterError(
            f"--scheduler: {error.name} is not installed; pip install 'colmap-affrect[cluster]'"
        ) from error
    if not re.fullmatch(r"(tcp|tls)://.+:\d+", address):
        raise ClusterError(f"--scheduler {address}: not an address such as tcp://10.0.0.1:8786")
    security = Security()  # as dask's configuration has it
    if address.startswith("tls") and not security.get_connection_args("client")["ssl_context"]:
        raise ClusterError(
            f"--scheduler {address}: needs certificates, distributed.comm.tls in the "
            "configuration of dask"
        )
    # Tasks may contain large images: dask need not warn of that.
    images_are_large = {"distributed.admin.large-graph-warning-threshold": "1 TB"}
    with _silent("distributed"), config.set(images_are_large):
        _require_scheduler(address, security)
        with Client(
            address, timeout=CONNECT_TIMEOUT_S, security=security, set_as_default=False
        ) as client:
            cluster = Cluster(client, address)
            cluster.require_workers()
            try:
                yield cluster
            finally:
                with suppress(OSError, RuntimeError, CancelledError):
                    client.run(_forget, on_error="ignore")


def _require_scheduler(address: str, security: Security) -> None:
    """Ask what listens at an address: a client waits for ever for what is not a scheduler."""
    from distributed.comm import CommClosedError
    from distributed.core import rpc

    async def kind() -> str:
        arguments = security.get_connection_args("client")
        async with (
            asyncio.timeout(CONNECT_TIMEOUT_S + 1.0),  # after that of connecting
            rpc(address, timeout=CONNECT_TIMEOUT_S, connection_args=arguments) as there,
        ):
            return str((await there.identity())["type"])

    try:
        with ThreadPoolExecutor(1) as own_thread:  # the caller's may have an event loop
            found = own_thread.submit(asyncio.run, kind()).result()
        if found != "Scheduler":
            raise ConnectionError(f"it is a {found.lower()}")
    except Exception as error:  # what listens there may say anything
        is_told = isinstance(error, OSError) and type(error) is not CommClosedError and str(error)
        raise ClusterError(
            f"--scheduler {address}: no scheduler answers "
            f"({error if is_told else 'what listens there does not speak as dask does'}); give the "
            "address that 'dask scheduler' prints"
        ) from error


@contextmanager
def _silent(package: str) -> Iterator[None]:
    """Keep a package from logging to the terminal: errors that matter are raised."""
    its = logging.getLogger(package)
    handlers, its.handlers = its.handlers, [logging.NullHandler()]
    try:
        yield
    finally:
        its.handlers = handlers


class Cluster:
    """An :class:`~colmap_affrect.parallel.executor.Executor` on the workers of a cluster."""

    def __init__(self, client: Client, address: str) -> None:
        self._client, self._address = client, address

    def require_workers(self) -> None:
        """Refuse, by a ClusterError, a cluster without workers or whose results would differ."""
        with suppress(TimeoutError):
            self._client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
        here = WorkerEnvironment.of([])
        try:
            self._client.run_on_scheduler(WorkerEnvironment.of, [])  # which unpickles tasks
            workers = list(self._client.run(WorkerEnvironment.of, []).values())
        except (ModuleNotFoundError, AttributeError) as error:
            raise self._not_installed(error) from error
        if not workers:
            raise ClusterError(
                f"{self._address}: the cluster has no workers; start some, with 'dask worker "
                f"{self._address}' on each machine"
            )
        for worker in workers:
            here.require_same(worker)

    def _not_installed(self, error: Exception) -> ClusterError:
        return ClusterError(
            f"{self._address}: scheduler or workers do not have this version of colmap-affrect "
            f"({error}); install it on all machines of the cluster"
        )

    def map(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], files: Sequence[Path] = ()
    ) -> Iterator[Result]:
        """See :class:`~colmap_affrect.parallel.executor.Executor`.

        Raises ClusterError when the scheduler is lost, several workers are lost with one task, or a
        worker differs or does not see the files.
        """
        job = _Job(pickle.dumps(function), WorkerEnvironment.of([str(path) for path in files]))
        name = f"{type(function).__name__}-{uuid.uuid4().hex}"
        pending: deque[tuple[Future, Task]] = deque()
        try:
            for number, task in enumerate(tasks):
                future = self._client.submit(
                    _work, job, pickle.dumps(task), key=f"{name}-{number}", pure=False
                )
                pending.append((future, task))
                while len(pending) >= TASKS_PER_THREAD * max(1, self._num_threads()):
                    yield self._result(*pending.popleft())
            while pending:
                yield self._result(*pending.popleft())
        finally:
            if pending:
                with suppress(OSError, RuntimeError, CancelledError):
                    self._client.cancel([future for future, _ in pending])

    def _num_threads(self) -> int:
        return sum(self._client.nthreads().values())

    def _result(self, future: Future, task: object) -> Any:
        from distributed import KilledWorker

        try:
            self._wait(future)
            return future.result()
        except KilledWorker as error:
            raise ClusterError(
                f"{task}: {error.allowed_failures + 1} workers were lost while working on it, for "
                "want of memory perhaps; run the same command again"
            ) from error
        except CancelledError as error:
            raise ClusterError(
                f"{self._address}: the scheduler was lost; start it and run the same command again"
            ) from error
        except ModuleNotFoundError as error:
            raise self._not_installed(error) from error

    def _wait(self, future: Future) -> None:
        """Wait until a task has ended, and for new workers if all are lost."""
        is_warned = False
        while not future.done():
            with suppress(TimeoutError):
                future.result(timeout=POLL_S)
            if not is_warned and not self._num_threads():
                logger.warning("%s: no workers are left; waiting for some", self._address)
                is_warned = True
