"""Keypoints that no model can use are left out where databases of other programs come in."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from command import start

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.useless_keypoints import leave_out_useless, useless

LIMIT_S = 60.0  # COLMAP does not end for minutes


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Exact matches of six images: the keypoints of one are all at its corner, one is nowhere."""
    path = tmp_path_factory.mktemp("useless") / "any.db"
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=6, num_points3D=150)
    with open_database(path) as database:
        pycolmap.synthesize_dataset(options, database)
        for image_id in (1, 3):
            keypoints = np.array(database.read_keypoints(image_id))
            keypoints[slice(None) if image_id == 3 else 0] = 0.0 if image_id == 3 else np.nan
            database.update_keypoints(image_id, keypoints)
    return path


@pytest.mark.parametrize(
    ("keypoints", "kinds"),
    [
        ([[5.0, 5.0]] * 9 + [[1.0, 2.0]] * 2, {}),
        ([[5.0, 5.0]] * 10 + [[1.0, 2.0]] * 2, {"keypoints-at-one-place": [*range(10)]}),
        ([[5.0, 5.0], [5.0, 7.0], [7.0, 5.0]] * 8, {}),
        ([[90.9, -0.9], [91.1, 3.0], [3.0, -1.1]], {"keypoints-outside": [1, 2]}),
        ([[np.nan, 1.0], [1.0, np.inf], [-1e30, 1.0]], {"keypoints-not-finite": [0, 1, 2]}),
    ],
)
def test_kinds_of_useless_keypoints(keypoints: object, kinds: dict[str, list[int]]) -> None:
    found = useless(np.array(keypoints, np.float32), (90, 60))
    assert {kind: np.flatnonzero(mask).tolist() for kind, mask in found.items()} == kinds


def test_indices_stay_and_matches_of_useless_keypoints_go(database: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(database, tmp_path / "copy.db"))
    with open_database(path) as copy:
        assert "are left out, with " in leave_out_useless(copy)
    with open_database(database) as before, open_database(path) as after:
        for image_id in range(1, 7):
            assert after.num_keypoints_for_image(image_id) == before.num_keypoints_for_image(
                image_id
            )
        assert after.read_keypoints(1)[0, :2].tolist() == [0.0, 0.0]
        old, new = before.read_matches(1, 2), after.read_matches(1, 2)
        assert new.tolist() == old[old[:, 0] != 0].tolist()
        assert after.read_matches(2, 4).tolist() == before.read_matches(2, 4).tolist()
        assert len(after.read_matches(2, 3)) == 0
        assert after.exists_two_view_geometry(1, 2)
        assert not after.exists_two_view_geometry(2, 3)


def test_such_databases_map_within_seconds_and_stay_as_they_are(
    database: Path, tmp_path: Path
) -> None:
    before = database.read_bytes()
    with start("map", "--from-database", database, "--output-path", tmp_path / "out") as process:
        stdout, stderr = process.communicate(timeout=LIMIT_S)
    assert "registered  5 of 6 images" in stdout
    assert "are left out, with" in stderr
    assert database.read_bytes() == before
