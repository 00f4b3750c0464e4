"""Memory of large arrays is used again in processes of the command, and given back when asked."""

from __future__ import annotations

import subprocess
import sys

import pytest

WORK = """
import resource, threading
from pathlib import Path
import numpy as np
from colmap_affrect.parallel.freed_memory import keep_freed_memory, return_freed_memory

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def resident_pages():
    return int(Path("/proc/self/statm").read_text().split()[1])

def fill():
    return np.ones(12_500_000)  # 100 MB

def in_thread():
    thread = threading.Thread(target=fill)
    thread.start()
    thread.join()

{first}
in_thread()
before = faults()
in_thread()
print(faults() - before)
before = resident_pages()
return_freed_memory()
print(before - resident_pages())
"""
PAGES = 100_000_000 // 4096
can_keep = pytest.mark.skipif(
    sys.platform != "linux", reason="it is the C library of Linux that is changed"
)


def told(first: str) -> list[int]:
    """Return the page faults of a second array of 100 MB, and the pages given back then."""
    command = [sys.executable, "-c", WORK.format(first=first)]
    ended = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return [int(line) for line in ended.stdout.split()]


@can_keep
def test_large_arrays_are_used_again_also_in_other_threads() -> None:
    num_faults, num_returned = told("keep_freed_memory()")
    num_usual, _ = told("")
    assert num_faults < num_usual / 4
    assert num_returned > PAGES / 2
