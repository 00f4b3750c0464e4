"""COLMAP through pycolmap, imported here and nowhere else."""

import os
import signal
import sys
from contextlib import suppress

from colmap_affrect.project.atomic_files import uninterrupted

was_there = "pycolmap" in sys.modules
with uninterrupted():  # pycolmap takes Ctrl-C in its import for a broken installation
    import pycolmap

    with suppress(ValueError):  # imported by another thread
        # Its handler of SIGTERM would print a stack, and no handler of Python would be called.
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))

if not was_there and "GLOG_log_dir" not in os.environ:
    # COLMAP would leave hidden files with the same lines in the folder for temporary files.
    pycolmap.logging.logtostderr = True

if not was_there and "ipykernel" in sys.modules:
    # In a notebook its lines on every step would stand between bars of progress.
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value

__all__ = ["pycolmap"]
