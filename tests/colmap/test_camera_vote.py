"""The vote on cameras of a database: who shares one, priors, and being killed in between."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import Call
from matched_scenes import in_a_box, on_a_plane, views_around, write_views

from colmap_affrect.colmap import camera_vote, pycolmap
from colmap_affrect.colmap.camera_vote import (
    MAX_SPREAD,
    CameraVote,
    apply_records,
    forget_votes,
    needs_vote,
    voting_pairs,
)
from colmap_affrect.colmap.cameras import (
    CameraRecord,
    read_camera_records,
    write_camera_records,
)
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.initial_cameras import record_cameras
from colmap_affrect.colmap.verification import VerificationOptions, verify
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.options import PRESETS
from colmap_affrect.pipeline import InputOptions, holds_vote
from colmap_affrect.stages import cameras as stage
from colmap_affrect.stages.cameras import hold_vote

FOCAL = 1.4
WIDE, HIGH, SMALL = (1000, 750), (750, 1000), (600, 450)
SIZES = (WIDE, HIGH, WIDE)
VERIFICATION = VerificationOptions()
NUM_POINTS = 900


def write(path: Path, focals: Sequence[float], sizes: Sequence[tuple[int, int]]) -> Path:
    rng = np.random.default_rng(4)
    points = in_a_box(NUM_POINTS, rng)
    write_views(path, views_around(focals, rng), sizes, points, 3)
    record_cameras(path, path.with_name("cameras.json"))
    return path


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scans by one camera, one of them turned, that nobody knows anything of."""
    return write(tmp_path_factory.mktemp("scans") / "database.db", [FOCAL] * 3, SIZES)


def vote(path: Path, *, may_share: bool = True) -> dict[int, CameraRecord]:
    hold_vote(path, path.with_name("cameras.json"), VERIFICATION, may_share=may_share)
    return read_camera_records(path.with_name("cameras.json"))


@pytest.fixture(scope="module")
def voted(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = copied(scans, tmp_path_factory.mktemp("voted"))
    vote(path)
    return path


def copied(path: Path, folder: Path) -> Path:
    for source in (path, path.with_name("cameras.json")):
        shutil.copy(source, folder / source.name)
    return folder / path.name


def content(path: Path) -> tuple[Any, ...]:
    """Return all that the vote may change."""
    with open_database(path) as database:
        cameras = {
            camera.camera_id: (camera.params.tolist(), camera.has_prior_focal_length)
            for camera in database.read_all_cameras()
        }
        rigs = {rig.rig_id: rig.ref_sensor_id.id for rig in database.read_all_rigs()}
        frames = {
            frame.frame_id: (frame.rig_id, [(d.sensor_id.id, d.id) for d in frame.data_ids])
            for frame in database.read_all_frames()
        }
        images = {
            image.image_id: (image.name, image.camera_id, image.frame_id)
            for image in database.read_all_images()
        }
        pairs, geometries = database.read_two_view_geometries()
        verified = [(g.config, len(g.inlier_matches)) for g in geometries]
    return cameras, rigs, frames, images, list(pairs), verified


def with_given(path: Path, focal_px: float, *distortion: float) -> None:
    """Give all cameras a focal length and perhaps a distortion, as the user may."""
    records_path = path.with_name("cameras.json")
    with open_database(path) as database:
        for camera in database.read_all_cameras():
            model, center = "RADIAL" if distortion else "SIMPLE_PINHOLE", camera.params[1:3]
            camera.model = getattr(pycolmap.CameraModelId, model)
            camera.params = [focal_px, *center, *distortion]
            camera.has_prior_focal_length = True
            database.update_camera(camera)
    verify(path, VERIFICATION)
    given = {
        key: replace(record, source="given", focal_px=focal_px, given=("focal", "distortion"))
        for key, record in read_camera_records(records_path).items()
    }
    write_camera_records(records_path, given)


@pytest.mark.parametrize(
    ("focal", "distortion", "expected"),
    [(FOCAL, (), False), (0.5 * FOCAL, (), True), (0.5 * FOCAL, (0.4, 0.1), False)],
)
def test_given_focal_length_that_most_pairs_contradict(
    tmp_path: Path, focal: float, distortion: tuple[float, ...], *, expected: bool
) -> None:
    path = write(tmp_path / "database.db", [FOCAL] * 4, [WIDE] * 4)
    with_given(path, 1000.0 * focal, *distortion)
    records = vote(path)
    assert {record.is_contradicted for record in records.values()} == {expected}
    assert {record.focal_px for record in records.values()} == {1000.0 * focal}
    before = path.with_name("cameras.json").stat().st_mtime_ns
    assert vote(path) == records
    assert path.with_name("cameras.json").stat().st_mtime_ns == before


def test_scans_of_one_camera_get_one_and_its_focal_length(scans: Path, voted: Path) -> None:
    """A turned scan shares the focal length, not the camera: its sides are swapped."""
    records = read_camera_records(voted.with_name("cameras.json"))
    assert {key: record.names for key, record in records.items()} == {
        1: ("0.jpg", "2.jpg"),
        2: ("1.jpg",),
    }
    for record in records.values():
        assert record.source == "pairs"
        assert record.low_px < FOCAL * 1000 < record.high_px
        assert record.high_px < MAX_SPREAD * record.low_px
        assert record.focal_px == records[1].focal_px
        assert "one camera for 3 images" in record.why
    cameras, rigs, frames, images, pairs, verified = content(voted)
    assert cameras.keys() == records.keys()
    for key, (params, has_prior) in cameras.items():
        assert params[0] == pytest.approx(records[key].focal_px)
        assert has_prior
    assert sorted(rigs.values()) == [1, 2]
    before = content(scans)
    assert {i: name for i, (name, *_) in images.items()} == {
        i: name for i, (name, *_) in before[3].items()
    }
    for frame_id, (rig_id, data) in frames.items():
        ((camera_id, image_id),) = data
        assert rigs[rig_id] == camera_id == images[image_id][1]
        assert images[image_id][2] == frame_id
    assert len(pairs) == 3
    calibrated = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    assert [config for config, _ in verified] == [calibrated] * 3


def test_a_vote_that_was_held_is_not_held_again(voted: Path, tmp_path: Path) -> None:
    path = copied(voted, tmp_path)
    records, before = read_camera_records(path.with_name("cameras.json")), content(path)
    assert not needs_vote(records)
    apply_records(path, records)
    apply_records(path, records)
    assert content(path) == before
    assert vote(path) == records
    assert content(path) == before


@pytest.mark.parametrize("where", ["before", "after"])
def test_a_killed_vote_is_gone_on_with(
    scans: Path, voted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    path = copied(scans, tmp_path)
    decided = read_camera_records(voted.with_name("cameras.json"))

    def killed(*arguments: object) -> None:
        if where == "after":
            apply_records(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(CameraVote, "decide", lambda *_: decided)
        patched.setattr(stage, "apply_records", killed)
        with pytest.raises(KeyboardInterrupt):
            vote(path)
        patched.setattr(CameraVote, "decide", killed)  # is not called again
        patched.setattr(stage, "apply_records", apply_records)
        vote(path)
    assert content(path) == content(voted)


@pytest.fixture
def _few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_vote, "MAX_PAIRS_OF_IMAGE", 1)


@pytest.mark.long
@pytest.mark.usefixtures("_few_pairs")
def test_images_that_are_added_later_are_voted_on_with_the_others(
    voted: Path, tmp_path: Path
) -> None:
    path = copied(voted, tmp_path)
    write(path, [FOCAL] * 4, [*SIZES, WIDE])
    records_path = path.with_name("cameras.json")
    assert needs_vote(read_camera_records(records_path))
    records = vote(path)
    assert not needs_vote(records)
    assert "3.jpg" in records[1].names
    assert content(path)[0].keys() == records.keys()


def test_a_forgotten_vote_leaves_cameras_without_prior(voted: Path, tmp_path: Path) -> None:
    path = copied(voted, tmp_path)
    records = forget_votes(path, read_camera_records(path.with_name("cameras.json")))
    assert needs_vote(records)
    assert {record.source for record in records.values()} == {"guess"}
    cameras, *_, pairs, _ = content(path)
    assert not any(has_prior for _, has_prior in cameras.values())
    assert not pairs


@pytest.mark.usefixtures("_few_pairs")
def test_what_is_known_stays(scans: Path, tmp_path: Path) -> None:
    path = copied(scans, tmp_path)
    records = read_camera_records(path.with_name("cameras.json"))
    records[2] = replace(records[2], source="exif", focal_px=1400.0)
    write_camera_records(path.with_name("cameras.json"), records)
    with open_database(path) as database:
        camera = database.read_camera(2)
        camera.params = [1400.0, *camera.params[1:]]
        camera.has_prior_focal_length = True
        database.update_camera(camera)
    found = vote(path, may_share=False)
    assert found[2] == records[2]
    assert sorted(found) == [1, 2, 3]
    for key in (1, 3):
        assert found[key].focal_px == pytest.approx(1400.0, rel=0.1)
        assert (found[key].low_px or 1e9) < 1400.0 < (found[key].high_px or 0.0)


def test_planes_leave_cameras_unknown(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    path = tmp_path / "database.db"
    write_views(path, views_around([FOCAL] * 3, rng), SIZES, on_a_plane(600, rng), 3)
    record_cameras(path, tmp_path / "cameras.json")
    verify(path, VERIFICATION)
    assert voting_pairs(path, {1, 2, 3}, None) == []
    records = vote(path)
    assert len(records) == 3
    for record in records.values():
        assert record.source == "guess"
        assert record.high_px > MAX_SPREAD * record.low_px
        assert "no pair can tell its focal length" in record.why
    assert not any(has_prior for _, has_prior in content(path)[0].values())


@pytest.mark.usefixtures("_few_pairs")
@pytest.mark.parametrize("asked", [[], ["--focal-vote", "always"]])
def test_cameras_of_another_database_are_its_owners(
    scans: Path, tmp_path: Path, call: Call, asked: list[str]
) -> None:
    before, output = content(scans), tmp_path / "out"
    ended = call("map", "--from-database", scans, "--output-path", output, "--mapper",
                 "incremental", *asked)  # fmt: skip
    assert ended.code == 0, ended.stderr
    assert content(scans) == before
    after = content(output / "database.db")
    votes = "always" in asked
    assert (after[0] == before[0]) == (not votes)
    assert after[1:4] == before[1:4]
    records = read_camera_records(output / "cameras.json")
    assert {record.low_px is not None for record in records.values()} == {votes}


@pytest.mark.parametrize("preset", PRESETS)
def test_who_votes(preset: str) -> None:
    mapping = type(MAPPERS.options({"name": "incremental"})).preset(preset)
    assert holds_vote("auto", mapping, is_others=False) == (preset != "colmap")
    assert not holds_vote("auto", mapping, is_others=True)
    for is_others in (True, False):
        assert holds_vote("always", mapping, is_others=is_others)
        assert not holds_vote("never", mapping, is_others=is_others)
    options = InputOptions(mapping=mapping, cameras=CameraOptions())
    assert options.holds_vote == (preset != "colmap")
    assert not replace(options, from_database=Path("other.db")).holds_vote
