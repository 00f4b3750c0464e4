"""Raw matches go into the database in batches, and a run that is killed loses one of them."""

from __future__ import annotations

import multiprocessing
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import num_matched_pairs, open_database
from colmap_affrect.pairs.lists import exhaustive_pairs
from colmap_affrect.project.match_store import MatchStore, PairMatches
from colmap_affrect.session import database_export
from colmap_affrect.session.view_graph import ViewGraph

NAMES = [f"{index}.png" for index in range(6)]
NUM_KEYPOINTS = 20
NUM_PER_WRITE = 4


@pytest.fixture
def context(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Matches of 15 pairs, of which the database has none."""
    monkeypatch.setattr(database_export, "PAIRS_PER_WRITE", NUM_PER_WRITE)
    path = tmp_path / "database.db"
    with open_database(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 80, 60)
        camera.camera_id = database.write_camera(camera)
        for name in NAMES:
            image = pycolmap.Image(name=name, camera_id=camera.camera_id)
            image_id = database.write_image(image)
            keypoints = np.zeros((NUM_KEYPOINTS, 2), np.float32)
            database.write_keypoints(image_id, keypoints)
    matches = MatchStore(tmp_path / "matches.h5")
    found = []
    for number, pair in enumerate(exhaustive_pairs(NAMES)):
        rows = np.arange(number + 1)
        scores = np.ones(number + 1, np.float32)
        indices = np.stack([rows, rows], axis=1)
        found.append(PairMatches(pair, indices, scores, NUM_KEYPOINTS))
    matches.write(found)
    return SimpleNamespace(matches=matches, path=path, graph=ViewGraph(path))


def write(context: Any) -> None:
    """Bring the database up to what is stored."""
    database_export.write_matches(context, exhaustive_pairs(NAMES))


def write_until_killed(context: Any, num_pairs: int) -> None:
    """End the process, as a kill does, when so many pairs have been written."""
    write_pair = colmap_database.write_matches
    num_written = 0

    def killed(*given: Any) -> None:
        nonlocal num_written
        if num_written == num_pairs:
            os._exit(9)
        num_written += 1
        write_pair(*given)

    colmap_database.write_matches = killed
    write(context)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks safely here")
@pytest.mark.parametrize(("num_written", "num_left"), [(3, 0), (7, 4), (8, 8)])
def test_a_run_that_is_killed_loses_one_batch_and_the_next_one_writes_it(
    context: Any, num_written: int, num_left: int
) -> None:
    forking = multiprocessing.get_context("fork")
    child = forking.Process(target=write_until_killed, args=(context, num_written))
    child.start()
    child.join()
    assert child.exitcode == 9
    assert num_matched_pairs(context.path) == num_left
    write(context)
    with open_database(context.path) as database:
        _, counts = database.read_num_matches()
    assert sorted(counts) == list(range(1, 16))
