"""What happens to runs that are killed and disks that are full. Usage:

    python tests/benchmarks/campaign.py --output-path out/campaign --kills 150 --calls 100

Each trial disturbs a small run (of the sample scene, or of the folders given) by chance, lets it
end undisturbed, and compares features, matches, database and models byte by byte with those of a
run that nothing disturbed. Prints a line for each trial and a table; exits with 1 if anything was
lost or went wrong, and leaves the folders of such trials. Every second folder is run with all
stages, escalation and guided matches included. Damaged files and databases, exports and all other
commands: tests/robustness/test_campaign.py.

Calls are those of the system that change files, found and killed at by ``strace``; full disks are
file systems in memory, which only root can mount. The same seed makes the same choices, but
moments depend on how fast the machine is.
"""

from __future__ import annotations

import argparse
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from command import run_in_process_of_its_own
from machine import describe_machine, table
from results import (
    Undisturbed,
    assert_readable,
    end_again_and_again,
    results,
    run_arguments,
    run_undisturbed,
    tree,
)

SAMPLE = Path(__file__).parents[2] / "sample_scenes" / "courtyard" / "images"
KILLS_IN_ONE_FOLDER = 3
SMALL = ("--set", "max_image_size_px=320")
ALL_STAGES = ("--recipe", "on-demand", "--set", "guided.enabled=always")
CALLS = "write,pwrite64,fsync,fdatasync,rename,ftruncate,unlink,mkdir,rmdir,fallocate"


def content(out: Path) -> dict[str, Any]:
    """All results of a run: what :func:`results.results` has, and each file of the models."""
    models = tree(out / "sparse", times=False)
    return results(out) | {name: value for name, value in models.items() if name.endswith(".bin")}


@dataclass(frozen=True)
class Case:
    """Photographs, options, and the run that nothing disturbs."""

    photos: Path
    options: tuple[str, ...]
    folder: Path

    @cached_property
    def undisturbed(self) -> Undisturbed:
        """The run; made when it is first asked for."""
        return run_undisturbed(self.photos, self.folder / "undisturbed", self.options)

    @cached_property
    def content(self) -> dict[str, Any]:
        """Its results."""
        return content(self.undisturbed.out)

    @cached_property
    def calls(self) -> dict[str, list[int]]:
        """For each kind of call that changes files of the run, which ones of its thread do so."""
        out, trace = self.folder / "traced", self.folder / "trace.txt"
        run_traced(["-y", "-s", "0", "-o", trace], self.arguments(out))
        counts, found = Counter[tuple[str, str]](), defaultdict[str, list[int]](list)
        for line in trace.read_text(encoding="utf-8", errors="replace").splitlines():
            if called := re.match(r"(\d+) +(\w+)[(]", line):
                counts[called[1], called[2]] += 1
                if str(out) in line:
                    found[called[2]].append(counts[called[1], called[2]])
        return dict(found)

    def arguments(self, out: Path) -> list[str]:
        return run_arguments(self.photos, out, self.options)

    def assert_finishes(self, out: Path) -> None:
        """Run again without disturbance and have the same results."""
        end = run_in_process_of_its_own(*self.arguments(out))
        assert end.code == 0, end.stderr
        found = content(out)
        different = {
            key for key in {*self.content, *found} if found.get(key) != self.content.get(key)
        }
        assert not different, f"other {', '.join(different)} than of the undisturbed run"


def run_traced(options: Sequence[object], arguments: Sequence[str]) -> int:
    """Run under ``strace`` and return the exit code."""
    command = ["strace", "-f", "-qq", *map(str, options), "-e", f"trace={CALLS}"]
    command += [sys.executable, "-m", "colmap_affrect", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode


def kills(case: Case, out: Path, chance: random.Random) -> str:
    """Kill a run at random moments, several times in one folder."""
    signals = [signal.SIGKILL] * KILLS_IN_ONE_FOLDER
    worked_s = case.undisturbed.worked_s
    stages = end_again_and_again(case.photos, out, case.options, worked_s, signals, chance)
    case.assert_finishes(out)
    return ", ".join(stages)


def calls(case: Case, out: Path, chance: random.Random) -> str:
    """Kill a run when it enters a system call that changes a file of its results."""
    while True:
        kind = chance.choice(sorted(case.calls))
        number = chance.choice(case.calls[kind])
        inject = ["-e", f"inject={kind}:signal=SIGKILL:when={number}", "-o", "/dev/null"]
        if run_traced(inject, case.arguments(out)) != 0:
            break
        shutil.rmtree(out)
    assert_readable(out)
    case.assert_finishes(out)
    return kind


def disks(case: Case, out: Path, chance: random.Random) -> str:
    """Run on a disk that is too small, and again on one that has grown."""
    needed = sum(p.stat().st_size for p in case.undisturbed.out.rglob("*") if p.is_file())
    num_kib = chance.randrange(8, needed * 11 // 10 // 1024)
    disk = out.with_name("disk")
    disk.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={num_kib}k", "none", disk], check=True)
    try:
        end = run_in_process_of_its_own(*case.arguments(disk / "out"))
        if end.code:
            assert (end.code, len(end.stderr)) == (1, 1), end
            assert "free space" in end.stderr[0], end
        subprocess.run(["mount", "-o", "remount,size=2g", disk], check=True)
        case.assert_finishes(disk / "out")
    finally:
        subprocess.run(["umount", disk], check=True)
    return f"{num_kib} KiB, exit code {end.code}"


TRIALS: dict[str, tuple[Callable[[Case, Path, random.Random], str], int, str]] = {
    "kills": (kills, KILLS_IN_ONE_FOLDER, "at random moments"),
    "calls": (calls, 1, "kills at system calls"),
    "disks": (disks, 1, "that are full"),
}
"""Kinds of trials, how many disturbances each has, and what these are."""


def campaign(cases: Sequence[Case], kind: str, count: int, seed: int, folder: Path) -> list[str]:
    """Make trials of a kind; return what went wrong."""
    trial, num_each, _ = TRIALS[kind]
    wrong = []
    for index in range(-(-count // num_each)):
        case, begun = cases[index % len(cases)], time.monotonic()
        name = f"{kind} {index} ({case.folder.name})"
        out = folder / f"{kind}-{index}"
        shutil.rmtree(out, ignore_errors=True)
        try:
            said = trial(case, out, random.Random(f"{seed} {kind} {index}"))
            shutil.rmtree(out, ignore_errors=True)
        except (AssertionError, subprocess.TimeoutExpired) as error:
            said = f"WRONG: {error}"
            wrong.append(f"{name}: {said}")
        print(f"{name}: {said}; {time.monotonic() - begun:.0f} s", flush=True)
    return wrong


def main() -> int:
    """Make the trials and print a table of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output-path", type=Path, required=True)
    parser.add_argument("--image-path", type=Path, nargs="+", default=[SAMPLE])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kills", type=int, default=0, help=TRIALS["kills"][2])
    parser.add_argument("--calls", type=int, default=0, help=TRIALS["calls"][2])
    parser.add_argument("--disks", type=int, default=0, help=TRIALS["disks"][2])
    arguments = parser.parse_args()
    folder = arguments.output_path.resolve()
    cases = []
    for number, path in enumerate(arguments.image_path):
        options = SMALL if number % 2 else (*SMALL, *ALL_STAGES)
        cases.append(Case(path.resolve(), options, folder / path.parent.name))
        shutil.rmtree(cases[-1].folder, ignore_errors=True)
        cases[-1].folder.mkdir(parents=True)
    print(describe_machine(), flush=True)
    rows, wrong = [], []
    for kind in TRIALS:
        if count := vars(arguments)[kind]:
            found = campaign(cases, kind, count, arguments.seed, folder)
            rows.append((kind, str(count), str(len(found))))
            wrong += found
    print(table(("trials", "disturbances", "trials that went wrong"), rows))
    print("\n".join(wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
