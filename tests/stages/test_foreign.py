"""Databases of other programs: with descriptors alone, lists of matches and known cameras."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import synthesize

import colmap_affrect
from colmap_affrect import CameraOptions
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.database import open_database
from colmap_affrect.errors import AffrectError, DatabaseError, OptionError, StoreError
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.descriptors import match_database
from colmap_affrect.stages.foreign import ForeignDatabase

pytestmark = pytest.mark.long

NUM_IMAGES = 4


@pytest.fixture(scope="module")
def verified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A verified database that also has descriptors."""
    path = tmp_path_factory.mktemp("verified") / "any.db"
    synthesize(path, num_rigs=NUM_IMAGES, num_points3D=80, noise_px=0.3)
    return path


@pytest.fixture
def unmatched(verified: Path, tmp_path: Path) -> Path:
    path = Path(shutil.copy(verified, tmp_path / "any.db"))
    with open_database(path) as database:
        database.clear_matches()
        database.clear_two_view_geometries()
        database.write_matches(
            1, 2, np.zeros((0, 2), np.uint32)
        )  # as COLMAP's matchers leave it
    return path


def names_of(path: Path) -> list[str]:
    with open_database(path) as database:
        return sorted(image.name for image in database.read_all_images())


def test_database_with_descriptors_alone_is_matched_and_mapped(
    unmatched: Path, tmp_path: Path
) -> None:
    names = names_of(unmatched)
    before = unmatched.read_bytes()
    report = colmap_affrect.map_database(unmatched, tmp_path / "out", page=False)
    assert report.registered_names == tuple(names)
    assert report.num_verified_pairs == NUM_IMAGES * (NUM_IMAGES - 1) // 2
    assert unmatched.read_bytes() == before
    again = colmap_affrect.map_database(unmatched, tmp_path / "out", page=False)
    assert [stage.num_done for stage in again.stages] == [0, 0]


def test_listed_pairs_alone_are_matched_by_descriptors(
    unmatched: Path, tmp_path: Path
) -> None:
    names = names_of(unmatched)
    listed = tmp_path / "pairs.txt"
    listed.write_text(
        f"{names[0]} {names[1]}\n{names[1]} {names[2]}\n", encoding="utf-8"
    )
    report = colmap_affrect.map_database(
        unmatched, tmp_path / "out", match_list_path=listed, page=False
    )
    assert report.num_verified_pairs == 2


def test_database_without_matches_and_descriptors_is_refused(
    unmatched: Path, tmp_path: Path
) -> None:
    with open_database(unmatched) as database:
        database.clear_descriptors()
    with pytest.raises(
        DatabaseError, match="has no matches, nor descriptors to match by"
    ):
        colmap_affrect.map_database(unmatched, tmp_path / "out", page=False)


@pytest.mark.parametrize("match_type", ["raw", "inliers"])
def test_list_of_matches_is_mapped_with_the_keypoints_of_a_database(
    verified: Path, unmatched: Path, tmp_path: Path, match_type: str
) -> None:
    lines = []
    with open_database(verified) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        for pair_id in database.read_num_matches()[0]:
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            rows = database.read_matches(first, second)
            lines += [
                f"{names[first]} {names[second]}",
                *(f"{a} {b}" for a, b in rows),
                "",
            ]
    given = tmp_path / "matches.txt"
    given.write_text("\n".join(lines), encoding="utf-8")
    with open_database(unmatched) as database:
        database.clear_descriptors()
    report = colmap_affrect.map_database(
        unmatched,
        tmp_path / "out",
        matches_path=given,
        match_type=match_type,
        page=False,
    )
    assert len(report.registered_names) == NUM_IMAGES
    assert report.stages[0].num_done == (6 if match_type == "raw" else 0)
    given.write_text("\n".join(lines[: lines.index("") + 1]), encoding="utf-8")
    report = colmap_affrect.map_database(
        unmatched,
        tmp_path / "out",
        matches_path=given,
        match_type=match_type,
        page=False,
    )
    assert report.num_verified_pairs == 1  # the copy is made anew
    given.write_text("a b\n0 0\n", encoding="utf-8")
    with pytest.raises(StoreError, match="line 1: 'a b' is not two names"):
        colmap_affrect.map_database(unmatched, tmp_path / "other", matches_path=given)


def test_cameras_are_given_for_the_database_of_another_program(
    verified: Path, tmp_path: Path
) -> None:
    first, second, *_ = names_of(verified)
    table = tmp_path / "cameras.csv"
    table.write_text(
        f'name,focal_px,model,params\n{first},1280,,\n{second},,PINHOLE,"1280 1280 512 384"\n',
        encoding="utf-8",
    )
    cameras = CameraOptions(cameras_path=str(table))
    colmap_affrect.map_database(verified, tmp_path / "out", cameras=cameras, page=False)
    workspace = Workspace(tmp_path / "out")
    records = {
        record.names[0]: record
        for record in read_camera_records(workspace.cameras).values()
    }
    assert records[first].given == ("focal",)
    assert set(records[second].given) == {"focal", "principal-point", "distortion"}
    assert [record.source for record in records.values()].count("given") == 2
    model = pycolmap.Reconstruction(workspace.sparse / "0")
    found = {
        image.name: model.cameras[image.camera_id] for image in model.images.values()
    }
    assert found[first].model_name == "SIMPLE_RADIAL"
    assert found[first].params[0] == 1280.0
    assert found[second].model_name == "PINHOLE"
    assert found[second].params.tolist() == [1280.0, 1280.0, 512.0, 384.0]


def test_given_focal_length_leaves_the_distortion_of_a_camera(
    verified: Path, tmp_path: Path
) -> None:
    path = Path(shutil.copy(verified, tmp_path / "copy.db"))
    given = ForeignDatabase(path, cameras=CameraOptions(focal_length_px=1300.0))
    with open_database(path) as database:
        records = given.initial_cameras().replace_cameras(database)
        cameras = database.read_all_cameras()
    assert len(records) == len(cameras) == NUM_IMAGES
    for camera in cameras:
        assert camera.params.tolist() == [1300.0, 512.0, 384.0, 0.05]
        assert camera.has_prior_focal_length


@pytest.mark.parametrize(
    ("row", "message"),
    [("gone.jpg,1280,", r"gone\.jpg is not in .*any\.db"), ("NAME,-1,", "focal_px=")],
)
def test_cameras_that_do_not_fit_are_refused_before_anything_is_made(
    verified: Path, tmp_path: Path, row: str, message: str
) -> None:
    table = tmp_path / "cameras.csv"
    table.write_text(
        "name,focal_px,model\n" + row.replace("NAME", names_of(verified)[0])
    )
    with pytest.raises(OptionError, match=message):
        colmap_affrect.map_database(
            verified, tmp_path / "out", cameras=CameraOptions(cameras_path=str(table))
        )
    assert not (tmp_path / "out").exists()


def test_cameras_of_a_model_that_is_extended_are_not_called_unknown(
    verified: Path, tmp_path: Path
) -> None:
    with open_database(verified) as database:
        first = database.read_all_images()[0]
    model = tmp_path / "first" / "sparse" / "0"
    colmap_affrect.map_database(verified, tmp_path / "first", page=False)
    found = pycolmap.Reconstruction(model)
    found.deregister_frame(found.find_image_with_name(first.name).frame_id)
    (tmp_path / "old").mkdir()
    found.write(tmp_path / "old")
    extension = colmap_affrect.Extension(model_path=tmp_path / "old")
    report = colmap_affrect.map_database(
        verified, tmp_path / "out", extend=extension, page=False
    )
    assert report.added == (first.name,)
    line = "focal lengths: 3 of the model that is extended, 1 not known beforehand"
    assert line in report.summary()


def test_what_is_given_beside_a_database_is_on_record_and_comes_back(
    tmp_path: Path,
) -> None:
    given = ForeignDatabase(
        tmp_path / "any.db", tmp_path, CameraOptions(focal_length_px=7.0), tmp_path / "m.h5",
        "inliers",
    )  # fmt: skip
    assert ForeignDatabase.of_record(given.to_record()) == given
    plain = ForeignDatabase(tmp_path / "any.db")
    assert plain.to_record() == {"database": str(tmp_path / "any.db"), "image_path": ""}
    assert ForeignDatabase.of_record(plain.to_record()) == plain


def test_functions_with_pycolmaps_names_match_foreign_descriptors(
    unmatched: Path,
) -> None:
    matched, verified = colmap_affrect.match_exhaustive(unmatched)
    assert (matched.num_done, verified.num_done) == (5, 5)  # one pair is on record
    with open_database(unmatched) as database:
        assert sum(database.read_two_view_geometry_num_inliers()[1]) > 200
    assert match_database(unmatched) == 0
    with pytest.raises(OptionError, match="not for descriptors of another program"):
        colmap_affrect.match_exhaustive(unmatched, {"guided_matching": True})


def test_descriptors_that_do_not_fit_the_keypoints_are_refused(unmatched: Path) -> None:
    with open_database(unmatched) as database:
        keypoints = database.read_keypoints(2)
        database.update_keypoints(2, keypoints[:-1])
    with pytest.raises(AffrectError, match=r"keypoints and .* descriptors"):
        match_database(unmatched)
