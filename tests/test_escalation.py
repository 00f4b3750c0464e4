"""On demand: only pairs that fail climb, what succeeded stays, and a killed run goes on."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from colmap_affrect import stages
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.options import CameraOptions, MatchingOptions, VerificationOptions
from colmap_affrect.outcomes import StageReport
from colmap_affrect.recipes import load_recipe
from colmap_affrect.store import FeatureStore, MatchStore
from colmap_affrect.workspace import Workspace

FACADE = Path(__file__).parents[1] / "sample_scenes" / "facade" / "images"
NAMES = ["view_1_tilt00.jpg", "view_2_tilt30.jpg", "view_6_tilt75.jpg"]
EASY, HARD = (NAMES[0], NAMES[1]), (NAMES[0], NAMES[2])
CAMERAS = CameraOptions(mode="single", model="PINHOLE", params="720,720,360,270")
SMALL = ["max_image_size_px=480", "features.max_num_features=1500",
         "features.max_num_rectified_features=3000"]  # fmt: skip


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("facade")
    for name in NAMES:
        shutil.copy(FACADE / name, folder / name)
    return folder


def verified(photos: Path, output: Path, recipe: str) -> Workspace:
    """A workspace after the stages that every recipe has."""
    workspace = Workspace(output)
    with workspace.locked():
        stages.extract(workspace, photos, load_recipe(recipe, SMALL), CAMERAS)
        stages.choose_pairs(workspace)
        stages.match(workspace, MatchingOptions())
        stages.verify_matches(workspace, VerificationOptions(), 0)
    return workspace


def escalate(workspace: Workspace, **options: bool) -> StageReport:
    with workspace.locked():
        return stages.escalate(workspace, **options)


@pytest.fixture(scope="module")
def before(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return verified(photos, tmp_path_factory.mktemp("before"), "on-demand")


@pytest.fixture(scope="module")
def plain(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return verified(photos, tmp_path_factory.mktemp("plain"), "unrectified-rootsift")


@pytest.fixture(scope="module")
def climbed(
    before: Workspace, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Workspace, StageReport]:
    workspace = copy(before, tmp_path_factory.mktemp("climbed"))
    return workspace, escalate(workspace)


def copy(workspace: Workspace, folder: Path) -> Workspace:
    shutil.copytree(workspace.path, folder, dirs_exist_ok=True)
    return Workspace(folder)


def geometry(workspace: Workspace, pair: tuple[str, str]) -> np.ndarray:
    """Inlier matches of a pair in the database."""
    ids = image_ids(workspace.database)
    with open_database(workspace.database) as database:
        return database.read_two_view_geometry(*(ids[name] for name in pair)).inlier_matches


def matches(workspace: Workspace, pair: tuple[str, str]) -> np.ndarray:
    ids = image_ids(workspace.database)
    with open_database(workspace.database) as database:
        return database.read_matches(*(ids[name] for name in pair))


def same_state(first: Workspace, second: Workspace) -> None:
    for pair in (EASY, HARD):
        assert_array_equal(matches(first, pair), matches(second, pair))
        assert_array_equal(geometry(first, pair), geometry(second, pair))
    for name in NAMES:
        one, other = (FeatureStore(item.features).read(name) for item in (first, second))
        assert_array_equal(one.lafs, other.lafs)
        assert_array_equal(one.rectification_ids, other.rectification_ids)
    assert stages.pair_levels(first) == stages.pair_levels(second)


def test_first_level_is_the_unrectified_recipe(before: Workspace, plain: Workspace) -> None:
    for name in NAMES:
        one, other = (FeatureStore(item.features).read(name) for item in (before, plain))
        assert_array_equal(one.lafs, other.lafs)
        assert_array_equal(one.descriptors, other.descriptors)
    assert len(geometry(before, EASY)) >= VerificationOptions().min_num_inliers
    assert len(geometry(before, HARD)) < VerificationOptions().min_num_inliers


def test_hard_pair_climbs_and_succeeds(climbed: tuple[Workspace, StageReport]) -> None:
    workspace, report = climbed
    assert len(geometry(workspace, HARD)) >= VerificationOptions().min_num_inliers
    levels = MatchStore(workspace.matches).levels([EASY, HARD])
    assert levels[EASY] == 0
    assert levels[HARD] > 0
    assert report.num_done == sum(
        level > 0 for level in MatchStore(workspace.matches).levels(pairs_of(workspace)).values()
    )


def pairs_of(workspace: Workspace) -> list[tuple[str, str]]:
    lines = workspace.pairs.read_text().splitlines()
    return [(line.split()[0], line.split()[1]) for line in lines]


def test_every_pair_that_verifies_unrectified_is_kept_as_it_was(
    climbed: tuple[Workspace, StageReport], plain: Workspace
) -> None:
    assert_array_equal(matches(climbed[0], EASY), matches(plain, EASY))
    assert_array_equal(geometry(climbed[0], EASY), geometry(plain, EASY))


def test_features_of_levels_follow_one_another(
    climbed: tuple[Workspace, StageReport], before: Workspace
) -> None:
    store, earlier = FeatureStore(climbed[0].features), FeatureStore(before.features)
    for name in NAMES:
        ends = store.level_ends(name)
        first = store.read(name, 0)
        assert_array_equal(first.lafs, earlier.read(name).lafs)
        if len(ends) > 1:
            ids = store.read(name).rectification_ids
            assert (ids[: ends[0]] == 0).all()
            assert (ids[ends[0] :] > 0).all()
            assert ends == sorted(ends)
    ids = image_ids(climbed[0].database)
    with open_database(climbed[0].database) as database:
        for name in NAMES:
            assert database.num_keypoints_for_image(ids[name]) == len(store.read(name))


def test_count_of_pairs_by_level_adds_up(climbed: tuple[Workspace, StageReport]) -> None:
    counts = stages.pair_levels(climbed[0])
    assert list(counts) == ["identity", "dense-shapes", "affnet-shapes", "asift", "none"]
    assert sum(counts.values()) == 3
    assert counts["identity"] >= 1


def test_again_does_nothing(
    climbed: tuple[Workspace, StageReport], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = copy(climbed[0], tmp_path / "again")
    monkeypatch.setattr(stages, "prepare", None)  # no features, so nothing to prepare
    assert escalate(workspace).num_done == 0
    same_state(workspace, climbed[0])


@pytest.mark.parametrize("where", ["_replace_matches", "_write_images_and_keypoints", "_verify_new"])
def test_killed_run_goes_on_to_the_same_result(
    before: Workspace,
    climbed: tuple[Workspace, StageReport],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
) -> None:
    workspace = copy(before, tmp_path / "killed")

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages, where, killed)
        escalate(workspace)
    escalate(workspace)
    same_state(workspace, climbed[0])


def test_overwrite_climbs_anew_to_the_same_result(
    climbed: tuple[Workspace, StageReport], tmp_path: Path
) -> None:
    workspace = copy(climbed[0], tmp_path / "overwritten")
    report = escalate(workspace, overwrite=True)
    assert report.num_done == climbed[1].num_done
    same_state(workspace, climbed[0])


def test_recipe_without_levels_has_nothing_to_climb(plain: Workspace, tmp_path: Path) -> None:
    workspace = copy(plain, tmp_path / "plain")
    assert escalate(workspace).num_done == 0
    assert stages.pair_levels(workspace) == {}
    assert_array_equal(geometry(workspace, EASY), geometry(plain, EASY))
