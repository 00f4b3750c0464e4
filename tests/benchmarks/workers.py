"""A cluster of workers on this machine, started as docs/cluster.md says, for benchmarks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

START_TIMEOUT_S = 60.0
PRELOADED = ["--preload", "colmap_affrect.stages.match", "--preload", "torch"]
ENVIRONMENT = {"DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False"}


@dataclass(frozen=True)
class StartedWorkers:
    """A scheduler and workers; none by default."""

    address: str = ""  # of the scheduler
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def options(self) -> list[str]:
        """Return the options of a command that uses them."""
        return ["--scheduler", self.address] if self.address else []

    def processor_s(self) -> float:
        """Return the processor time that all have taken so far (Linux)."""
        total = 0.0
        for process in self.processes:
            text = Path(f"/proc/{process.pid}/stat").read_text(encoding="ascii")
            fields = text.rpartition(")")[2].split()
            total += int(fields[11]) + int(fields[12])  # user and system
        return total / os.sysconf("SC_CLK_TCK")


@contextmanager
def started_workers(number: int, folder: Path) -> Iterator[StartedWorkers]:
    """Start a scheduler and workers of one thread each, and wait until all are there.

    Args:
        number: of workers; with 0 nothing is started.
        folder: for their files.
    """
    if not number:
        yield StartedWorkers()
        return
    file = folder / "scheduler.json"
    common = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)]
    own = ["--nthreads", "1", "--no-nanny", "--local-directory", str(folder)]
    worker = ["worker", *common, *own, *PRELOADED]
    commands = [["scheduler", "--port", "0", *common], *[worker] * number]
    processes = []
    for command in commands:
        processes.append(
            subprocess.Popen(
                [sys.executable, "-m", "dask", *command],
                cwd=folder,
                env={**os.environ, **ENVIRONMENT},
                stderr=subprocess.DEVNULL,
            )
        )
    try:
        yield StartedWorkers(_address_of_all(file, number), processes)
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _address_of_all(file: Path, number: int) -> str:
    """Return the address of a scheduler, once so many workers have reached it."""
    from distributed import Client

    end_s = time.monotonic() + START_TIMEOUT_S
    while not (file.exists() and file.read_text(encoding="utf-8")):
        if time.monotonic() > end_s:
            raise SystemExit(
                "no scheduler starts; pip install 'colmap-affrect[cluster]'"
            )
        time.sleep(0.1)
    address = str(json.loads(file.read_text(encoding="utf-8"))["address"])
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(number, timeout=START_TIMEOUT_S)
    return address
