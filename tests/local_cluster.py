"""A dask.distributed cluster on this machine, each part in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

START_TIMEOUT_S = 60.0


@contextmanager
def local_cluster(folder: Path, num_workers: int) -> Iterator[str]:
    """Start a scheduler and workers of one thread each; yield the scheduler's address."""
    file = folder / "scheduler.json"
    common = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)]
    worker = ["worker", *common, "--nthreads", "1", "--no-nanny", "--local-directory", str(folder)]
    commands = [["scheduler", "--port", "0", *common], *[worker] * num_workers]
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *command], cwd=folder, stderr=subprocess.DEVNULL
        )
        for command in commands
    ]
    try:
        deadline = time.monotonic() + START_TIMEOUT_S
        while not (file.exists() and file.read_text(encoding="utf-8")):
            assert time.monotonic() < deadline, "the scheduler does not start"
            time.sleep(0.1)
        yield json.loads(file.read_text(encoding="utf-8"))["address"]
    finally:
        for process in started:
            process.kill()
            process.wait()
