"""Python processes of our own that end with the process that started them.

Started by their module's name, not by ``multiprocessing``, which would run a user's script again.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO


@contextmanager
def child(
    module: str, argument: str, *, stderr: IO[str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Run a module of this package with one argument; its stdout is piped.

    If the block raises, also for Ctrl-C, the child is killed; otherwise it is waited for. The
    module must call :func:`end_with_parent` first.
    """
    # -P and the path: the package is found as it was here, and nothing in the current folder.
    search_path = os.pathsep.join(filter(None, sys.path))
    with subprocess.Popen(  # noqa: S603  (this Python and a module of ours)
        [sys.executable, "-P", "-m", module, argument],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
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


def end_with_parent() -> None:
    """Make this process end when the one that started it ends, which closes our stdin."""

    def wait_and_end() -> None:
        os.read(sys.stdin.fileno(), 1)  # nothing is ever sent: it returns when the pipe is closed
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=wait_and_end, daemon=True).start()
