"""How much freed memory the C library of Linux keeps. Nothing heavy is imported here."""

import ctypes
import sys
from contextlib import suppress

# Of glibc's malloc.h
TRIM_THRESHOLD = -1  # format
MMAP_THRESHOLD = -3  # format
ARENA_MAX = -8  # format
# Arrays up to this size, of a photograph or a layer of a network, are taken from memory that was
# freed before; resource
MAX_ARRAY_BYTES = 1 << 30
# Freed memory that is kept above all that is in use; ALIKED frees 1.1 GB of a megapixel, and a
# network wants it again for the next photograph; resource
KEPT_BYTES = (1 << 31) - 1


def keep_freed_memory() -> None:
    """Let this process use freed memory again, instead of giving large arrays back at once.

    The system zeroes each page that it gives, one thread at a time: of the time of ALIKED in two
    threads that was three quarters. Arenas of threads hold no blocks above 64 MB, so all threads
    share the main one. Nothing changes where the library refuses such large blocks (before 2.35).
    """
    if sys.platform == "linux":
        with suppress(AttributeError):  # another C library than GNU's
            change = ctypes.CDLL(None).mallopt
            if change(MMAP_THRESHOLD, MAX_ARRAY_BYTES):
                change(TRIM_THRESHOLD, KEPT_BYTES)
                change(ARENA_MAX, 1)


def return_freed_memory() -> None:
    """Give freed memory back to the system."""
    if sys.platform == "linux":
        with suppress(AttributeError):  # another C library than GNU's
            ctypes.CDLL(None).malloc_trim(0)
