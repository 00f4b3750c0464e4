"""``python -m colmap_affrect`` and ``colmap-affrect``: the first lines that run.

Nothing is imported here that takes time. Until :mod:`colmap_affrect.process` can handle Ctrl-C and
SIGTERM they are put off; Python alone would answer them with a traceback.
"""

import signal


def main() -> None:
    """Run the command line."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    from colmap_affrect.process import run_command

    run_command()


if __name__ == "__main__":
    main()
