"""Processes of our own end with the process that started them."""

import ctypes
import os
import signal
import sys
import threading
import time

# Linux: the signal that a process gets when its parent dies; format
PR_SET_PDEATHSIG = 1
WATCH_S = 0.5  # elsewhere: how often a process looks whether its parent lives; resource


def end_with(parent: int) -> None:
    """Make this process end when its parent, of this process id, has ended.

    On Linux the system kills it then, also in native code that holds Python's lock.
    """

    def wait_and_end() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os.kill(os.getpid(), signal.SIGKILL)

    if sys.platform != "linux":
        threading.Thread(target=wait_and_end, daemon=True).start()
        return
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before
        os.kill(os.getpid(), signal.SIGKILL)
