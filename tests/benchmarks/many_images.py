"""Time, memory and errors of ``run`` on many images. Usage:

    python tests/benchmarks/many_images.py --output-path out/many --num-images 1000

Renders photographs of a street from random places, once, seven to the metre, and runs the command
on them in a process of its own, whose memory is looked at ten times a second. Prints a table of its
stages, and how many images of the largest model are where they were rendered.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from machine import describe_machine
from speed_report import table
from street import FOCAL_LENGTH_PX, IMAGE_SIZE, take_photographs, view_of

from colmap_affrect.comparison.metrics import pose_scores, read_poses

INTERVAL_S = 0.1
PROGRESS = re.compile(r"^([\w ()-]+): \d+/\d+ \w+")


@dataclass
class StageMemory:
    """What one stage took.

    Attributes:
        name: as in the progress of the command.
        first_s, last_s: since the start of the command.
        first_bytes, peak_bytes: resident memory at its begin and at most.
    """

    name: str
    first_s: float
    last_s: float
    first_bytes: int
    peak_bytes: int


def memory_bytes(process_id: int) -> int:
    """Return the resident memory of a process, 0 when it has ended."""
    try:
        status = Path(f"/proc/{process_id}/status").read_text(encoding="ascii", errors="replace")
    except OSError:
        return 0
    return next((int(s.split()[1]) << 10 for s in status.splitlines() if s[:5] == "VmRSS"), 0)


def watched(command: Sequence[str]) -> Iterator[StageMemory]:
    """Run a command; yield its stages as they begin, which change while they last.

    Raises:
        CalledProcessError: when it fails.
    """
    start = time.perf_counter()
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        current = StageMemory("start", 0.0, 0.0, 0, 0)

        def watch() -> None:
            while process.poll() is None:
                now = memory_bytes(process.pid)
                current.last_s = time.perf_counter() - start
                current.peak_bytes = max(current.peak_bytes, now)
                time.sleep(INTERVAL_S)

        threading.Thread(target=watch, daemon=True).start()
        yield current
        for line in process.stderr or ():
            found = PROGRESS.match(line)
            if found is None:
                print(line, end="", file=sys.stderr)
            elif found[1] != current.name:
                seconds, here = time.perf_counter() - start, memory_bytes(process.pid)
                current = StageMemory(found[1], seconds, seconds, here, here)
                yield current
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)


def scores(model_path: Path, count: int) -> str:
    """Compare a model with the places that the images were rendered from."""
    views = [view_of(number) for number in range(count)]
    truth = {view.name: (view.rotation, -view.rotation @ view.center) for view in views}
    found = pose_scores(read_poses(model_path), truth, list(truth))
    return (
        f"{len(found.correct_names)} of {count} images are registered correctly; median error of "
        f"{found.median_rotation_error_deg:.3f} degrees, {found.median_position_error:.4f} m"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output-path", type=Path, required=True)
    parser.add_argument("--num-images", type=int, default=1000)
    parser.add_argument("options", nargs="*", help="of run, after --; default: --pairs retrieval")
    arguments = parser.parse_args()
    photographs = arguments.output_path / "images"
    photographs.mkdir(parents=True, exist_ok=True)
    take_photographs(photographs, arguments.num_images)
    parameters = f"{FOCAL_LENGTH_PX},{FOCAL_LENGTH_PX},{IMAGE_SIZE[0] / 2},{IMAGE_SIZE[1] / 2}"
    command = [
        *(sys.executable, "-m", "colmap_affrect", "run", "--overwrite"),
        *("--image-path", str(photographs), "--output-path", str(arguments.output_path / "run")),
        *("--camera-mode", "single", "--camera-model", "PINHOLE", "--camera-params", parameters),
        *(arguments.options or ("--pairs", "retrieval")),
    ]
    print(describe_machine())
    stages = list(watched(command))
    header = ("stage", "seconds", "memory at its begin (MiB)", "at most (MiB)")
    rows = [
        (
            stage.name,
            f"{stage.last_s - stage.first_s:.0f}",
            f"{stage.first_bytes / 2**20:.0f}",
            f"{stage.peak_bytes / 2**20:.0f}",
        )
        for stage in stages
    ]
    print(table(header, rows))
    print(scores(arguments.output_path / "run" / "sparse" / "0", arguments.num_images))


if __name__ == "__main__":
    main()
