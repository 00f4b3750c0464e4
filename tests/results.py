"""What a run left in its output folder, and runs that are ended while they are at work."""

from __future__ import annotations

import json
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
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
    """Keypoints by image, matches and inlier matches by pair."""
    names = {image_id: name for name, image_id in image_ids(path).items()}
    with open_database(path) as database:
        pair_ids, geometries = database.read_two_view_geometries()
        return {
            "keypoints": {names[i]: database.read_keypoints(i).tobytes() for i in names},
            "raw matches": {
                tuple(names[i] for i in pycolmap.pair_id_to_image_pair(pair_id)): len(rows)
                for pair_id, rows in zip(*database.read_all_matches(), strict=True)
            },
            "inliers": {
                tuple(names[i] for i in pycolmap.pair_id_to_image_pair(pair_id)): (
                    geometry.inlier_matches.tolist()
                )
                for pair_id, geometry in zip(pair_ids, geometries, strict=True)
            },
        }


def model_names(workspace: Workspace) -> list[list[str]]:
    """Names of the registered images of every model in sparse/."""
    models = [pycolmap.Reconstruction(path) for path in sorted(workspace.sparse.glob("[0-9]*"))]
    return [
        sorted(model.images[image_id].name for image_id in model.reg_image_ids())
        for model in models
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


def log_size(out: Path) -> int:
    """Bytes that are in the log of an output folder."""
    log = Workspace(out).log
    return log.stat().st_size if log.exists() else 0


def wait_until_at_work(process: subprocess.Popen[str], out: Path) -> None:
    """Wait until a run has written into the log."""
    before = log_size(out)
    while log_size(out) == before and process.poll() is None:
        time.sleep(0.005)


def state(folder: Path, *, without: Path | None = None) -> dict[str, tuple[bytes, int]]:
    """Content and time of a folder and all in it, perhaps but for one of its folders."""
    return {
        str(path): (path.read_bytes() if path.is_file() else b"", path.lstat().st_mtime_ns)
        for path in [folder, *folder.rglob("*")]
        if without is None or not path.is_relative_to(without)
    }


def end_after(delay_s: float, number: signal.Signals, arguments: Sequence[str], out: Path) -> bool:
    """Start a run and send it a signal; tell whether it was still at work then."""
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
            with h5py.File(path, "r") as file:
                file.visititems(lambda *_: None)
    if workspace.database.exists():
        with open_database(workspace.database) as database:
            database.read_all_images()


def end_again_and_again(
    photos: Path,
    out: Path,
    options: Sequence[str],
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
