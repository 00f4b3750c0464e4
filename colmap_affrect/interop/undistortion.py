"""Undistorted photographs, by COLMAP in a process of its own, which ends when this one ends.

On a full disk COLMAP ends the process in which it works.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path

from colmap_affrect.colmap.native_writes import why_not_written
from colmap_affrect.errors import MAX_REASON, one_line
from colmap_affrect.parallel.subprocesses import end_with


def undistort(output_path: Path, model_path: Path, image_path: Path) -> None:
    """Write undistorted photographs with their model, as COLMAP's image undistorter does.

    Args:
        output_path: folder to be made.
        model_path: folder of the model.
        image_path: folder of its photographs.

    Raises:
        WorkspaceError: something cannot be written.
    """
    paths = [os.fspath(path) for path in (output_path, model_path, image_path)]
    done = subprocess.run(  # noqa: S603  (this Python and this module)
        # -P and the path: the package is found as it was here, not in the current folder.
        [sys.executable, "-P", "-m", __name__, str(os.getpid()), *paths],
        check=False,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        start_new_session=True,  # else Ctrl-C would reach it too
    )
    if not done.returncode:
        return
    said = one_line(done.stdout.decode("utf-8", "replace").strip())[:MAX_REASON]
    if done.returncode < 0:
        said = f"COLMAP was ended by {signal.Signals(-done.returncode).name}"
    raise why_not_written(output_path, RuntimeError(said or "COLMAP failed"))


def main() -> None:
    """Undistort in this process, and say in one line why that failed."""
    end_with(int(sys.argv[1]))
    from colmap_affrect.colmap import pycolmap

    try:
        output_path, model_path, image_path = sys.argv[2:]
        pycolmap.undistort_images(output_path, model_path, image_path)
    except Exception as error:  # noqa: BLE001 - the parent says it
        sys.stdout.write(str(error))
        sys.exit(1)


if __name__ == "__main__":
    main()
