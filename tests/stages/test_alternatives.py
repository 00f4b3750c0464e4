"""Models of one kind of matches alone, beside those of the best matches of each pair."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from numpy.testing import assert_array_equal
from results import database_content
from small_scene import NAMES
from verified import copy_of, verified

from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.features.base import EXTRACTORS
from colmap_affrect.mappers.base import MAPPERS, Mapper
from colmap_affrect.mappers.mapping import read_summaries
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.stores import (
    CLIMBING,
    FINISHED,
    LEARNED,
    MEASURED,
    SCORES,
    Alternative,
)
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe, load_recipe
from colmap_affrect.stages import alternatives, climb
from colmap_affrect.stages.alternatives import (
    Choice,
    Scores,
    choose_kind,
    look_at_learned,
    score,
)
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import Escalation, begin
from colmap_affrect.stages.expected_gain import Step

RECIPE = """
[rectifier]
name = "identity"
[[escalation]]
features = { name = "shapeless", max_num_features = 900 }
"""
UNSURE = ModelSummary(NAMES[:2], 50, 2.0, 0.5, probabilities=dict.fromkeys(NAMES[:2], 0.6))


@pytest.fixture(scope="module", autouse=True)
def _shapeless() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EXTRACTORS.built_in, "shapeless", "shapeless_features:Shapeless")
        yield


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    path = tmp_path_factory.mktemp("recipe") / "recipe.toml"
    path.write_text(RECIPE)
    return load_recipe(str(path))


@pytest.fixture(scope="module")
def matched(photos: Path, recipe: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """All pairs were matched by both kinds; the learned ones have fewer features."""
    workspace = verified(photos, tmp_path_factory.mktemp("matched") / "out", recipe.name)
    escalation, _ = begin(Context(workspace), recipe.escalate)
    escalation.learn(Step(1, escalation.pairs))
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
    return set(context.matches.levels(escalation_of(context).pairs).values())


def with_models(monkeypatch: pytest.MonkeyPatch, *, found: ModelSummary) -> list[Choice]:
    """Say what models are there, and what a copy gives; return the choices that are mapped."""
    asked = list[Choice]()

    def models_of(_: Context, __: Mapper, choice: Choice) -> list[ModelSummary]:
        asked.append(choice)
        return [found]

    monkeypatch.setattr(alternatives, "_models_of", models_of)
    monkeypatch.setattr(alternatives, "read_summaries", lambda _: [UNSURE])
    return asked


def test_learned_matches_are_kept_beside_those_that_are_there(context: Context) -> None:
    pairs = escalation_of(context).pairs
    others = context.matches.alternatives(list(pairs), LEARNED)
    assert levels(context) == {0}
    assert set(others) == set(pairs)
    assert not context.matches.alternatives(list(pairs), MEASURED)
    states = escalation_of(context).states()
    for pair, other in others.items():
        assert other.matches.level == 1
        assert other.matches.names == pair
        assert 0 < other.worth[0] < states[pair].num_inliers
        assert (states[pair].tried, states[pair].learned_level) == (1, 1)


def test_step_takes_matches_that_are_kept_and_matches_nothing_anew(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = escalation_of(context)
    (pair, *_) = escalation.pairs
    (there,) = context.matches.read([pair])
    none = replace(there, indices=there.indices[:0], scores=there.scores[:0])
    context.matches.write([none])
    escalation.write()
    (other,) = context.matches.alternatives([pair], LEARNED).values()
    monkeypatch.setattr("colmap_affrect.stages.escalate.matched_at_level", None)
    escalation.match_at([pair], 1)
    state = escalation.states()[pair]
    assert (state.level, state.num_inliers, state.tried) == (1, other.worth[0], 0b11)
    assert (state.measured_worth, state.learned_level) == ((0, 0), 1)
    (measured,) = context.matches.alternatives([pair], MEASURED).values()
    assert len(measured.matches.indices) == 0


def test_better_learned_models_are_chosen_and_are_what_the_database_holds(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = escalation_of(context)
    better = replace(UNSURE, probabilities=dict.fromkeys(NAMES[:2], 0.9))
    asked = with_models(monkeypatch, found=better)
    others = context.matches.alternatives(list(escalation.pairs), LEARNED)
    context.matches.keep_note(CLIMBING, context.matches.note(FINISHED))
    look_at_learned(escalation, mapper)
    assert len(asked) == 1
    assert not choose_kind(escalation, at_once=True)  # more may be tried without them
    assert levels(context) == {0}
    assert choose_kind(escalation, at_once=False)
    scores = Scores.of(context)
    assert scores
    assert scores.by_kind == pytest.approx({MEASURED: 0.2, LEARNED: 0.8})
    assert scores.chosen == LEARNED
    assert context.matches.note(CLIMBING) is None  # models that are there are not gone on from
    assert levels(context) == {1}
    ids = image_ids(context.workspace.database)
    with open_database(context.workspace.database) as database:
        for pair, other in others.items():
            stored = database.read_matches(*(ids[name] for name in pair))
            assert_array_equal(stored, other.matches.indices)
    measured = context.matches.alternatives(list(escalation.pairs), MEASURED)
    assert {other.matches.level for other in measured.values()} == {0}
    assert not choose_kind(escalation, at_once=False)  # that is decided


def test_learned_models_that_are_sure_of_all_are_chosen_at_once(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    sure = replace(UNSURE, registered_names=NAMES, probabilities=dict.fromkeys(NAMES, 0.95))
    with_models(monkeypatch, found=sure)
    look_at_learned(escalation_of(context), mapper)
    assert choose_kind(escalation_of(context), at_once=True)
    assert levels(context) == {1}


def test_any_learned_model_is_chosen_at_once_where_there_is_none(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_models(monkeypatch, found=UNSURE)
    monkeypatch.setattr(alternatives, "read_summaries", lambda _: [])
    look_at_learned(escalation_of(context), mapper)
    assert choose_kind(escalation_of(context), at_once=True)


def test_learned_models_that_are_no_better_change_nothing(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_models(monkeypatch, found=UNSURE)
    before = database_content(context.workspace.database)
    look_at_learned(escalation_of(context), mapper)
    assert not choose_kind(escalation_of(context), at_once=True)
    assert not choose_kind(escalation_of(context), at_once=False)
    assert levels(context) == {0}
    assert database_content(context.workspace.database) == before


def test_measured_matches_alone_come_back_where_models_were_better_before(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = escalation_of(context)
    pairs = list(escalation.pairs)
    before = {found.names: found for found in context.matches.read(pairs)}
    others = context.matches.alternatives(pairs, LEARNED)
    escalation.matches.choose(
        [others[pair].matches for pair in pairs[:2]],
        [Alternative(MEASURED, before[pair], (100, 0)) for pair in pairs[:2]],
    )
    escalation.write()
    assert levels(context) == {0, 1}
    with_models(monkeypatch, found=UNSURE)
    context.matches.keep_note(SCORES, asdict(Scores({MEASURED: 0.5, LEARNED: 0.3})))
    assert choose_kind(escalation, at_once=False)
    assert levels(context) == {0}
    for found in context.matches.read(pairs):
        assert_array_equal(found.indices, before[found.names].indices)


def test_score_counts_poses_that_are_expected_to_be_right() -> None:
    pair = replace(UNSURE, probabilities={"a": 0.9, "b": 0.9})
    three = replace(UNSURE, probabilities={"a": 0.9, "b": 0.9, "c": 0.9})
    assert score([]) == 0.0
    assert score([pair]) == pytest.approx(0.8)
    assert score([three]) == pytest.approx(1.7)
    assert score([pair, pair]) < score([three])
    assert score([replace(UNSURE, probabilities={"a": 0.2, "b": 0.2})]) == 0.0


@pytest.mark.long
def test_run_killed_after_the_choice_maps_the_chosen_matches(
    matched: Workspace, recipe: Recipe, mapper: Mapper, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Not from the models of before: they are of other matches."""
    spaces = [copy_of(matched, tmp_path / name) for name in ("whole", "killed")]
    surest = replace(UNSURE, probabilities=dict.fromkeys("abcdefgh", 1.0))
    monkeypatch.setattr(alternatives, "_models_of", lambda *_: [surest])
    monkeypatch.setattr(Escalation, "needs", lambda *_: {NAMES[0]: 1.0})
    monkeypatch.setattr(Escalation, "next_step", lambda _: None)
    whole, killed = (Context(space) for space in spaces)
    climb.climb(whole, mapper, recipe)
    with monkeypatch.context() as patch:
        patch.setattr(Escalation, "write", interrupted_at_second_call())
        with pytest.raises(KeyboardInterrupt):
            climb.climb(killed, mapper, recipe)
    goes_on = list[bool]()
    map_images = climb.map_images

    def watched(context: Context, mapper: Mapper, **how: bool) -> object:
        goes_on.append(how.get("goes_on", False))
        return map_images(context, mapper, **how)

    monkeypatch.setattr(climb, "map_images", watched)
    climb.climb(killed, mapper, recipe)
    assert goes_on[0] is False
    for context in (whole, killed):
        assert levels(context) == {1}
    contents = [database_content(space.database) for space in spaces]
    assert contents[0] == contents[1]
    models = [read_summaries(space.sparse) for space in spaces]
    assert models[0] == models[1]


def interrupted_at_second_call() -> Callable[[Escalation], None]:
    written = Escalation.write
    calls = list[int]()

    def write(escalation: Escalation) -> None:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        written(escalation)

    return write
