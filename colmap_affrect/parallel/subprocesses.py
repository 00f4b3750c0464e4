"""Python processes of our own that end with the process that started them.

Started by their module's name, not by ``multiprocessing``, which would run a user's script again.
"""

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

PR_SET_PDEATHSIG = 1  # Linux: the signal that a process gets when its parent dies
WATCH_S = 0.5  # elsewhere: how often a process looks whether its parent lives


@contextmanager
def child(
    module: str,
    argument: str,
    *,
    stdout: int = subprocess.PIPE,
    stderr: IO[str] | None = None,
) -> Iterator[subprocess.Popen[str]]:
    """Run a module of this package with one argument and our process id.

    Its stdout is piped where nothing else is said.
    If the block raises, also for Ctrl-C, the child is killed; otherwise it is waited for. The
    module must call :func:`end_with` first, with the process id.
    """
    # -P and the path: the package is found as it was here, and nothing in the current folder.
    search_path = os.pathsep.join(filter(None, sys.path))
    with subprocess.Popen(  # noqa: S603  (this Python and a module of ours)
        [sys.executable, "-P", "-m", module, argument, str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        env={**os.environ, "PYTHONPATH": search_path},
        start_new_session=True,  # else Ctrl-C would reach it too
        encoding="utf-8",
        errors="replace",
    ) as process:
        try:
            yield process
            process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise


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
