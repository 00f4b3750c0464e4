"""The command line for tests: arguments for the small scene, and how a command ended."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from small_scene import INTRINSICS

CAMERA = [
    "--camera-mode",
    "per-image",
    "--camera-model",
    "PINHOLE",
    "--camera-params",
    INTRINSICS,
]
FAST = ["--recipe", "unrectified-rootsift", *CAMERA]


def pair_list(folder: Path, *names: str) -> Path:
    """Write a list of one pair."""
    path = folder / "list.txt"
    path.write_text("\t".join(names) + "\n", encoding="utf-8")
    return path


class Ended(NamedTuple):
    """How a command ended: exit code, what it printed, the lines of stderr."""

    code: int
    stdout: str
    stderr: list[str]

    @property
    def errors(self) -> list[str]:
        """Lines that say why the command failed."""
        return [line for line in self.stderr if line.startswith("error: ")]

    @property
    def report(self) -> dict[str, Any]:
        """The report that --json printed."""
        report: dict[str, Any] = json.loads(self.stdout)
        return report


Call = Callable[..., Ended]


def on_photographs(photos: Path, out: Path) -> list[str]:
    """Return the options of a fast run on photographs of the small scene."""
    return ["--image-path", str(photos), "--output-path", str(out), *FAST]


def start(
    *arguments: object,
    python: Sequence[str] = (),
    stderr: int = subprocess.PIPE,
    start_new_session: bool = False,
) -> subprocess.Popen[str]:
    """Start the command line in a process of its own, which Ctrl-C ends.

    Test runners in the background ignore SIGINT, and their children inherit that.
    """
    return subprocess.Popen(
        [sys.executable, *python, "-m", "colmap_affrect", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        start_new_session=start_new_session,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509 - no threads
    )


def run_in_process_of_its_own(*arguments: object, python: Sequence[str] = ()) -> Ended:
    """Run the command line in a process of its own."""
    with start(*arguments, python=python) as process:
        stdout, stderr = process.communicate(timeout=120)
    return Ended(process.returncode, stdout, stderr.splitlines())
