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
from colmap_affrect.errors import AffrectError
from colmap_affrect.parallel.subprocesses import end_with
from colmap_affrect.progress import Progress


def run_alone(run: MethodRun, title: str, progress: Progress) -> str:
    """Run a method in another process; return how that was lost, empty if it was not.

    What it prints goes to ``run.log`` in its folder. It is killed where this raises, as for Ctrl-C.
    """
    log_path = run.workspace.log
    with log_path.open("a", encoding="utf-8") as log:
        code = subprocess.run(  # noqa: S603  (this Python and this module)
            # -P and the path: the package is found as it was here, not in the current folder.
            [sys.executable, "-P", "-m", __name__, str(os.getpid())],
            check=False,
            input=pickle.dumps((run, title)),  # too long for an argument, with many photographs
            stdout=progress.file_number,
            stderr=log,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # else Ctrl-C would reach it too
        ).returncode
    if not code:
        return ""
    ending = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
    memory = " (perhaps for want of memory)" if code == -signal.SIGKILL else ""
    return f"its process ended {ending}{memory}; {log_path} may say why"


def main() -> None:
    """Run the method that is asked for: progress to stdout, all else that is printed to stderr."""
    end_with(int(sys.argv[1]))
    shown = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what others print
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s")
    run, title = pickle.load(sys.stdin.buffer)  # noqa: S301 (of our parent)
    run.progress = Progress(shown, 1, title)
    try:
        with run.workspace.locked():
            run.run()
    except AffrectError as error:
        run.keep(failed=str(error))
    except Exception as error:
        logging.exception("failed")
        run.keep(failed=f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
