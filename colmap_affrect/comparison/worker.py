"""One method of a comparison, in a process of its own: ``python -m ... TASK``.

Its peak memory is the method's, and when it dies the other methods go on. What was done stays:
run again, it goes on. Progress goes to stdout; everything else that is printed goes to stderr.
"""

import logging
import os
import pickle
import sys
from base64 import b64decode

from colmap_affrect.errors import AffrectError
from colmap_affrect.parallel.subprocesses import end_with
from colmap_affrect.progress import Progress
from colmap_affrect.project.atomic_files import replace_text

logger = logging.getLogger("colmap_affrect")


def main() -> None:
    """Run the method that is asked for, unless the parent ends before."""
    end_with(int(sys.argv[2]))
    shown = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what others print
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.addHandler(handler)
    method, title = pickle.loads(b64decode(sys.argv[1]))  # noqa: S301 (of our parent)
    method.progress = Progress(shown, 1).titled(title)
    try:
        with method.workspace.locked():
            method.run()
    except AffrectError as error:
        replace_text(method.failure, str(error))
    except Exception as error:
        logger.exception("failed")
        replace_text(method.failure, f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
