"""Models of one kind of matches alone, beside those of the best matches of each pair."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from results import database_content, hdf5_content
from small_scene import NAMES
from verified import copy_of, verified

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.escalation import alternatives, image_set, map_and_rematch
from colmap_affrect.escalation.alternatives import (
    SCORE,
    Choice,
    adopt_chosen_models,
    choose_learned,
    keep_best,
    learned_models_on_record,
    map_learned_matches,
    needs_learned_models,
    num_right_poses,
    num_right_poses_now,
    num_right_poses_of_best,
    remove_alternatives,
    restore_best,
)
from colmap_affrect.escalation.escalate import Escalation, begin
from colmap_affrect.escalation.image_set import ImageSet
from colmap_affrect.escalation.summary import escalation_summary
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.mappers.base import MAPPERS, Mapper
from colmap_affrect.mappers.mapping import read_summaries
from colmap_affrect.project.match_state import Begun, LearnedModels
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.sealed_json import write_sealed
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe, load_recipe
from colmap_affrect.session.context import Context, Resources
from colmap_affrect.stages.map import map_images
from colmap_affrect.stages.match import match

RECIPE = """
[rectifier]
name = "identity"
[[escalation]]
features = { name = "shapeless", max_num_features = 900 }
"""
UNSURE = ModelSummary(
    NAMES[:2], 50, 2.0, 0.5, probabilities=dict.fromkeys(NAMES[:2], 0.6)
)


pytestmark = [
    pytest.mark.long,
    pytest.mark.usefixtures("shapeless_features_are_known"),
]


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    path = tmp_path_factory.mktemp("recipe") / "recipe.toml"
    path.write_text(RECIPE)
    return load_recipe(str(path))


@pytest.fixture(scope="module")
def matched(
    photos: Path, recipe: Recipe, tmp_path_factory: pytest.TempPathFactory
) -> Workspace:
    """All pairs were matched by both kinds; the learned ones have fewer features."""
    workspace = verified(
        photos, tmp_path_factory.mktemp("matched") / "out", recipe.name
    )
    escalation = begin(Context(workspace), recipe.escalate)
    escalation.matches.update_state(
        learned_matching=Begun(1, tuple(escalation.image_set.pairs))
    )
    assert escalation.match_learned() == len(escalation.image_set.pairs)
    return workspace


@pytest.fixture
def context(matched: Workspace, tmp_path: Path) -> Context:
    return Context(copy_of(matched, tmp_path / "out"))


@pytest.fixture
def mapper() -> Mapper:
    return MAPPERS.make(MAPPERS.options("sparse"))


def escalation_of(context: Context) -> Escalation:
    return Escalation(context, context.escalation)


def levels(context: Context) -> set[int]:
    return set(context.matches.levels(escalation_of(context).image_set.pairs).values())


def with_models(
    monkeypatch: pytest.MonkeyPatch,
    *,
    found: ModelSummary,
    there: Sequence[ModelSummary],
) -> list[Choice]:
    """Say what models are there, and what a copy gives; return the choices that are mapped."""
    asked = list[Choice]()

    def map_copy(_: Context, __: Mapper, choice: Choice, target: Path) -> None:
        asked.append(choice)
        (target / "0").mkdir()

    def summaries(folder: Path) -> list[ModelSummary]:
        is_learned = folder.name == "sparse.learned" or (folder / "learned").exists()
        return [found] if is_learned else list(there)

    def copied(folder: Path, target: Path, _: Path) -> None:
        assert folder.parent.name == "sparse.learned"
        target.mkdir()
        (target.parent / "learned").touch()

    monkeypatch.setattr(alternatives, "_map_copy", map_copy)
    monkeypatch.setattr(alternatives, "read_summaries", summaries)
    monkeypatch.setattr(alternatives, "copy_with_keypoints", copied)
    return asked


def test_learned_matches_are_kept_beside_those_that_are_there(context: Context) -> None:
    pairs = escalation_of(context).image_set.pairs
    learned = context.matches.learned(list(pairs))
    assert levels(context) == {0}
    assert set(learned) == set(pairs)
    states = escalation_of(context).image_set.states()
    for pair, kept in learned.items():
        assert kept.matches.level == 1
        assert kept.matches.names == pair
        assert 0 < kept.worth[0] < states[pair].num_inliers
        assert (states[pair].tried, states[pair].learned_level) == (1, 1)


def test_step_takes_matches_that_are_kept_and_matches_nothing_anew(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = escalation_of(context)
    (pair, *_) = escalation.image_set.pairs
    without_matches(escalation, pair)
    (kept,) = context.matches.learned([pair]).values()
    monkeypatch.setattr("colmap_affrect.escalation.escalate.matched_at_level", None)
    escalation.match_at([pair], 1)
    state = escalation.image_set.states()[pair]
    assert (state.level, state.num_inliers, state.tried) == (1, kept.worth[0], 0b11)
    assert (state.measured_worth, state.learned_level) == ((0, 0), 1)


def without_matches(escalation: Escalation, pair: tuple[str, str]) -> None:
    (there,) = escalation.matches.read([pair])
    none = replace(there, indices=there.indices[:0], scores=there.scores[:0])
    escalation.matches.write([none])
    escalation.write()


def stored_matches(context: Context, pair: tuple[str, str]) -> Indices:
    """Return the (M, 2) raw matches of a pair in the database."""
    ids = image_ids(context.workspace.database)
    first, second = pair
    with open_database(context.workspace.database) as database:
        return database.read_matches(ids[first], ids[second])


def test_better_learned_models_are_chosen_and_are_what_the_database_holds(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = escalation_of(context)
    there = replace(UNSURE, probabilities=dict.fromkeys(NAMES, 0.55))
    better = replace(UNSURE, probabilities=dict.fromkeys(NAMES, 0.6))
    asked = with_models(monkeypatch, found=better, there=[there])
    learned = context.matches.learned(list(escalation.image_set.pairs))
    before = escalation.image_set.states()
    map_learned_matches(escalation, mapper)
    assert len(asked) == 1
    assert not choose_learned(
        escalation, at_once=True
    )  # more may be tried without them
    assert levels(context) == {0}
    assert choose_learned(escalation, at_once=False)
    learned_models = learned_models_on_record(context)
    assert learned_models
    assert (learned_models.score, learned_models.score_without) == pytest.approx(
        (1.4, 1.2)
    )
    assert learned_models.is_chosen
    assert num_right_poses_now(context) == learned_models.score
    assert (
        context.matches.state.modelled == context.matches.state.listed
    )  # are gone on from
    assert context.matches.state.follows == ""
    assert context.workspace.model_inputs() == context.current_model_inputs()
    assert levels(context) == {1}
    for pair, kept in learned.items():
        assert_array_equal(stored_matches(context, pair), kept.matches.indices)
    for pair, state in escalation.image_set.states().items():
        assert state.measured_worth == before[pair].worth
    assert not choose_learned(escalation, at_once=False)  # that is decided


def test_better_learned_models_are_gone_on_from_where_most_poses_are_expected_to_be_right(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where they are not sure of all photographs: what else is tried mends the rest."""
    there = replace(UNSURE, probabilities=dict.fromkeys(NAMES, 0.6))
    better = replace(UNSURE, probabilities=dict.fromkeys(NAMES, 0.7))
    with_models(monkeypatch, found=better, there=[there])
    map_learned_matches(escalation_of(context), mapper)
    assert choose_learned(escalation_of(context), at_once=True)
    assert levels(context) == {1}


def test_any_learned_model_is_chosen_at_once_where_there_is_none(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_models(monkeypatch, found=UNSURE, there=())
    map_learned_matches(escalation_of(context), mapper)
    assert choose_learned(escalation_of(context), at_once=True)


@pytest.mark.parametrize(("probability", "is_chosen"), [(0.45, True), (0.6, False)])
def test_better_learned_models_are_gone_on_from_where_no_pose_is_expected_to_be_right(
    context: Context,
    mapper: Mapper,
    monkeypatch: pytest.MonkeyPatch,
    probability: float,
    is_chosen: bool,
) -> None:
    there = replace(UNSURE, probabilities=dict.fromkeys(NAMES, probability))
    better = replace(UNSURE, probabilities=dict.fromkeys(NAMES, 0.62))
    with_models(monkeypatch, found=better, there=[there])
    map_learned_matches(escalation_of(context), mapper)
    assert choose_learned(escalation_of(context), at_once=True) == is_chosen


def test_learned_models_that_are_no_better_change_nothing(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_models(monkeypatch, found=UNSURE, there=[UNSURE])
    before = database_content(context.workspace.database)
    map_learned_matches(escalation_of(context), mapper)
    assert not choose_learned(escalation_of(context), at_once=True)
    assert not choose_learned(escalation_of(context), at_once=False)
    assert levels(context) == {0}
    assert database_content(context.workspace.database) == before


def test_score_counts_poses_that_are_expected_to_be_right() -> None:
    pair = replace(UNSURE, probabilities={"a": 0.9, "b": 0.9})
    three = replace(UNSURE, probabilities={"a": 0.9, "b": 0.9, "c": 0.9})
    assert num_right_poses([]) == 0.0
    assert num_right_poses([pair]) == pytest.approx(0.8)
    assert num_right_poses([three]) == pytest.approx(1.7)
    assert num_right_poses([pair, pair]) < num_right_poses([three])
    assert num_right_poses([replace(UNSURE, probabilities={"a": 0.2, "b": 0.2})]) == 0.0


@pytest.fixture(scope="module")
def mapped(matched: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    workspace = copy_of(matched, tmp_path_factory.mktemp("mapped") / "out")
    map_images(Context(workspace), MAPPERS.make(MAPPERS.options("sparse")))
    return workspace


def made_worse(workspace: Workspace, mapper: Mapper) -> Escalation:
    """Keep the models, take the matches of a photograph away, and map again.

    Images get more features meanwhile.
    """
    context = Context(workspace)
    escalation = escalation_of(context)
    keep_best(context)
    more = context.features.read(NAMES[1]).select(np.arange(7))
    context.features.extend(NAMES[1], more, 2)
    for pair in escalation.image_set.pairs:
        if NAMES[0] in pair:
            (there,) = escalation.matches.read([pair])
            none = replace(
                there, indices=there.indices[:0], scores=there.scores[:0], level=1
            )
            escalation.matches.write([none])
    escalation.write()
    map_images(context, mapper)
    assert num_right_poses_now(context) < num_right_poses_of_best(context)
    return escalation


def assert_same_with_all_keypoints(
    workspace: Workspace, old: pycolmap.Reconstruction
) -> None:
    """The largest model has the points that it had, and the keypoints of the database."""
    model = pycolmap.Reconstruction(workspace.sparse / "0")
    assert model.num_points3D() == old.num_points3D()
    for image in model.images.values():
        with open_database(workspace.database) as database:
            keypoints = database.read_keypoints(image.image_id)
        assert_array_equal([point.xy for point in image.points2D], keypoints[:, :2])
        was = old.images[image.image_id]
        ids = [point.point3D_id for point in image.points2D]
        ids_before = [point.point3D_id for point in was.points2D]
        assert ids[: len(ids_before)] == ids_before
        assert image.num_points3D == was.num_points3D


def test_best_models_and_their_matches_come_back(
    mapped: Workspace, mapper: Mapper, tmp_path: Path
) -> None:
    workspace = copy_of(mapped, tmp_path / "out")
    summaries = read_summaries(workspace.sparse)
    before = database_content(workspace.database)
    old = pycolmap.Reconstruction(workspace.sparse / "0")
    escalation = made_worse(workspace, mapper)
    context = escalation.context
    keep_best(context)  # worse ones take no place
    assert restore_best(escalation)
    assert read_summaries(workspace.sparse) == summaries
    after = database_content(workspace.database)
    assert after.keys() == before.keys()
    for table in before.keys() - {"keypoints"}:
        assert after[table] == before[table]
    assert levels(context) == {0}
    assert_same_with_all_keypoints(workspace, old)
    tried = context.matches.levels(escalation.image_set.pairs, "tried")
    assert {levels for pair, levels in tried.items() if NAMES[0] in pair} == {0b11}
    assert (
        map_images(context, mapper, begins_with_models=True)[0].num_done == 0
    )  # nothing is mapped anew
    assert not restore_best(escalation)
    remove_alternatives(context)
    assert num_right_poses_of_best(context) == 0.0
    assert not workspace.best.exists()


@pytest.mark.parametrize("where", ["guide", "_replaced"])
def test_run_killed_while_it_goes_back_does_so_afterwards(
    mapped: Workspace,
    mapper: Mapper,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
) -> None:
    workspace = copy_of(mapped, tmp_path / "out")
    summaries = read_summaries(workspace.sparse)
    content = database_content(workspace.database)
    before = {table: rows for table, rows in content.items() if table != "keypoints"}
    escalation = made_worse(workspace, mapper)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(alternatives, where, killed)
        with pytest.raises(KeyboardInterrupt):
            restore_best(escalation)
    assert escalation.matches.state.follows
    adopt_chosen_models(escalation)
    assert not escalation.matches.state.follows
    assert read_summaries(workspace.sparse) == summaries
    after = database_content(workspace.database)
    assert {k: v for k, v in after.items() if k != "keypoints"} == before


def test_models_of_other_pairs_than_the_verified_ones_are_not_kept(
    mapped: Workspace, tmp_path: Path
) -> None:
    context = Context(copy_of(mapped, tmp_path / "out"))
    without_matches(escalation_of(context), escalation_of(context).image_set.pairs[0])
    keep_best(context)
    assert not context.workspace.best.exists()


def test_what_was_looked_at_is_of_the_listed_pairs_and_of_what_is_said_by_hand(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_models(monkeypatch, found=UNSURE, there=[UNSURE])
    map_learned_matches(escalation_of(context), mapper)
    assert learned_models_on_record(context)
    assert not learned_models_on_record(
        replace(context, by_hand=ByHand(left_out=(NAMES[0],)))
    )
    context.matches.update_state(listed="another list")
    assert not learned_models_on_record(context)


def test_images_that_are_left_out_need_nothing_and_are_no_lack(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = NAMES[1:]
    found = replace(
        UNSURE, registered_names=others, probabilities=dict.fromkeys(others, 0.8)
    )
    with_models(monkeypatch, found=found, there=[UNSURE])
    said = replace(context, by_hand=ByHand(left_out=(NAMES[0],)))
    assert NAMES[0] not in escalation_of(said).image_set.weights([UNSURE])
    map_learned_matches(escalation_of(said), mapper)
    learned_models = learned_models_on_record(said)
    assert learned_models
    assert learned_models.is_of_most


def without_learned_matches(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> Escalation:
    """Return an escalation of photographs that all need something, none of it tried."""
    monkeypatch.setattr(ImageSet, "weights", lambda *_: dict.fromkeys(NAMES, 1.0))
    escalation = escalation_of(context)
    context.matches.remove(pairs=list(escalation.image_set.pairs))
    match(context)
    escalation.write()
    return escalation


def test_learning_that_was_killed_goes_on_with_the_same_pairs(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images may have got features: what is needed would look different."""
    escalation = escalation_of(context)
    pairs = list(escalation.image_set.pairs)
    context.matches.update_state(learned_matching=None)
    monkeypatch.setattr(ImageSet, "weights", lambda *_: dict.fromkeys(NAMES, 1.0))
    assert not escalation.plan_learned_matching()  # all have learned matches
    escalation = without_learned_matches(context, monkeypatch)
    assert escalation.plan_learned_matching()
    monkeypatch.setattr(ImageSet, "weights", lambda *_: {})
    assert escalation.plan_learned_matching()
    assert not escalation.has_all_learned_matches
    monkeypatch.setattr(Escalation, "is_over_time", True)
    assert escalation.match_learned() == 0
    monkeypatch.setattr(Escalation, "is_over_time", False)
    assert escalation.match_learned() == len(pairs)
    assert escalation.has_all_learned_matches


def test_weights_that_are_installed_after_steps_bring_learned_matching(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = without_learned_matches(context, monkeypatch)
    with monkeypatch.context() as patch:
        patch.setattr(Resources, "usable_levels", lambda *_: [0])
        assert not escalation.plan_learned_matching()
        escalation.match_at(list(escalation.image_set.pairs)[:1], 1)
    assert escalation.plan_learned_matching()


def test_steps_that_were_taken_without_learned_matching_go_on_without_it(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = without_learned_matches(context, monkeypatch)
    escalation.match_at(list(escalation.image_set.pairs)[:1], 1)
    assert not escalation.plan_learned_matching()


def test_learned_matching_that_a_set_was_gone_on_without_is_left_out_later_too(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a run that was killed would decide otherwise than one that goes through."""
    escalation = without_learned_matches(context, monkeypatch)
    with monkeypatch.context() as patch:
        patch.setattr(image_set, "_gains", lambda names, _: dict.fromkeys(names, 0.0))
        assert not escalation.plan_learned_matching()
    assert not escalation.plan_learned_matching()
    high = escalation_of(replace(context, effort="high"))
    assert high.plan_learned_matching()
    context.matches.update_state(learned_matching=None)
    said = replace(context, by_hand=ByHand(left_out=(NAMES[0],)))
    assert escalation_of(said).plan_learned_matching()


def test_matches_of_pairs_that_are_removed_take_learned_ones_along(
    context: Context,
) -> None:
    pairs = list(escalation_of(context).image_set.pairs)
    context.matches.update_state(learned_models=LearnedModels("set", 1.0, 0.5))
    context.matches.remove(pairs=pairs[:1])
    assert not context.matches.has(pairs).any()
    assert context.matches.state.learned_models is None
    assert context.matches.state.learned_matching is None


@pytest.mark.long
def test_rematching_with_learned_matches_ends_and_does_nothing_when_run_again(
    photos: Path,
    recipe: Recipe,
    mapper: Mapper,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also the copy of the workspace is mapped here."""
    weights = ImageSet.weights

    def unsure(state: ImageSet, models: Sequence[ModelSummary]) -> dict[str, float]:
        return weights(state, models) or dict.fromkeys(NAMES, 1e-3)

    monkeypatch.setattr(ImageSet, "weights", unsure)
    monkeypatch.setattr(image_set, "_gains", lambda names, _: dict.fromkeys(names, 1.0))
    monkeypatch.setattr(map_and_rematch, "has_models_to_go_on_from", lambda _: False)
    workspace = verified(photos, tmp_path / "out", recipe.name)
    context = Context(workspace)
    with workspace.locked():
        reports = map_and_rematch.map_and_rematch(context, mapper, recipe)
        assert reports[-1].num_done == len(escalation_of(context).image_set.pairs)
        learned_models = learned_models_on_record(context)
        assert learned_models
        assert learned_models.score > 1.0
        before = hdf5_content(workspace.matches), database_content(workspace.database)
        model = (workspace.sparse / "0" / "images.bin").stat().st_mtime_ns
        again = map_and_rematch.map_and_rematch(context, mapper, recipe)
    assert {report.num_done for report in again} == {0}
    assert (
        hdf5_content(workspace.matches),
        database_content(workspace.database),
    ) == before
    assert (workspace.sparse / "0" / "images.bin").stat().st_mtime_ns == model
    assert not workspace.best.exists()
    done = escalation_summary(context)
    assert done.effort == "normal"
    assert [(one.kind, one.num_pairs) for one in done.matched_again] == [("learned", 6)]


@pytest.mark.long
def test_chosen_models_are_those_that_were_looked_at_also_when_killed_after_the_choice(
    matched: Workspace, recipe: Recipe, mapper: Mapper, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Mapping their matches a second time might end elsewhere."""
    spaces = [copy_of(matched, tmp_path / name) for name in ("whole", "killed")]
    monkeypatch.setattr(LearnedModels, "is_enough", True)
    monkeypatch.setattr(map_and_rematch, "has_models_to_go_on_from", lambda _: False)
    monkeypatch.setattr(ImageSet, "weights", lambda *_: {NAMES[0]: 1.0})
    monkeypatch.setattr(Escalation, "next_step", lambda *_, **__: None)
    whole, killed = (Context(space) for space in spaces)
    map_and_rematch.map_and_rematch(whole, mapper, recipe)
    with monkeypatch.context() as patch:
        patch.setattr(Escalation, "write", interrupted_at_third_call())
        with pytest.raises(KeyboardInterrupt):
            map_and_rematch.map_and_rematch(killed, mapper, recipe)
    learned_models = read_summaries(killed.workspace.learned)
    monkeypatch.setattr(alternatives, "map_images", None)
    map_and_rematch.map_and_rematch(killed, mapper, recipe)
    for context in (whole, killed):
        assert levels(context) == {1}
        assert read_summaries(context.workspace.sparse) == learned_models
        assert not context.workspace.learned.exists()
        assert map_images(context, mapper, begins_with_models=True)[0].num_done == 0
        model = pycolmap.Reconstruction(context.workspace.sparse / "0")
        with open_database(context.workspace.database) as database:
            for image in model.images.values():
                assert image.num_points2D() == len(
                    database.read_keypoints(image.image_id)
                )
    contents = [database_content(space.database) for space in spaces]
    assert contents[0] == contents[1]


@pytest.mark.long
def test_models_of_learned_matches_that_were_removed_are_made_again(
    mapped: Workspace, mapper: Mapper, tmp_path: Path
) -> None:
    context = Context(copy_of(mapped, tmp_path / "out"))
    assert needs_learned_models(context)
    map_learned_matches(escalation_of(context), mapper)
    learned_models = learned_models_on_record(context)
    assert learned_models
    remove_alternatives(context)
    assert needs_learned_models(context) == (
        learned_models.score > num_right_poses_now(context)
    )
    shutil.rmtree(context.workspace.sparse)
    assert not choose_learned(escalation_of(context), at_once=False)
    assert needs_learned_models(context)


def interrupted_at_third_call() -> Callable[[Escalation], None]:
    written = Escalation.write
    calls = list[int]()

    def write(escalation: Escalation) -> None:
        calls.append(1)
        if len(calls) == 3:  # after those of begin and learn
            raise KeyboardInterrupt
        written(escalation)

    return write


def test_an_edited_score_of_the_best_models_does_not_count(tmp_path: Path) -> None:
    context = Mock()
    context.workspace.best = tmp_path
    context.set_digest.return_value = "set"
    kept = {"of_set": "set", "num_right_poses": 2.5}
    write_sealed(tmp_path / SCORE, json.dumps(kept))
    assert num_right_poses_of_best(context) == 2.5
    text = (tmp_path / SCORE).read_text(encoding="utf-8")
    for edited in ("1e9", "NaN", "Infinity", '"x"', "[]"):
        (tmp_path / SCORE).write_text(text.replace("2.5", edited), encoding="utf-8")
        assert num_right_poses_of_best(context) == 0.0
    context.set_digest.return_value = "another set"
    write_sealed(tmp_path / SCORE, json.dumps(kept))
    assert num_right_poses_of_best(context) == 0.0
