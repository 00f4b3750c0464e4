"""What is written to a COLMAP database comes back, and nothing wrong gets in."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from strategies import Array
from synthetic import blobs, texture, write_image

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import image_import, pycolmap
from colmap_affrect.colmap.database import (
    colmap_keypoints,
    image_ids,
    open_database,
    write_keypoints,
    write_matches,
)
from colmap_affrect.colmap.image_import import import_images
from colmap_affrect.data import Rectification
from colmap_affrect.errors import DatabaseError
from colmap_affrect.features.sift import RootSift, SiftOptions
from colmap_affrect.geometry.affine import (
    fit_canvas,
    lafs_from_keypoints,
    rectifying_affine,
    rotation,
    transform_lafs,
)
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.images.warping import warp

ELLIPSE_ERROR_DEG = 3.0


@pytest.fixture
def image_folder(tmp_path: Path) -> Path:
    """Four images of two sizes, in folders, with names that need care."""
    folder = tmp_path / "images"
    for seed, name in enumerate(["b.png", "a.png", "wing/č 1.png", "wing/a.png"]):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, texture((90, 60) if seed < 3 else (64, 80), seed))
    return folder


NAMES = ["a.png", "b.png", "wing/a.png", "wing/č 1.png"]


@pytest.fixture
def database_path(tmp_path: Path, image_folder: Path) -> Path:
    """A database with the images of the folder and no keypoints."""
    path = tmp_path / "database.db"
    assert import_images(path, image_folder, NAMES, CameraOptions()) == []
    return path


def some_frames(count: int) -> Array:
    """Frames that differ from each other."""
    rng = np.random.default_rng(count)
    points = rng.uniform(0, [90, 60], (count, 2))
    return lafs_from_keypoints(
        points, rng.uniform(5, 80, count), rng.uniform(-3, 3, count)
    )


def test_import_images_looks_for_room_for_each_of_its_two_databases(
    tmp_path: Path, image_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """COLMAP ends the process where the second one finds that the first has taken its room."""
    has_been_read = []

    def require_space(new: Path, _: int) -> None:
        has_been_read.append((new.parent / "read.db").exists())

    monkeypatch.setattr(image_import, "require_database_space", require_space)
    import_images(tmp_path / "database.db", image_folder, NAMES, CameraOptions())
    assert has_been_read == [False, True]


def test_import_images_adds_what_is_new_and_names_what_colmap_cannot_read(
    tmp_path: Path, image_folder: Path
) -> None:
    (image_folder / "text.png").write_bytes(b"no image")
    path = tmp_path / "database.db"
    import_images(path, image_folder, NAMES[1:3], CameraOptions())
    before = image_ids(path)
    assert import_images(path, image_folder, ["text.png", *NAMES], CameraOptions()) == [
        "text.png"
    ]
    after = image_ids(path)
    assert {name: after[name] for name in before} == before
    assert sorted(after) == NAMES
    with open_database(path) as database:
        assert (database.num_images(), database.num_frames()) == (4, 4)


def test_new_database_appears_with_all_images_or_not_at_all(
    tmp_path: Path, image_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", lambda *_: pytest.fail("killed"))
        with pytest.raises(pytest.fail.Exception):
            import_images(path, image_folder, NAMES, CameraOptions(mode="per-folder"))
    assert not path.exists()
    (tmp_path / "database.db-wal").write_bytes(b"of a database that was removed")
    import_images(path, image_folder, NAMES[:2], CameraOptions(mode="per-folder"))
    assert sorted(image_ids(path)) == NAMES[:2]
    assert sorted(file.name for file in tmp_path.glob("database.db*")) == [
        "database.db"
    ]


def test_colmap_keypoints_move_by_half_a_pixel_and_divide_shapes_by_six() -> None:
    laf = np.array([[[12.0, -6.0, 10.0], [3.0, 18.0, 20.0]]])
    keypoints = colmap_keypoints(laf)
    assert keypoints.dtype == np.float32
    assert_allclose(keypoints, [[10.5, 20.5, 2.0, -1.0, 0.5, 3.0]])


def test_intrinsics_are_in_pixels_whose_first_one_is_at_zero() -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 900.0, 1000, 700)
    camera.principal_point_y = 320.0
    expected = [[900.0, 0.0, 499.5], [0.0, 900.0, 319.5], [0.0, 0.0, 1.0]]
    assert_allclose(colmap_database.camera_matrix(camera), expected)


def test_keypoints_that_are_there_stay_unless_escalation_has_extended_them(
    database_path: Path,
) -> None:
    with open_database(database_path) as database:
        write_keypoints(database, 1, some_frames(5))
        write_keypoints(database, 1, some_frames(5) + 1.0)
        with pytest.raises(DatabaseError, match=r"5 keypoints .* 9"):
            write_keypoints(database, 1, some_frames(9))
        np.testing.assert_array_equal(
            database.read_keypoints(1), colmap_keypoints(some_frames(5))
        )
        write_keypoints(database, 1, some_frames(9), level_ends=[5, 9])
        np.testing.assert_array_equal(
            database.read_keypoints(1), colmap_keypoints(some_frames(9))
        )


def test_write_keypoints_refuses_values_that_are_not_finite(
    database_path: Path,
) -> None:
    lafs = some_frames(4)
    lafs[1, 0, 2] = np.nan
    with open_database(database_path) as database:
        with pytest.raises(DatabaseError, match="finite"):
            write_keypoints(database, 3, lafs)
        assert not database.exists_keypoints(3)


def test_elliptic_blob_of_30_degrees_keeps_its_axis_in_the_database(
    database_path: Path,
) -> None:
    # An ellipse of axis ratio 2 with its long axis 30 degrees from x towards y.
    ellipse = rotation(np.deg2rad(30.0)) @ np.diag([10.0, 5.0])
    image = blobs((220, 200), [[110.3, 99.6]], ellipse)
    # The map diag(t, 1) R(phi) that makes it round stretches the direction -phi: 120 degrees.
    linear = rectifying_affine(2.0, np.deg2rad(60.0))
    corners = np.array([[0.0, 0.0], [219.0, 0.0], [0.0, 199.0], [219.0, 199.0]])
    matrix, canvas = fit_canvas(linear, corners, margin_px=0.0)
    plan = Rectification(
        matrix, canvas, np.ones(image.shape, bool), 2.0, np.deg2rad(60.0)
    )
    features = RootSift(SiftOptions()).detect((warp(image, plan), None))
    lafs = transform_lafs(plan.image_from_rectified, features.lafs)
    best = np.linalg.norm(lafs[:, :, 2] - [110.3, 99.6], axis=1).argmin()
    laf = lafs[best : best + 1].copy()
    laf[0, :, :2] = laf[0, :, :2] @ rotation(
        np.deg2rad(77.0)
    )  # which is not seen in the ellipse
    with open_database(database_path) as database:
        write_keypoints(database, 1, laf)
        x, y, *shape = database.read_keypoints(1)[0].astype(float)
    assert np.hypot(x - 110.8, y - 100.1) < 0.1
    values, vectors = np.linalg.eigh(
        np.reshape(shape, (2, 2)) @ np.reshape(shape, (2, 2)).T
    )
    angle_deg = np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1])) % 180.0
    assert abs(angle_deg - 30.0) < ELLIPSE_ERROR_DEG
    assert_allclose(np.sqrt(values), [5.0, 10.0], rtol=0.2)
    names = ("x", "y", "a11", "a12", "a21", "a22")
    keypoint = pycolmap.FeatureKeypoint(dict(zip(names, (x, y, *shape), strict=True)))
    # COLMAP's scale is the mean length of the columns, between the two half axes.
    assert 5.0 < keypoint.compute_scale() < 10.0


@pytest.fixture
def matchable_path(database_path: Path) -> Path:
    """A database whose images 1 to 4 have 5, 7, 0 and 40000 keypoints."""
    with open_database(database_path) as database:
        for image_id, count in enumerate([5, 7, 0, 40_000], 1):
            write_keypoints(database, image_id, some_frames(count))
    return database_path


def test_write_matches_round_trips_in_the_order_of_the_pair(
    matchable_path: Path,
) -> None:
    # Also above the range of signed integers of 16 bits.
    for pair, matches in (
        ((2, 1), [[4, 1], [0, 3]]),
        ((4, 2), [[39_999, 6], [32_768, 0]]),
    ):
        indices = np.array(matches, np.uint16)
        with open_database(matchable_path) as database:
            write_matches(database, *pair, indices)
            np.testing.assert_array_equal(database.read_matches(*pair), indices)
            np.testing.assert_array_equal(
                database.read_matches(*pair[::-1]), indices[:, ::-1]
            )
            database.write_two_view_geometry(*pair, pycolmap.TwoViewGeometry())
            write_matches(database, *pair, indices)  # nothing has changed
            assert database.exists_two_view_geometry(*pair)
            write_matches(database, *pair, indices[:1])
            np.testing.assert_array_equal(database.read_matches(*pair), indices[:1])
            assert not database.exists_two_view_geometry(*pair)
            write_matches(database, 1, 3, np.zeros((0, 2), np.int64))
            assert database.exists_matches(1, 3)


@pytest.mark.parametrize(("pair", "matches"), [
    ((1, 2), np.array([[0.0, 1.0]])),
    ((1, 2), np.array([[0, 1, 2]])),
    ((1, 2), np.array([[-1, 0]])),
    ((1, 2), np.array([[0, 7]])),
    ((2, 1), np.array([[0, 5]])),
    ((1, 3), np.array([[0, 0]])),
    ((4, 2), np.array([[40_000, 1]])),
    ((1, 2), np.array([[1 << 32, 0]])),
    ((1, 1), np.array([[0, 1]])),
    ((1, 99), np.array([[0, 1]])),
])  # fmt: skip
def test_write_matches_refuses_what_would_crash_colmap(
    matchable_path: Path, pair: tuple[int, int], matches: np.ndarray
) -> None:
    with open_database(matchable_path) as database:
        with pytest.raises(DatabaseError):
            write_matches(database, *pair, matches)
        assert database.num_matches() == 0
        assert database.num_matched_image_pairs() == 0


def test_database_that_is_read_only_is_called_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    path.write_bytes(b"")
    monkeypatch.setattr(colmap_database, "_open_when_free", refuses_to_open)
    monkeypatch.setattr(colmap_database.os, "access", lambda *_: False)
    with (
        pytest.raises(DatabaseError, match="it is read-only"),
        colmap_database.open_database(path),
    ):
        pass


def refuses_to_open(_: Path) -> None:
    raise RuntimeError("No registered database factory succeeded.")


def test_what_is_no_database_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "any.db").mkdir()
    with pytest.raises(DatabaseError, match="not a usable COLMAP database"):
        image_ids(tmp_path / "any.db")


LOCK = """
import sqlite3, sys, time
other = sqlite3.connect(sys.argv[1], isolation_level=None)
other.execute("PRAGMA locking_mode=EXCLUSIVE")
other.execute("BEGIN EXCLUSIVE")
print("locked", flush=True)
time.sleep(0.3)
"""


def test_database_that_another_program_locks_for_a_moment_is_opened_after_it(
    matchable_path: Path,
) -> None:
    command = [sys.executable, "-c", LOCK, matchable_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"locked\n"
        with open_database(matchable_path) as database:
            assert database.num_images() == 4
