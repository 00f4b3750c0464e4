"""Work on an existing dask.distributed cluster (the only user of distributed).

The workers compute and send results back; only this process writes. Tasks of a lost worker are
done again by others. A worker has as many tasks at a time as it has threads, each on one core.
Short tasks are sent several at a time: sending takes as long as a short one. Results are the same
as here, because a worker must have the same versions of the packages that compute.
"""

from __future__ import annotations

import asyncio
import logging
import pickle
import platform
import re
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from itertools import count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
from threadpoolctl import threadpool_limits

from colmap_affrect.errors import AffrectError, Option, OptionError
from colmap_affrect.parallel.cluster_watch import ClusterWatch
from colmap_affrect.parallel.executor import Result, Task, in_order
from colmap_affrect.parallel.freed_memory import keep_freed_memory, return_freed_memory

if TYPE_CHECKING:
    from distributed import Client, Future, Security

CONNECT_TIMEOUT_S = 10.0  # resource
CLOSE_TIMEOUT_S = 5.0  # resource
# That a result is waited for before somebody looks whether the cluster is there; resource
POLL_S = 1.0
TRANSFER_S = 60.0  # that a finished result may take to come here; resource
# One that is being worked on and one that waits, so that no worker has to; resource
TASKS_PER_THREAD = 2
# That tasks take that are sent at a time, some fifty times as long as sending them; resource
BATCH_S = 0.5
# Seconds that are divided by; numeric
TINY_S = 1e-9
# Of their number from one time to the next: the first may be quick ones; resource
MAX_GROWTH = 4
PACKAGES = (
    "colmap-affrect",
    "distributed",
    "numpy",
    "pycolmap",
    "opencv-python-headless",
    "torch",
    "kornia",
)
"""Packages whose versions must be the same everywhere."""


def environment(paths: Iterable[str]) -> dict[str, str]:
    """Return what results depend on besides the task: versions of ``PACKAGES``, sizes of files."""
    versions = {package: _version(package) for package in PACKAGES}
    return versions | {path: _size(path) for path in paths}


def _version(package: str) -> str:
    """Return a version without its build, which differs on a worker with a GPU."""
    try:
        return metadata.version(package).partition("+")[0]
    except metadata.PackageNotFoundError:
        return "missing"


def _size(path: str) -> str:
    try:
        if Path(path).is_dir():
            return "a folder"
        return f"{Path(path).stat().st_size} bytes"
    except OSError:
        return "missing"


def require_environment(expected: Mapping[str, str]) -> None:
    """Refuse a worker, where this is called, that would give other results: AffrectError."""
    found = environment(key for key in expected if key not in PACKAGES)
    for key, value in expected.items():
        if found[key] != value:
            raise AffrectError(
                f"{key} is {found[key]}, and {value} on the machine that leads the work",
                where=f"worker on {platform.node()}",
                advice="results could differ: install the same versions, and have files on "
                "storage that all machines share, under the same path",
            )


_loading = threading.Lock()


@lru_cache(maxsize=1)
def _function(
    pickled: bytes, expected: tuple[tuple[str, str], ...]
) -> Callable[[Any], Any]:
    """Unpickle a function once per process; the next one replaces it and frees its memory."""
    require_environment(dict(expected))
    keep_freed_memory()
    threadpool_limits(1, user_api="blas")
    cv2.setNumThreads(1)
    function: Callable[[Any], Any] = pickle.loads(pickled)  # noqa: S301 - from the driver
    return function


def _forget() -> None:
    """Free what a worker keeps of a run."""
    _function.cache_clear()
    return_freed_memory()


@dataclass(frozen=True)
class _Done:
    """What a worker sends back of a batch."""

    results: list[Any]  # of its tasks, in their order
    seconds: float  # that they took


def _work(pickled: bytes, expected: tuple[tuple[str, str], ...], tasks: bytes) -> _Done:
    """Do a batch of tasks on a worker that has what is expected, by a pickled function."""
    with _loading:
        function = _function(pickled, expected)
    start = time.perf_counter()
    results = [function(task) for task in pickle.loads(tasks)]  # noqa: S301 - from the driver
    return _Done(results, time.perf_counter() - start)


class _Batches:
    """Puts tasks together that take about :data:`BATCH_S`, by what those before took."""

    def __init__(self) -> None:
        """Begin with single tasks."""
        self.size = 1  # number of tasks of the next batch
        self._num_done = 0
        self._seconds = 0.0

    def of(self, tasks: Iterable[Task]) -> Iterator[list[Task]]:
        """Yield tasks in their order, each batch when its turn comes."""
        waiting = iter(tasks)
        batch = list(islice(waiting, self.size))
        while batch:
            yield batch
            batch = list(islice(waiting, self.size))

    def learn(self, num_tasks: int, seconds: float) -> None:
        """Take into account how long tasks took.

        Args:
            num_tasks: of a batch.
            seconds: that they took together.
        """
        self._num_done += num_tasks
        self._seconds += seconds
        fitting = int(BATCH_S * self._num_done / max(self._seconds, TINY_S))
        self.size = max(1, min(fitting, MAX_GROWTH * self.size))


@dataclass(frozen=True)
class _Sent:
    """A batch on its way."""

    tasks: list[Any]
    future: Future

    def cancel(self) -> None:
        """Have it not done, if it has not begun."""
        self.future.cancel()


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """Use the cluster of a scheduler, such as ``tcp://10.0.0.1:8786``, and leave it running.

    AffrectError when distributed is not installed, no scheduler answers, or there are no workers.
    """
    try:
        from dask import config
        from distributed import Client, Security
    except ModuleNotFoundError as error:
        raise AffrectError(
            f"{error.name} is not installed",
            where=Option("scheduler"),
            advice="pip install 'colmap-affrect[cluster]'",
        ) from error
    if not re.fullmatch(r"(tcp|tls)://.+:\d+", address):
        raise OptionError(
            "not an address such as tcp://10.0.0.1:8786",
            where=Option("scheduler", address),
        )
    security = Security()  # as dask's configuration has it
    for name in ("distributed", "distributed.client"):  # errors that matter are raised
        logging.getLogger(name).setLevel(logging.CRITICAL)
    # Tasks may contain large images: dask need not warn of that.
    with config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"}):
        _require_scheduler(address, security)
        client = Client(
            address, timeout=CONNECT_TIMEOUT_S, security=security, set_as_default=False
        )
        try:
            cluster = _with_workers(client, address)
            try:
                yield cluster
            finally:
                cluster.forget()
        finally:
            with suppress(OSError, RuntimeError, CancelledError):
                client.close(timeout=CLOSE_TIMEOUT_S)


def _with_workers(client: Client, address: str) -> Cluster:
    """Return a cluster that has workers; AffrectError without."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
    except TimeoutError as error:
        raise AffrectError(
            "the cluster has no workers",
            where=address,
            advice=f"start some, with 'dask worker {address}' on each machine",
        ) from error
    return Cluster(client, address)


def _require_scheduler(address: str, security: Security) -> None:
    """Ask what listens at an address: a client waits for ever for what is not a scheduler."""
    from distributed.core import rpc

    async def kind() -> object:
        arguments = security.get_connection_args("client")
        async with (
            asyncio.timeout(CONNECT_TIMEOUT_S),
            rpc(address, timeout=CONNECT_TIMEOUT_S, connection_args=arguments) as there,
        ):
            return (await there.identity())["type"]

    try:
        with ThreadPoolExecutor(1) as own_thread:  # the caller's may have an event loop
            found = own_thread.submit(asyncio.run, kind()).result()
    except Exception as error:  # noqa: BLE001 - what listens there may say anything
        found = f"{type(error).__name__} {error}".strip()
    if found != "Scheduler":
        raise AffrectError(
            f"no scheduler answers ({found})",
            where=Option("scheduler", address),
            advice="give the address that 'dask scheduler' prints",
        )


class Cluster:
    """An :class:`~colmap_affrect.parallel.executor.Executor` on the workers of a cluster."""

    def __init__(self, client: Client, address: str) -> None:
        self._client = client
        self._address = address
        self._watch = ClusterWatch(client, address)

    def _result(self, future: Future) -> Any:
        """Wait for the result of a task; AffrectError when the cluster is lost meanwhile."""
        while not future.done():
            try:
                future.exception(timeout=POLL_S)  # waits, and brings no result here
            except TimeoutError:
                self._watch.look()
        while future.status == "finished":
            try:
                return future.result(timeout=TRANSFER_S)
            except TimeoutError:  # the worker that has it may be lost
                self._watch.look()
        return future.result()  # raises what the task has raised

    def forget(self) -> None:
        """Have workers free the memory of what they were given, if somebody is there."""
        with suppress(OSError, RuntimeError, CancelledError, AffrectError):
            self._watch.look()
            if not self._watch.is_lost:
                self._client.run(_forget, on_error="ignore")

    def map(
        self,
        function: Callable[[Task], Result],
        tasks: Iterable[Task],
        files: Sequence[Path] = (),
    ) -> Iterator[Result]:
        """Yield the results of tasks in their order, as every executor does.

        Args:
            function: does a task. It does not change its state, and can be pickled.
            tasks: they are taken when their turn comes, and can be pickled.
            files: what the function reads.

        Raises:
            AffrectError: the scheduler or all workers are lost for long, several workers are lost
                with one task, or a worker differs or does not see the files.
            Exception: what the function raises, at the place of its task.
        """
        expected = environment(str(path) for path in files)
        job = _Job(self._client, function, expected)
        batches = _Batches()

        def results(sent: _Sent) -> Iterable[Any]:
            """Wait for the results of a batch."""
            try:
                done = self._result(sent.future)
            except Exception:
                if len(sent.tasks) == 1 or sent.future.status != "error":
                    raise
                return one_by_one(sent.tasks)
            batches.learn(len(done.results), done.seconds)
            return list(done.results)

        def one_by_one(tasks: list[Task]) -> Iterator[Any]:
            """Yield results up to what a task raises, which so comes at its place."""
            for task in tasks:
                yield from self._result(job.submit([task]).future).results

        def num_batches() -> int:
            """Return how many may be on their way."""
            return TASKS_PER_THREAD * self._watch.num_threads()

        sent = in_order(
            job.submit, batches.of(tasks), limit=num_batches, result=results
        )
        with _lost_cluster_told(self._address), closing(sent):
            for found in sent:
                yield from found


class _Job:
    """Sends batches of the tasks of one function to a cluster."""

    def __init__(
        self, client: Client, function: Callable[[Any], Any], expected: dict[str, str]
    ) -> None:
        """Pickle the function.

        Args:
            client: of the cluster.
            function: does a task.
            expected: what workers must have, as :func:`environment` names it.
        """
        self._client = client
        self._job = pickle.dumps(function), tuple(expected.items())
        self._name = f"{type(function).__name__}-{uuid.uuid4().hex}"
        self._numbers = count()

    def submit(self, batch: list[Any]) -> _Sent:
        """Send a batch."""
        key = f"{self._name}-{next(self._numbers)}"
        future = self._client.submit(
            _work, *self._job, pickle.dumps(batch), key=key, pure=False
        )
        return _Sent(batch, future)


@contextmanager
def _lost_cluster_told(address: str) -> Iterator[None]:
    """Make one line of what distributed raises where a cluster is lost or is another one."""
    from distributed import KilledWorker

    try:
        yield
    except KilledWorker as error:
        raise AffrectError(
            f"{error.allowed_failures + 1} workers were lost while working on one "
            "task, for want of memory perhaps",
            where=address,
            advice="run the same command again",
        ) from error
    except CancelledError as error:
        raise AffrectError(
            "the scheduler was lost",
            where=address,
            advice="start it and run the same command again",
        ) from error
    except (ModuleNotFoundError, RuntimeError) as error:
        why = error.__cause__ or error
        if not isinstance(why, ModuleNotFoundError):
            raise
        raise AffrectError(
            f"scheduler or workers do not have this version of colmap-affrect ({why})",
            where=address,
            advice="install it on all machines of the cluster",
        ) from error
