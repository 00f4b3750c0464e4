"""Work on images and pairs elsewhere: on a cluster of this machine, some of it lost midway."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from random_weights import write_comparing_lightglue, write_random_weights
from results import hdf5_content
from small_scene import write_photographs
from verified import CAMERAS

from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.errors import AffrectError, StoreError
from colmap_affrect.parallel import cluster as cluster_module
from colmap_affrect.parallel import cluster_watch
from colmap_affrect.parallel.cluster import (
    Cluster,
    _Batches,
    connected,
    environment,
    require_environment,
)
from colmap_affrect.parallel.executor import Executor, Threads
from colmap_affrect.pipeline import run
from colmap_affrect.progress import SILENT, Advance, Progress
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.session.context import Context, Inputs, Resources
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.match import Matching, iterate_matches, match
from colmap_affrect.stages.pairs import choose_pairs
from colmap_affrect.stages.verify import verify_matches

START_TIMEOUT_S = 60.0
RECIPE = load_recipe("unrectified-rootsift")
DAMAGED = "damaged.png"


@contextmanager
def started(
    folder: Path, num_workers: int
) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Start a scheduler and workers of one thread each; yield its address, and all processes."""
    file = folder / "scheduler.json"
    common = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)]
    worker = [
        "worker",
        *common,
        "--nthreads",
        "1",
        "--no-nanny",
        "--local-directory",
        str(folder),
    ]
    commands = [["scheduler", "--port", "0", *common], *[worker] * num_workers]
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *command],
            cwd=folder,
            stderr=subprocess.DEVNULL,
        )
        for command in commands
    ]
    try:
        deadline = time.monotonic() + START_TIMEOUT_S
        while not (file.exists() and file.read_text(encoding="utf-8")):
            assert time.monotonic() < deadline, "the scheduler does not start"
            time.sleep(0.1)
        yield json.loads(file.read_text(encoding="utf-8"))["address"], processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A scheduler and two workers of one thread each, in processes of their own."""
    with started(tmp_path_factory.mktemp("cluster"), 2) as (address, _):
        yield address


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four photographs and one that cannot be read."""
    folder = tmp_path_factory.mktemp("photos č")
    write_photographs(folder)
    (folder / DAMAGED).write_bytes(b"no image")
    return folder


def run_stages(
    out: Path, photos: Path, executor: Executor | None, *, progress: Progress = SILENT
) -> StageReport:
    inputs = Inputs.of(photos, cameras=CAMERAS)
    with Workspace(out).locked() as workspace:
        context = Context(workspace, executor=executor, progress=progress)
        report = extract(context, inputs, RECIPE)
        choose_pairs(context)
        match(context)
    return report


def hdf5_contents(out: Path) -> list[dict[str, tuple[str, bytes]]]:
    return [
        hdf5_content(path) for path in (Workspace(out).features, Workspace(out).matches)
    ]


class KillsOneWorker(Progress):
    """When the first image is done, the worker that has most of the others is killed."""

    def __init__(self, cluster: Cluster) -> None:
        super().__init__()
        self._client = cluster._client
        self.lost_tasks: Sequence[str] = ()

    @contextmanager
    def stage(
        self, name: str, total: int, unit: str, part: str = ""
    ) -> Iterator[Advance]:
        del name, total, unit, part
        yield self._advance

    def _advance(self, count: int) -> None:
        del count
        if self.lost_tasks:
            return
        there = self._client.has_what()
        doing = self._client.processing()
        tasks = {worker: [*there[worker], *doing[worker]] for worker in there}
        victim = max(tasks, key=lambda worker: len(tasks[worker]))
        self.lost_tasks = tasks[victim]
        os.kill(self._client.run(os.getpid)[victim], signal.SIGKILL)


@pytest.mark.long
def test_cluster_that_loses_a_worker_leaves_what_a_local_run_leaves(
    tmp_path: Path, photos: Path, address: str
) -> None:
    expected = run_stages(tmp_path / "local", photos, None)
    with connected(address) as cluster:
        cluster._client.wait_for_workers(2, timeout=60)
        killing = KillsOneWorker(cluster)
        report = run_stages(tmp_path / "cluster", photos, cluster, progress=killing)
        assert len(killing.lost_tasks) > 0
        assert len(cluster._client.nthreads()) == 1
    assert report.failures == expected.failures
    assert list(report.failures) == [DAMAGED]
    assert hdf5_contents(tmp_path / "cluster") == hdf5_contents(tmp_path / "local")


@pytest.mark.long
@pytest.mark.parametrize(("number", "harm", "said"), [
    (1, signal.SIGKILL, "the cluster has no workers any more; start some with 'dask worker"),
    (1, signal.SIGSTOP, "none of the 1 workers is heard of any more; start some with"),
    (0, signal.SIGSTOP, "the scheduler does not answer any more; start 'dask scheduler'"),
    (0, signal.SIGKILL, "the scheduler was lost; start it"),
])  # fmt: skip
def test_cluster_that_is_lost_ends_the_run_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    harm: signal.Signals,
    said: str,
) -> None:
    for name, seconds in (
        ("SILENT_S", 3.0),
        ("WARN_AFTER_S", 0.5),
        ("GIVE_UP_AFTER_S", 3.0),
    ):
        monkeypatch.setattr(cluster_watch, name, seconds)
    with started(tmp_path, 1) as (address, processes):
        start = time.monotonic()
        found = 0

        def work() -> None:
            nonlocal found
            with connected(address) as cluster:
                for _ in cluster.map(time.sleep, [0.3] * 1000):
                    found += 1
                    if found == 3:
                        processes[number].send_signal(harm)

        with pytest.raises(AffrectError, match=said):
            work()
        assert 3 <= found < 10
        assert time.monotonic() - start < 60


@pytest.mark.long
def test_short_tasks_are_sent_together_and_an_error_comes_at_its_place(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = list[object]()
    with connected(address) as cluster:
        submit = cluster._client.submit

        def counted(*arguments: Any, **keywords: Any) -> Any:
            sent.append(keywords)
            return submit(*arguments, **keywords)

        monkeypatch.setattr(cluster._client, "submit", counted)
        numbers = list(map(str, range(300)))
        assert list(cluster.map(int, numbers)) == list(range(300))
        assert len(sent) < 60
        results = cluster.map(int, [*numbers, "no number", *numbers])
        assert [next(results) for _ in numbers] == list(range(300))
        with pytest.raises(ValueError, match="no number"):
            next(results)


def test_batches_take_about_half_a_second() -> None:
    batches = _Batches()
    sizes = []
    for batch in batches.of(range(300)):
        sizes.append(len(batch))
        batches.learn(len(batch), len(batch) / 128)
    assert sizes == [1, 4, 16, 64, 64, 64, 64, 23]
    batches.learn(1, 30.0)
    assert batches.size == 4
    batches.learn(9, 1000.0)
    assert batches.size == 1


def test_files_that_workers_do_not_see_are_named(photos: Path, address: str) -> None:
    with connected(address) as cluster:
        assert list(cluster.map(len, ["task"], [photos, photos / "a.png"])) == [4]
        unseen = Path(os.path.relpath(photos / "a.png"))
        with pytest.raises(
            AffrectError, match=rf"{unseen} is missing, and .* bytes on the machine"
        ):
            list(cluster.map(len, ["task"], [photos, unseen]))


def test_cluster_that_is_no_use_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cluster_module, "CONNECT_TIMEOUT_S", 0.2)
    for address, said in (
        ("tcp://127.0.0.1:1", r"tcp://127\.0\.0\.1:1: no scheduler answers"),
        ("10.0.0.1", "not an address such as"),
        ("tls://10.0.0.1:8786", r"no scheduler answers .*TLS expects"),
    ):
        with pytest.raises(AffrectError, match=said):
            connected(address).__enter__()
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        AffrectError, match=r"distributed is not installed; .*\[cluster\]"
    ):
        connected("tcp://10.0.0.1:8786").__enter__()


@pytest.mark.parametrize(
    "said", [b"", b"SSH-2.0-OpenSSH_9.2\r\n"], ids=["silent", "ssh"]
)
def test_port_of_another_program_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, said: bytes
) -> None:
    monkeypatch.setattr(cluster_module, "CONNECT_TIMEOUT_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as server:
        accepted = threading.Thread(target=greet, args=(server, said), daemon=True)
        accepted.start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(
            AffrectError, match=rf"{address}: no scheduler answers \(.+\); give"
        ):
            connected(address).__enter__()


def greet(server: socket.socket, said: bytes) -> None:
    """Say something to the first that connects, and wait for it to go."""
    with server.accept()[0] as connection:
        connection.sendall(said)
        while connection.recv(4096):
            pass


def test_worker_that_would_give_other_results_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"1")
    here = environment([str(tmp_path / "a.png"), str(tmp_path)])
    assert {"pycolmap", "torch"} <= here.keys()  # both compute
    require_environment(here)
    with pytest.raises(
        AffrectError, match=r"kornia is .*, and 0\.1 on the machine that leads"
    ):
        require_environment({**here, "kornia": "0.1"})
    (tmp_path / "a.png").write_bytes(b"22")
    with pytest.raises(
        AffrectError, match=r"a\.png is 2 bytes, and 1 bytes on the machine"
    ):
        require_environment(here)


def test_a_worker_uses_freed_memory_again_while_it_works_for_a_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = Mock()
    monkeypatch.setattr(cluster_module, "keep_freed_memory", calls.keep)
    monkeypatch.setattr(cluster_module, "return_freed_memory", calls.give_back)
    monkeypatch.setattr(cluster_module, "threadpool_limits", Mock())
    monkeypatch.setattr(cluster_module.cv2, "setNumThreads", Mock())
    for _ in range(2):
        done = cluster_module._work(pickle.dumps(len), (), pickle.dumps(["task"]))
        assert done.results == [4]
    cluster_module._forget()
    assert [name for name, _, _ in calls.mock_calls] == ["keep", "give_back"]


def test_torch_is_not_loaded_here_where_workers_match(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loads = Mock()
    monkeypatch.setattr(
        "colmap_affrect.matchers.nearest.nearest_8bit.load_meanwhile", loads
    )
    monkeypatch.setattr(
        "colmap_affrect.pipeline.extract_features", Mock(side_effect=KeyError)
    )
    for executor, num_loads in ((Threads(1), 0), (None, 1)):
        with pytest.raises(KeyError):
            run(
                photos,
                tmp_path / "out",
                recipe="unrectified-rootsift",
                executor=executor,
            )
        assert loads.call_count == num_loads


WITH_NETWORK = load_recipe("aliked-lightglue", ["matching.max_num_features=120"])


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    write_random_weights(folder)["aliked-n16"].rename(folder / "aliked-n16.pth")
    write_comparing_lightglue(folder / "aliked_lightglue.pth", sharpness=1000.0)
    return folder


@pytest.fixture(scope="module")
def extracted(
    photos: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """An output folder before matching."""
    out = tmp_path_factory.mktemp("out")
    with Workspace(out).locked() as workspace:
        extract(
            Context(workspace, Resources(weights_path=weights, device="cpu")),
            Inputs.of(photos),
            WITH_NETWORK,
        )
        choose_pairs(Context(workspace))
    return out


def matched(
    out: Path, extracted: Path, weights: Path, executor: Executor
) -> dict[str, tuple[str, bytes]]:
    """Match in a copy of the folder, or in the folder if it is there already."""
    if not out.exists():
        shutil.copytree(extracted, out)
    with Workspace(out).locked() as workspace:
        match(
            Context(workspace, Resources(weights_path=weights, device="cpu"), executor)
        )
    return hdf5_content(Workspace(out).matches)


@pytest.mark.long
def test_matches_of_other_weights_are_not_mixed(
    tmp_path: Path, extracted: Path, weights: Path
) -> None:
    matched(tmp_path / "out", extracted, weights, Threads(1))
    workspace = Workspace(tmp_path / "out")
    assert list(workspace.record()["match"]["weights"]) == ["lightglue-aliked"]
    assert Context(workspace).matching == WITH_NETWORK.matching
    write_comparing_lightglue(tmp_path / "aliked_lightglue.pth")
    with pytest.raises(StoreError, match="match stage was run there with weights"):
        matched(tmp_path / "out", extracted, tmp_path, Threads(1))


@pytest.mark.long
def test_threads_one_pair_alone_and_a_resumed_run_find_the_same(
    tmp_path: Path, extracted: Path, weights: Path
) -> None:
    expected = matched(tmp_path / "one", extracted, weights, Threads(1))
    assert matched(tmp_path / "two", extracted, weights, Threads(2)) == expected
    context = Context(
        Workspace(tmp_path / "one"), Resources(weights_path=weights, device="cpu")
    )
    pairs = context.listed_pairs()
    assert sum(len(found.scores) for found in context.matches.read(pairs)) > 50
    matching = Matching(
        context.features,
        WITH_NETWORK.matching,
        extractor="aliked",
        resources=context.resources,
    )
    (alone,) = iterate_matches(pairs[3:4], matching, Threads(1))
    (stored,) = context.matches.read(pairs[3:4])
    np.testing.assert_array_equal(alone.indices, stored.indices)
    assert len(np.unique(stored.scores)) > 3
    with h5py.File(
        context.workspace.matches, "a"
    ) as file:  # as if the run had been killed
        for key in list(file)[1:]:
            del file[key]
    assert matched(tmp_path / "one", extracted, weights, Threads(2)) == expected


@pytest.mark.long
def test_cluster_finds_what_threads_find(
    tmp_path: Path, extracted: Path, weights: Path, address: str
) -> None:
    expected = matched(tmp_path / "local", extracted, weights, Threads(2))
    with connected(address) as cluster:
        assert matched(tmp_path / "cluster", extracted, weights, cluster) == expected


def verified(out: Path, matched_path: Path, executor: Executor | None) -> str:
    """Verify in a copy of a folder; return a digest of all rows of its database."""
    shutil.copytree(matched_path, out)
    with Workspace(out).locked() as workspace:
        report = verify_matches(Context(workspace, executor=executor))
    assert report.num_done == 6
    return rows_digest(workspace.database)


@pytest.mark.long
def test_cluster_verifies_what_threads_verify(
    tmp_path: Path, photos: Path, address: str
) -> None:
    run_stages(tmp_path / "matched", photos, None)
    expected = verified(tmp_path / "local", tmp_path / "matched", None)
    with connected(address) as cluster:
        found = verified(tmp_path / "cluster", tmp_path / "matched", cluster)
    assert found == expected
