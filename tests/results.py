"""What runs leave in folders, and runs that are ended while they are at work."""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
from command import start

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.project.atomic_files import journal_of
from colmap_affrect.project.workspace import Workspace


def results(out: Path) -> dict[str, Any]:
    """Features, matches, geometries and registered images of a finished run.

    Images go by their names: COLMAP's ids follow the order in which they came.
    """
    workspace = Workspace(out)
    report = json.loads(workspace.report.read_text(encoding="utf-8"))
    return {
        "features": hdf5_content(workspace.features),
        "matches": hdf5_content(workspace.matches),
        "pairs": workspace.pairs.read_text(encoding="utf-8"),
        **database_content(workspace.database),
        "registered": report["registered_names"],
        "models": model_names(workspace),
        "points": report["points3D"],
    }


def hdf5_content(path: Path) -> dict[str, tuple[str, bytes]]:
    """Type and bytes of all datasets of a file by key."""
    content = {}

    def collect(key: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            content[key] = (f"{item.dtype}{item.shape}", item[()].tobytes())

    with h5py.File(path, "r") as file:
        file.visititems(collect)
    return content


def database_content(path: Path) -> dict[str, Any]:
    """Keypoints by image, numbers of raw matches and inlier matches by pair."""
    names = {image_id: name for name, image_id in image_ids(path).items()}

    def pair(pair_id: int) -> tuple[str, ...]:
        return tuple(names[i] for i in pycolmap.pair_id_to_image_pair(pair_id))

    with open_database(path) as database:
        raw = zip(*database.read_all_matches(), strict=True)
        geometries = zip(*database.read_two_view_geometries(), strict=True)
        return {
            "keypoints": {names[i]: database.read_keypoints(i).tobytes() for i in names},
            "raw matches": {pair(key): len(rows) for key, rows in raw},
            "inliers": {pair(key): found.inlier_matches.tolist() for key, found in geometries},
        }


def model_names(workspace: Workspace) -> list[list[str]]:
    """Names of the registered images of every model in sparse/."""
    models = [pycolmap.Reconstruction(path) for path in sorted(workspace.sparse.glob("[0-9]*"))]
    return [sorted(model.images[i].name for i in model.reg_image_ids()) for model in models]


def tree(folder: Path, *without: Path, times: bool = True) -> dict[str, tuple[object, ...]]:
    """What is in a folder, by its path there: files by digest and time; links are not followed."""
    found: dict[str, tuple[object, ...]] = {}
    for path in folder.rglob("*"):
        if any(path.is_relative_to(other) for other in without):
            continue
        key = str(path.relative_to(folder))
        if path.is_symlink():
            found[key] = ("link", str(path.readlink()))
        elif path.is_file():
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            found[key] = (digest, path.stat().st_mtime_ns) if times else (digest,)
        else:
            found[key] = ("folder",)
    return found


def differences(before: Mapping[str, object], after: Mapping[str, object]) -> list[str]:
    """What was made, changed or removed between two looks at a folder."""
    said = {(False, True): "made", (True, False): "removed", (True, True): "changed"}
    keys = sorted(before.keys() | after.keys())
    return [
        f"{said[key in before, key in after]} {key!r}"
        for key in keys
        if before.get(key) != after.get(key)
    ]


@dataclass(frozen=True)
class Undisturbed:
    """A run that nothing disturbed.

    Attributes:
        out: its output folder.
        results: what it left.
        worked_s: seconds from the first line in its log to its end.
    """

    out: Path
    results: dict[str, Any]
    worked_s: float


def run_arguments(photos: Path, out: Path, options: Sequence[object]) -> list[str]:
    """Arguments of a run that prints its summary only."""
    paths = ["run", "--image-path", photos, "--output-path", out, "-q"]
    return [str(argument) for argument in (*paths, *options)]


def run_undisturbed(photos: Path, out: Path, options: Sequence[object]) -> Undisturbed:
    """Run in a process of its own, and measure the time that can be disturbed."""
    with start(*run_arguments(photos, out, options)) as process:
        wait_until_at_work(process, out)
        begun = time.monotonic()
        process.communicate(timeout=300)
        worked_s = time.monotonic() - begun
    assert process.returncode == 0
    return Undisturbed(out, results(out), worked_s)


def wait_until_at_work(process: subprocess.Popen[str], out: Path) -> None:
    """Wait until a run has written into its log."""
    log = Workspace(out).log

    def size() -> int:
        return log.stat().st_size if log.exists() else 0

    before = size()
    while size() == before and process.poll() is None:
        time.sleep(0.005)


def end_after(delay_s: float, number: signal.Signals, arguments: Sequence[str], out: Path) -> bool:
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


def assert_readable(out: Path) -> None:
    """Every file that is there can be read as it lies there; an HDF5 file with its journal."""
    workspace = Workspace(out)
    workspace.recorded()
    for path in (workspace.features, workspace.matches):
        if path.exists() and not journal_of(path).exists():
            hdf5_content(path)
    if workspace.database.exists():
        image_ids(workspace.database)


def end_again_and_again(
    photos: Path,
    out: Path,
    options: Sequence[object],
    worked_s: float,
    signals: Sequence[signal.Signals],
    chance: random.Random,
) -> list[str]:
    """End runs in one folder at random moments, each while it is at work.

    Returns:
        The stages that were the last to have begun at these moments.
    """
    stages = []
    for index, number in enumerate(signals):
        # What is done stays done: later runs are nearer to their end.
        delay_s = chance.uniform(0.0, worked_s / (index + 1))
        while not end_after(delay_s, number, run_arguments(photos, out, options), out):
            shutil.rmtree(out)
            delay_s /= 2
        assert_readable(out)
        stages.append((Workspace(out).recorded().get("begun") or ["start"])[-1])
    return stages
