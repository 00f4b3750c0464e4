"""COLMAP through pycolmap, imported here and nowhere else."""

import signal
from contextlib import suppress

from colmap_affrect.project.atomic_files import uninterrupted

with uninterrupted():  # pycolmap takes Ctrl-C in its import for a broken installation
    import pycolmap

    with suppress(ValueError):  # imported by another thread
        # Its handler of SIGTERM would print a stack, and no handler of Python would be called.
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))

__all__ = ["pycolmap"]
