"""Runs that are killed, whose disk is full, or that have fewer cores leave the same results.

    CAMPAIGN=50 pytest -m long --dist load tests/robustness/test_interruption.py

makes fifty times as many kills by chance; every second folder is run with all stages, escalation
and guided matches included. The same number makes the same choices, but moments depend on how fast
the machine is. A limit on the size of files stands for a full disk: what goes beyond it fails in
the same calls.
"""

from __future__ import annotations

import errno
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest
from command import CAMERA, FAST, Call, Ended, run_in_process_of_its_own, start
from results import differences, hdf5_content, results, tree

from colmap_affrect.colmap.database import image_ids
from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.project.atomic_files import FileTransaction, journal_of
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.workspace import Workspace

pytestmark = pytest.mark.long

TIMES = int(os.environ.get("CAMPAIGN", "1"))
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGKILL)
CALLS = "write,pwrite64,fsync,fdatasync,rename,ftruncate,unlink,mkdir,rmdir,fallocate"
"""System calls that change files."""


@dataclass(frozen=True)
class Case:
    """A run that is to be disturbed, and in ``folder / "out"`` the same without disturbance."""

    photos: Path
    options: Sequence[str]
    folder: Path

    def arguments(self, out: Path) -> list[str]:
        paths = ["run", "--image-path", self.photos, "--output-path", out, "-q"]
        return [str(argument) for argument in (*paths, *self.options)]

    @cached_property
    def worked_s(self) -> float:
        """Run without disturbance; return the seconds from the first line in the log to the end."""
        with start(*self.arguments(self.folder / "out")) as process:
            wait_until_at_work(process, self.folder / "out")
            begun = time.monotonic()
            process.communicate(timeout=300)
        assert process.returncode == 0
        return time.monotonic() - begun

    @cached_property
    def content(self) -> dict[str, Any]:
        assert self.worked_s
        return content(self.folder / "out")

    @cached_property
    def calls(self) -> dict[str, list[int]]:
        """For each kind of call that changes files of the run, which ones of its thread do so."""
        out = self.folder / "traced"
        trace = self.folder / "trace.txt"
        run_traced(["-y", "-s", "0", "-o", trace], self.arguments(out))
        counts = Counter[tuple[str, str]]()
        found = defaultdict[str, list[int]](list)
        for line in trace.read_text(encoding="utf-8", errors="replace").splitlines():
            if called := re.match(r"(\d+) +(\w+)[(]", line):
                counts[called[1], called[2]] += 1
                if str(out) in line:
                    found[called[2]].append(counts[called[1], called[2]])
        return dict(found)

    def assert_finishes(self, out: Path) -> None:
        """Run again without disturbance and have the same results."""
        ended = run_in_process_of_its_own(*self.arguments(out))
        assert ended.code == 0, ended.stderr
        assert differences(self.content, content(out)) == []


def content(out: Path) -> dict[str, Any]:
    """All results of a run: what :func:`results.results` has, and each file of the models."""
    models = tree(out / "sparse", times=False)
    return results(out) | {
        name: value for name, value in models.items() if name.endswith(".bin")
    }


def wait_until_at_work(process: subprocess.Popen[str], out: Path) -> None:
    """Wait until a run has written into its log."""
    log = Workspace(out).log

    def size() -> int:
        return log.stat().st_size if log.exists() else 0

    before = size()
    while size() == before and process.poll() is None:
        time.sleep(0.005)


def end_after(
    delay_s: float, number: signal.Signals, arguments: Sequence[str], out: Path
) -> bool:
    """Start a run and send it a signal; return whether it was still at work then."""
    with start(*arguments) as process:
        wait_until_at_work(process, out)
        time.sleep(delay_s)
        process.send_signal(number)
        _, stderr = process.communicate(timeout=300)
    assert "Traceback" not in stderr, stderr
    ended = -number if number == signal.SIGKILL else 128 + number
    assert process.returncode in (0, ended), stderr
    return process.returncode != 0


def wait_until_signals_are_put_off(pid: int) -> None:
    """Wait until the first function of the command runs; before that Python starts."""
    blocked = 0
    while not blocked & 1 << signal.SIGINT - 1:
        status = Path(f"/proc/{pid}/status").read_text()
        blocked = int(re.search(r"^SigBlk:\t(\w+)", status, re.MULTILINE)[1], 16)


@pytest.mark.skipif(
    sys.platform != "linux", reason="other systems do not tell what is put off"
)
@pytest.mark.parametrize("send", [os.kill, os.killpg])
@pytest.mark.parametrize("times", [1, 2])
def test_interrupt_while_a_command_starts_ends_it_at_once_with_one_line(
    photos: Path, tmp_path: Path, send: Callable[[int, int], None], times: int
) -> None:
    """After delays up to 0.6 s, most of them while packages are loaded."""
    for number in range(30 * TIMES):
        out = tmp_path / str(number)
        arguments = ["run", "--image-path", photos, "--output-path", out, *FAST]
        with start(*arguments, start_new_session=True) as process:
            wait_until_signals_are_put_off(process.pid)
            time.sleep(0.6 * number / (30 * TIMES - 1))
            sent = time.monotonic()
            for _ in range(times):
                send(process.pid, signal.SIGINT)
                time.sleep(0.03)
            _, stderr = process.communicate(timeout=60)
        assert time.monotonic() - sent < 3.0
        assert process.returncode == 130, stderr
        lines = [
            line for line in stderr.splitlines() if not line.startswith("extract: ")
        ]
        assert lines == ["interrupted; run the same command again to go on"], number


def run_traced(options: Sequence[object], arguments: Sequence[str]) -> int:
    """Run under ``strace`` and return the exit code."""
    command = ["strace", "-f", "-qq", *map(str, options), "-e", f"trace={CALLS}"]
    command += [sys.executable, "-m", "colmap_affrect", *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode


def assert_readable(out: Path) -> None:
    """Every file that is there can be read as it lies there; an HDF5 file with its journal."""
    workspace = Workspace(out)
    workspace.record()
    for path in (workspace.features, workspace.matches):
        if path.exists() and not journal_of(path).exists():
            hdf5_content(path)
    if workspace.database.exists():
        image_ids(workspace.database)


@pytest.fixture(scope="module")
def cases(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Case]:
    """A fast run, and one of all stages; they are run when they are first asked for."""
    every = [*CAMERA, "--recipe", "on-demand", "--set", "guided.enabled=always"]
    return [
        Case(photos, options, tmp_path_factory.mktemp("case"))
        for options in (FAST, every)
    ]


@pytest.mark.parametrize("number", range(2 * TIMES))
def test_runs_ended_again_and_again_have_the_results_of_an_undisturbed_one(
    cases: list[Case], tmp_path: Path, number: int
) -> None:
    case = cases[number % 2]
    chance = random.Random(number)
    out = tmp_path / "out"
    for index, sent in enumerate(SIGNALS):
        # What is done stays done: later runs are nearer to their end.
        delay_s = chance.uniform(0.0, case.worked_s / (index + 1))
        while not end_after(delay_s, sent, case.arguments(out), out):
            shutil.rmtree(out)
            delay_s /= 2
        assert_readable(out)
    case.assert_finishes(out)


@pytest.mark.skipif(not shutil.which("strace"), reason="strace is missing")
@pytest.mark.parametrize("number", range(2 * TIMES))
def test_runs_killed_when_they_enter_a_system_call_lose_nothing(
    cases: list[Case], tmp_path: Path, number: int
) -> None:
    case = cases[number % 2]
    chance = random.Random(number)
    out = tmp_path / "out"
    code = 0
    while not code:
        shutil.rmtree(out, ignore_errors=True)
        kind = chance.choice(sorted(case.calls))
        when = chance.choice(case.calls[kind])
        inject = ["-e", f"inject={kind}:signal=SIGKILL:when={when}", "-o", "/dev/null"]
        code = run_traced(inject, case.arguments(out))
    assert_readable(out)
    case.assert_finishes(out)


def mounted(*command: object) -> bool:
    done = subprocess.run(
        ["mount", *map(str, command)], capture_output=True, check=False
    )
    return done.returncode == 0


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a disk")
@pytest.mark.parametrize("number", range(TIMES))
def test_runs_on_full_disks_go_on_when_these_have_grown(
    cases: list[Case], tmp_path: Path, number: int
) -> None:
    case = cases[number % 2]
    disk = tmp_path / "disk"
    assert case.worked_s
    needed = sum(
        p.stat().st_size for p in (case.folder / "out").rglob("*") if p.is_file()
    )
    num_kib = random.Random(number).randrange(8, needed // 1024)
    disk.mkdir()
    if not mounted("-t", "tmpfs", "-o", f"size={num_kib}k", "none", disk):
        pytest.skip("no disk can be mounted here")
    try:
        ended = run_in_process_of_its_own(*case.arguments(disk / "out"))
        if ended.code:
            assert (ended.code, len(ended.stderr)) == (1, 1), ended
            assert "free space" in ended.stderr[0], ended
        assert mounted("-o", "remount,size=2g", disk)
        case.assert_finishes(disk / "out")
    finally:
        subprocess.run(["umount", disk], check=True)


@contextmanager
def file_size_limit(num_bytes: int) -> Iterator[None]:
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


def assert_says_what_to_do(ended: Ended, path: Path) -> None:
    """One line that names a file and says to free space."""
    assert (ended.code, ended.stdout) == (1, "")
    (line,) = ended.stderr
    assert line.startswith(f"error: {path}: ")
    assert "free space" in line
    assert "run the same command again" in line


@pytest.mark.parametrize("passing", [2, 4])
def test_hdf5_write_that_fails_loses_nothing_else(
    cases: list[Case],
    tmp_path: Path,
    call: Call,
    monkeypatch: pytest.MonkeyPatch,
    passing: int,
) -> None:
    workspace = Workspace(tmp_path / "out")
    calls = []
    commit = FileTransaction.commit

    def full(changes: FileTransaction) -> None:
        calls.append(changes)
        if len(calls) > passing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        commit(changes)

    with monkeypatch.context() as patch:
        patch.setattr(FileTransaction, "commit", full)
        ended = call(*cases[0].arguments(workspace.path))
    assert_says_what_to_do(
        ended, workspace.features if passing < 4 else workspace.matches
    )
    assert len(FeatureStore(workspace.features).names()) == passing
    cases[0].assert_finishes(workspace.path)


def test_record_of_options_that_does_not_fit_on_the_disk(
    cases: list[Case], tmp_path: Path, call: Call
) -> None:
    workspace = Workspace(tmp_path / "out")
    with file_size_limit(700):
        assert_says_what_to_do(
            call(*cases[0].arguments(workspace.path)), workspace.config
        )
    assert not workspace.config.exists()
    assert not workspace.features.exists()


def test_model_that_does_not_fit_on_the_disk_is_not_taken_for_whole(
    cases: list[Case], tmp_path: Path, call: Call
) -> None:
    # pycolmap writes what fits and says nothing.
    workspace = Workspace(tmp_path / "out")
    assert cases[0].worked_s
    shutil.copytree(cases[0].folder / "out", workspace.path)
    shutil.rmtree(workspace.sparse)
    workspace.report.unlink()
    with file_size_limit(50_000):
        ended = call(*cases[0].arguments(workspace.path))
    assert_says_what_to_do(ended, workspace.path / "sparse.partial" / "0")
    assert not workspace.sparse.exists()
    assert not workspace.report.exists()
    cases[0].assert_finishes(workspace.path)


def run_on_cores(cores: set[int], photos: Path, out: Path) -> dict[str, object]:
    """Run on some of the cores only, in a process of its own."""
    usual = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)  # which the process inherits
    try:
        case = Case(photos, [*CAMERA, "--random-seed", "7"], out.parent)
        assert run_in_process_of_its_own(*case.arguments(out)).code == 0
    finally:
        os.sched_setaffinity(0, usual)
    return results(out)


@pytest.mark.skipif(available_cores() < 2, reason="needs two cores")
def test_results_do_not_depend_on_the_number_of_cores(
    photos: Path, tmp_path: Path
) -> None:
    cores = sorted(os.sched_getaffinity(0))
    one = run_on_cores({cores[0]}, photos, tmp_path / "one")
    assert one["registered"]
    assert run_on_cores(set(cores[:2]), photos, tmp_path / "two") == one
