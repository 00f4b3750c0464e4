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
from collections.abc import Sequence
from pathlib import Path

from machine import describe_machine, table
from street import FOCAL_LENGTH_PX, IMAGE_SIZE, take_photographs, view_of

from colmap_affrect.colmap.poses import read_poses
from colmap_affrect.comparison.pose_scores import pose_scores

INTERVAL_S = 0.1
PROGRESS = re.compile(r"^([\w ()-]+): \d+/\d+ \w+")


def resident_mib(process_id: int) -> int:
    """Return the resident memory of a process and the one that works for it, 0 when both ended."""
    place = Path(f"/proc/{process_id}")
    try:
        status = (place / "status").read_text(encoding="ascii", errors="replace")
        workers = (place / "task" / str(process_id) / "children").read_text().split()
    except OSError:
        return 0
    own = next((int(s.split()[1]) >> 10 for s in status.splitlines() if s[:5] == "VmRSS"), 0)
    return own + sum(resident_mib(int(worker)) for worker in workers)


def watch(command: Sequence[str]) -> dict[str, list[tuple[float, int]]]:
    """Run a command; return for each stage of its progress (seconds, resident MiB) at moments.

    Raises:
        CalledProcessError: when it fails.
    """
    start, stages = time.perf_counter(), ["start"]
    moments: dict[str, list[tuple[float, int]]] = {}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:

        def look() -> None:
            while process.poll() is None:
                now = (time.perf_counter() - start, resident_mib(process.pid))
                moments.setdefault(stages[-1], []).append(now)
                time.sleep(INTERVAL_S)

        threading.Thread(target=look, daemon=True).start()
        for line in process.stderr or ():
            if found := PROGRESS.match(line):
                stages.append(found[1])
            else:
                print(line, end="", file=sys.stderr)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return moments


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
    rows = [
        (name, f"{seen[-1][0] - seen[0][0]:.0f}", f"{max(mib for _, mib in seen)}")
        for name, seen in watch(command).items()
    ]
    print(table(("stage", "seconds", "memory at most (MiB)"), rows))
    print(scores(arguments.output_path / "run" / "sparse" / "0", arguments.num_images))


if __name__ == "__main__":
    main()
