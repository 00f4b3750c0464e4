"""The command line in processes of its own: streams, terminals and Ctrl-C."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command import on_photographs, run_in_process_of_its_own, start
from exported_model import write_model

from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.workspace import Workspace

TIMEOUT_S = 60


@pytest.mark.long
def test_json_goes_to_stdout_alone_and_progress_to_stderr(
    photos: Path, tmp_path: Path
) -> None:
    done = run_in_process_of_its_own(
        "run", *on_photographs(photos, tmp_path / "out"), "--json"
    )
    assert done.code == 0, done.stderr
    report = done.report
    assert report["images_registered"] == 3
    assert report == json.loads(
        (tmp_path / "out" / "report.json").read_text(encoding="utf-8")
    )
    lines = done.stderr
    printed = "\n".join(["", *lines])
    assert "\nextract: 3/3 images" in printed
    assert "\nmatch: 3/3 pairs" in printed
    # What COLMAP prints is in the log.
    stages = ("extract", "match", "verify", "map", "pictures")
    assert all(line.split(":")[0] in stages for line in lines)
    log = (tmp_path / "out" / "run.log").read_text(encoding="utf-8")
    assert "colmap-affrect" in log
    assert ".cc:" in log


@pytest.mark.long
@pytest.mark.parametrize("line", ["extract: 1/3 images", "match: 1/3 pairs"])
def test_interrupt_ends_with_130_and_a_later_run_completes(
    photos: Path, tmp_path: Path, line: str
) -> None:
    arguments = ["run", *on_photographs(photos, tmp_path / "out")]
    with start(*arguments) as process:
        printed = process.stderr.readline().strip()
        while not printed.startswith(line):
            assert printed, process.wait()
            printed = process.stderr.readline().strip()
        os.kill(process.pid, signal.SIGINT)
        stdout, stderr = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, stdout) == (130, "")
    lines = stderr.splitlines()
    assert lines[-1] == "interrupted; run the same command again to go on"
    stages = ("extract: ", "match: ", "verify: ", "map: ")
    assert all(text.startswith(stages) for text in lines[:-1])
    assert not Workspace(tmp_path / "out").report.exists()
    done = run_in_process_of_its_own(*arguments, "-q")
    assert (done.code, done.stderr) == (0, [])
    assert done.stdout.startswith("registered  3 of 3 images")


SAID_OF_SLOW_ONES = ("loading: ", "map: ")
"""How lines begin that are printed where a machine has much else to do."""
ENDLESS = {
    "incremental": [
        "ba_global_max_refinements=1000000000", "ba_global_max_refinement_change=0",
    ],
    "global": ["max_num_irls_iterations=1000000000", "irls_step_convergence_threshold=-1"],
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_interrupted_mapping_ends_with_130_and_leaves_no_half_written_models(
    verified: Path, tmp_path: Path, mapper: str
) -> None:
    out = Path(shutil.copytree(verified, tmp_path / "out"))
    arguments = ["map", "--output-path", str(out), "--mapper", mapper, "--overwrite"]
    with start(*arguments, "--mapper-options", *ENDLESS[mapper]) as process:
        if mapper == "incremental":
            assert process.stderr.readline() == "map: 2/3 images\n"
        while not (out / "sparse.partial" / "raw").exists():
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGINT)
        stdout, stderr = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, stdout) == (130, "")
    *before, last = stderr.splitlines()
    assert last == "interrupted; run the same command again to go on"
    assert all(line.startswith(SAID_OF_SLOW_ONES) for line in before), before
    assert not list(out.glob("sparse*"))
    assert not (out / "report.json").exists()
    done = run_in_process_of_its_own(*arguments, "-q")
    assert (done.code, done.stderr) == (0, [])
    assert done.stdout.startswith("registered  3 of 3 images\n")
    assert f"preset      sparse, {mapper} mapper\n" in done.stdout


AS_PROCESS = """
import collections, ctypes, itertools, time
from colmap_affrect import __main__, cli
def tidy_up_for_ever():
    try:
        print("working", flush=True)
        time.sleep(60)
    finally:
        print("tidying up", flush=True)
        time.sleep(60)
cli.main = lambda begin: (begin(), print("begun", flush=True), WORK)
__main__.main()
"""
STUCK = (
    "collections.deque(itertools.repeat(0), maxlen=0)"  # holds Python's lock for ever
)


def start_stuck(work: str) -> subprocess.Popen[str]:
    """Start the command line with other work, and wait until that has begun."""
    process = subprocess.Popen(
        [sys.executable, "-c", AS_PROCESS.replace("WORK", work)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    assert process.stdout.readline() == "begun\n"
    return process


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("send", [os.kill, os.killpg])
def test_native_code_that_does_not_return_is_left(number: signal.Signals, send) -> None:
    with start_stuck(STUCK) as process:
        begin = time.monotonic()
        while process.poll() is None:  # who is impatient does not have to wait longer
            assert time.monotonic() - begin < 5.0
            send(process.pid, number)
            time.sleep(0.5)
        _, stderr = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, stderr.splitlines()) == (
        128 + number,
        ["interrupted; run the same command again to go on"],
    )


@pytest.mark.long
@pytest.mark.parametrize("send", [os.kill, os.killpg])
def test_second_interrupt_ends_a_command_that_tidies_up_at_once(send) -> None:
    with start_stuck("tidy_up_for_ever()") as process:
        assert process.stdout.readline() == "working\n"
        send(process.pid, signal.SIGINT)
        assert process.stdout.readline() == "tidying up\n"
        begin = time.monotonic()
        send(process.pid, signal.SIGINT)
        _, stderr = process.communicate(timeout=TIMEOUT_S)
    assert time.monotonic() - begin < 2.0
    assert process.returncode == 130
    assert stderr == "interrupted; run the same command again to go on\n"


@pytest.mark.long
def test_crash_in_native_code_is_one_line() -> None:
    with start_stuck("ctypes.string_at(1)") as process:
        _, stderr = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 1
    assert [
        line.startswith("error: ended by SIGSEGV; ") for line in stderr.splitlines()
    ] == [True]


@pytest.mark.long
def test_worker_ends_with_the_process_that_was_started() -> None:
    with start_stuck(STUCK) as process:
        process.kill()
        process.communicate(
            timeout=5.0
        )  # which the worker's end of the pipe would keep open


@pytest.mark.long
@pytest.mark.parametrize(
    "closed",
    [
        (0, 1, 2),
        *(pytest.param((number,), marks=pytest.mark.long) for number in (1, 2)),
    ],
)
def test_streams_that_are_closed_stop_nothing(
    photos: Path, tmp_path: Path, closed: tuple[int, ...]
) -> None:
    extract = ["extract", *on_photographs(photos, tmp_path / "out"), "-q"]

    def close() -> None:
        for number in closed:
            os.close(number)

    done = subprocess.run(
        [sys.executable, "-m", "colmap_affrect", *extract],
        stdout=subprocess.PIPE, text=True, check=False, timeout=TIMEOUT_S,
        preexec_fn=close,
    )  # fmt: skip
    assert done.returncode == 0
    assert done.stdout.startswith("extract: 3 done" if 1 not in closed else "")
    assert FeatureStore(tmp_path / "out" / "features.h5").num_keypoints()


def test_native_code_that_ends_the_command_is_named() -> None:
    code = "import os\nfrom colmap_affrect import __main__, cli\n"
    code += "cli.main = lambda begin: os._exit(1)\n"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}__main__.main()"],
        capture_output=True, text=True, check=False, timeout=TIMEOUT_S,
    )  # fmt: skip
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        "error: native code ended the command with exit code 1 (perhaps for"
    )


def run_as_command(main: str) -> tuple[str, str, float]:
    """Run Python code as the command line; return what it prints, and how long it took."""
    code = "import atexit, ctypes, time\nfrom colmap_affrect import __main__, cli, process\n"
    code += f"process.QUIET_S = 0.2\nprocess.TICK_S = 0.05\ncli.main = {main}\n"
    begin_s = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", f"{code}__main__.main()"],
        capture_output=True, text=True, check=False, timeout=TIMEOUT_S,
    )  # fmt: skip
    return done.stdout, done.stderr, time.monotonic() - begin_s


def test_loading_is_told_while_native_code_holds_the_lock_of_python() -> None:
    loads = "ctypes.PyDLL(None).usleep(600_000)"
    _, before, _ = run_as_command(f"lambda begin: ({loads}, begin(), 0)[-1]")
    assert before.startswith("loading: at work for ")
    assert "loading: done in " in before
    _, quiet, _ = run_as_command("lambda begin: (begin(), time.sleep(0.6), 0)[-1]")
    assert quiet.count("at work") <= 2  # at most of what was before the beginning


def test_a_command_ends_without_taking_apart_what_is_loaded() -> None:
    ends = "atexit.register(print, 'tidied up')"
    slow = "setattr(cli, 'slow', type('Slow', (), {'__del__': lambda _: time.sleep(20)})())"
    printed, _, wall_s = run_as_command(
        f"lambda begin: (begin(), {ends}, {slow}, 0)[-1]"
    )
    assert printed == "tidied up\n"
    assert wall_s < 15.0


def test_want_of_memory_while_packages_are_loaded_is_one_line() -> None:
    code = (
        "import sys, types\nfrom colmap_affrect import __main__\n"
        "class Full:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'colmap_affrect.cli':\n"
        "            raise ImportError('x.so: failed to map segment from shared object')\n"
        "sys.meta_path.insert(0, Full())\n__main__.main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, check=False, timeout=TIMEOUT_S,
    )  # fmt: skip
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: not enough memory; ")


@pytest.mark.long
@pytest.mark.parametrize(("encoding", "shown"), [
    ("ascii", b"out \\u010d\\u00e9\\ud83d\\ude00"),
    ("cp1252:strict", b"out \\u010d\xe9\\ud83d\\ude00"),
    ("utf-8", "out čé😀".encode()),
])  # fmt: skip
def test_output_has_any_encoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str, shown: bytes
) -> None:
    """What an encoding lacks is escaped as JSON has it; the exit codes are the usual ones."""
    write_model(tmp_path / "model")
    monkeypatch.setenv("PYTHONIOENCODING", encoding)
    command = [
        sys.executable,
        "-m",
        "colmap_affrect",
        "export",
        "--model-path",
        tmp_path / "model",
    ]
    for code in (0, 2):  # the second time the files are there
        given = ["--output-path", tmp_path / "out čé😀", "--format", "cameras"]
        ended = subprocess.run([*command, *given], check=False, capture_output=True)
        printed = ended.stderr if code else ended.stdout
        assert (ended.returncode, shown in printed) == (code, True), ended
        assert len(printed.splitlines()) == 1
