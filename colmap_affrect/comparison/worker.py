"""A method of a comparison in a process of its own, which ends when this one ends.

Started by the name of this module: ``multiprocessing`` would run a user's script again.
"""

import logging
import os
import pickle
import signal
import subprocess
import sys

from colmap_affrect.comparison.method_run import MethodRun
from colmap_affrect.errors import AffrectError, with_flags
from colmap_affrect.parallel.subprocesses import end_with
from colmap_affrect.progress import Progress


def run_alone(run: MethodRun, title: str, progress: Progress) -> str:
    """Run a method in another process.

    What that prints goes to ``run.log`` in the folder of the method. The process is killed where
    this function raises, as for Ctrl-C.

    Args:
        run: the method.
        title: what its progress begins with.
        progress: where to show it.

    Returns:
        How the process died; empty if it did not.
    """
    log_path = run.workspace.log
    # -P and the path: the package is found as it was here, not in the current folder.
    command = [sys.executable, "-P", "-m", __name__, str(os.getpid())]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with log_path.open("a", encoding="utf-8") as log:
        # With many photographs the input is too long for an argument.
        code = subprocess.run(  # noqa: S603  (this Python and this module)
            command,
            check=False,
            input=pickle.dumps((run, title)),
            stdout=progress.file_number,
            stderr=log,
            env=environment,
            start_new_session=True,  # else Ctrl-C would reach it too
        ).returncode
    if not code:
        return ""
    if code == -signal.SIGKILL:
        ending = "by SIGKILL (perhaps for want of memory)"
    elif code < 0:
        ending = f"by {signal.Signals(-code).name}"
    else:
        ending = f"with exit code {code}"
    return f"its process ended {ending}; {log_path} may say why"


def main() -> None:
    """Run the method that the parent sends; its progress goes to stdout, all else to stderr."""
    end_with(int(sys.argv[1]))
    # By lines: else they come all at once, when the process ends
    shown = os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8")
    os.dup2(2, 1)  # what others print
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s")
    run, title = pickle.load(sys.stdin.buffer)  # noqa: S301 (from the parent)
    run.progress = Progress(shown, 1, title)
    try:
        with run.workspace.locked(), run.progress.never_silent():
            run.run()
    except AffrectError as error:
        run.keep(failed=with_flags(error.words))
    except Exception as error:
        logging.exception("failed")
        run.keep(failed=f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
