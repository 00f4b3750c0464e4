"""Whether scheduler and workers of a cluster are still there, while results are waited for."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from colmap_affrect.errors import AffrectError

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)

ASK_TIMEOUT_S = 3.0  # that a scheduler has to answer; resource
ASK_EVERY_S = 1.0  # at most; resource
# Since a worker was last heard of, which it is every second or so; resource
SILENT_S = 15.0
WARN_AFTER_S = 5.0  # without a scheduler, or a worker that is not silent; resource
# The same: a nanny starts a lost worker again long before; resource
GIVE_UP_AFTER_S = 35.0


class ClusterWatch:
    """Says when a cluster is lost: in a warning after seconds, then by an error."""

    def __init__(
        self, client: Client, address: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._client = client
        self._address = address
        self._clock = clock
        # When each was heard of, by the scheduler and by us
        self._heard: dict[str, tuple[float, float]] = {}
        self._asked_s = -ASK_EVERY_S
        self._lost_since_s: float | None = None
        self._has_warned = False
        self._num_threads = 1

    @property
    def is_lost(self) -> bool:
        """Whether nobody was there when last asked."""
        return self._lost_since_s is not None

    def num_threads(self) -> int:
        """Return how many threads all workers have; as many as before while nobody is there."""
        self.look()
        return self._num_threads

    def look(self) -> None:
        """Ask the scheduler who is there; AffrectError when nobody was for long."""
        if self._clock() - self._asked_s < ASK_EVERY_S:
            return
        fault = self._fault()
        now = self._asked_s = self._clock()
        if not fault:
            if self._has_warned:
                logger.warning("%s: the cluster is there again", self._address)
            self._lost_since_s = None
            self._has_warned = False
            return
        if self._lost_since_s is None:
            self._lost_since_s = now
        lost_s = now - self._lost_since_s
        if lost_s >= GIVE_UP_AFTER_S:
            raise AffrectError(
                f"{fault}, and run the same command again: what was done before is kept",
                where=self._address,
            )
        if lost_s >= WARN_AFTER_S and not self._has_warned:
            self._has_warned = True
            left_s = GIVE_UP_AFTER_S - lost_s
            logger.warning(
                "%s: %s; this waits for %.0f s more", self._address, fault, left_s
            )

    def _fault(self) -> str:
        """Return who is not there and how to start it, empty if all is well."""
        start = f"start some with 'dask worker {self._address}' on each machine"
        try:
            workers = self._workers()
        except (OSError, RuntimeError, AttributeError):
            # A client that has closed raises the last two
            return "the scheduler does not answer any more; start 'dask scheduler' and workers"
        heard = [
            worker
            for address, worker in workers.items()
            if self._is_heard(address, worker)
        ]
        if heard:
            self._num_threads = max(1, sum(int(worker["nthreads"]) for worker in heard))
            return ""
        if workers:
            return f"none of the {len(workers)} workers is heard of any more; {start}"
        return f"the cluster has no workers any more; {start}"

    def _workers(self) -> dict[str, Any]:
        """Return what the scheduler knows of each worker, by its address."""

        async def ask() -> Any:
            return await self._client.scheduler.identity()

        identity = self._client.sync(ask, callback_timeout=ASK_TIMEOUT_S)
        return dict(identity["workers"])

    def _is_heard(self, address: str, worker: dict[str, Any]) -> bool:
        """Return whether a worker was heard of lately, by our clock."""
        last = float(worker["last_seen"])
        now = self._clock()
        known, when = self._heard.get(address, (last, now))
        if known != last:
            when = now
        self._heard[address] = last, when
        return now - when < SILENT_S
