"""The longest silence of commands: how long a terminal shows nothing new while one works.

Each command runs in a pseudo-terminal, as people see it. A file has one command a line, without
the name of the program; lines that begin with # are passed over. Usage:

    python tests/benchmarks/silence.py --commands-path commands.txt --output-path out/silence.json

Prints a table. Silence counts from the beginning of the process, and up to its end.
"""

from __future__ import annotations

import errno
import json
import os
import select
import shlex
import signal
import subprocess
import sys
import termios
import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from machine import describe_machine, parser_of, table

HEADER = (
    "command",
    "seconds",
    "processor",
    "longest silence, s",
    "after",
    "ended with",
)
HEIGHT = 50  # lines of the terminal
WIDTH = 200  # columns of it
MAX_SHOWN = 60  # characters of what was last seen


@dataclass(frozen=True)
class Heard:
    """What a terminal showed of a command.

    Attributes:
        command: as it was given.
        wall_s: how long it ran.
        processor_s: of its processes.
        silence_s: the longest time without anything new.
        silent_from_s: when that began.
        seen_before: the last words before it.
        code: with which the command ended; negative: the signal.
    """

    command: str
    wall_s: float
    processor_s: float
    silence_s: float
    silent_from_s: float
    seen_before: str
    code: int


def listen(command: Sequence[str], max_s: float) -> Heard:
    """Run a command in a pseudo-terminal, and return when it was silent.

    Args:
        command: program and arguments.
        max_s: after which it is interrupted, as a server is; its silence counts until then.
    """
    near, far = os.openpty()
    termios.tcsetwinsize(far, (HEIGHT, WIDTH))  # bars take what there is
    environment = os.environ | {"TERM": "xterm"}
    begin_s = time.monotonic()
    before = os.times()
    process = subprocess.Popen(
        command, stdin=far, stdout=far, stderr=far, env=environment, close_fds=True
    )
    os.close(far)
    moments = [(0.0, "")]
    is_interrupted = False
    while True:
        passed_s = time.monotonic() - begin_s
        if passed_s > max_s and not is_interrupted:
            process.send_signal(signal.SIGINT)
            is_interrupted = True
        if not select.select([near], [], [], 0.1)[0]:
            continue
        text = _read(near)
        if not text:
            break
        moments.append((time.monotonic() - begin_s, text))
    os.close(near)
    code = process.wait()
    wall_s = time.monotonic() - begin_s
    after = os.times()
    children_s = after.children_user - before.children_user
    children_s += after.children_system - before.children_system
    moments.append((wall_s, ""))
    longest = max(
        range(1, len(moments)), key=lambda at: moments[at][0] - moments[at - 1][0]
    )
    from_s = moments[longest - 1][0]
    return Heard(
        command=shlex.join(command[3:]),
        wall_s=wall_s,
        processor_s=children_s,
        silence_s=moments[longest][0] - from_s,
        silent_from_s=from_s,
        seen_before=_last_words(moments[longest - 1][1]),
        code=code,
    )


def _read(terminal: int) -> str:
    """Return what a terminal shows next; empty at its end."""
    try:
        return os.read(terminal, 1 << 16).decode(errors="replace")
    except OSError as error:
        if error.errno == errno.EIO:  # the other side is closed
            return ""
        raise


def _last_words(text: str) -> str:
    """Return the end of what was seen, on one line of a table."""
    lines = text.replace("\r", "\n").split("\n")
    seen = [line.strip() for line in lines if line.strip()]
    return seen[-1][:MAX_SHOWN].replace("|", " ") if seen else ""


def row_of(heard: Heard) -> list[str]:
    """Return the cells of a command."""
    silence = f"{heard.silence_s:.1f}"
    place = f"{heard.silent_from_s:.0f} s: {heard.seen_before}".rstrip(": ")
    return [
        f"`{heard.command}`",
        f"{heard.wall_s:.0f}",
        f"{heard.processor_s:.0f}",
        silence,
        place,
        str(heard.code),
    ]


def parsed_arguments() -> Namespace:
    """Return what the command line says."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--commands-path", type=Path, required=True, help="text file, a command a line"
    )
    parser.add_argument("--output-path", type=Path, required=True, help="JSON file")
    parser.add_argument(
        "--max-s", type=float, default=600.0,
        help="seconds after which a command is interrupted",
    )  # fmt: skip
    return parser.parse_args()


def main() -> None:
    """Listen to the commands in turn, and print the table."""
    arguments = parsed_arguments()
    lines = arguments.commands_path.read_text(encoding="utf-8").splitlines()
    all_heard = []
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        command = [sys.executable, "-m", "colmap_affrect", *shlex.split(line)]
        all_heard.append(listen(command, arguments.max_s))
        values = {
            "machine": describe_machine(),
            "commands": [asdict(heard) for heard in all_heard],
        }
        arguments.output_path.write_text(json.dumps(values, indent=1) + "\n")
    print(table(HEADER, [row_of(heard) for heard in all_heard]))


if __name__ == "__main__":
    main()
