"""What a machine can do: its description, its peaks, its memory."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from stage_clock import Work
from threadpoolctl import threadpool_limits

from colmap_affrect.executor import available_cores, peak_memory_bytes
from colmap_affrect.pipeline import installed_versions

MATRIX_SIZE = 2048
COPY_BYTES = 1 << 28
NUM_TRIES = 5
CLEAR_REFS = Path("/proc/self/clear_refs")
RESET_PEAK = "5"


@dataclass(frozen=True)
class Peaks:
    """The best that was measured.

    Attributes:
        gflops_one, gflops_all: products of float32 matrices on one core, on all; a
            multiply-add is two operations.
        gbytes_one, gbytes_all: gigabytes per second of copying, read and written ones both.
    """

    gflops_one: float
    gflops_all: float
    gbytes_one: float
    gbytes_all: float

    def limit_s(self, work: Work) -> float:
        """Return the seconds that one core needs at least, computing or moving bytes."""
        computing = 2.0 * work.multiply_adds / (self.gflops_one * 1e9)
        return max(computing, work.num_bytes / (self.gbytes_one * 1e9))


def measure_peaks() -> Peaks:
    """Multiply matrices and copy arrays."""
    left = np.random.default_rng(0).random((MATRIX_SIZE, MATRIX_SIZE), dtype=np.float32)
    right, product = left.T.copy(), np.empty_like(left)
    source = np.ones(COPY_BYTES, np.uint8)
    target = np.zeros_like(source)
    cores = available_cores()

    def copy_all() -> None:
        parts = zip(np.array_split(target, cores), np.array_split(source, cores), strict=True)
        list(pool.map(lambda pair: np.copyto(*pair), parts))

    gflop, gbyte = 2.0 * MATRIX_SIZE**3 / 1e9, 2.0 * COPY_BYTES / 1e9
    with ThreadPoolExecutor(cores) as pool:
        with one_core():
            one_s = best_of(lambda: np.matmul(left, right, out=product), time.process_time)
        all_s = best_of(lambda: np.matmul(left, right, out=product))
        return Peaks(
            gflop / one_s,
            gflop / all_s,
            gbyte / best_of(lambda: np.copyto(target, source), time.process_time),
            gbyte / best_of(copy_all),
        )


def best_of(function: Callable[[], object], now: Callable[[], float] = time.perf_counter) -> float:
    """Return the seconds, by the clock ``now``, of the fastest of several calls."""
    seconds = []
    for _ in range(NUM_TRIES):
        start = now()
        function()
        seconds.append(now() - start)
    return min(seconds)


@contextmanager
def one_core() -> Iterator[None]:
    """Let the libraries use one thread each in the block."""
    num_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(num_threads)


def describe_machine() -> str:
    """Return processor, cores, memory, load and versions."""
    versions = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return (
        f"{processor()}, {available_cores()} cores, {memory:.0f} GiB, "
        f"load {os.getloadavg()[0]:.1f} at the start\n{versions}"
    )


def processor() -> str:
    """Return the name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


class PeakMemory:
    """The most memory that the process has in a block above what it has before.

    Attributes:
        mib: after the block; None where the system does not tell (other than Linux).
    """

    mib: float | None = None

    def __enter__(self) -> PeakMemory:
        """Give free memory back to the system and begin anew."""
        if sys.platform == "linux":
            ctypes.CDLL(None).malloc_trim(0)
            CLEAR_REFS.write_text(RESET_PEAK)
        self._before = peak_memory_bytes()
        return self

    def __exit__(self, *error: object) -> None:
        """Read the peak."""
        if sys.platform == "linux":
            self.mib = (peak_memory_bytes() - self._before) / 2**20
