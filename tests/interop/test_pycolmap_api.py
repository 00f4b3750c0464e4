"""Scripts written for pycolmap go on working when two of their calls are replaced."""

from __future__ import annotations

import hashlib
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scene import NAMES, write_photographs
from synthetic import write_image

import colmap_affrect
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.errors import AffrectError, DatabaseError, OptionError, StoreError
from colmap_affrect.images.reading import read_gray
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context


@pytest.fixture(scope="module")
def sift(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SIFT database of COLMAP: two images share a camera of known focal length, one has GPS."""
    path = tmp_path_factory.mktemp("sift") / "old.db"
    pycolmap.extract_features(
        path,
        photos,
        camera_mode=pycolmap.CameraMode.PER_FOLDER,
        reader_options=dict(camera_model="PINHOLE", camera_params="301,302,161,122"),
    )
    pycolmap.match_exhaustive(path)
    with open_database(path) as database:
        image = database.read_all_images()[1]
        prior = pycolmap.PosePrior(position=np.array([1.0, 2.0, 3.0]))
        prior.corr_data_id = image.data_id
        database.write_pose_prior(prior)
    return path


def content(path: Path) -> dict[str, bytes]:
    """Digests of all files of a folder."""
    files = (file for file in path.parent.rglob("*") if file.is_file())
    return {file.name: hashlib.sha256(file.read_bytes()).digest() for file in files}


def keypoints(path: Path) -> dict[str, Any]:
    with open_database(path) as database:
        images = database.read_all_images()
        return {image.name: database.read_keypoints(image.image_id) for image in images}


@pytest.mark.long
def test_database_is_that_of_a_run(photos: Path, tmp_path: Path) -> None:
    colmap_affrect.extract_features(str(tmp_path / "a.db"), str(photos))
    colmap_affrect.match_exhaustive(str(tmp_path / "a.db"))
    colmap_affrect.run(photos, tmp_path / "run")
    one = keypoints(tmp_path / "a.db")
    other = keypoints(tmp_path / "run" / "database.db")
    assert one.keys() == other.keys() == set(NAMES)
    for name in NAMES:
        np.testing.assert_array_equal(one[name], other[name])
    with (
        open_database(tmp_path / "a.db") as first,
        open_database(tmp_path / "run/database.db") as second,
    ):
        for ids in itertools.combinations(range(1, 5), 2):
            np.testing.assert_array_equal(
                first.read_matches(*ids), second.read_matches(*ids)
            )
        assert (
            first.num_verified_image_pairs() == second.num_verified_image_pairs() == 6
        )


@pytest.mark.long
def test_images_and_pairs_are_added_call_by_call(photos: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    listed = tmp_path / "pairs.txt"
    first = colmap_affrect.extract_features(path, photos, image_names=NAMES[2:])
    assert (first.num_done, first.num_kept) == (2, 0)
    listed.write_text(f"{NAMES[3]} {NAMES[2]}\n")
    match, *_ = colmap_affrect.match_image_pairs(
        path, pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed)
    )
    assert match.num_done == 1
    second = colmap_affrect.extract_features(path, photos)
    assert (second.num_done, second.num_kept) == (2, 2)
    match, verify, _ = colmap_affrect.match_exhaustive(path)
    assert (match.num_done, match.num_kept) == (5, 1)
    assert verify.num_done == 5


@pytest.mark.long
def test_reader_options_and_camera_mode_are_those_of_pycolmap(
    photos: Path, tmp_path: Path
) -> None:
    options = dict(camera_model="PINHOLE", camera_params="301,302,161,122")
    colmap_affrect.extract_features(
        tmp_path / "a.db", photos, NAMES, pycolmap.CameraMode.PER_FOLDER, options
    )
    colmap_affrect.extract_features(
        tmp_path / "b.db",
        photos,
        NAMES[:1],
        "per_image",
        dict(default_focal_length_factor=2.0),
    )
    with open_database(tmp_path / "a.db") as database:
        cameras = database.read_all_cameras()
        assert [camera.params.tolist() for camera in cameras] == [
            [301, 302, 161, 122]
        ] * 2
    with open_database(tmp_path / "b.db") as database:
        (camera,) = database.read_all_cameras()
        assert camera.focal_length == 2.0 * 320
    path = tmp_path / "c.db"  # with images that pycolmap has imported before
    with open_database(path):
        pass
    native = pycolmap.ImageReaderOptions(**options)
    pycolmap.import_images(
        path, photos, pycolmap.CameraMode.SINGLE, NAMES[::-1], native
    )
    ids = image_ids(path)
    colmap_affrect.extract_features(path, photos, NAMES[:1])
    assert image_ids(path) == ids
    with open_database(path) as database:
        assert [camera.params.tolist() for camera in database.read_all_cameras()] == [
            [301, 302, 161, 122]
        ]


def image_rows(database: pycolmap.Database) -> list[tuple[int, str, int, int]]:
    """Return id, name, camera and frame of each image."""
    images = database.read_all_images()
    return [
        (image.image_id, image.name, image.camera_id, image.frame_id)
        for image in images
    ]


@pytest.mark.long
def test_features_are_replaced_in_a_new_database_and_the_old_one_stays(
    photos: Path, sift: Path, tmp_path: Path
) -> None:
    before = content(sift)
    colmap_affrect.extract_features(tmp_path / "new.db", photos, from_database=sift)
    colmap_affrect.match_exhaustive(tmp_path / "new.db")
    assert content(sift) == before

    with open_database(sift) as old, open_database(tmp_path / "new.db") as new:
        for kind in ("cameras", "rigs", "frames", "pose_priors"):
            found = getattr(new, f"read_all_{kind}")()
            assert len(found) > 0
            assert repr(found) == repr(getattr(old, f"read_all_{kind}")())
        assert image_rows(new) == image_rows(old)
        assert new.num_verified_image_pairs() == 6
        assert not new.exists_descriptors(1)
    store = FeatureStore(Workspace.beside(tmp_path / "new.db").features)
    for name, points in keypoints(tmp_path / "new.db").items():
        np.testing.assert_allclose(
            points[:, :2], store.read(name).keypoints + 0.5, atol=1e-4
        )


def test_a_database_of_another_program_and_other_photographs_are_refused(
    photos: Path, sift: Path, tmp_path: Path
) -> None:
    before = keypoints(sift)
    extract = colmap_affrect.extract_features
    with pytest.raises(
        DatabaseError, match=r"has other features of a\.png.*--from-database"
    ):
        extract(sift, photos)
    with pytest.raises(OptionError, match="leave out camera mode"):
        extract(tmp_path / "a.db", photos, camera_mode="single", from_database=sift)
    write_photographs(tmp_path / "few", 2)
    with pytest.raises(
        AffrectError, match=r"lists side/d\.png and 1 more, which is not in "
    ):
        extract(tmp_path / "b.db", tmp_path / "few", from_database=sift)
    write_photographs(tmp_path / "cut")
    write_image(tmp_path / "cut/b c.png", read_gray(photos / "b c.png")[:200, :310])
    with pytest.warns(
        UserWarning, match=r"^left out: b c\.png; the first: .*is 310 x 200 px"
    ):
        report = extract(tmp_path / "c.db", tmp_path / "cut", from_database=sift)
    assert (report.num_done, *report.failures) == (3, "b c.png")
    assert (
        "is 310 x 200 px, and its camera in the database 320 x 240"
        in report.failures["b c.png"]
    )
    for name, points in keypoints(sift).items():
        np.testing.assert_array_equal(points, before[name])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"extraction_options": {"sifft": {"a": 1}}},
            "sifft.a: pycolmap has no such option",
        ),
        ({"extraction_options": pycolmap.Camera()}, "Camera does not apply here"),
        ({"extraction_options": "defualt"}, "did you mean 'default'"),
        (
            {"reader_options": {"camera_modell": "PINHOLE"}},
            "did you mean 'camera_model'",
        ),
        ({"camera_mode": "two"}, "mode='two': should be 'auto'"),
        ({"image_names": ["a.png", "../x.png"]}, r"lists \.\./x\.png"),
    ],
)
def test_wrong_arguments_are_one_clear_line(
    photos: Path, tmp_path: Path, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(AffrectError, match=message) as error:
        colmap_affrect.extract_features(
            tmp_path / "a.db", **{"image_path": photos, **arguments}
        )
    assert "\n" not in str(error.value)
    assert not (tmp_path / "a.db").exists()


def test_options_of_verification_come_from_pycolmap_or_a_dictionary(
    photos: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.db"
    colmap_affrect.extract_features(path, photos, NAMES[:2], extraction_options={})
    pycolmaps = pycolmap.TwoViewGeometryOptions(
        min_num_inliers=31, ransac=dict(max_error=2.5)
    )
    colmap_affrect.match_exhaustive(path, verification_options=pycolmaps)
    recorded = Context(Workspace.beside(path)).verification
    assert (recorded.min_num_inliers, recorded.max_error_px) == (31, 2.5)
    with pytest.raises(
        StoreError, match=r"max_error_px=2\.5, and it is 3\.0 now; use a new"
    ):
        colmap_affrect.match_exhaustive(path)
    with pytest.raises(
        OptionError, match="multiple_models=True cannot be carried over"
    ):
        colmap_affrect.match_exhaustive(
            path, verification_options={"multiple_models": True}
        )
    with pytest.raises(
        OptionError, match=r"^matching_options: int does not apply here; give pyc"
    ):
        colmap_affrect.match_exhaustive(path, 3)
    with pytest.raises(AffrectError, match="give match_list_path"):
        colmap_affrect.match_image_pairs(path)
