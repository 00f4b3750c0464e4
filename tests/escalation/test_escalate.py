"""On demand: only pairs that fail escalate, what succeeded stays, and a killed run goes on."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import Call
from numpy.testing import assert_array_equal
from PIL import Image
from results import database_content
from verified import copy_of, verified

from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.colmap.database_verification import PairVerifier
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import AffrectError, OptionError, StoreError
from colmap_affrect.escalation import escalate as escalation
from colmap_affrect.escalation.escalate import Escalation
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.progress import Progress
from colmap_affrect.project.atomic_files import FileTransaction
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.match_store import MatchStore
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import EscalateOptions
from colmap_affrect.session.context import Context, Resources
from colmap_affrect.stages import verify as verification
from colmap_affrect.stages.verify import extracted_px

pytestmark = pytest.mark.long

FACADE = Path(__file__).parents[2] / "sample_scenes" / "facade" / "images"
NAMES = ["view_1_tilt00.jpg", "view_2_tilt30.jpg", "view_6_tilt75.jpg"]
EASY = (NAMES[0], NAMES[1])
HARD = (NAMES[0], NAMES[2])
CAMERAS = CameraOptions(mode="single", model="PINHOLE", params="720,720,360,270")
SMALL = ["max_image_size_px=440", "features.max_num_features=1500",
         "features.max_num_rectified_features=3000"]  # fmt: skip


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("facade")
    for name in NAMES:
        shutil.copy(FACADE / name, folder / name)
    return folder


def facade_run(photos: Path, output: Path, recipe: str) -> Workspace:
    return verified(photos, output, recipe, SMALL, CAMERAS)


def escalate(
    workspace: Workspace, options: EscalateOptions | None = None
) -> StageReport:
    with workspace.locked():
        return escalation.escalate(Context(workspace), options)


@pytest.fixture(scope="module")
def before(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return facade_run(photos, tmp_path_factory.mktemp("before"), "on-demand")


@pytest.fixture(scope="module")
def plain(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return facade_run(photos, tmp_path_factory.mktemp("plain"), "unrectified-rootsift")


@pytest.fixture(scope="module")
def escalated(before: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    workspace = copy_of(before, tmp_path_factory.mktemp("escalated"))
    assert escalate(workspace).num_done >= 1
    return workspace


def geometry(workspace: Workspace, pair: tuple[str, str]) -> np.ndarray:
    """Inlier matches of a pair in the database."""
    ids = image_ids(workspace.database)
    with open_database(workspace.database) as database:
        return database.read_two_view_geometry(
            *(ids[name] for name in pair)
        ).inlier_matches


def matches(workspace: Workspace, pair: tuple[str, str]) -> np.ndarray:
    ids = image_ids(workspace.database)
    with open_database(workspace.database) as database:
        return database.read_matches(*(ids[name] for name in pair))


def same_state(first: Workspace, second: Workspace) -> None:
    for pair in (EASY, HARD):
        assert_array_equal(matches(first, pair), matches(second, pair))
        assert_array_equal(geometry(first, pair), geometry(second, pair))
    for name in NAMES:
        one, other = (
            FeatureStore(item.features).read(name) for item in (first, second)
        )
        assert_array_equal(one.lafs, other.lafs)
        assert_array_equal(one.rectification_ids, other.rectification_ids)
    levels = [MatchStore(item.matches).levels([EASY, HARD]) for item in (first, second)]
    assert levels[0] == levels[1]


def test_escalation_before_its_turn_leaves_nothing_on_record(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="the verify stage has not been run there"):
        escalate(Workspace(tmp_path))
    assert not Workspace(tmp_path).config.exists()


def test_other_thresholds_than_before_are_refused(
    escalated: Workspace, tmp_path: Path
) -> None:
    workspace = copy_of(escalated, tmp_path)
    before = workspace.config.read_bytes()
    with pytest.raises(
        StoreError, match="with strong_num_inliers=100, and it is 5 now"
    ):
        escalate(workspace, EscalateOptions(strong_num_inliers=5))
    assert workspace.config.read_bytes() == before


def test_device_that_is_not_there_discards_nothing(
    escalated: Workspace, tmp_path: Path, call: Call
) -> None:
    workspace = copy_of(escalated, tmp_path)
    before = database_content(workspace.database)
    ended = call(
        "match", "--output-path", tmp_path, "--device", "cuda:99", "--overwrite"
    )
    assert (ended.code, len(ended.errors)) == (2, 1)
    assert "--device cuda:99" in ended.errors[0]
    with pytest.raises(AffrectError, match="--device cuda:99"):
        escalation.escalate(Context(workspace, Resources(device="cuda:99")))
    assert workspace.matches.exists()
    assert database_content(workspace.database) == before


def test_first_level_is_the_unrectified_recipe(
    before: Workspace, plain: Workspace
) -> None:
    for name in NAMES:
        one, other = (
            FeatureStore(item.features).read(name) for item in (before, plain)
        )
        assert_array_equal(one.lafs, other.lafs)
        assert_array_equal(one.descriptors, other.descriptors)
    assert len(geometry(before, EASY)) >= VerificationOptions().min_num_inliers
    assert len(geometry(before, HARD)) < VerificationOptions().min_num_inliers


def test_hard_pair_escalates_and_succeeds(escalated: Workspace) -> None:
    assert len(geometry(escalated, HARD)) >= VerificationOptions().min_num_inliers
    store = MatchStore(escalated.matches)
    level = store.levels([HARD])[HARD]
    assert store.levels([HARD], "tried")[HARD].bit_length() - 1 == level > 0


def test_trial_of_a_pair_is_what_the_database_then_holds(escalated: Workspace) -> None:
    size_px = Context(escalated).extraction.max_image_size_px
    graph = Context(escalated).graph
    verifier = PairVerifier(graph.ids, graph.cameras, VerificationOptions(), size_px)
    store = FeatureStore(escalated.features)
    for pair in (EASY, HARD, HARD[::-1]):
        frames = [store.read_frames(name) for name in pair]
        indices = matches(escalated, pair).astype(np.int64)
        count = len(verifier.inliers(pair, tuple(frames), indices))
        assert count == len(geometry(escalated, pair))


OTHER_FEATURES = """
[rectifier]
name = "identity"
[[escalation]]
max_image_size_px = 360
features = { name = "rootsift", contrast_threshold = 0.01 }
matching = { name = "nearest", max_ratio = 0.9 }
[[escalation]]
rectifier.name = "dense-shapes"
max_image_size_px = 360
features = { name = "rootsift", contrast_threshold = 0.01 }
[escalate]
strong_num_inliers = 1000000
"""


def test_levels_with_features_and_matching_of_their_own(
    photos: Path, tmp_path: Path
) -> None:
    """The first of them looks at the photographs again; others add warps to what it found."""
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(OTHER_FEATURES)
    workspace = facade_run(photos, tmp_path / "out", str(recipe))
    escalate(workspace)
    features = FeatureStore(workspace.features)
    store = MatchStore(workspace.matches)
    ids = image_ids(workspace.database)
    tried = store.levels([EASY, HARD], "tried")
    assert max(tried.values()).bit_length() - 1 == 2
    sizes = extracted_px(Context(workspace))
    for name in HARD:
        first, second, third = (
            part.stop for part in features.level_ranges(name).values()
        )
        origin = features.read(name).rectification_ids
        assert not origin[:second].any()
        assert (origin[second:] > 0).all()
        scales = features.read(name).scales
        assert (
            scales[first:second].min() > 1.2 * scales[:first].min()
        )  # it was shrunk more
        assert_array_equal(
            features.level_indices(name, 2, base=1), np.arange(first, third)
        )
    for pair in (EASY, HARD):
        level = store.levels([pair])[pair]
        low, high = sorted(ids[name] for name in pair)
        assert sizes[low, high] == (480, 360, 360)[level]
        (found,) = store.read([pair])
        for side, name in enumerate(pair):
            parts = features.level_ranges(name)
            own = found.indices[:, side]
            assert own.max() < parts[level].stop
            assert own.min() >= (parts[0].stop if level else 0)
    assert store.levels([EASY])[EASY] > 0


def test_strong_pairs_without_a_track_of_three_escalate(
    before: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Escalation(Context(before), EscalateOptions())
    chain = {EASY: 200, (NAMES[1], NAMES[2]): 150}
    matches = {pair: np.arange(80).reshape(40, 2) for pair in chain}
    apart = {**matches, (NAMES[1], NAMES[2]): np.arange(1, 81).reshape(40, 2)}
    monkeypatch.setattr(work.image_set, "num_inliers", lambda: chain)
    monkeypatch.setattr(Context, "verified_inliers", lambda _: apart)
    assert work.next_step() is None
    monkeypatch.setattr(Context, "verified_inliers", lambda _: matches)
    step = work.next_step()
    assert step
    assert (step.level, step.pairs) == (1, list(chain))


def test_photographs_that_are_likely_right_in_another_model_need_a_quarter(
    before: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Escalation(Context(before), EscalateOptions())
    inputs = work.context.current_model_inputs()
    monkeypatch.setattr(Workspace, "model_inputs", lambda _: inputs)
    models = [ModelSummary(names, 9, 2.0, 0.5) for names in ((), EASY)]
    assert work.image_set.weights(models) == {
        EASY[0]: 0.25,
        EASY[1]: 0.25,
        NAMES[2]: 1.0,
    }


def test_each_step_has_a_bar_that_ends_full(before: Workspace, tmp_path: Path) -> None:
    workspace = copy_of(before, tmp_path)
    shown = io.StringIO()
    with workspace.locked():
        escalation.escalate(Context(workspace, progress=Progress(shown)))
    lines = [
        line for line in shown.getvalue().splitlines() if line.startswith("escalate, ")
    ]
    last = {
        line.split(":")[0]: line.split(": ")[1].split()[0].split("/") for line in lines
    }
    assert all(done == total for done, total in last.values())


def test_no_verified_pair_loses_inliers(escalated: Workspace, plain: Workspace) -> None:
    assert len(geometry(escalated, EASY)) >= len(geometry(plain, EASY))


def test_pairs_that_verify_well_escalate_nowhere(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "easy"
    folder.mkdir()
    for name in EASY:
        shutil.copy(photos / name, folder / name)
    workspace = facade_run(folder, tmp_path / "out", "on-demand")
    first = matches(workspace, EASY)
    monkeypatch.setattr(escalation, "prepare", None)  # nothing to extract
    assert escalate(workspace).num_done == 0
    assert_array_equal(matches(workspace, EASY), first)


def test_features_of_levels_follow_one_another(
    escalated: Workspace, before: Workspace
) -> None:
    store = FeatureStore(escalated.features)
    earlier = FeatureStore(before.features)
    for name in NAMES:
        ends = [part.stop for part in store.level_ranges(name).values()]
        first = store.read(name).select(store.level_indices(name, 0))
        assert_array_equal(first.lafs, earlier.read(name).lafs)
        if len(ends) > 1:
            ids = store.read(name).rectification_ids
            assert (ids[: ends[0]] == 0).all()
            assert (ids[ends[0] :] > 0).all()
            assert ends == sorted(ends)
    ids = image_ids(escalated.database)
    with open_database(escalated.database) as database:
        for name in NAMES:
            assert database.num_keypoints_for_image(ids[name]) == len(store.read(name))


def test_again_does_nothing(
    escalated: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = copy_of(escalated, tmp_path / "again")
    monkeypatch.setattr(
        escalation, "prepare", None
    )  # no features, so nothing to prepare
    assert escalate(workspace).num_done == 0
    same_state(workspace, escalated)


def killed_at(patch: pytest.MonkeyPatch, where: str) -> None:
    """Kill a function when it is called."""

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    patch.setattr(
        escalation if where == "update_verified" else verification, where, killed
    )


def killed_after(patch: pytest.MonkeyPatch, path: Path, number: int) -> None:
    """Kill a run when it has changed a file so many times."""
    changed = list[Path]()
    commit = FileTransaction.commit

    def killed(changes: FileTransaction) -> None:
        commit(changes)
        changed.append(changes._path)
        if changed.count(path) == number:
            raise KeyboardInterrupt

    patch.setattr(FileTransaction, "commit", killed)


@pytest.mark.parametrize(
    "when", ["update_verified", "write_matches", "verify_pairs", 1, 2, 3]
)
def test_killed_run_goes_on_to_the_same_result(
    before: Workspace,
    escalated: Workspace,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    when: str | int,
) -> None:
    """Killed when it calls a function, or between two changes of its matches."""
    workspace = copy_of(before, tmp_path / "killed")
    with monkeypatch.context() as patch:
        if isinstance(when, str):
            killed_at(patch, when)
        else:
            killed_after(patch, workspace.matches, when)
        with pytest.raises(KeyboardInterrupt):
            escalate(workspace)
    escalate(workspace)
    same_state(workspace, escalated)


def test_photographs_without_a_feature_escalate_nowhere(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in NAMES[:2]:
        Image.new("L", (320, 240)).save(photos / name)
    workspace = facade_run(photos, tmp_path / "out", "on-demand")
    escalate(workspace)
    assert set(Context(workspace).features.num_keypoints().values()) == {0}


def test_recipe_without_levels_has_nothing_to_escalate(
    plain: Workspace, tmp_path: Path
) -> None:
    workspace = copy_of(plain, tmp_path / "plain")
    assert escalate(workspace).num_done == 0
    assert_array_equal(geometry(workspace, EASY), geometry(plain, EASY))
