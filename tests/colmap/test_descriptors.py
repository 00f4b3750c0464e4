"""Descriptors in the database as COLMAP's own matchers take them."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from small_scene import write_photographs

import colmap_affrect
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import (
    fill_descriptors,
    image_ids,
    open_database,
    write_descriptors,
)
from colmap_affrect.colmap.old_databases import export_database
from colmap_affrect.errors import DatabaseError
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context

MAX_RATIO = 0.8
Matches = set[tuple[int, int]]


def float_matches(first: NDArray[np.float32], second: NDArray[np.float32]) -> Matches:
    """Mutual nearest neighbours whose angles pass COLMAP's ratio test in both directions."""
    angles = np.arccos(np.clip(first @ second.T, -1.0, 1.0))

    def nearest(rows: NDArray[np.float32]) -> NDArray[np.int64]:
        order = np.argsort(rows, axis=1)[:, :2]
        best, other = np.take_along_axis(rows, order, axis=1).T
        return np.where(best < MAX_RATIO * other, order[:, 0], -1)

    forward = nearest(angles)
    backward = nearest(angles.T)
    return {
        (i, j) for i, j in enumerate(forward.tolist()) if j >= 0 and backward[j] == i
    }


def colmap_matches(path: Path) -> Matches:
    """What COLMAP's exact matcher finds between images 1 and 2."""
    options = pycolmap.FeatureMatchingOptions(
        skip_geometric_verification=True, use_gpu=False
    )
    options.sift.cpu_brute_force_matcher = True
    options.sift.max_ratio = MAX_RATIO
    pycolmap.match_exhaustive(path, matching_options=options)
    with open_database(path) as database:
        return {(int(i), int(j)) for i, j in database.read_matches(1, 2)}


@pytest.mark.long
def test_colmap_matches_what_float_descriptors_match(tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos", 2)
    colmap_affrect.extract_features(tmp_path / "a.db", tmp_path / "photos")
    context = Context(Workspace.beside(tmp_path / "a.db"))
    fill_descriptors(context.workspace.database, context.features)
    path = context.workspace.database
    store = context.features
    first, second = (store.read(name).descriptors for name in sorted(image_ids(path)))
    expected = float_matches(first, second)
    found = colmap_matches(path)
    assert len(expected) > 500
    old = tmp_path / "old.db"
    assert export_database(path, old, descriptors=True) == 2
    with open_database(path) as database, closing(sqlite3.connect(old)) as copied:
        data = copied.execute(
            "SELECT data FROM descriptors WHERE image_id = 1"
        ).fetchone()[0]
        assert data == np.asarray(database.read_descriptors(1).data).tobytes()
    assert len(expected & found) >= 0.95 * len(expected)
    assert len(found - expected) <= 0.05 * len(expected)


def written(path: Path, *descriptors: NDArray[np.floating]) -> list[NDArray[np.uint8]]:
    """Write descriptors of an image each; return them as COLMAP has them."""
    with open_database(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 300.0, 320, 240)
        database.write_camera(camera)
        for number, rows in enumerate(descriptors, start=1):
            database.write_image(pycolmap.Image(name=f"{number}.png", camera_id=1))
            database.write_keypoints(number, np.full((len(rows), 2), 5.0, np.float32))
            write_descriptors(database, number, rows)
        return [database.read_descriptors(n + 1).data for n in range(len(descriptors))]


def test_signed_descriptors_of_networks_are_matched_too(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)

    def unit(rows: NDArray[np.float64]) -> NDArray[np.float32]:
        return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)

    first = unit(rng.normal(size=(1500, 128)))
    cosines = rng.uniform(0.5, 0.95, (1500, 1))
    noise = unit(rng.normal(size=(1500, 128)))
    second = unit(cosines * first + np.sqrt(1.0 - cosines**2) * noise)
    second[900:] = unit(rng.normal(size=(600, 128)))
    path = tmp_path / "a.db"
    written(path, first, second)
    expected = float_matches(first, second)
    found = colmap_matches(path)
    assert len(expected) > 600
    assert len(expected & found) >= 0.95 * len(expected)


def test_positive_descriptors_keep_their_values_and_none_or_zero_are_no_trouble(
    tmp_path: Path,
) -> None:
    row = np.full((1, 128), np.sqrt((1.0 - 0.26) / 125))
    row[0, :3] = 0.3, 0.4, 0.1
    values, none, zeros = written(
        tmp_path / "a.db", row, np.zeros((0, 128)), np.zeros((2, 128))
    )
    assert values[0, :3].tolist() == [154, 205, 51]
    assert len(none) == 0
    assert not zeros.any()
    with pytest.raises(
        DatabaseError, match=r"64 elements.*leave out --database-descriptors"
    ):
        written(tmp_path / "b.db", np.ones((3, 64)))
